"""Every reward term against a number worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from agility_rl.envs import rewards
from agility_rl.envs.rewards import LOCOMOTION_REWARDS
from agility_rl.envs.state import LocomotionState

Neutral = Callable[..., LocomotionState]
COMMAND = torch.tensor([[1.0, 0.2, 1.0, 0.5, 0.3]])


def joints(**values: float) -> Tensor:
    """Zeros ``[1, 12]`` but for entries named ``j0`` to ``j11``."""
    row = torch.zeros(1, 12)
    for name, value in values.items():
        row[0, int(name[1:])] = value
    return row


def pose(**values: float) -> Tensor:
    """The default pose ``[1, 12]`` with some joints at given angles."""
    row = torch.tensor([[0.0, 0.9, -1.8] * 4])
    for name, value in values.items():
        row[0, int(name[1:])] = value
    return row


JUMPING = torch.tensor([True])
TURN = torch.tensor([[0.0, 0.0, -0.8, 0.0, 0.3]])
CASES: list[tuple[str, dict[str, Any], float]] = [
    # errors 0.5 and 0.2 m/s: exp(-(0.25 + 0.04) / 0.25)
    ("linear_velocity", {"command": COMMAND, "linear_velocity": torch.tensor([[0.5, 0.0, 9.0]])}, 0.3134862),
    ("linear_velocity", {"command": COMMAND, "linear_velocity": torch.tensor([[1.0, 0.2, 0.0]])}, 1.0),
    # along the command: (1.0 * 0.5 + 0.2 * 0.1) / sqrt(1.04), half of its sqrt(1.04); 1.5 times it misses by half too
    ("velocity_progress", {"command": COMMAND, "mean_velocity": torch.tensor([[0.5, 0.1, 9.0]])}, 0.5),
    ("velocity_progress", {"command": COMMAND, "mean_velocity": torch.tensor([[1.5, 0.3, 0.0]])}, 0.5),
    ("velocity_progress", {"command": 0.05 * COMMAND}, 1.0 - 0.05 * 1.04**0.5 / 0.1),
    ("velocity_progress", {"command": COMMAND, "mean_velocity": torch.tensor([[-9.0, 0.0, 0.0]])}, -1.0),
    ("velocity_progress", {"command": COMMAND}, 0.0),
    ("turn_progress", {"command": TURN, "mean_yaw_rate": torch.tensor([-0.3])}, 0.5),
    ("turn_progress", {"command": TURN, "mean_yaw_rate": torch.tensor([-1.0])}, 0.8),
    ("turn_progress", {"command": TURN, "mean_yaw_rate": torch.tensor([4.0])}, -1.0),
    ("velocity_progress", {"command": 0.0 * COMMAND}, 1.0),
    ("velocity_progress", {"command": 0.0 * COMMAND, "mean_velocity": torch.tensor([[0.03, -0.04, 9.0]])}, 0.5),
    ("low_feet", {"low_feet": torch.tensor([0.17])}, 0.17),
    ("lateral_progress", {"command": COMMAND, "mean_velocity": torch.tensor([[9.0, 0.05, 9.0]])}, 0.5),
    ("lateral_progress", {"command": COMMAND, "mean_velocity": torch.tensor([[1.0, -0.7, 0.0]])}, -1.0),
    # error 0.5 rad/s: exp(-1)
    ("yaw_rate", {"command": COMMAND, "angular_velocity": torch.tensor([[9.0, 9.0, 0.5]])}, 0.3678794),
    ("jump_height_window", {"command": COMMAND, "root_height": torch.tensor([[0.46]]), "jumping": JUMPING}, 10.0),
    ("jump_height_window", {"command": COMMAND, "root_height": torch.tensor([[0.44]]), "jumping": JUMPING}, 0.0),
    ("jump_height_window", {"command": COMMAND, "root_height": torch.tensor([[0.50]])}, 0.0),
    # 0.1 m below: exp(-0.01 / 0.01)
    ("jump_height_peak", {"command": COMMAND, "peak_height": torch.tensor([0.4]), "jumping": JUMPING}, 0.3678794),
    ("jump_height_peak", {"command": COMMAND, "peak_height": torch.tensor([0.5])}, 0.0),
    # 0.1 m below: exp(-10 * 0.01 / 0.25)
    ("locomotion_height", {"command": COMMAND, "root_height": torch.tensor([[0.2]])}, 0.6703200),
    ("locomotion_height", {"command": COMMAND, "root_height": torch.tensor([[0.3]]), "jumping": JUMPING}, 0.0),
    ("torque", {"torque": torch.full((1, 12), -2.0)}, 48.0),
    ("torque_change", {"torque": torch.full((1, 12), 3.0), "previous_torque": torch.full((1, 12), 1.0)}, 48.0),
    # 0.2 rad/s in 0.02 s are 10 rad/s^2, twelve times
    (
        "joint_acceleration",
        {"joint_velocity": torch.full((1, 12), 0.3), "previous_joint_velocity": joints() + 0.1},
        1200,
    ),
    # hip: 0.9 * 1.0472 = 0.94248; front calf: middle -1.78023, half range 0.942470 -> upper soft stop -0.932007
    ("joint_position_limit", {"joint_position": pose(j0=1.0)}, 0.0575200),
    ("joint_position_limit", {"joint_position": pose(j0=-1.0, j2=-0.9)}, 0.0575200 + 0.0320070),
    ("joint_position_limit", {}, 0.0),
    # hip 0.5 over 30.1, thigh 1.9 over (counts as 1), calf 0.25 over 20.07
    ("joint_velocity_limit", {"joint_velocity": joints(j0=30.6, j4=-32.0, j8=20.32, j9=30.0)}, 1.75),
    # hip 5 over 20, calf 1 over 40
    ("torque_limit", {"torque": joints(j0=25.0, j2=-41.0, j3=-19.0, j5=39.0)}, 6.0),
    (
        "collision",
        {"thigh_contact": torch.tensor([[0.2, 0.0, 5.0, 0.05]]), "calf_contact": torch.tensor([[0.0, 0.0, 0.0, 9.0]])},
        3.0,
    ),
    ("collision", {"foot_contact": torch.full((1, 4), 99.0), "hip_contact": torch.full((1, 4), 99.0)}, 0.0),
    ("action_smoothness", {"action": joints() + 0.75, "previous_action": joints() + 0.25}, 3.0),
    ("hip_deviation", {"joint_position": pose(j0=0.1, j3=-0.2, j6=0.3, j1=2.0)}, 0.14),
    ("pose_deviation", {"joint_position": pose(j0=0.1, j3=-0.2, j6=0.3, j1=1.0)}, 0.15),
]


@pytest.mark.parametrize(("name", "changes", "expected"), CASES)
def test_values(neutral: Neutral, name: str, changes: dict[str, Any], expected: float) -> None:
    value = getattr(rewards, name)(neutral(1, **changes))
    assert value.shape == (1,) and value.dtype == torch.float32
    assert value.item() == pytest.approx(expected, rel=1e-5, abs=2e-6)


def test_every_term_has_a_value_above() -> None:
    tested = {name for name, _, _ in CASES}
    assert {term.function.__name__ for term in LOCOMOTION_REWARDS.values()} <= tested
    assert {"jump_height_peak", "velocity_progress"} <= tested


def test_weights_are_those_of_the_method_notes() -> None:
    assert {name: term.weight for name, term in LOCOMOTION_REWARDS.items()} == {
        "linear_velocity": 2.0,
        "yaw_rate": 1.5,
        "jump_height": 0.2,
        "locomotion_height": 0.1,
        "torque": -1e-5,
        "torque_change": -1e-7,
        "joint_acceleration": -2.5e-7,
        "joint_position_limit": -0.1,
        "joint_velocity_limit": -0.1,
        "torque_limit": -0.03,
        "collision": -10.0,
        "action_smoothness": -0.1,
        "hip_deviation": -0.5,
        "pose_deviation": -0.1,
    }


def test_terms_treat_robots_apart(neutral: Neutral, generator: torch.Generator) -> None:
    many = neutral(3)
    for name, value in vars(many).items():
        if isinstance(value, Tensor) and value.is_floating_point():
            setattr(many, name, value + torch.randn(value.shape, generator=generator))
    many.jumping = torch.tensor([True, False, True])
    for term in LOCOMOTION_REWARDS.values():
        whole = term.function(many)
        for row in range(3):
            fields = {k: v[row : row + 1] if isinstance(v, Tensor) else v for k, v in vars(many).items()}
            torch.testing.assert_close(term.function(LocomotionState(**fields)), whole[row : row + 1])
            assert math.isfinite(whole[row])
