"""Observation groups: layout, memories, noise, and agreement with what a clip would give."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.observations import ObservationGroups, RecentFrames
from agility_rl.envs.reference import standing_states
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import features

Build = Callable[..., LocomotionEnv]
Neutral = Callable[..., LocomotionState]
BOTH = torch.tensor([True, True])


@pytest.fixture
def groups(generator: torch.Generator) -> ObservationGroups:
    return ObservationGroups(2, generator)


@pytest.fixture
def commands(generator: torch.Generator) -> CommandSampler:
    commands = CommandSampler(2, generator, period=None)
    commands.assign(BOTH, torch.tensor([2, 4]), torch.full((2, 5), 0.5), torch.zeros(2, 1))
    return commands


def actions(count: int, n: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    return [0.5 * torch.randn(n, 12, generator=generator) for _ in range(count)]


def test_proprioception_by_hand(neutral: Neutral, groups: ObservationGroups, commands: CommandSampler) -> None:
    state = neutral(
        roll=torch.full((2,), 0.1),
        pitch=torch.full((2,), -0.2),
        angular_velocity=torch.tensor([[1.0, 2.0, -4.0]] * 2),
        joint_velocity=torch.full((2, 12), 10.0),
        action=torch.full((2, 12), 3.0),
        foot_contact=torch.tensor([[2.1, 1.9, 0.0, 50.0]] * 2),
    )
    state.joint_position = state.joint_position + 0.3
    groups.reset(BOTH, state)
    seen = groups.build(state, commands, torch.zeros(2, 29))[keys.PROPRIOCEPTION]
    by_hand = [0.1, -0.2, 0.25, 0.5, -1.0, *[0.3] * 12, *[0.5] * 12, *[3.0] * 12, 0.5, -0.5, -0.5, 0.5]
    torch.testing.assert_close(seen, torch.tensor([by_hand] * 2))


def test_explicit_and_peak_by_hand(neutral: Neutral, groups: ObservationGroups, commands: CommandSampler) -> None:
    state = neutral(linear_velocity=torch.tensor([[1.0, -0.5, 0.2]] * 2), peak_height=torch.tensor([0.4, 0.45]))
    seen = groups.build(state, commands, torch.zeros(2, 29))
    torch.testing.assert_close(seen[keys.EXPLICIT], torch.tensor([[0.2884, 0.5, -0.25, 0.1]] * 2))
    torch.testing.assert_close(seen[keys.PEAK], torch.tensor([[0.0], [0.45]]))  # only the second one jumps


def test_measurements_are_clipped(neutral: Neutral, groups: ObservationGroups, commands: CommandSampler) -> None:
    state = neutral(action=torch.tensor([[1e9], [-1e9]]).expand(2, 12))
    groups.reset(BOTH, state)
    seen = groups.build(state, commands, torch.zeros(2, 29))[keys.PROPRIOCEPTION]
    assert seen.max() == 100.0 and seen.min() == -100.0


def test_a_contact_is_seen_one_step_longer(neutral: Neutral, groups: ObservationGroups) -> None:
    groups.reset(BOTH, neutral(foot_contact=torch.full((2, 4), 9.0)))
    for expected in (0.5, -0.5):
        groups.update(neutral())
        assert (groups.history[:, -1, -4:] == expected).all()


def test_reset_fills_only_its_rows(neutral: Neutral, groups: ObservationGroups) -> None:
    for k in range(12):
        groups.update(neutral(roll=torch.full((2,), 0.01 * k)))
    history, motion = groups.history, groups.motion()
    groups.reset(torch.tensor([False, True]), neutral(roll=torch.tensor([1.0, 2.0])))
    assert torch.equal(groups.history[0], history[0]) and torch.equal(groups.motion()[0], motion[0])
    assert (groups.history[1, :, 0] == 2.0).all() and (groups.motion()[1, :, 0] == 2.0).all()
    torch.testing.assert_close(groups.history[0, :, 0], 0.01 * torch.arange(2.0, 12.0))  # oldest first
    torch.testing.assert_close(motion[0, :, 0], torch.tensor([0.10, 0.11]))


def test_a_ring_of_frames_is_a_list_of_which_the_oldest_is_dropped() -> None:
    frames, generator = RecentFrames(2, 4, 3, "cpu"), torch.Generator().manual_seed(0)
    expected = torch.zeros(2, 4, 3)
    for step in range(11):
        if step in (3, 8):  # one robot begins anew, wherever the ring has come to
            fresh = torch.randn(1, 4, 3, generator=generator)
            frames.fill(torch.tensor([False, True]), torch.tensor([1]), fresh)
            expected = torch.cat((expected[:1], fresh))
        if step == 6:
            whole = frames.all()
            frames = RecentFrames(2, 4, 3, "cpu")
            frames.restore(whole)
        newest = torch.randn(2, 3, generator=generator)
        frames.push(newest)
        expected = torch.cat((expected[:, 1:], newest[:, None]), 1)
        assert torch.equal(frames.all(), expected)
        assert torch.equal(frames.read(torch.tensor([3, 0])), expected[:, [3, 0]])


def test_noise_has_the_half_widths_of_the_layout(neutral: Neutral, generator: torch.Generator) -> None:
    n = 4000
    groups = ObservationGroups(n, generator, noise=2.0)
    groups.update(neutral(n))
    clean = ObservationGroups(n, generator)
    clean.update(neutral(n))
    error = (groups.history - clean.history)[:, -1]
    # twice: angle 0.01 rad, rate 0.2 rad/s x 0.25, joint 0.01 rad, joint rate 1.5 rad/s x 0.05
    half = torch.tensor([0.02] * 2 + [0.1] * 3 + [0.02] * 12 + [0.15] * 12 + [0.0] * 16)
    assert (error.abs().amax(0) <= half + 1e-6).all()
    assert (error.abs().amax(0) >= 0.98 * half).all()
    assert (error.mean(0).abs() <= 5 * half / (3 * n) ** 0.5 + 1e-7).all()
    assert torch.equal(groups.motion(), clean.motion())  # what the discriminator sees is exact


def test_history_and_motion_slide_over_time(build: Build) -> None:
    env = build(3, observation_noise=1.0)
    carrier = env.reset()
    measured, frames = [carrier[keys.PROPRIOCEPTION]] * 10, [carrier[keys.MOTION][:, -1]] * 2
    for action in actions(15, 3):
        carrier = env.step(carrier.set(keys.ACTION, action))["next"]
        measured.append(carrier[keys.PROPRIOCEPTION])
        frames.append(carrier[keys.MOTION][:, -1])
        assert torch.equal(carrier[keys.HISTORY], torch.stack(measured[-10:], 1))
        assert torch.equal(carrier[keys.MOTION], torch.stack(frames[-2:], 1))


def test_motion_frames_far_apart(build: Build) -> None:
    dense, sparse = build(3, motion_offsets=range(7)), build(3, motion_offsets=(0, 2, 5, 6))
    carriers = [env.reset() for env in (dense, sparse)]
    for action in actions(9, 3):
        carriers = [
            env.step_and_maybe_reset(carrier.set(keys.ACTION, action))[1]
            for env, carrier in zip((dense, sparse), carriers, strict=True)
        ]
        assert torch.equal(carriers[0][keys.MOTION][:, [0, 2, 5, 6]], carriers[1][keys.MOTION])


def test_before_an_episode_stand_the_frames_of_the_reference(build: Build) -> None:
    reference = standing_states(torch.arange(5))
    reference["past_motion"] = torch.arange(5.0)[:, None, None].expand(5, 3, 49) + torch.tensor([[0.1], [0.2], [0.3]])
    env = build(4, reference=reference, motion_offsets=(0, 1, 3))
    carrier = env.reset()
    skill = carrier[keys.SKILL].float()
    now = carrier[keys.MOTION][:, 2]
    assert torch.equal(carrier[keys.MOTION][:, :2, 0], skill[:, None] + torch.tensor([0.1, 0.2]))
    carrier = env.step(carrier.set(keys.ACTION, torch.zeros(4, 12)))["next"]
    assert torch.equal(carrier[keys.MOTION][:, :2, 0], skill[:, None] + torch.tensor([0.2, 0.3]))
    carrier = env.step(carrier.set(keys.ACTION, torch.zeros(4, 12)))["next"]
    assert torch.equal(carrier[keys.MOTION][:, 1], now)


def test_earlier_observations_stay_as_they_were(build: Build) -> None:
    env = build(2, push_interval=0.06, resample_period=0.1)
    carrier = env.reset()
    kept, copies = [], []
    for action in actions(12, 2):
        step, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, action))
        kept.append(step)
        copies.append(step.clone())
    for one, other in zip(kept, copies, strict=True):
        assert (one == other).all()


def test_motion_frames_are_those_of_a_clip_of_the_same_motion(build: Build) -> None:
    env = build(4)
    carrier = env.reset()
    for action in actions(20, 4):
        carrier = env.step(carrier.set(keys.ACTION, action))["next"]
    robots = env.simulator
    world_rate = features.rotations.rotate(robots.root_quaternion, robots.root_angular_velocity)
    clip = features.clip_frames(
        robots.root_position[:, 2],
        robots.root_quaternion,
        robots.root_linear_velocity,
        world_rate,
        robots.joint_position,
        robots.joint_velocity,
    )
    torch.testing.assert_close(carrier[keys.MOTION][:, -1], clip, atol=1e-5, rtol=0)


def test_peak_is_the_highest_trunk_of_45_steps(build: Build) -> None:
    env = build(3)
    carrier = env.reset()
    env.set_commands(torch.tensor([4, 4, 0]), torch.zeros(3, 5))
    heights = [env.simulator.root_position[:, 2]] * 45
    for k, action in enumerate(actions(60, 3)):
        if k == 5:  # a hop, whose height must be forgotten 0.9 s after it
            action = torch.tensor([0.0, -3.0, 3.0] * 4).repeat(3, 1)
        carrier = env.step(TensorDict({keys.ACTION: action}, [3]))["next"]
        heights.append(env.simulator.root_position[:, 2])
        highest = torch.stack(heights[-45:]).amax(0)
        torch.testing.assert_close(carrier[keys.PEAK][:, 0], highest * torch.tensor([1.0, 1.0, 0.0]))
    assert torch.stack(heights).amax(0)[0] > heights[-1][0]


def test_state_dict_restores(neutral: Neutral, groups: ObservationGroups, generator: torch.Generator) -> None:
    groups.update(neutral(roll=torch.full((2,), 0.3), foot_contact=torch.full((2, 4), 9.0)))
    saved = groups.state_dict()
    groups.update(neutral())
    other = ObservationGroups(2, generator)
    other.load_state_dict(saved)
    other.update(neutral())
    for name, value in groups.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name
