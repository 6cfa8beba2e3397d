from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.collectors import ParameterSpace, RobotLogError, RobotLogRecorder, record_robot_log
from agility_rl.envs import LocomotionEnv
from agility_rl.go2 import constants
from agility_rl.simulation import BatchSimulator

Simulate = Callable[..., BatchSimulator]
POSE, SCALE = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_log_replayed_in_the_same_simulator_gives_itself(simulate: Simulate, swing: Any) -> None:
    log = record_robot_log(simulate(1), swing(), 100, generator=seeded())
    assert log.start.tolist() == [True] + [False] * 99
    torch.testing.assert_close(log.time[-1].item(), 99 * 0.02)
    simulator = simulate(1)
    start = {"root_position": torch.tensor([[0.0, 0.0, constants.STANDING_HEIGHT]])}
    start |= {"root_quaternion": torch.tensor([[1.0, 0.0, 0.0, 0.0]]), "joint_position": POSE[None]}
    still = {name: torch.zeros(1, 3) for name in ("root_linear_velocity", "root_angular_velocity")}
    simulator.reset(torch.ones(1, dtype=torch.bool), **start, **still, joint_velocity=torch.zeros(1, 12))
    for row in range(100):
        assert torch.equal(log.joint_position[row], simulator.joint_position[0])
        assert torch.equal(log.angular_velocity[row], simulator.root_angular_velocity[0])
        simulator.step(POSE + SCALE * log.action[row, None])


def test_parameters_show_in_the_log(simulate: Simulate, swing: Any) -> None:
    simulator, space = simulate(2), ParameterSpace()
    values = space.nominal.repeat(2, 1)
    values[1] *= 0.5
    simulator.set_parameters(torch.ones(2, dtype=torch.bool), **space.fields(values))
    logs = [record_robot_log(simulator, swing(), 100, generator=seeded(), row=row) for row in range(2)]
    assert torch.equal(logs[0].action, logs[1].action)
    assert (logs[0].joint_position - logs[1].joint_position).abs().max() > 0.05


def test_latency_and_noise(simulate: Simulate, swing: Any) -> None:
    prompt = record_robot_log(simulate(1), swing(), 100, generator=seeded())
    late = record_robot_log(simulate(1), swing(), 100, generator=seeded(), latency=1)
    assert torch.equal(late.joint_position[1:], prompt.joint_position[:-1])
    assert torch.equal(late.action, prompt.action)  # an open loop does not care
    noisy = record_robot_log(simulate(1), swing(), 100, generator=seeded(), noise={"joint_position": 0.01})
    difference = (noisy.joint_position - prompt.joint_position).abs()
    assert 0.005 < difference.max() <= 0.0101
    assert torch.equal(noisy.joint_velocity, prompt.joint_velocity)


def test_a_fall_starts_a_new_part(simulate: Simulate) -> None:
    side = torch.tensor([8.0, 8.0, -3.0, 8.0, 8.0, -3.0] * 2)

    def policy(measured: TensorDictBase) -> Tensor:
        return side.expand(len(measured), 12) * (1.0 - 0.5 * measured["is_init"].float())

    log = record_robot_log(simulate(1), policy, 120, generator=seeded())
    starts = int(log.start.sum())
    assert starts > 1
    assert len(log.transitions()) == 120 - starts


def test_recording_beside_an_environment() -> None:
    env = LocomotionEnv(3, simulator_options={"num_threads": 1}, seed=1)
    recorder, generator = RobotLogRecorder(env.simulator, row=2), seeded()
    td, states = env.reset(), []
    for step in range(30):
        if step == 20:
            td, _ = env.reset(), recorder.restart()
        td["action"] = torch.randn(3, 12, generator=generator)
        states.append(env.simulator.joint_velocity[2])
        recorder.record(td["action"])
        td = env.step_mdp(env.step(td))
    log = recorder.log(min_steps=30)
    assert torch.equal(log.joint_velocity, torch.stack(states))
    assert log.start.nonzero()[:, 0].tolist() == [0, 20]
    assert len(log.transitions()) == 28
    env.close()


def test_both_ways_give_the_same_log(simulate: Simulate, swing: Any) -> None:
    simulator, policy = simulate(1), swing()
    recorder = RobotLogRecorder(simulator, latency=1)

    def watched(measured: TensorDictBase) -> Tensor:
        action = policy(measured)
        recorder.record(action[0])
        return action

    one = record_robot_log(simulator, watched, 100, generator=seeded(), latency=1)
    other = recorder.log()
    for name in ("time", "joint_position", "joint_velocity", "roll_pitch", "angular_velocity", "action", "start"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_errors(simulate: Simulate) -> None:
    recorder = RobotLogRecorder(simulate(2))
    with pytest.raises(ValueError, match="nothing was recorded"):
        recorder.log()
    with pytest.raises(ValueError, match="action must be"):
        recorder.record(torch.zeros(2, 11))
    recorder.record(torch.zeros(2, 12))
    with pytest.raises(RobotLogError, match="too short: 1 rows"):
        recorder.log()
    with pytest.raises(RobotLogError, match="action is the same"):
        record_robot_log(simulate(1), lambda measured: torch.zeros(1, 12), 100, generator=seeded())
