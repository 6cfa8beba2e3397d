"""The controller in plain MuJoCo with two physics steps, and how near it comes to its limits."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy import Artifact, BehaviourCommand, DeployedBBC, JointCommand, SafetyLimits
from agility_rl.deploy.behaviour import torch_network
from agility_rl.deploy.safety import Safety
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import RobotState
from agility_rl.go2 import constants

Module = Callable[[str], ModuleType]


@pytest.fixture
def sim(module: Module) -> ModuleType:
    return module("sim_to_sim")


@pytest.fixture
def shipped(repository: Path) -> DeployedBBC:
    artifact = Artifact.load(repository / "pretrained" / "bbc", kind="bbc")
    return DeployedBBC(torch_network(artifact), artifact)


def test_what_is_measured_by_hand(sim: ModuleType, shipped: DeployedBBC) -> None:
    state = RobotState.standing()
    state.joint_position[4] = constants.JOINT_UPPER[4] + 0.125
    state.joint_velocity[2] = -2.0 * 20.07
    state.quaternion[:] = torch.tensor([math.cos(0.2), 0.0, math.sin(0.2), 0.0])
    position = state.joint_position.clone()
    position[3] += 1.0
    command = JointCommand(position, torch.full((12,), 30.0), torch.zeros(12))
    safety = Safety(SafetyLimits.from_manifest(shipped.manifest))
    found = sim.measure(state, command, shipped, safety)
    assert found == pytest.approx({"tilt": 0.4, "beyond stops": 0.125, "commanded torque": 1.5, "joint speed": 2.0})


def test_a_trot_is_a_trot_with_either_physics_step(sim: ModuleType, shipped: DeployedBBC) -> None:
    told = BehaviourCommand.of("trot", velocity_x=1.0)
    steps = constants.SIM_DT, 0.001
    episodes = [sim.run_episode(SimulatedRobot(sim_dt=dt, friction_loss=0.0), shipped, told, 3.0) for dt in steps]
    for episode in episodes:
        assert not episode.recording.fell.any() and episode.stopped is None
        assert 0.0 < episode.largest["tilt"] < 1.2 and 0.0 < episode.largest["joint speed"] < 2.0
        assert episode.recording.velocity[0, 50:, 0].mean() == pytest.approx(1.0, abs=0.2)
    five, one = (episode.recording.velocity for episode in episodes)
    assert not torch.equal(five, one), "they are different physics"
    found = sim.summarise(episodes, torch.tensor([2, 2]), told.command.expand(2, -1), 0.5)
    assert list(found) == ["trot"]
    trot = found["trot"]
    assert trot["recognised"] == 2 and trot["falls"] == 0 and 1.5 < trot["stride frequency"] < 3.5
    assert trot["speed error"] < 0.2 and trot["tilt"] == max(episode.largest["tilt"] for episode in episodes)


def test_a_check_that_would_stop_it_is_told_and_a_fall_is_seen(sim: ModuleType, shipped: DeployedBBC) -> None:
    """A controller that folds its legs and then asks for more than the motors may be asked for."""
    calls = 0

    def collapse(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nonlocal calls
        calls += 1
        return torch.tensor([[0.0, 0.46 / 0.25, -0.85 / 0.25] * 4]) * (1.0 if calls < 50 else 20.0), torch.zeros(1, 4)

    shipped.network = collapse
    episode = sim.run_episode(
        SimulatedRobot(friction_loss=0.0, command_timeout=None), shipped, BehaviourCommand.of("walk"), 1.2
    )
    assert episode.recording.fell.all(), "the trunk lies on the ground"
    assert episode.stopped is not None and episode.stopped[1].startswith("commanded torque")
    assert episode.stopped[0] == pytest.approx(49 * 0.02), "the first check, at its time"
    assert episode.largest["commanded torque"] > 4.0


def test_the_tables_and_the_file(
    sim: ModuleType, untrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "new" / "figures.json"
    found = sim.main(sim.Config(untrained, episodes=1, seconds=1.2, settle=0.2, output=output))
    assert list(found) == [constants.SIM_DT, 0.001] and all(tuple(rows) == BEHAVIOURS for rows in found.values())
    printed = capsys.readouterr().out
    for text in (*BEHAVIOURS, "5 ms", "1 ms", "stride frequency", "beyond stops", "stopped by a check"):
        assert text in printed, text
    written = json.loads(output.read_text())["physics steps"]
    assert written["1 ms"]["jump"]["tilt"] == pytest.approx(found[0.001]["jump"]["tilt"], abs=1e-5)
    few = sim.main(sim.Config(untrained, behaviours=("jump",), steps=(0.005,), episodes=1, seconds=1.2, settle=0.2))
    assert list(few[0.005]) == ["jump"]
    for options, message in (({"seconds": 1.5}, "at least 1 s longer"), ({"output": tmp_path / "x.csv"}, r"in \.json")):
        with pytest.raises(ValueError, match=message):
            sim.main(sim.Config(untrained, **options))
