"""Reader of 19-column Laikago clips: root position 3, root quaternion xyzw 4, joints 12.

These files store no feet, so nothing in them tells the leg order; it is that of the robot's URDF, FR, FL, RR, RL. The
URDF's trunk frame has x left, y up and z forward, its hips count outwards on both sides, and at zero its thighs and
calves are not straight.

Source: ``laikago_toes_limits.urdf`` of pybullet_data (joint axes and origins); data notes, section C.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2 import constants
from agility_rl.motion.clip import MotionClip, clip_from_joints
from agility_rl.motion.legs import GO2
from agility_rl.motion.motion_json import unit_quaternion

_FILE_ORDER = (1, 0, 3, 2)
"""Block of FL, FR, RL, RR in a file that goes FR, FL, RR, RL."""
_HIP_SIGN = (1.0, -1.0, 1.0, -1.0)
"""Outward is positive in the file; Go2's hips all turn about x forward."""

_KNEE = (0.1422, 0.20833)
_TOE = (0.022, 0.25)
"""Back and down from thigh joint to knee, and from knee to toe, at joint angle zero [m]."""
_THIGH_ANGLE = math.atan2(*_KNEE)
_CALF_ANGLE = math.atan2(*_TOE) - _THIGH_ANGLE
_LEG_LENGTH = math.hypot(*_KNEE) + math.hypot(*_TOE)

_TRUNK_FRAME = torch.tensor([0.5, 0.5, 0.5, 0.5], dtype=torch.float64)
"""Turns the URDF's axes (left, up, forward) into the Go2's (forward, left, up)."""


def read_nineteen(path: str | Path, frame_duration: float, frames: Tensor) -> MotionClip:
    """A clip at its own frame rate from 19 columns of a Laikago.

    Leg directions are kept, angles beyond Go2's limits are cut to them, and the path is scaled by the ratio of leg
    lengths, so that the steps fit.

    Args:
        path: where the frames come from, for the name and for messages.
        frame_duration: seconds between two frames.
        frames: float64 ``[T, 19]`` from :func:`agility_rl.motion.motion_json.read_frames`.

    Raises:
        MotionError: if columns 3-6 are no unit quaternion.
    """
    path = Path(path)
    quaternion = unit_quaternion(frames[:, 3:7], path)
    quaternion = rotations.multiply(quaternion, rotations.conjugate(_TRUNK_FRAME).expand_as(quaternion))
    scale = GO2.leg_length / _LEG_LENGTH
    joints, cut = laikago_joints(frames[:, 7:19])
    notes = (
        "19 columns, Laikago legs: joints FR,FL,RR,RL by its URDF, hips outward; no feet stored to verify them",
        f"leg directions kept, path scaled by {scale:.3f}, {cut:.1%} of the angles cut to the Go2's limits",
    )
    return clip_from_joints(
        path.stem,
        frame_duration,
        frames[:, :3] * scale,
        quaternion,
        joints,
        source="19 columns",
        notes=notes,
    )


def laikago_joints(stored: Tensor) -> tuple[Tensor, float]:
    """Go2 joint angles with the leg directions of a Laikago.

    Args:
        stored: ``[T, 12]`` [rad], URDF order and zeros.

    Returns:
        ``[T, 12]`` [rad], and the share of angles that had to be cut to the limits.

    Example:
        >>> joints, cut = laikago_joints(torch.zeros(1, 12))
        >>> joints[0, :3], cut
        (tensor([ 0.0000,  0.5989, -0.8378]), 0.333...)
    """
    blocks = stored.unflatten(-1, (4, 3))[:, list(_FILE_ORDER)]
    zero = torch.tensor([0.0, _THIGH_ANGLE, _CALF_ANGLE], dtype=stored.dtype)
    sign = torch.ones(4, 3, dtype=stored.dtype)
    sign[:, 0] = torch.tensor(_HIP_SIGN, dtype=stored.dtype)
    joints = (blocks * sign + zero).flatten(1)
    limited = joints.clamp(
        torch.tensor(constants.JOINT_LOWER, dtype=stored.dtype), torch.tensor(constants.JOINT_UPPER, dtype=stored.dtype)
    )
    return limited, float((limited != joints).double().mean())
