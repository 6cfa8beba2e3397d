"""Each reward term of the course by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from agility_rl.envs import agility_rewards as rewards
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.state import LocomotionState

Make = Callable[..., AgilityState]


def test_weights_are_those_of_s5_and_of_the_notes() -> None:
    weights = {name: term.weight for name, term in rewards.AGILITY_REWARDS.items()}
    assert weights == {
        "goal_velocity": 0.4,
        "heading": 2.0,
        "reach_goal": 5.0,
        "collision": -20.0,
        "edge_contact": -1.0,
        "decision_smoothness": -0.1,
        "behaviour_switching": -1.0,
    }
    assert rewards.TERMINATION == -50.0


def test_goal_velocity_counts_up_to_the_target(on_course: Make) -> None:
    direction = torch.tensor([[1.0, 0.0], [0.6, 0.8], [1.0, 0.0]])
    velocity = torch.tensor([[0.2, 5.0], [1.2, 1.6], [-0.4, 0.0]])
    state = on_course(3, goal_direction=direction, velocity=velocity, target_speed=torch.tensor([0.4, 2.5, 0.4]))
    torch.testing.assert_close(rewards.goal_velocity(state), torch.tensor([0.5, 0.8, -1.0]), atol=1e-4, rtol=0)
    paid = rewards.goal_velocity(state, least=1.2)
    torch.testing.assert_close(paid, torch.tensor([0.2 / 1.2, 0.8, -0.4 / 1.2]), atol=1e-4, rtol=0)
    fast = on_course(1, goal_direction=direction[:1], velocity=torch.tensor([[3.0, 0.0]]))
    assert rewards.goal_velocity(fast).item() == pytest.approx(1.0, abs=1e-4)


def test_a_sprint_counts_beyond_a_speed(on_course: Make) -> None:
    direction = torch.tensor([[1.0, 0.0], [0.6, 0.8], [1.0, 0.0]])
    velocity = torch.tensor([[1.9, 5.0], [1.8, 2.4], [-4.0, 0.0]])  # 1.9, 3 and -4 m/s towards the goal
    state = on_course(3, goal_direction=direction, velocity=velocity)
    torch.testing.assert_close(rewards.sprint(state, beyond=2.0), torch.tensor([0.0, 1.0, 0.0]))


def test_heading_and_goal(on_course: Make) -> None:
    state = on_course(2, heading_error=torch.tensor([[0.5, 3.0], [-1.0, 0.0]]), at_goal=torch.tensor([True, False]))
    torch.testing.assert_close(rewards.heading(state), torch.tensor([math.exp(-0.5), math.exp(-1.0)]))
    assert rewards.reach_goal(state).tolist() == [1.0, 0.0]


def test_collisions(on_course: Make, neutral: Callable[..., LocomotionState]) -> None:
    force = torch.tensor([[0.2, 0.0, 0.05, 3.0]])
    robot = neutral(1, thigh_contact=force, calf_contact=force, hip_contact=force, trunk_contact=torch.tensor([9.0]))
    state = on_course(1, robot=robot)
    assert rewards.collision(state).tolist() == [4.0]
    assert rewards.collision_of_any_body(state).tolist() == [7.0]


def test_edges_need_foot_and_force(on_course: Make, neutral: Callable[..., LocomotionState]) -> None:
    robot = neutral(1, foot_contact=torch.tensor([[9.0, 9.0, 1.9, 2.1]]))
    state = on_course(1, robot=robot, foot_on_edge=torch.tensor([[True, False, True, True]]))
    assert rewards.edge_contact(state).tolist() == [2.0]


def test_changes_of_decisions(on_course: Make) -> None:
    applied = torch.zeros(1, 2, 6)
    applied[0, 0, :2] = torch.tensor([0.3, -0.4])
    parameters = torch.zeros(1, 2, 5, 6)
    parameters[0, 0, 1, 2], parameters[0, 0, 4, 5] = 1.0, 2.0
    state = on_course(1, applied=applied, parameters=parameters, behaviours=torch.tensor([[4, 2, 2]]))
    assert rewards.decision_smoothness(state).item() == pytest.approx(0.25)
    assert rewards.decision_change(state).item() == pytest.approx(math.sqrt(4 + 1 + 4))
    assert rewards.behaviour_switching(state).item() == 2.0
    assert rewards.behaviour_switching(on_course(1, behaviours=torch.tensor([[4, 4, 2]]))).item() == 1.0
    assert rewards.behaviour_switching(on_course(1, behaviours=torch.tensor([[2, 2, 2]]))).item() == 0.0
