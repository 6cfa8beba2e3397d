"""The state that rewards see, against the engine's own numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from itertools import pairwise

import mujoco
import numpy as np
import torch

from agility_rl import keys
from agility_rl.behaviours import JUMP
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import Randomization
from agility_rl.envs.rewards import RewardTerm
from agility_rl.envs.state import LocomotionState
from agility_rl.go2.constants import CONTACT_GROUPS, DEFAULT_POSE

Build = Callable[..., LocomotionEnv]
N = 3


def states_of_a_walk(build: Build, steps: int) -> tuple[LocomotionEnv, list[LocomotionState], list[torch.Tensor]]:
    """States as a reward term gets them, and the actions that led there."""
    seen: list[LocomotionState] = []

    def look(state: LocomotionState) -> torch.Tensor:
        seen.append(state)
        return torch.zeros(N)

    env = build(N, rewards={"look": RewardTerm(1.0, look)}, randomization=Randomization())
    carrier = env.reset()
    generator = torch.Generator().manual_seed(2)
    actions = [torch.randn(N, 12, generator=generator) for _ in range(steps)]
    for action in actions:
        carrier = env.step(carrier.set(keys.ACTION, action))["next"]
    return env, seen, actions


def test_every_field_is_documented_and_has_the_batch_first(build: Build) -> None:
    _, seen, _ = states_of_a_walk(build, 2)
    for field in fields(LocomotionState):
        assert f"    {field.name}: " in (LocomotionState.__doc__ or ""), field.name
        if field.name != "dt":
            assert getattr(seen[-1], field.name).shape[0] == N, field.name
    assert seen[-1].dt == 0.02


def test_base_frame(build: Build) -> None:
    env, seen, _ = states_of_a_walk(build, 20)
    state, batch = seen[-1], env.simulator.batch
    qpos, qvel = np.array(batch.bind("qpos")), np.array(batch.bind("qvel"))
    for row in range(N):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, qpos[row, 3:7])
        matrix = matrix.reshape(3, 3)
        np.testing.assert_allclose(state.linear_velocity[row].numpy(), matrix.T @ qvel[row, :3], atol=1e-5)
        np.testing.assert_allclose(state.angular_velocity[row].numpy(), qvel[row, 3:6], atol=1e-5)
        # intrinsic z-y-x: the third row of the matrix is (-sin p, cos p sin r, cos p cos r)
        roll, pitch, yaw = (float(angle[row]) for angle in (state.roll, state.pitch, state.yaw))
        expected = [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
        np.testing.assert_allclose(matrix[2], expected, atol=1e-5)
        np.testing.assert_allclose(np.arctan2(matrix[1, 0], matrix[0, 0]), yaw, atol=1e-5)
    np.testing.assert_allclose(state.root_height[:, 0].numpy(), qpos[:, 2], atol=1e-6)
    np.testing.assert_allclose(state.joint_position.numpy(), qpos[:, 7:], atol=1e-6)


def test_torque_is_that_of_the_pd_controller_before_the_limits(build: Build) -> None:
    env, seen, actions = states_of_a_walk(build, 6)
    state = seen[-1]
    target = np.array(DEFAULT_POSE) + np.array([0.125, 0.25, 0.25] * 4) * actions[-1].numpy()
    model = env.simulator.parameter
    torque = model("stiffness").numpy() * (target - state.joint_position.numpy())
    torque -= model("damping").numpy() * state.joint_velocity.numpy()
    np.testing.assert_allclose(state.torque.numpy(), torque, atol=1e-4)


def test_previous_values_are_those_of_the_step_before(build: Build) -> None:
    _, seen, actions = states_of_a_walk(build, 6)
    for before, now in pairwise(seen):
        assert torch.equal(now.previous_torque, before.torque)
        assert torch.equal(now.previous_joint_velocity, before.joint_velocity)
        assert torch.equal(now.previous_action, before.action)
    for state, action in zip(seen, actions, strict=True):
        assert torch.equal(state.action, action)
    assert not seen[0].previous_action.any()


def test_contact_by_link(build: Build) -> None:
    env, seen, _ = states_of_a_walk(build, 12)
    state, force = seen[-1], env.simulator.contact_force
    assert torch.equal(state.trunk_contact, force[:, CONTACT_GROUPS.index("trunk")])
    for link in ("hip", "thigh", "calf", "foot"):
        columns = [CONTACT_GROUPS.index(f"{leg}_{link}") for leg in ("FL", "FR", "RL", "RR")]
        assert torch.equal(getattr(state, f"{link}_contact"), force[:, columns]), link
    assert state.foot_contact.any()


def test_commands_are_those_that_were_in_force(build: Build) -> None:
    env, seen, _ = states_of_a_walk(build, 1)
    skill, command = torch.tensor([JUMP, 0, 2]), torch.arange(15.0).reshape(3, 5)
    env.set_commands(skill, command)
    env.rand_step(env.reset())  # the reset draws new ones
    env.set_commands(skill, command)
    env.rand_step()
    assert torch.equal(seen[-1].command, command)
    assert seen[-1].jumping.tolist() == [True, False, False]
