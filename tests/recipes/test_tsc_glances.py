"""Images are collected by one recipe and learned from by another; the student goes on from there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from agility_rl.deploy.artifact import Artifact
from agility_rl.envs import COURSES
from agility_rl.modules import RecurrentStudent

Module = Callable[[str], ModuleType]


@pytest.fixture
def student(module: Module, untrained: Path, untrained_teacher: Path, tmp_path: Path) -> Any:
    """A run of a tiny student."""
    recipe = module("tsc_student")
    cfg = recipe.PRESETS["smoke"]
    cfg = replace(cfg, env=replace(cfg.env, num_threads=1), runs=tmp_path, teacher=untrained_teacher, bbc=untrained)
    return replace(cfg, iterations=1, byol=False, name="student")


@pytest.fixture
def images(module: Module, student: Any, tmp_path: Path) -> Path:
    """A folder of images of four robots."""
    recipe = module("tsc_images")
    run = module("tsc_student").train(student)
    options = {"student": run, "teacher": student.teacher, "bbc": student.bbc, "runs": tmp_path}
    return recipe.main(recipe.Config(**options, windows=1, num_robots=4))


@pytest.fixture
def wider(student: Any, tmp_path: Path) -> Path:
    """The student's course between walls that stand elsewhere, and taller."""
    course = COURSES[student.env.course or Artifact.load(student.teacher / "policy", kind="teacher").manifest["course"]]
    slots = "".join(
        f'[[slots]]\nobstacle = "{slot.obstacle}"\nposition = {list(slot.position)}\n'
        f"yaw_degrees = {math.degrees(slot.yaw)}\n"
        for slot in course.slots
    )
    path = tmp_path / "wider.toml"
    size = [side + 1.5 for side in course.size]
    path.write_text(f'name = "wider"\nsize = {size}\nwall_height = [3.0, 5.0]\n{slots}', encoding="utf-8")
    return path


def test_images_between_other_walls(module: Module, images: Path, student: Any, wider: Path, tmp_path: Path) -> None:
    recipe = module("tsc_images")
    options = {"student": tmp_path / "student", "teacher": student.teacher, "bbc": student.bbc, "runs": tmp_path}
    other = recipe.main(recipe.Config(**options, course=str(wider), name="other", windows=1, num_robots=4))
    here, there = (load_file(folder / "images.safetensors")["depth"][:, :, 0] for folder in (images, other))
    sky, walls = ((upper == 255).float().mean() for upper in (here, there))
    assert walls < sky - 0.05  # walls where the sky was


def test_images_of_short_episodes_show_where_they_start(
    module: Module, images: Path, student: Any, tmp_path: Path
) -> None:
    recipe = module("tsc_images")
    options = {"student": tmp_path / "student", "teacher": student.teacher, "bbc": student.bbc, "runs": tmp_path}
    short = recipe.main(recipe.Config(**options, episode_length=0.4, led=1.0, name="short", windows=1, num_robots=4))
    along = load_file(short / "images.safetensors")["place"][..., 4]  # [m] from the bar, whose way begins 1.8 m before
    assert ((along[::10] > -2.01) & (along[::10] < -1.79)).all()  # ten decisions each
    assert not torch.equal(along[0], along[10])


@pytest.mark.parametrize("own", [False, True])
def test_a_student_walks_as_it_is_whatever_its_teacher_is_now(
    module: Module, student: Any, make_student: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, own: bool
) -> None:
    recipe, built = module("tsc_images"), []
    monkeypatch.setattr(recipe, "build", lambda *given, build=recipe.build: built.append(build(*given)) or built[-1])
    path = make_student("walker", own_estimator=own)
    learned = Artifact.load(path)
    parts = ("actor.", "history_encoder.", "estimator.")  # practice changes the first two
    changed = {name: value + float(name.startswith(parts)) for name, value in learned.state.items()}
    Artifact.save(learned.folder, changed, learned.manifest)
    options = {"student": path, "teacher": student.teacher, "bbc": student.bbc, "runs": student.runs}
    recipe.main(recipe.Config(**options, windows=1, num_robots=2))
    walked = built[0].student.state_dict()
    assert all(torch.equal(walked[name], value) for name, value in changed.items())


def options_of(folder: Path, **others: Any) -> dict[str, Any]:
    given = {"images": (folder / "images",), "student": folder / "student", "runs": folder, "batch": 8}
    return given | {"minutes": 0.002} | others


def test_images_with_what_they_should_tell(images: Path) -> None:
    rows = load_file(images / "images.safetensors")
    assert rows["depth"].shape == (48, 4, 58, 87) and rows["depth"].dtype == torch.uint8
    assert len(rows["depth"].flatten(0, 1).flatten(1).unique(dim=0)) > 100
    assert rows["terrain_latent"].shape == (48, 4, 32) and rows["place"].shape == (48, 4, 8)
    assert rows["obstacle"].shape == rows["progress"].shape == (48, 4)


