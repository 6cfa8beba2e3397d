from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from agility_rl.collectors import ParameterSpace, RobotLog, cut_windows, record_robot_log
from agility_rl.collectors.windows import SINK, estimate_states, predict, smooth
from agility_rl.go2 import constants, kinematics
from agility_rl.simulation import BatchSimulator

Simulate = Callable[..., BatchSimulator]
SPACE = ParameterSpace()


def numbered(rows: int, starts: tuple[int, ...]) -> RobotLog:
    """A log whose angular velocity and action say which row they stand in."""
    number = torch.arange(rows, dtype=torch.float32)
    return RobotLog(
        time=constants.CONTROL_DT * torch.arange(rows, dtype=torch.float64),
        joint_position=torch.tensor(constants.DEFAULT_POSE).repeat(rows, 1),
        joint_velocity=torch.zeros(rows, 12),
        roll_pitch=torch.zeros(rows, 2),
        angular_velocity=number[:, None].repeat(1, 3),
        action=number[:, None].repeat(1, 12),
        start=torch.isin(torch.arange(rows), torch.tensor(starts)),
    )


@pytest.mark.parametrize("latency", [0, 2])
def test_windows_cross_no_reset_and_undo_the_latency(latency: int) -> None:
    windows = cut_windows(numbered(100, (0, 48)), 8, latency=latency)
    first = windows.first[:, 2]
    assert torch.equal(windows.start["root_angular_velocity"][:, 0], first)
    # What was measured ``latency`` rows later is the state in which this row's action was taken.
    assert torch.equal(windows.action[:, 0, 1], first - latency)
    torch.testing.assert_close(windows.measured[..., 2], first[:, None] + 1 + torch.arange(8.0))
    rows = first - latency
    assert rows.tolist() == [0, 8, 16, 24, 32, 48, 56, 64, 72, 80, 88]
    assert not bool(((rows < 48) & (rows + latency + 8 >= 48)).any())


def test_targets_are_actions_about_the_default_pose() -> None:
    windows = cut_windows(numbered(100, ()), 4)
    expected = constants.DEFAULT_POSE[4] + constants.ACTION_SCALE[4] * windows.action[..., 4]
    torch.testing.assert_close(windows.target[..., 4], expected)
    few = windows.take(torch.tensor([3, 1]))
    assert few.steps == 4 and torch.equal(few.target, windows.target[[3, 1]])
    assert torch.equal(few.first, windows.first[[3, 1]]) and torch.equal(few.measured, windows.measured[[3, 1]])


def test_standing_feet_tell_the_velocity_of_the_trunk() -> None:
    """Feet that stay in place while the trunk moves with v go with -v in its frame: inverse kinematics say how."""
    velocity = torch.tensor([0.4, -0.1, 0.05], dtype=torch.float64)
    pose = torch.tensor(constants.DEFAULT_POSE, dtype=torch.float64)
    feet, dt = kinematics.forward(pose), 1e-5
    speed = (kinematics.inverse(feet - dt * velocity) - kinematics.inverse(feet + dt * velocity)) / (2 * dt)
    state = estimate_states(torch.cat((torch.zeros(5), pose.float(), speed.float()))[None])
    torch.testing.assert_close(state["root_linear_velocity"][0], velocity.float(), atol=1e-3, rtol=0.0)
    height = constants.FOOT_RADIUS - float(feet[:, 2].min()) - SINK
    assert state["root_position"][0].tolist() == pytest.approx([0.0, 0.0, height], abs=1e-5)


def test_everybody_plays_every_window_whatever_the_number_of_robots(simulate: Simulate, log: RobotLog) -> None:
    """Two chunks of four robots, the second half idle; one chunk a window; one for all: bit for bit the same."""
    few = cut_windows(log, 4).take(torch.arange(3))
    individuals = torch.stack((torch.full((6,), 0.5), torch.tensor([0.8, 0.3, 0.25, 0.7, 0.7, 0.4]))).double()
    once, *others = (predict(simulate(robots), SPACE, individuals, few) for robots in (4, 2, 6, 1))
    assert once.shape == (2, 3, 4, 29)
    assert all(torch.equal(once, other) for other in others)
    exact = replace(few, measured=once[1])
    assert float(exact.residual(predict(simulate(4), SPACE, individuals[1:], exact)).abs().max()) == 0.0
    assert float(exact.residual(once[0]).abs().mean()) > 0.05


def test_a_window_is_what_a_plain_loop_does(simulate: Simulate, log: RobotLog) -> None:
    windows, individuals = cut_windows(log, 3), torch.rand(1, 6, generator=torch.Generator().manual_seed(1)).double()
    predicted = predict(simulate(5), SPACE, individuals, windows)[0, 7]
    simulator, everyone = simulate(1), torch.ones(1, dtype=torch.bool)
    simulator.set_parameters(everyone, **SPACE.fields(SPACE.denormalize(individuals)))
    simulator.reset(everyone, **{name: value[7:8] for name, value in windows.start.items()})
    for step in range(3):
        action = log.action[7 * 3 + step]
        simulator.step((torch.tensor(constants.DEFAULT_POSE) + torch.tensor(constants.ACTION_SCALE) * action)[None])
        assert torch.equal(predicted[step, 5:17], simulator.joint_position[0])
        assert torch.equal(predicted[step, 17:], simulator.joint_velocity[0])
        assert torch.equal(predicted[step, 2:5], simulator.root_angular_velocity[0])


