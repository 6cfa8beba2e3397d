"""What the terms of the agility course may look at after one control step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from agility_rl.envs.state import LocomotionState


@dataclass
class AgilityState:
    """A robot's state, where it is on its course, and what it has decided.

    Attributes:
        robot: the state that locomotion knows.
        position: ``[N, 3]`` of the trunk in the arena [m].
        velocity: ``[N, 2]`` horizontal, world frame [m/s].
        goal_distance: ``[N]`` to the current way-point [m].
        goal_direction: ``[N, 2]``, unit vector to it, world frame.
        heading_error: ``[N, 2]`` to the current and the next way-point [rad].
        target_speed: ``[N]``, speed towards the goal that is worth the full reward [m/s].
        at_goal: bool ``[N]``, inside the goal radius.
        foot_on_edge: bool ``[N, 4]``, a foot is over an edge zone.
        behaviours: int64 ``[N, 3]``, of this control step and the two before, newest first.
        parameters: ``[N, 2, 5, 6]``, of this control step and the one before, all behaviours.
        applied: ``[N, 2, 6]``, those of the chosen behaviour, clipped.
    """

    robot: LocomotionState
    position: Tensor
    velocity: Tensor
    goal_distance: Tensor
    goal_direction: Tensor
    heading_error: Tensor
    target_speed: Tensor
    at_goal: Tensor
    foot_on_edge: Tensor
    behaviours: Tensor
    parameters: Tensor
    applied: Tensor
