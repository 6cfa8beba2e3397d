"""Conditions that end an episode as a failure: plain functions of a state, each ``-> bool [N]``."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from agility_rl.envs.state import LocomotionState

Termination = Callable[[LocomotionState], Tensor]

TERMINATION_FORCE = 1.0
"""Force on trunk or hip that ends an episode [N] (released code)."""


def body_contact(state: LocomotionState) -> Tensor:
    """Trunk (head included) or a hip presses on something with more than 1 N (method notes, section 4.2)."""
    return (state.trunk_contact > TERMINATION_FORCE) | (state.hip_contact > TERMINATION_FORCE).any(-1)


def thigh_contact(state: LocomotionState) -> Tensor:
    """A thigh presses on something with more than 1 N: sitting is a failure (stage 3's rule, method notes 5.6)."""
    return (state.thigh_contact > TERMINATION_FORCE).any(-1)


def diverged(state: LocomotionState) -> Tensor:
    """The engine reported a bad position, velocity, acceleration or control."""
    return state.unstable


LOCOMOTION_TERMINATIONS: tuple[Termination, ...] = (body_contact, diverged)
"""Failures of stage 1 (method notes, section 4.2)."""
