"""Joining the behaviours of two untrained controllers on a few robots and the synthetic gaits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs.mirror import mirror
from agility_rl.go2 import features
from agility_rl.go2.mirror import mirror_joints
from agility_rl.modules import BasicBehaviourController

Module = Callable[[str], ModuleType]


def save(folder: Path, seed: int) -> Path:
    torch.manual_seed(seed)
    bbc = BasicBehaviourController(hidden=(16, 16))
    last = [parameter for name, parameter in bbc.actor.named_parameters() if name.endswith("weight")][-1]
    torch.nn.init.normal_(last, std=0.5)  # two teachers that say clearly different things
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02) | {"network": bbc.settings}
    Artifact.save(folder / "policy", bbc.state_dict(), manifest)
    return folder


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return save(tmp_path / "a", 1), save(tmp_path / "b", 2)


def observations(rows: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    td = TensorDict({keys.SKILL: torch.arange(rows) % 5}, [rows])
    for key, shape in (
        (keys.PROPRIOCEPTION, (45,)),
        (keys.PRIVILEGED, (29,)),
        (keys.COMMAND, (11,)),
        (keys.PEAK, (1,)),
    ):
        td[key] = torch.randn(rows, *shape, generator=generator)
    return td


def test_every_row_is_labelled_by_the_teacher_of_its_behaviour(module: Module, pair: tuple[Path, Path]) -> None:
    distill, (first, second) = module("bbc_distill"), pair
    chosen = tuple((name, second if name in ("pace", "jump") else first) for name in reversed(BEHAVIOURS))
    teachers = distill.load_teachers(replace(distill.PRESETS["smoke"], teachers=chosen))
    td = observations()
    said = distill.labeller(teachers, ())(td)
    assert not said.requires_grad
    for row in range(10):
        bbc = module("rollouts").load_controller(second if row % 5 in (1, 4) else first).bbc
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = bbc.privileged_policy()(td[row : row + 1].exclude(keys.SKILL))[keys.ACTION]
        torch.testing.assert_close(said[row], expected[0])


def test_the_student_comes_nearer_to_its_teachers(
    module: Module, pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    distill, (first, second) = module("bbc_distill"), pair
    teachers = tuple((name, second if name == "trot" else first) for name in BEHAVIOURS)
    cfg = replace(distill.PRESETS["smoke"], runs=tmp_path, teachers=teachers, updates=40)
    run = distill.main(cfg)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("round")]
    told = [dict(zip(line[2::2], map(float, line[3::2]), strict=True)) for line in lines]
    assert told[0]["walk"] == 0.0 and told[0]["trot"] > 0.1, "the student starts as its first teacher"
    assert told[-1]["trot"] < 0.8 * told[0]["trot"]
    artifact = Artifact.load(run / "policy", kind="bbc")
    assert artifact.manifest["simulation"] == {"friction_loss": 0.0}, "the teachers', whatever --env says"
    sums = {path: Artifact.load(path / "policy").manifest["weights"]["sha256"] for path in pair}
    assert (
        artifact.manifest["teachers"]["trot"] == sums[second] and artifact.manifest["teachers"]["pace"] == sums[first]
    )
    module("rollouts").load_controller(run)


@pytest.mark.parametrize(
    ("teachers", "message"),
    [
        ((), "every behaviour once"),
        (("walk", "pace", "trot", "canter"), "got walk, pace, trot, canter"),
        (("walk", "pace", "trot", "canter", "canter"), "every behaviour once"),
        (("walk", "pace", "trot", "canter", "gallop"), "gallop"),
    ],
)
def test_a_wrong_set_of_behaviours_is_refused(module: Module, teachers: tuple[str, ...], message: str) -> None:
    distill = module("bbc_distill")
    with pytest.raises(ValueError, match=message):
        distill.load_teachers(replace(distill.PRESETS["smoke"], teachers=tuple((name, Path()) for name in teachers)))


def test_the_command_line_takes_pairs_and_gives_one_line_errors(
    module: Module, pair: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    distill, (first, _) = module("bbc_distill"), pair
    words = [word for name in BEHAVIOURS for word in (name, "nowhere" if name == "trot" else str(first))]
    with pytest.raises(SystemExit) as stop, distill.cli.one_line_errors():
        distill.main(distill.cli.from_presets(distill.PRESETS, ["smoke", "--teachers", *words]))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert "nowhere" in errors and "Traceback" not in errors


def test_a_steered_teacher_labels_the_curve(module: Module, pair: tuple[Path, Path]) -> None:
    """Where a turn is commanded the label of a steered behaviour differs from its teacher's own; others do not."""
    distill, (first, _) = module("bbc_distill"), pair
    teachers = distill.load_teachers(
        replace(distill.PRESETS["smoke"], teachers=tuple((name, first) for name in BEHAVIOURS))
    )
    td = observations()
    plain, led = distill.labeller(teachers, ())(td), distill.labeller(teachers, ("pace",))(td)
    pacing = td[keys.SKILL] == BEHAVIOURS.index("pace")
    assert torch.equal(led[~pacing], distill.labeller(teachers, ())(td[~pacing]))
    assert (led[pacing] - plain[pacing]).abs().amax(-1).min() > 1e-3 and led.isfinite().all()
    with pytest.raises(ValueError, match="--steered: unknown gallop"):
        distill.load_teachers(replace(distill.PRESETS["smoke"], steered=("gallop",)))


def test_a_mirrored_teacher_labels_the_other_side_in_a_mirror(module: Module, pair: tuple[Path, Path]) -> None:
    distill, (first, _) = module("bbc_distill"), pair
    teachers = distill.load_teachers(
        replace(distill.PRESETS["smoke"], teachers=tuple((name, first) for name in BEHAVIOURS))
    )
    td = observations()
    plain, both = distill.labeller(teachers)(td), distill.labeller(teachers, sides={"trot": "left"})(td)
    right = (td[keys.SKILL] == BEHAVIOURS.index("trot")) & (td[keys.COMMAND][:, 2] < 0.0)
    assert right.any() and torch.allclose(both[~right], plain[~right])
    expected = mirror_joints(distill.labeller(teachers)(mirror(td.exclude(keys.SKILL)).set(keys.SKILL, td[keys.SKILL])))
    torch.testing.assert_close(both[right], expected[right])
    with pytest.raises(ValueError, match="--mirrored: unknown gallop"):
        distill.load_teachers(replace(distill.PRESETS["smoke"], mirrored=(("gallop", "left"),)))
    with pytest.raises(ValueError, match="--mirrored: expected every behaviour once at most, got trot, trot"):
        distill.load_teachers(replace(distill.PRESETS["smoke"], mirrored=(("trot", "left"), ("trot", "right"))))