def test_glances_move_what_sees_and_nothing_else(
    module: Module, images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = module("tsc_glances")
    run = recipe.main(recipe.Config(**options_of(images.parent)))
    before, after = (Artifact.load(folder / "policy", kind="student") for folder in (images.parent / "student", run))
    moved = {name.split(".")[0] for name in after.state if not torch.equal(after.state[name], before.state[name])}
    assert moved == {"depth_encoder", "memory"}
    seeing = ("depth_encoder.", "memory.glance.")
    assert all(torch.equal(after.state[n], before.state[n]) for n in after.state if not n.startswith(seeing))
    out = capsys.readouterr().out
    assert "144 images to learn from, 48 held out" in out and "before; held out: error_latent" in out
    same = ("teacher", "bbc", "course", "camera", "control_period", "network")
    assert all(after.manifest[name] == before.manifest[name] for name in same)
    artifacts = module("tsc_artifacts")
    assert artifacts.trained_bbc(artifacts.load_trained(run)).is_dir(), "its own run says of no controller"


def test_robots_that_are_held_out_are_led_and_not(module: Module, images: Path) -> None:
    recipe = module("tsc_glances")
    cfg = recipe.Config(**(options_of(images.parent) | {"held_out": 0.5}))
    train, test = recipe.load_images(cfg, torch.device("cpu"))
    depth = load_file(images / "images.safetensors")["depth"]
    for rows, robots in ((train, [0, 2]), (test, [1, 3])):
        assert torch.equal(rows["depth"], depth[:, robots].flatten(0, 1))


def test_an_encoder_of_other_sizes_keeps_the_rest(module: Module, images: Path, student: Any) -> None:
    recipe = module("tsc_glances")
    other = {"encoder_channels": (4, 6, 8), "encoder_features": 12}
    run = recipe.main(recipe.Config(**options_of(images.parent, **other)))
    artifact = Artifact.load(run / "policy", kind="student")
    before = Artifact.load(images.parent / "student" / "policy").state
    assert artifact.manifest["network"]["encoder_channels"] == [4, 6, 8]
    network = RecurrentStudent(**artifact.manifest["network"])
    artifact.fill(network)
    for name in ("memory.cell.weight_hh", "actor.module.0.module.trunk.layers.0.weight", "memory.fusion.2.weight"):
        assert torch.equal(artifact.state[name], before[name]), name
    assert artifact.state["memory.fusion.0.weight"].shape[1] == before["memory.fusion.0.weight"].shape[1] + 4
    goes_on = replace(student, init_from=run, name="goes_on", **other, glance=replace(student.glance, steps=1))
    assert (module("tsc_student").train(goes_on) / "policy" / "manifest.json").is_file()


def test_other_layers_that_read_places_keep_the_encoder(module: Module, images: Path) -> None:
    recipe = module("tsc_glances")
    run = recipe.main(recipe.Config(**options_of(images.parent, glance_hidden=(6, 5), learning_rate=1e-9)))
    artifact = Artifact.load(run / "policy", kind="student")
    before = Artifact.load(images.parent / "student" / "policy").state
    assert artifact.manifest["network"]["glance_hidden"] == [6, 5]
    assert artifact.state["memory.glance.correction.2.weight"].shape == (5, 6)
    for name in (name for name in before if not name.startswith("memory.glance.correction.")):
        torch.testing.assert_close(artifact.state[name], before[name], atol=1e-6, rtol=0)


def test_options_that_cannot_be(module: Module, images: Path) -> None:
    recipe, collect = module("tsc_glances"), module("tsc_images")
    for others, message in (
        ({"images": ()}, "--images: expected one folder"),
        ({"held_out": 1.0}, r"--held-out: expected a share within \(0, 1\), got 1.0"),
        ({"batch": 0}, "--batch and --reports of at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            recipe.main(recipe.Config(**options_of(images.parent, **others)))
    with pytest.raises(FileNotFoundError, match=r"student/images.safetensors: no such file; expected a folder that"):
        recipe.main(recipe.Config(**options_of(images.parent, images=(images.parent / "student",))))
    nowhere = {"student": images.parent / "nowhere", "runs": images.parent, "name": "free"}
    with pytest.raises(FileNotFoundError, match="check the path"):
        collect.main(collect.Config(**nowhere))
    assert not (images.parent / "free").exists(), "the name stays free"
    for others, message in (({"led": 1.5}, "--led: expected a share"), ({"minutes": 0.0}, "--minutes above 0")):
        with pytest.raises(ValueError, match=message):
            collect.main(collect.Config(**others))
