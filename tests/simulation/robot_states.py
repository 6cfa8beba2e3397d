"""States of simulated robots that the tests of the simulators share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.simulation import Simulator

POSE = torch.tensor(constants.DEFAULT_POSE)
FEET = list(constants.FOOT_GROUPS)
STATE = ("root_position", "root_quaternion", "root_linear_velocity", "root_angular_velocity")
STATE += ("joint_position", "joint_velocity", "contact_force", "unstable")


def everyone(n: int) -> Tensor:
    """All rows."""
    return torch.ones(n, dtype=torch.bool)


def only(n: int, *rows: int) -> Tensor:
    """Some rows."""
    mask = torch.zeros(n, dtype=torch.bool)
    mask[list(rows)] = True
    return mask


def standing(n: int, height: float = 0.3, **changes: Tensor) -> dict[str, Tensor]:
    """Arguments of a reset: still, in the default pose."""
    state = {
        "root_position": torch.tensor([0.0, 0.0, height]).repeat(n, 1),
        "root_quaternion": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        "root_linear_velocity": torch.zeros(n, 3),
        "root_angular_velocity": torch.zeros(n, 3),
        "joint_position": POSE.repeat(n, 1),
        "joint_velocity": torch.zeros(n, 12),
    }
    return state | changes


def targets(n: int, steps: int, seed: int = 0) -> Tensor:
    """Joint targets ``[steps, n, 12]`` about the default pose."""
    generator = torch.Generator().manual_seed(seed)
    return POSE + 0.25 * torch.randn(steps, n, 12, generator=generator)


def snapshot(simulator: Simulator) -> dict[str, Tensor]:
    """What a simulator shows now."""
    return {name: getattr(simulator, name) for name in STATE}


def assert_same(left: dict[str, Tensor], right: dict[str, Tensor], rows: Any = slice(None)) -> None:
    """Bit for bit."""
    for name in STATE:
        assert torch.equal(left[name][rows], right[name][rows]), name
