"""What environments share of their robots: memories, resets of some rows, pushes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.randomization import NOMINAL, Randomization
from agility_rl.envs.robots import STRIDE, Pushes, Robots
from agility_rl.go2 import constants, features
from agility_rl.simulation import make_simulator


def build(n: int = 3, **options: object) -> tuple[Robots, CommandSampler]:
    generator = torch.Generator().manual_seed(0)
    robots = Robots(make_simulator(num_simulations=n, num_threads=1), generator, **options)  # type: ignore[arg-type]
    return robots, CommandSampler(n, generator, None)


def test_an_action_of_one_asks_for_the_default_pose_and_the_scale() -> None:
    robots, commands = build(1)
    robots.step(torch.ones(1, 12))
    state = robots.state(torch.ones(1, 12), commands)
    target = torch.tensor(constants.DEFAULT_POSE) + torch.tensor(constants.ACTION_SCALE)
    expected = 40.0 * (target - state.joint_position) - state.joint_velocity
    torch.testing.assert_close(state.torque, expected)
    assert torch.equal(state.previous_action, torch.zeros(1, 12))
    robots.remember(state)
    robots.step(torch.zeros(1, 12))
    later = robots.state(torch.zeros(1, 12), commands)
    assert torch.equal(later.previous_action, torch.ones(1, 12)) and torch.equal(later.previous_torque, state.torque)


def test_torques_are_towards_the_targets_that_the_motors_have() -> None:
    """Robots 0 to 2 get targets at once, after two physics steps, and with the next control step."""
    robots, commands = build(3)
    everyone = torch.ones(3, dtype=torch.bool)
    robots.simulator.set_parameters(everyone, action_delay=torch.tensor([[0.0], [0.01], [0.02]]))
    robots.begin(everyone, commands)
    held = robots.simulator.joint_position  # where they were put
    for value in (1.0, -1.0):
        action = torch.full((3, 12), value)
        robots.step(action)
        state = robots.state(action, commands)
        asked = torch.tensor(constants.DEFAULT_POSE) + torch.tensor(constants.ACTION_SCALE) * action
        there = torch.cat((asked[:2], held[2:]))
        assert torch.equal(robots.simulator.motor_target, there)
        torch.testing.assert_close(state.torque, 40.0 * (there - state.joint_position) - state.joint_velocity)
        held = asked


def test_a_delay_ends_where_there_is_none_any_more() -> None:
    robots, _ = build(2)
    everyone = torch.ones(2, dtype=torch.bool)
    robots.randomize(everyone, replace(NOMINAL, action_delay=(0.02, 0.02)))
    assert robots.simulator.parameter("action_delay").tolist() == [[pytest.approx(0.02)]] * 2
    robots.load_state_dict(robots.state_dict())
    robots.randomize(everyone, NOMINAL)
    assert robots.simulator.parameter("action_delay").tolist() == [[0.0]] * 2


def test_heights_count_from_the_given_ground_and_peaks_last_their_window() -> None:
    robots, commands = build(2, ground=lambda position: torch.full((len(position),), 0.1))
    robots.begin(torch.ones(2, dtype=torch.bool), commands)
    start = robots.simulator.root_position[:, 2] - 0.1
    torch.testing.assert_close(robots.state(robots.action, commands).root_height[:, 0], start)
    for _ in range(round(features.PEAK_WINDOW / 0.02) - 1):
        robots.step(torch.zeros(2, 12))
    torch.testing.assert_close(robots.state(robots.action, commands).peak_height, start)
    robots.step(torch.zeros(2, 12))
    assert (robots.state(robots.action, commands).peak_height < start).all()  # it has sunk into its springs


def test_the_mean_velocity_follows_with_its_time_constant_and_starts_with_the_robot() -> None:
    robots, commands = build(1)
    robots.begin(torch.ones(1, dtype=torch.bool), commands)
    robots.simulator.push(torch.ones(1, dtype=torch.bool), torch.tensor([[1.0, 0.5]]))
    robots.begin(torch.ones(1, dtype=torch.bool), commands)
    state = robots.state(robots.action, commands)
    mean, turn = state.linear_velocity, state.angular_velocity[:, 2]
    for _ in range(10):
        robots.step(0.5 * torch.eye(12)[:1])
        state = robots.state(torch.zeros(1, 12), commands)
        mean = mean + 0.02 / STRIDE * (state.linear_velocity - mean)
        turn = turn + 0.02 / STRIDE * (state.angular_velocity[:, 2] - turn)
        torch.testing.assert_close(state.mean_velocity, mean)
        torch.testing.assert_close(state.mean_yaw_rate, turn)
    assert turn.abs() > 1e-3
    robots.begin(torch.ones(1, dtype=torch.bool), commands)
    state = robots.state(robots.action, commands)
    assert torch.equal(state.mean_velocity, state.linear_velocity)
    assert torch.equal(state.mean_yaw_rate, state.angular_velocity[:, 2])


def test_randomising_some_leaves_the_others() -> None:
    robots, _ = build(3)
    mask = torch.tensor([True, False, True])
    robots.randomize(mask, Randomization())
    assert robots.privileged[1, :5].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0]
    assert torch.equal(robots.stiffness[1], torch.full((12,), 40.0)) and (robots.stiffness[mask] != 40.0).all()
    assert torch.equal(robots.simulator.parameter("stiffness"), robots.stiffness)  # type: ignore[attr-defined]
    torch.testing.assert_close(robots.privileged[:, 5:17], robots.stiffness / 40.0 - 1.0)


def test_parameters_of_the_simulator_are_those_that_rewards_and_critics_are_told() -> None:
    simulator = make_simulator(num_simulations=2, num_threads=1, stiffness=20.0, ground_friction=0.5)
    robots = Robots(simulator, torch.Generator())
    assert robots.stiffness.unique().tolist() == [20.0] and robots.damping.unique().tolist() == [1.0]
    assert robots.privileged[0, 4].item() == 0.5 and robots.privileged[0, 5:17].unique().tolist() == [-0.5]


def test_memories_are_saved() -> None:
    robots, commands = build(2)
    robots.step(torch.ones(2, 12))
    robots.remember(robots.state(torch.ones(2, 12), commands))
    saved = robots.state_dict()
    other, _ = build(2)
    other.load_state_dict(saved | {"something_else": torch.zeros(1)})
    assert all(torch.equal(value, saved[name]) for name, value in other.state_dict().items())


@pytest.mark.parametrize("interval", [4, None])
def test_pushes_come_once_in_their_interval(interval: int | None) -> None:
    robots, _ = build(40)
    pushes = Pushes(40, torch.Generator().manual_seed(1), interval, 0.5)
    pushes.begin(torch.ones(40, dtype=torch.bool))
    pushed = torch.zeros(40)
    for step in range(4):
        robots.simulator.push(torch.ones(40, dtype=torch.bool), torch.full((40, 2), 9.0))
        pushes.apply(robots.simulator, torch.full((40,), step))
        speed = torch.from_numpy(robots.simulator.batch.bind("qvel")[:, :2].copy())  # type: ignore[attr-defined]
        assert speed[speed < 9.0].abs().max() <= 0.5 if (speed < 9.0).any() else True
        pushed += (speed < 9.0).all(-1)
    assert (pushed == (0 if interval is None else 1)).all()
