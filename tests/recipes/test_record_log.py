"""The recorder of robot logs, called in this process: a start of Python costs more than a log."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.collectors import RobotLog
from agility_rl.go2 import constants
from agility_rl.simulation import Simulator

Module = Callable[[str], ModuleType]


@pytest.fixture
def record(module: Module) -> ModuleType:
    return module("record_log")


def test_a_log_and_its_truth(record: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = record.Truth(hip_stiffness=1.3, ground_friction=0.5, trunk_mass_offset=1.5)
    cfg = replace(record.PRESETS["smoke"], log=tmp_path / "target.csv", truth=truth, noise=1.0, latency=1)
    log = RobotLog.load(record.main(cfg))
    assert len(log) == 200 and log.control_dt == constants.CONTROL_DT
    assert bool((log.joint_position.std(0) > 0.01).all()), "every joint must move, the hips too"
    found = json.loads((tmp_path / "target.truth.json").read_text())
    parameters = found["parameters"]
    assert parameters["hip_stiffness"] == {"value": 52.0, "unit": "N m/rad", "multiple": 1.3}
    assert parameters["calf_damping"]["multiple"] == 1.0
    assert parameters["ground_friction"]["value"] == 0.5
    assert parameters["trunk_mass_offset"] == {"value": 1.5, "unit": "kg", "multiple": None}
    assert found["recording"]["latency"] == 1 and found["recording"]["policy"] == "open-loop trot"
    assert "200 rows, 4 s" in capsys.readouterr().out
    assert sorted(file.name for file in tmp_path.iterdir()) == ["target.csv", "target.truth.json"]


def test_the_log_is_of_the_robot_that_the_truth_names(
    record: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}
    log = record.record_robot_log

    def watched(simulator: Simulator, *arguments: Any, **options: Any) -> RobotLog:
        seen.update(options, friction_loss=simulator.parameter("friction_loss")[0].tolist())
        seen["stiffness"] = simulator.parameter("stiffness")[0].tolist()
        return log(simulator, *arguments, **options)

    monkeypatch.setattr(record, "record_robot_log", watched)
    truth = record.Truth(hip_stiffness=1.3)
    cfg = replace(record.PRESETS["smoke"], log=tmp_path / "target.csv", truth=truth, noise=0.5, latency=2)
    record.main(replace(cfg, friction_loss=0.1))
    assert (seen["noise"], seen["latency"]) == (0.5, 2)
    assert seen["stiffness"] == pytest.approx([52.0, 40.0, 40.0] * 4)
    assert seen["friction_loss"] == pytest.approx([0.1] * 12)


def test_a_seed_makes_the_draw_and_a_given_value_changes_no_other(record: ModuleType) -> None:
    def multiples(**options: object) -> dict[str, float]:
        generator = torch.Generator().manual_seed(0)
        found = record.parameters(record.Config(draw=True, **options), generator)
        return {name: entry["multiple"] for name, entry in found.items()}

    drawn = multiples()
    assert len(set(drawn.values())) == 6 and all(1 / 3 <= multiple <= 3 for multiple in drawn.values())
    assert multiples(truth=record.Truth(hip_damping=2.0)) == drawn | {"hip_damping": 2.0}
    assert all(0.5 <= multiple <= 2.0 for multiple in multiples(span=2.0).values())


def test_a_controller_records_too(record: ModuleType, untrained: Path, tmp_path: Path) -> None:
    cfg = replace(record.PRESETS["smoke"], log=tmp_path / "target.npz", policy=untrained, steps=100)
    assert len(RobotLog.load(record.main(cfg))) == 100
    manifest = json.loads((untrained / "policy" / "manifest.json").read_text())
    found = json.loads((tmp_path / "target.truth.json").read_text())
    assert found["recording"]["policy"] == manifest["weights"]["sha256"]


def test_commands_turn_both_ways_in_every_behaviour(module: Module) -> None:
    policies = module("log_policy")
    commands = policies.commands(["walk", "jump"])
    assert commands.shape == (4, 11)
    assert commands[:, 6:].argmax(-1).tolist() == [BEHAVIOURS.index("walk")] * 2 + [BEHAVIOURS.index("jump")] * 2
    assert commands[:, 2].tolist() == pytest.approx([0.5, -0.5, 0.25, -0.25])
    assert commands[2, 3] == pytest.approx(0.5)


def test_the_open_loop_trot_moves_every_joint_the_same_in_log_and_search(module: Module) -> None:
    actions = module("log_policy").swing_actions(10)
    assert actions.shape == (40, 12)
    assert bool((actions.std(0) > 0.01).all())
    assert torch.equal(actions, module("log_policy").swing_actions(10))
    policy = module("log_policy").OpenLoop(actions)
    played = []
    for reset in ([True, True], [False, True], [False, False]):
        measured = TensorDict({"is_init": torch.tensor(reset)[:, None]}, [2])
        played.append(policy(measured))
    assert torch.equal(torch.stack(played)[:, 0], actions[:3])
    assert torch.equal(torch.stack(played)[:, 1], actions[[0, 0, 1]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give --log FILE"),
        (("--log", "target.txt"), "give --log FILE"),
        (("--log", "{tmp}/there.csv"), "already exists"),
        (("--log", "{tmp}/new.csv", "--truth.hip-stifness", "2"), "did you mean --truth.hip-stiffness"),
        (("--log", "{tmp}/new.csv", "--truth.hip-damping", "-1"), "--truth.hip-damping makes -1"),
        (("--log", "{tmp}/new.csv", "--steps", "20"), "too short"),
        (("--log", "{tmp}/new.csv", "--policy", "nowhere"), "nowhere"),
        (("--log", "{tmp}/new.csv", "--behaviours", "gallop"), "no behaviour"),
        (("--log", "{tmp}/new.csv", "--latency", "-1"), "latency"),
    ],
)
def test_bad_options_give_one_clear_line(
    record: ModuleType,
    tmp_path: Path,
    untrained: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    (tmp_path / "there.csv").touch()
    arguments = ["smoke", *(option.format(tmp=tmp_path) for option in options)]
    if "--behaviours" in arguments:
        arguments += ["--policy", str(untrained)]
    with pytest.raises(SystemExit) as stop, record.cli.one_line_errors():
        record.main(record.cli.from_presets(record.PRESETS, arguments))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "new.csv").exists() and not (tmp_path / "new.truth.json").exists()
