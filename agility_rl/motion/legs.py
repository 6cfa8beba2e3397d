"""Leg lengths of the robots whose clips are read, and the forward kinematics that tells whose joints a file holds.

All of them share one build: hip (about x), thigh and calf (about y), mirrored left to right and not front to back.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from agility_rl.go2 import constants


@dataclass(frozen=True)
class LegGeometry:
    """Dimensions of one quadruped [m]; x forward, y left, z up, all joint angles 0 with straight legs down.

    Attributes:
        name: for messages.
        half_length: hip joints in front of and behind the trunk's centre.
        half_width: hip joints left and right of it.
        abduction: from the hip axis sideways to the thigh.
        thigh: length.
        calf: length.
        foot_x: of the foot's centre, in the calf's frame.
    """

    name: str
    half_length: float
    half_width: float
    abduction: float
    thigh: float
    calf: float
    foot_x: float = 0.0

    @property
    def leg_length(self) -> float:
        """Thigh and calf together [m]."""
        return self.thigh + self.calf

    def leg(self, leg: int, joint_position: Tensor) -> Tensor:
        """Foot centre in the base frame, ``[*B, 3]`` [m], of one leg (FL, FR, RL, RR) with joints ``[*B, 3]`` [rad].

        .. math:: p = h + R_x(q_1) \\left( (0, \\pm a, 0) + R_y(q_2) ((0, 0, -l_1) + R_y(q_3) (f, 0, -l_2)) \\right)

        Example:
            >>> GO2.leg(0, torch.zeros(3))
            tensor([ 0.1914,  0.1420, -0.4260])
        """
        front, left = (1.0 if leg < 2 else -1.0), (1.0 if leg % 2 == 0 else -1.0)
        hip, thigh, knee = joint_position.unbind(-1)
        total = thigh + knee
        x = -self.thigh * torch.sin(thigh) - self.calf * torch.sin(total) + self.foot_x * torch.cos(total)
        z = -self.thigh * torch.cos(thigh) - self.calf * torch.cos(total) - self.foot_x * torch.sin(total)
        y = torch.full_like(x, left * self.abduction)
        turned_y = y * torch.cos(hip) - z * torch.sin(hip)
        turned_z = y * torch.sin(hip) + z * torch.cos(hip)
        return torch.stack((front * self.half_length + x, left * self.half_width + turned_y, turned_z), -1)


GO2 = LegGeometry(
    "Go2",
    half_length=constants.HIP_OFFSET_X,
    half_width=constants.HIP_OFFSET_Y,
    abduction=constants.ABDUCTION,
    thigh=constants.THIGH,
    calf=constants.CALF,
    foot_x=constants.FOOT_OFFSET_X,
)

A1 = LegGeometry("A1", half_length=0.183, half_width=0.047, abduction=0.085, thigh=0.2, calf=0.2)
"""Unitree A1. Source: fitted to the feet that the MetalHead clips store, which it meets to 0.1 mm."""