def test_a_diverged_simulation_predicts_nothing(simulate: Simulate, log: RobotLog) -> None:
    windows = cut_windows(log, 3).take(torch.arange(2))
    windows.start["joint_velocity"][1] = 1e7
    predicted = predict(simulate(2), SPACE, torch.full((1, 6), 0.5), windows)
    assert bool(predicted[0, 0].isfinite().all()) and bool(predicted[0, 1].isnan().all())
    assert float(windows.residual(predicted)[0, 1].min()) == 10.0


def test_noise_is_smoothed_in_start_states_only() -> None:
    time = constants.CONTROL_DT * torch.arange(100)
    state = torch.sin(6.0 * time)[:, None].repeat(1, 29)
    smoothed = smooth(state)
    torch.testing.assert_close(smoothed[5:-5, 5], state[5:-5, 5], atol=1e-3, rtol=0.0)
    torch.testing.assert_close(smoothed[5:-5, 17], 6.0 * torch.cos(6.0 * time)[5:-5], atol=0.05, rtol=0.0)
    log = numbered(100, ())
    object.__setattr__(log, "joint_position", log.joint_position + 0.01 * (torch.arange(100) % 2)[:, None])
    noisy, exact = cut_windows(log, 5, noise=1.0), cut_windows(log, 5)
    assert torch.equal(noisy.measured, exact.measured) and torch.equal(noisy.first, exact.first)
    assert not torch.equal(noisy.start["joint_position"], exact.start["joint_position"])
    assert bool((noisy.scale > exact.scale).all())


def test_windows_that_do_not_fit_say_so(log: RobotLog) -> None:
    with pytest.raises(ValueError, match="0 <= skip < window, got 5 and 5"):
        cut_windows(log, 5, skip=5)
    with pytest.raises(ValueError, match="expected 201 rows without a reset"):
        cut_windows(log, 200)
    with pytest.raises(ValueError, match="expected a latency from 0, got -1"):
        cut_windows(log, 5, latency=-1)


def test_only_smoothing_asks_for_more_rows_than_a_window_has() -> None:
    pieces = numbered(100, tuple(range(0, 100, 4)))
    assert len(cut_windows(pieces, 3)) == 25
    with pytest.raises(ValueError, match="expected 7 rows without a reset"):
        cut_windows(pieces, 3, noise=1.0)


def test_a_log_at_another_rate_is_replayed_at_its_own(simulate: Simulate) -> None:
    log = numbered(100, ())
    fast = replace(log, time=log.time / 2, control_dt=constants.CONTROL_DT / 2)
    windows, individuals = cut_windows(fast, 50), torch.full((1, len(SPACE)), 0.5)
    with pytest.raises(ValueError, match=r"holds an action for 0.01 s, the simulator for 0.02 s"):
        predict(simulate(1), SPACE, individuals, windows)
    assert predict(BatchSimulator(1, control_dt=0.01), SPACE, individuals, windows).shape == (1, 1, 50, 29)


def test_the_true_state_and_parameters_reproduce_the_log(simulate: Simulate, swing: Any) -> None:
    """What windows miss is the trunk's velocity and height: with those given, the log's next rows come out again."""
    simulator, policy, steps = simulate(1), swing(), 60
    truth = torch.tensor([[0.8, 0.3, 0.25, 0.7, 0.7, 0.4]]).double()
    simulator.set_parameters(torch.ones(1, dtype=torch.bool), **SPACE.fields(SPACE.denormalize(truth)))
    hidden: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []

    def watched(measured: Any) -> torch.Tensor:
        state = simulator.root_position, simulator.root_quaternion, simulator.root_linear_velocity
        hidden.append(tuple(entry[0].clone() for entry in state))  # type: ignore[arg-type]
        return policy(measured)  # type: ignore[no-any-return]

    log = record_robot_log(simulator, watched, 100, generator=torch.Generator().manual_seed(0))
    windows = cut_windows(log, 2).take(torch.arange(steps // 2))
    estimated = predict(simulate(10), SPACE, truth, windows)[0] - windows.measured
    position, quaternion, velocity = (torch.stack(entry)[0:steps:2] for entry in zip(*hidden, strict=True))
    start = windows.start.clone()
    start["root_position"], start["root_quaternion"], start["root_linear_velocity"] = position, quaternion, velocity
    given = predict(simulate(10), SPACE, truth, replace(windows, start=start))[0] - windows.measured
    # float32 states and a cold start of the contact solver
    assert float(given[..., :17].abs().max()) < 2e-3 and float(given[..., 17:].abs().max()) < 0.1
    # With the estimate: half of the joint positions to 5 mrad, half of the speeds to 0.3 rad/s.
    assert float(estimated[..., 5:17].abs().median()) < 5e-3
    assert float(estimated[..., 17:].abs().median()) < 0.3
