"""The recipe of stage 4 on a few robots, called in this process: a start of Python costs more than the run."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.deploy.artifact import Artifact
from agility_rl.deploy.task import describe_camera
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import camera
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.planar import inverted, moved
from agility_rl.record.mcap_logger import read_scalars

Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("tsc_student")


@pytest.fixture
def smoke(recipe: ModuleType, untrained: Path, untrained_teacher: Path, tmp_path: Path) -> Any:
    cfg = recipe.PRESETS["smoke"]
    env = replace(cfg.env, num_threads=1)
    return replace(cfg, runs=tmp_path, teacher=untrained_teacher, bbc=untrained, env=env, checkpoint_every=10)


def test_a_run_writes_a_student_and_what_it_saw(
    recipe: ModuleType, smoke: Any, untrained: Path, untrained_teacher: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = recipe.train(smoke)
    artifact = Artifact.load(run / "policy", kind="student")
    manifest = artifact.manifest
    assert manifest["control_period"] == pytest.approx(0.04) and manifest["course"] == "bar_jump"  # the teacher's
    assert manifest["teacher"] == Artifact.load(untrained_teacher / "policy").manifest["weights"]["sha256"]
    assert manifest["bbc"] == Artifact.load(untrained / "policy").manifest["weights"]["sha256"]
    assert manifest["camera"]["image"] == [58, 87] and manifest["camera"]["depth_range"] == [0.3, 4.0]
    assert manifest["camera"]["training"]["latency"] == [1, 1] and manifest["byol"] is True
    student = RecurrentStudent(**manifest["network"])
    student.load_state_dict(artifact.state)
    assert student.settings["solids"] == [kind.solids() for kind in OBSTACLES.values()]
    scalars = read_scalars(run)
    losses = ("behaviour", "parameters", "heading", "obstacle", "place", "latent", "byol")
    for name in (*(f"loss_{loss}" for loss in losses), "spread"):
        assert bool(scalars[name][1].isfinite().all()) and bool((scalars[name][1] > 0.0).all()), name
    for name in ("accuracy_behaviour", "accuracy_obstacle", "success/bar_jump", "use/trot", "time/collect"):
        assert bool(scalars[name][1].isfinite().all()), name
    assert "success/tunnel" not in scalars and scalars["pretrain/images"][1].tolist() == [6.0]
    assert "pre-training 1/1 on 6 images; 2 held out" in capsys.readouterr().out
    saved = json.loads((run / "config.json").read_text())["config"]
    assert saved["bbc"] == str(untrained) and saved["env"]["course"] == "bar_jump"


@pytest.mark.parametrize("steps", [0, 2], ids=["the imitation teaches the encoder", "glances do"])
def test_resume_equals_an_uninterrupted_run_bit_for_bit(recipe: ModuleType, smoke: Any, steps: int) -> None:
    smoke = replace(smoke, glance=replace(smoke.glance, steps=steps))
    whole = recipe.train(replace(smoke, name="whole", iterations=2))
    halves = recipe.train(replace(smoke, name="halves", iterations=1))
    recipe.train(replace(smoke, resume=halves, iterations=2))
    one, other = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in one if not torch.equal(one[name], other[name])]
    for name in ("loss_behaviour", "loss_byol", "reward", "use/jump", *(["glance/error_place"] if steps else [])):
        assert torch.equal(read_scalars(whole)[name][1], read_scalars(halves)[name][1]), name


def test_what_a_step_moves(recipe: ModuleType, module: Module, smoke: Any) -> None:
    """Imitation moves student and encoder, not the estimator; BYOL the encoder alone; the teacher nothing at all."""
    setup = module("tsc_student_setup")
    cfg = replace(smoke, imitation=replace(smoke.imitation, minibatches=1, latent=None))
    parts = setup.build(*setup.resolve(cfg))
    state = {name: value.clone() for name, value in parts.student.state_dict().items()}
    teacher = {name: value.clone() for name, value in parts.teacher.state_dict().items()}

    def moved() -> set[str]:
        new = parts.student.state_dict()
        changed = {name.split(".")[0] for name in state if not torch.equal(new[name], state[name])}
        state.update({name: value.clone() for name, value in new.items()})
        return changed

    window = parts.collector.collect()
    assert window["depth"].dtype == torch.uint8 and moved() == set()
    images = window["depth"].clone()
    recipe.imitate(parts, cfg, window, 0)
    assert moved() == {"depth_encoder", "memory", "actor", "history_encoder"}
    assert torch.equal(window["depth"], images), "augmentation is for the step, not for the window"
    recipe.represent_window(parts, cfg, window, 0)
    assert moved() == {"depth_encoder"}
    assert all(torch.equal(value, teacher[name]) for name, value in parts.teacher.state_dict().items())
    parts.env.close()


def test_glances_move_the_encoder_and_the_imitation_the_rest(recipe: ModuleType, module: Module, smoke: Any) -> None:
    setup = module("tsc_student_setup")
    own, glance = replace(smoke.imitation, minibatches=1), replace(smoke.glance, steps=1, every=2)
    cfg = replace(smoke, imitation=own, glance=glance)
    parts = setup.build(*setup.resolve(cfg))
    state = {name: value.clone() for name, value in parts.student.state_dict().items()}

    def moved() -> set[str]:
        new = parts.student.state_dict()
        changed = {".".join(name.split(".")[:2]) for name in state if not torch.equal(new[name], state[name])}
        state.update({name: value.clone() for name, value in new.items()})
        return changed

    window = parts.collector.collect()
    feature = parts.student.depth_encoder(window[0].select("depth"))["depth_feature"]
    torch.testing.assert_close(window["depth_feature"][0], feature)
    assert window["scan_match"].shape == (*window.shape, 21), "matched when it was seen, not with every pass"
    glances = module("glances")
    window["label", "terrain_latent"] = glances.known_terrain(parts.teacher, window)
    recipe.imitate(parts, cfg, window, 0)
    changed = moved()
    assert "memory.cell" in changed and "memory.head" in changed and "memory.glance" not in changed
    assert not any(name.startswith("depth_encoder") for name in changed)
    parts.glances.images.extend(glances.asked(window[::2], window["label", "terrain_latent"][::2]).flatten())
    assert len(parts.glances.images.rows) == 2 * 4
    parts.glances.learn(1, 0)
    assert moved() == {"depth_encoder.module", "memory.glance"}
    parts.env.close()


def test_only_the_newest_images_are_kept(module: Module) -> None:
    images = module("glances").Newest(5)
    assert images.state_dict() == {}
    for first in (0, 3):
        images.extend(TensorDict({"depth": torch.arange(first, first + 3)}, [3]))
    assert images.rows["depth"].tolist() == [1, 2, 3, 4, 5]
    other = module("glances").Newest(5)
    other.load_state_dict(images.state_dict())
    images.extend(TensorDict({"depth": torch.arange(6, 20)}, [14]))
    assert images.rows["depth"].tolist() == [15, 16, 17, 18, 19]
    other.load_state_dict(images.state_dict())
    one, two = (x.draw(20, torch.Generator().manual_seed(1))["depth"] for x in (images, other))
    assert torch.equal(one, two) and set(one.tolist()) <= {15, 16, 17, 18, 19}


def test_of_the_images_that_come_first_some_remain(recipe: ModuleType, module: Module, smoke: Any) -> None:
    setup, glances = module("tsc_student_setup"), module("glances")
    cfg = replace(smoke, glance=replace(smoke.glance, images=30, kept=5, epochs=2))
    parts = setup.build(*setup.resolve(cfg))
    newest = parts.glances.images
    metrics = glances.pretrain(parts.glances, parts.env, parts.teacher, cfg.glance, 8, None)
    assert metrics["pretrain/images"] == 3 * 8, "of four robots one is held out; eight decisions are 30 images or more"
    assert parts.glances.images is newest and len(newest.rows) == 5
    assert newest.rows["depth"].dtype == torch.uint8
    assert parts.glances.optimizer.param_groups[0]["lr"] < cfg.glance.pretrain_learning_rate / glances.ROUND
    parts.env.close()


def test_glances_of_the_same_images_lower_their_errors(recipe: ModuleType, module: Module, smoke: Any) -> None:
    setup = module("tsc_student_setup")
    nothing = replace(smoke.augmentation, rectangle=0.0, white_noise=0.0, dropout=0.0, blur=0.0)
    cfg = replace(smoke, augmentation=nothing, precision="float32", glance=replace(smoke.glance, steps=1))
    cfg = replace(cfg, glance_hidden=(128,))
    parts = setup.build(*setup.resolve(cfg))
    window, glances = parts.collector.collect(), module("glances")
    parts.glances.images.extend(glances.asked(window, glances.known_terrain(parts.teacher, window)).flatten())
    first, _, last = (parts.glances.learn(steps, 0) for steps in (20, 100, 20))
    for name in ("error_latent", "loss_obstacle"):
        assert last[f"glance/{name}"] < 0.8 * first[f"glance/{name}"], name
    assert last["glance/loss_place"] < first["glance/loss_place"] - 0.05  # a logarithm, by scales of some 0.2
    parts.env.close()


def test_a_glance_knows_how_sure_it_is(recipe: ModuleType, module: Module, smoke: Any) -> None:
    """The loss of the place is Laplace's negative log-likelihood, but for the logarithm of 2, times scale and lever.

    Who corrects by a constant is as far off as what was expected is, and that constant.
    """
    setup, glances = module("tsc_student_setup"), module("glances")
    parts = setup.build(*setup.resolve(replace(smoke, precision="float32")))
    correction, scale = torch.tensor([0.1, -0.2, 0.0, 0.05]), torch.tensor([0.4, 0.3, 0.15])
    with torch.no_grad():
        parts.glances.head.correction[-1].bias.copy_(torch.cat((correction, scale.log())))
    window = parts.collector.collect()
    sample = glances.asked(window, glances.known_terrain(parts.teacher, window)).flatten()
    before = parts.glances.generator.get_state()
    found = dict(zip(glances.ERRORS, parts.glances.errors(sample, window["depth"].flatten(0, 1).float()), strict=True))
    noise = torch.randn(len(sample), 3, generator=parts.glances.generator.set_state(before))
    truth = inverted(sample["place"][:, 4:])
    said = moved(truth, noise * torch.tensor([0.5, 0.5, 0.2])) + correction
    scale = torch.cat((scale, scale[2:]))
    density = torch.distributions.Laplace(said, scale).log_prob(truth) + math.log(2.0)
    torch.testing.assert_close(found["loss_place"], -(torch.tensor([1.0, 1.0, 3.0, 3.0]) * scale * density).mean())
    torch.testing.assert_close(found["error_place"], (truth - said).abs().mean())
    parts.env.close()


def test_imitation_of_one_window_lowers_its_loss(recipe: ModuleType, module: Module, smoke: Any) -> None:
    """On the full course: where there is one obstacle its type is known, and parameters are nearly right at once."""
    setup = module("tsc_student_setup")
    own = replace(smoke.imitation, minibatches=1, latent=None, augment=False, learning_rate=3e-3)
    sizes = {"memory": 64, "encoder_features": 32, "estimator_history": False}
    env = replace(smoke.env, course="full")
    cfg = replace(smoke, byol=False, precision="float32", imitation=own, env=env, seed=1, **sizes)
    parts = setup.build(*setup.resolve(cfg))
    window = parts.collector.collect()
    losses = [recipe.imitate(parts, cfg, window, 0) for _ in range(30)]
    first, last = losses[0], losses[-1]
    assert parts.representation is None
    for name in ("loss_behaviour", "loss_parameters", "loss_obstacle", "loss_progress"):
        assert last[name] < 0.75 * first[name], name
    parts.env.close()


def test_sixteen_bits_without_byol_from_another_student(recipe: ModuleType, smoke: Any) -> None:
    parent = recipe.train(replace(smoke, iterations=1))
    nothing = replace(smoke.glance, images=0)
    child = replace(smoke, name="child", init_from=parent, iterations=0, byol=False, bits=16, glance=nothing)
    one, other = (Artifact.load(run / "policy") for run in (parent, recipe.train(child)))
    assert all(torch.equal(other.state[name], value) for name, value in one.state.items())
    assert other.manifest["byol"] is False
    run = recipe.train(replace(child, name="sixteen", iterations=1))
    assert "loss_byol" not in read_scalars(run) and "loss_behaviour" in read_scalars(run)


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("actor", [False, True])
def test_a_student_of_another_teacher_takes_this_ones_parts_that_do_not_learn(
    recipe: ModuleType, smoke: Any, make_student: Callable[..., Path], own: bool, actor: bool
) -> None:
    """Its estimator, unless it has one of its own; without ``--imitation.actor`` actor and history encoder."""
    smoke = replace(smoke, estimator_history=own, imitation=replace(smoke.imitation, actor=actor))
    kept = ("estimator.",) * (not own) + ("actor.", "history_encoder.") * (not actor)
    other = Artifact.load(make_student("other", own_estimator=own))
    changed = ("estimator.", "memory.", "actor.", "history_encoder.")
    state = {n: value + float(n.startswith(changed)) for n, value in other.state.items()}
    Artifact.save(other.folder, state, other.manifest)
    run = recipe.train(replace(smoke, name="child", init_from=other.folder, iterations=0))
    began, teacher = Artifact.load(run / "policy").state, Artifact.load(smoke.teacher / "policy").state
    assert all(torch.equal(began[n], (teacher if n.startswith(kept) else state)[n]) for n in state)
    assert all(any(n.startswith(part) for n in state) for part in changed)


def test_an_estimator_of_its_own_learns_before_the_imitation(
    recipe: ModuleType, smoke: Any, make_student: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """A student without one goes on with one: all but that stays, and more steps on the same walk miss less."""
    other = Artifact.load(make_student("other"))
    errors = []
    for epochs in (1, 40):
        own = replace(smoke.estimation, robots=8, decisions=12, epochs=epochs, batch=12)
        cfg = replace(smoke, name=f"own_{epochs}", init_from=other.folder, iterations=0, estimation=own)
        artifact = Artifact.load(recipe.train(cfg) / "policy")
        errors.append(float(capsys.readouterr().out.split("held out: ")[1].split()[0]))
        assert artifact.manifest["network"]["estimator_history"] is True
        kept = {n for n in other.state if not n.startswith("estimator.")}
        assert all(torch.equal(artifact.state[n], other.state[n]) for n in kept)
        first = artifact.state["estimator.module.layers.0.weight"]
        assert first.shape == (128, 450)
    assert errors[1] < 0.5 * errors[0]


def test_a_student_commands_canters_as_fast_as_its_teacher(
    recipe: ModuleType, module: Module, smoke: Any, untrained_teacher: Path
) -> None:
    own = recipe.train(replace(smoke, name="slow", iterations=1))
    artifact = Artifact.load(untrained_teacher / "policy")
    Artifact.save(untrained_teacher / "policy", artifact.state, artifact.manifest | {"fastest_canter": 3.2})
    run = recipe.train(replace(smoke, name="fast", iterations=1, init_from=own))
    assert [Artifact.load(one / "policy").manifest["fastest_canter"] for one in (own, run)] == [2.0, 3.2]
    setup = module("tsc_student_setup")
    parts = setup.build(*setup.resolve(replace(smoke, init_from=own)))
    assert parts.env.decisions.bounds[1][3, 0].item() == pytest.approx(3.2)
    setup.load_student(parts, own, ())
    name = "actor.module.0.module.parameters_head.mean.0.weight"  # the canter's speed is row 18 of 30
    was = Artifact.load(own / "policy").state[name]
    torch.testing.assert_close(parts.student.state_dict()[name][18], 0.5 * was[18])  # 1.2 of 2.4 m/s
    assert torch.equal(parts.student.state_dict()[name][19], was[19])
    parts.env.close()


def test_labels_are_what_is_applied(module: Module, smoke: Any) -> None:
    """A teacher that says far more than the environment takes is copied in what it takes."""
    setup = module("tsc_student_setup")
    parts = setup.build(*setup.resolve(smoke))
    with torch.no_grad():
        *_, bias = parts.teacher.actor.network.parameters_head.mean.parameters()
        bias.fill_(5.0)
    label = parts.collector.collect()[keys.LABEL]
    assert (label[keys.PARAMETERS] == 1.0).all() and label[keys.BEHAVIOUR].max() < 5
    parts.env.close()


def test_the_cpu_preset_leaves_the_teachers_actor_as_it_is(recipe: ModuleType, smoke: Any) -> None:
    """And its history encoder; where they are trained on, as in ``smoke``, they do not stay."""
    kept = {"behaviour": 0.0, "continuous": 0.0, "actor": False}
    assert kept.items() <= vars(recipe.PRESETS["cpu"].imitation).items()
    teacher = Artifact.load(smoke.teacher / "policy").state
    run = recipe.train(replace(smoke, imitation=replace(smoke.imitation, **kept)))
    state = Artifact.load(run / "policy").state
    stays = [name for name in state if name.startswith(("actor.", "history_encoder."))]
    assert stays and all(torch.equal(state[name], teacher[name]) for name in stays)
    state = Artifact.load(recipe.train(replace(smoke, name="trained_on")) / "policy").state
    assert not any(torch.equal(state[name], teacher[name]) for name in stays if name.endswith("weight"))


def test_the_paper_preset_is_the_papers(module: Module) -> None:
    """Supplement S2 to S8 and method notes, 5.5 to 5.10, written down once more."""
    cfg = module("tsc_student_config").PRESETS["paper"]
    own, byol, disturbed = cfg.imitation, cfg.representation, cfg.augmentation
    assert (cfg.env.num_robots, own.steps, own.epochs, own.minibatches, cfg.iterations) == (256, 24, 1, 1, 15_000)
    assert (own.learning_rate, own.final_learning_rate, own.decay, own.max_grad_norm) == (1e-3, 1e-5, 20_000, 1.0)
    assert own.heading_weights == (2.0, 0.5) and own.compared == "all" and own.augment
    assert (own.behaviour, own.continuous, own.heading, own.obstacle) == (1.0, 1.0, 1.0, 1.0)
    assert (byol.hidden, byol.out_features, byol.learning_rate, byol.final_learning_rate) == (1024, 64, 3e-4, 1e-5)
    assert (byol.images, byol.minibatches, byol.decay) == (256 * 24, 6, 0.99)
    assert (disturbed.rectangle, disturbed.white_noise, disturbed.white_noise_std) == (0.1, 0.1, 0.02)
    assert (disturbed.dropout, disturbed.dropout_share, disturbed.blur) == (0.05, 0.05, 0.1)
    assert disturbed.blur_std == (0.5, 1.5) and (cfg.memory, cfg.heading_gate) == (512, 0.6)
    assert cfg.camera.latency == (1, 1) and cfg.camera.pitch == pytest.approx(math.radians(5.0))
    assert (cfg.camera.offset_noise, cfg.camera.pixel_noise, cfg.camera.frame_steps) == (0.05, 0.05, 1)
    assert (cfg.env.goal_radius, cfg.env.command_noise, cfg.env.push_interval) == (0.45, (0.8, 1.2), 8.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--teacher", "nowhere"), "nowhere: expected the folder of a run"),
        (("--teacher", "BBC"), "expected a teacher of tsc_teacher.py, got an artifact of kind 'bbc'"),
        (("--bbc", "TEACHER"), "expected an artifact of kind 'bbc', got 'teacher'"),
        (("--init-from", "TEACHER"), "expected a student of tsc_student.py, got an artifact of kind 'teacher'"),
        (("--env.course", "nowhere"), "unknown course 'nowhere'; expected one of full"),
        (("--env.course", "hurdles"), "course hurdles: its bar_jump has way-points of its own"),
        (("--representation.images", "2", "--representation.minibatches", "2"), "BYOL needs 2 images or more, got 1"),
        (("--glance.batch", "0"), "expected every, epochs, batch and kept above 0"),
        (("--env.start-after", "1"), "--env.start-after 1: a student that knows its place expects"),
        (("--env.num-robots", "1"), "--glance.images: expected two robots or more"),
        (("--byo",), "did you mean --byol?"),
    ],
)
def test_bad_options_give_one_clear_line(
    recipe: ModuleType,
    smoke: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    places = {"BBC": str(smoke.bbc), "TEACHER": str(smoke.teacher)}
    arguments = ["smoke", "--runs", str(tmp_path), "--teacher", str(smoke.teacher), "--bbc", str(smoke.bbc)]
    arguments += [places.get(option, option) for option in options]
    with pytest.raises(SystemExit) as stop, recipe.cli.one_line_errors():
        recipe.train(recipe.cli.from_presets(recipe.PRESETS, arguments))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1


def test_another_camera_another_teacher_and_other_sizes_are_refused(
    recipe: ModuleType, smoke: Any, module: Module, make_student: Callable[..., Path]
) -> None:
    seen = describe_camera() | {"image": [60, 106]}
    wrong = make_student("wrong", camera=seen)
    with pytest.raises(ValueError, match=r"images of image \[60, 106\], this code's camera has \[58, 87\]"):
        recipe.train(replace(smoke, init_from=wrong))
    assert not (smoke.runs / smoke.name).exists(), "the name stays free"
    with pytest.raises(ValueError, match=r"has {'memory': 16}, this run builds {'memory': 17}; give the same --memory"):
        recipe.train(replace(smoke, name="larger", memory=17, init_from=make_student()))
    bold = Artifact.load(make_student("bold"))
    network = bold.manifest["network"] | {"initial_std": 0.9, "min_std": 0.2}
    Artifact.save(bold.folder, bold.state, bold.manifest | {"network": network})
    recipe.train(replace(smoke, name="timid", init_from=bold.folder, iterations=0))  # a student tries nothing out
    run = recipe.train(replace(smoke, name="mine", iterations=0))
    other = Artifact.load(smoke.teacher / "policy")
    weights = {name: value + 1.0 for name, value in other.state.items()}
    manifest = {name: value for name, value in other.manifest.items() if name != "weights"}
    Artifact.save(smoke.teacher / "policy", weights, manifest)
    with pytest.raises(ValueError, match=r"began with another policy \(teacher .{12}\) than .* holds now"):
        recipe.train(replace(smoke, resume=run))


def test_nan_stops_before_a_step_and_says_where(recipe: ModuleType, module: Module, smoke: Any) -> None:
    setup = module("tsc_student_setup")
    cfg = replace(smoke, imitation=replace(smoke.imitation, minibatches=1, latent=None))
    parts = setup.build(*setup.resolve(cfg))
    window = parts.collector.collect()
    before = {name: value.clone() for name, value in parts.student.state_dict().items()}
    window["label", "parameters"][0, 0] = math.nan
    with pytest.raises(ValueError, match="the loss of the imitation is nan in iteration 8; nothing was saved since"):
        recipe.imitate(parts, cfg, window, 7)
    assert all(torch.equal(value, before[name]) for name, value in parts.student.state_dict().items())
    with pytest.raises(ValueError, match="pixels of the depth images are NaN"):
        camera.normalize_depth(torch.full((58, 87), math.nan))
    with pytest.raises(ValueError, match="rows and columns are swapped"):
        recipe.represent(parts, 0, window["depth"].flatten(0, 1).mT)
    parts.env.close()
