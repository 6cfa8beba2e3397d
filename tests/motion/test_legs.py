from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import kinematics
from agility_rl.motion.legs import A1, GO2


def test_the_go2_agrees_with_its_own_kinematics(generator: torch.Generator) -> None:
    joints = torch.rand(50, 12, generator=generator, dtype=torch.float64) * 2 - 1.5
    feet = torch.stack([GO2.leg(leg, joints[:, 3 * leg : 3 * leg + 3]) for leg in range(4)], 1)
    assert torch.allclose(feet, kinematics.forward(joints), atol=1e-7)


def test_a_bent_leg_by_hand() -> None:
    """Thigh straight back, calf straight down, hip turned outwards by 90 degrees: the calf points to the left."""
    foot = A1.leg(0, torch.tensor([math.pi / 2, math.pi / 2, -math.pi / 2]))
    assert torch.allclose(foot, torch.tensor([0.183 - 0.2, 0.047 + 0.2, 0.085]), atol=1e-6)


def test_right_and_hind_legs_are_images_of_the_front_left() -> None:
    joints = torch.tensor([0.2, 0.7, -1.3])
    left, right = A1.leg(0, joints), A1.leg(1, joints * torch.tensor([-1.0, 1.0, 1.0]))
    assert torch.allclose(right, left * torch.tensor([1.0, -1.0, 1.0]))
    assert torch.allclose(A1.leg(2, joints), left - torch.tensor([2 * 0.183, 0.0, 0.0]), atol=1e-6)


def test_leg_lengths() -> None:
    assert GO2.leg_length == pytest.approx(0.426)
    assert A1.leg_length == pytest.approx(0.4)
