"""Reference states: drawn by skill, and put into the engine in the right frames."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.locomotion import CLEARANCE
from agility_rl.envs.reference import STATE_ENTRIES, ReferenceStates, standing_states
from agility_rl.go2 import features
from agility_rl.go2.constants import DEFAULT_POSE


def states(skills: list[int]) -> TensorDict:
    """States that differ in everything; ``root_height`` is their number."""
    n, generator = len(skills), torch.Generator().manual_seed(1)
    return TensorDict(
        {
            "skill": torch.tensor(skills),
            "root_height": torch.arange(float(n))[:, None],
            "root_quaternion": torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=-1),
            "root_linear_velocity": torch.randn(n, 3, generator=generator),
            "root_angular_velocity": torch.randn(n, 3, generator=generator),
            "joint_position": torch.tensor(DEFAULT_POSE) + 0.1 * torch.randn(n, 12, generator=generator),
            "joint_velocity": torch.randn(n, 12, generator=generator),
        },
        [n],
    )


def test_each_skill_draws_only_its_own_states(generator: torch.Generator) -> None:
    skills = [3, 0, 1, 4, 2, 0, 3, 3]
    reference = ReferenceStates(states(skills))
    for skill in range(5):
        drawn = reference.states[reference.draw(torch.full((600,), skill), generator)]
        numbers = torch.bincount(drawn["root_height"][:, 0].long(), minlength=8)
        own = [i for i, s in enumerate(skills) if s == skill]
        assert numbers.nonzero()[:, 0].tolist() == own
        assert (numbers[own] - 600 / len(own)).abs().max() <= 60


def test_entries_of_a_state_stay_together(generator: torch.Generator) -> None:
    given = states([3, 0, 1, 4, 2, 0])
    given["past_motion"] = given["root_height"][:, None].repeat(1, 3, 49)
    reference = ReferenceStates(given)
    number = reference.draw(torch.tensor([0, 1, 2, 3, 4, 0]), generator)
    assert reference.past_motion is not None
    for row, past in zip(reference.states[number], reference.past_motion[number], strict=True):
        original = given[int(row["root_height"])]
        assert all(torch.equal(row[name], original[name]) for name in STATE_ENTRIES)
        assert (past == row["root_height"]).all()


def test_draws_follow_the_generator() -> None:
    reference = ReferenceStates(states([0, 1, 2, 3, 4] * 20))
    skill = torch.zeros(50, dtype=torch.int64)
    one, other = (reference.draw(skill, torch.Generator().manual_seed(7)) for _ in range(2))
    assert torch.equal(one, other)


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_share_of_the_draws_stands(share: float) -> None:
    """One state of each skill does; of the others each is drawn as often."""
    reference = ReferenceStates(states([0, 1, 2, 3, 4] * 3))
    skill = torch.full((4000,), 2)
    number = reference.draw(skill, torch.Generator().manual_seed(0), share) - reference.first[2]
    moving = [(1.0 - share) / 3] * 3
    assert torch.bincount(number, minlength=4).div(4000).tolist() == pytest.approx([*moving, share], abs=0.03)
    stands = reference.states[reference.first + reference.count]
    assert (stands["joint_position"] == torch.tensor(DEFAULT_POSE)).all()


def test_an_environment_starts_from_a_stand_as_often_as_told(build: Callable[..., LocomotionEnv]) -> None:
    env, pose = build(40, reference=states([0, 1, 2, 3, 4]), standing_starts=1.0), torch.tensor(DEFAULT_POSE)
    env.reset()
    torch.testing.assert_close(env.simulator.joint_position, pose.expand(40, 12))
    env.standing_starts = 0.0
    env.reset()
    assert ((env.simulator.joint_position - pose).abs().amax(-1) > 0.01).all()
    with pytest.raises(ValueError, match=r"standing_starts: expected a share from 0 to 1, got 1\.5"):
        build(2, standing_starts=1.5)


def test_standing_states_stand() -> None:
    state = ReferenceStates.standing().states
    assert state["joint_position"].unique(dim=0).tolist() == torch.tensor([DEFAULT_POSE]).tolist()
    assert not state["joint_velocity"].any() and not state["root_linear_velocity"].any()
    # soles on the ground: thigh and calf of 0.213 m at 0.9 rad each, foot radius 0.022 m, foot offset -0.002 m
    sole = 2 * 0.213 * np.cos(0.9) + 0.022
    assert state["root_height"][0].item() == pytest.approx(sole, abs=2.5e-3)


def test_a_stand_has_stood_before(build: Callable[..., LocomotionEnv]) -> None:
    """The frames before a stand are those of the environment at its start, and no velocity is in them."""
    reference = standing_states(torch.arange(5), span=8)
    motion = build(3, reference=reference, motion_offsets=(0, 4, 8)).reset()[keys.MOTION]
    torch.testing.assert_close(motion[:, 0], motion[:, 1])
    height = features.layout_slice(features.MOTION_LAYOUT, "root_height")
    feet = features.layout_slice(features.MOTION_LAYOUT, "foot_position")
    other = torch.ones(motion.shape[-1], dtype=torch.bool)
    other[height] = False  # the engine's robots are let down from a few millimetres above the ground
    torch.testing.assert_close(motion[:, 0, other], motion[:, 2, other], atol=1e-5, rtol=0.0)
    torch.testing.assert_close(motion[:, 0, height] + CLEARANCE, motion[:, 2, height])
    for name in ("linear_velocity", "angular_velocity", "joint_velocity"):
        assert not motion[..., features.layout_slice(features.MOTION_LAYOUT, name)].any()
    assert motion[..., feet].any()


def test_errors_name_what_is_missing() -> None:
    with pytest.raises(ValueError, match="lack joint_velocity, root_height; they have"):
        ReferenceStates(states([0, 1, 2, 3, 4]).exclude("root_height", "joint_velocity"))
    with pytest.raises(ValueError, match="no reference state for pace, jump"):
        ReferenceStates(states([0, 2, 3]))


def test_a_past_of_another_length_is_refused(build: Callable[..., LocomotionEnv]) -> None:
    given = states([0, 1, 2, 3, 4]).set("past_motion", torch.zeros(5, 7, 49))
    with pytest.raises(ValueError, match=r"bring 7 past motion frames, expected 8; .* same motion offsets"):
        build(2, reference=given, motion_offsets=(0, 4, 8))


def test_resets_turn_a_state_about_the_vertical_only(build: Callable[..., LocomotionEnv]) -> None:
    given = states([0, 1, 2, 3, 4])
    given["root_height"] = 0.5 + 0.1 * given["root_height"]
    env = build(40, reference=given)
    observation = env.reset()
    simulator = env.simulator
    source = given[observation[keys.SKILL]]
    torch.testing.assert_close(simulator.root_position[:, 2:], source["root_height"] + CLEARANCE)
    assert torch.equal(simulator.joint_position, source["joint_position"])
    assert torch.equal(simulator.joint_velocity, source["joint_velocity"])
    yaws = []
    for row in range(40):
        before, after, velocity = np.zeros(9), np.zeros(9), np.zeros(3)
        mujoco.mju_quat2Mat(before, source["root_quaternion"][row].double().numpy())
        mujoco.mju_quat2Mat(after, simulator.root_quaternion[row].double().numpy())
        before, after = before.reshape(3, 3), after.reshape(3, 3)
        turn = after @ before.T
        np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-5)  # a pure yaw
        yaws.append(np.arctan2(turn[1, 0], turn[0, 0]))
        velocity = source["root_linear_velocity"][row].double().numpy()
        np.testing.assert_allclose(simulator.root_linear_velocity[row].numpy(), turn @ velocity, atol=1e-5)
        # the engine keeps the angular velocity in the base frame, where a yaw changes nothing
        spin = before.T @ source["root_angular_velocity"][row].double().numpy()
        np.testing.assert_allclose(simulator.root_angular_velocity[row].numpy(), spin, atol=1e-5)
    assert np.ptp(yaws) > np.pi
