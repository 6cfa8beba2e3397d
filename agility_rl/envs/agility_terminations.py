"""Conditions that end an episode on the course as a failure: plain functions of a state, each ``-> bool [N]``.

Source: method notes, section 5.6 (released code).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from agility_rl.envs import terminations
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.course import GOAL_DISTANCE

Termination = Callable[[AgilityState], Tensor]

TILT = 1.5
"""Roll or pitch that ends an episode [rad]."""
DEPTH = -0.25
"""Trunk height that ends an episode [m]."""


def body_contact(state: AgilityState) -> Tensor:
    """Trunk, head or a hip presses on something with more than 1 N."""
    return terminations.body_contact(state.robot)


def thigh_contact(state: AgilityState) -> Tensor:
    """A thigh presses on something with more than 1 N."""
    return terminations.thigh_contact(state.robot)


def tilted(state: AgilityState) -> Tensor:
    """Roll or pitch beyond 1.5 rad."""
    return torch.maximum(state.robot.roll.abs(), state.robot.pitch.abs()) > TILT


def sunk(state: AgilityState) -> Tensor:
    """The trunk is below -0.25 m."""
    return state.position[:, 2] < DEPTH


def lost(state: AgilityState) -> Tensor:
    """The current way-point is more than 4 m away."""
    return state.goal_distance > GOAL_DISTANCE


def diverged(state: AgilityState) -> Tensor:
    """The engine reported a bad position, velocity, acceleration or control."""
    return terminations.diverged(state.robot)


AGILITY_TERMINATIONS: Mapping[str, Termination] = {
    "body_contact": body_contact,
    "thigh_contact": thigh_contact,
    "tilted": tilted,
    "sunk": sunk,
    "lost": lost,
    "diverged": diverged,
}
"""All failures of section 5.6, by the name under which they are logged."""
