"""The state that terms of the course see has the shapes it documents, on the real environment."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.envs import AgilityEnv
from agility_rl.envs.agility_rewards import AgilityTerm, goal_velocity
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.course import Course, Slot


def test_shapes_and_consistency_on_the_real_course() -> None:
    seen: list[AgilityState] = []

    def look(state: AgilityState) -> torch.Tensor:
        seen.append(state)
        return torch.zeros(len(state.position))

    env = AgilityEnv(
        3,
        lambda td: td.set("action", torch.zeros(3, 12)),
        simulator_options={"num_threads": 1},
        rewards={"look": AgilityTerm(1.0, look)},
    )
    env.rollout(3)
    state = seen[-1]
    shapes = {
        "position": (3,), "velocity": (2,), "goal_distance": (), "goal_direction": (2,), "heading_error": (2,),
        "target_speed": (), "at_goal": (), "foot_on_edge": (4,), "behaviours": (3,), "parameters": (2, 5, 6),
        "applied": (2, 6),
    }  # fmt: skip
    for name, shape in shapes.items():
        assert getattr(state, name).shape == (3, *shape), name
    torch.testing.assert_close(state.goal_direction.norm(dim=-1), torch.ones(3))
    goal = env.arena.progress.goal()
    torch.testing.assert_close((goal - state.position[:, :2]).norm(dim=-1), state.goal_distance)
    bearing = torch.atan2(*state.goal_direction.flip(-1).unbind(-1)) - state.robot.yaw
    torch.testing.assert_close(torch.cos(bearing), torch.cos(state.heading_error[:, 0]), atol=1e-5, rtol=0)
    assert seen[0].at_goal.all()  # episodes start at their first way-point
    env.close()


def test_velocity_and_feet_are_those_of_the_world() -> None:
    """A bar that is passed along +y, 1.8 m behind its first way-point; a robot flies over both at 2.5 m/s.

    That is as fast as is paid for. Its front feet are 0.19 m ahead of the trunk, the bar's zone is 0.1 m wide each way.
    """
    seen: list[AgilityState] = []

    def look(state: AgilityState) -> torch.Tensor:
        seen.append(state)
        return torch.zeros(1)

    env = AgilityEnv(
        1,
        lambda td: td.set("action", torch.zeros(1, 12)),
        Course("bar", (10.0, 10.0), (Slot("bar_jump", (5.0, 5.0), math.pi / 2),), wall_height=None),
        simulator_options={"num_threads": 1},
        rewards={"look": AgilityTerm(1.0, look)},
    )
    start = env.reset()
    for y, towards, edges in ((3.0, 1.0, [False] * 4), (4.76, -1.0, [True, True, False, False])):
        env.simulator.reset(
            torch.ones(1, dtype=torch.bool),
            root_position=torch.tensor([[5.0, y, 3.0]]),
            root_quaternion=torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]]),
            root_linear_velocity=torch.tensor([[0.0, 2.5, 0.0]]),
            root_angular_velocity=torch.zeros(1, 3),
            joint_position=env.simulator.joint_position,
            joint_velocity=torch.zeros(1, 12),
        )
        env.rand_step(start)
        assert torch.equal(seen[-1].velocity, env.simulator.root_linear_velocity[:, :2])
        assert goal_velocity(seen[-1]).item() == pytest.approx(towards, abs=0.01)
        assert seen[-1].foot_on_edge.tolist() == [edges]
    env.close()
