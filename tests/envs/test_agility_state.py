"""The state that terms of the course see has the shapes it documents, on the real environment."""

from __future__ import annotations

import torch

from agility_rl.envs import AgilityEnv
from agility_rl.envs.agility_rewards import AgilityTerm
from agility_rl.envs.agility_state import AgilityState


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
