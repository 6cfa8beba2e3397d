"""Reward terms of the agility course: functions of an :class:`AgilityState`, each ``-> [N]``, without weight and time.

Sources: supplement S5 for the regularisation terms; the others are missing there and come from the released code
(method notes, section 5.6). The environment multiplies each term by its weight and the control step, logs it by name,
clips the sum at zero, and adds :data:`TERMINATION` behind the clip.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from agility_rl.envs import rewards
from agility_rl.envs.agility_state import AgilityState
from agility_rl.go2 import features

TERMINATION = -50.0
"""Weight of a failure, times the control step (section 5.6)."""
TERMINATION_TERM = "termination"
"""Name under which it is logged."""


class AgilityTerm(NamedTuple):
    """A reward function and its weight."""

    weight: float
    function: Callable[[AgilityState], Tensor]


def goal_velocity(state: AgilityState, least: float = 0.0) -> Tensor:
    """``min(v_xy . d, v_t) / (v_t + 1e-5)``: speed towards the goal, up to that of the obstacle (section 5.6).

    Args:
        state: the present.
        least: v_t where the obstacle's is smaller [m/s] (ours): the release pays most of them up to 0.4 m/s only.
    """
    towards = (state.velocity * state.goal_direction).sum(-1)
    target = state.target_speed.clamp(min=least)
    return torch.minimum(towards, target) / (target + 1e-5)


def sprint(state: AgilityState, beyond: float) -> Tensor:
    """``max(v_xy . d - beyond, 0)`` [m/s]: what :func:`goal_velocity` cannot say.

    Paid by the metre, speed up to a target earns the same on a given way, however fast it is covered; beyond ``beyond``
    a sprint earns more, the faster it is.

    Source: ours.

    Args:
        state: the present.
        beyond: speed towards the goal that earns nothing yet [m/s].
    """
    return ((state.velocity * state.goal_direction).sum(-1) - beyond).clamp(min=0.0)


def heading(state: AgilityState) -> Tensor:
    """``exp(-|heading error|)`` to the current way-point (section 5.6)."""
    return torch.exp(-state.heading_error[:, 0].abs())


def reach_goal(state: AgilityState) -> Tensor:
    """1 inside the goal radius (section 5.6)."""
    return state.at_goal.float()


def collision(state: AgilityState) -> Tensor:
    """Number of thighs and calves in contact (weight: S5; that they are counted: released code)."""
    return rewards.collision(state.robot)


def collision_of_any_body(state: AgilityState) -> Tensor:
    """Number of bodies but the feet in contact (section 5.6); an alternative to :func:`collision`."""
    robot = state.robot
    force = torch.cat((robot.trunk_contact[:, None], robot.hip_contact, robot.thigh_contact, robot.calf_contact), -1)
    return (force > rewards.COLLISION_FORCE).sum(-1).float()


def edge_contact(state: AgilityState) -> Tensor:
    """Number of feet that stand on the edge of an obstacle (S5)."""
    return ((state.robot.foot_contact > features.FOOT_CONTACT_FORCE) & state.foot_on_edge).sum(-1).float()


def decision_smoothness(state: AgilityState) -> Tensor:
    """``|a - a'|^2`` of the six applied parameters (S5).

    S5 leaves open which numbers a^T holds. Those of the behaviours that were not chosen move nothing, so that
    punishing them would punish exploration alone.
    """
    return (state.applied[:, 0] - state.applied[:, 1]).square().sum(-1)


def decision_change(state: AgilityState) -> Tensor:
    """``|a - a'|`` over the behaviour's index and all parameters (section 5.6); an alternative, with weight -0.2."""
    index = (state.behaviours[:, 0] - state.behaviours[:, 1]).float()
    change = (state.parameters[:, 0] - state.parameters[:, 1]).flatten(1)
    return torch.cat((index[:, None], change), -1).norm(dim=-1)


def behaviour_switching(state: AgilityState) -> Tensor:
    """``(|k'' - k| + |k' - k|) / 2`` with the behaviour's index k, of now and the two steps before (section 5.6)."""
    now, before, earlier = state.behaviours.unbind(-1)
    return ((earlier - now).abs() + (before - now).abs()) / 2.0


AGILITY_REWARDS: Mapping[str, AgilityTerm] = {
    "goal_velocity": AgilityTerm(0.4, goal_velocity),
    "heading": AgilityTerm(2.0, heading),
    "reach_goal": AgilityTerm(5.0, reach_goal),
    "collision": AgilityTerm(-20.0, collision),
    "edge_contact": AgilityTerm(-1.0, edge_contact),
    "decision_smoothness": AgilityTerm(-0.1, decision_smoothness),
    "behaviour_switching": AgilityTerm(-1.0, behaviour_switching),
}
"""Weights of supplement S5 where it has them (collision, edge contact, smoothness), else of the released code."""
