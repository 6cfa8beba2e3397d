"""Leg kinematics of the Go2: joint angles to feet and back, batched and differentiable, exact as the MuJoCo model.

A leg is a hip joint about x, then a sideways offset, then thigh and calf joints about y.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.tensors import constant

_ALONG = (1.0, 1.0, -1.0, -1.0)
_SIDE = (1.0, -1.0, 1.0, -1.0)
_HIPS = tuple((constants.HIP_OFFSET_X * x, constants.HIP_OFFSET_Y * y, 0.0) for x, y in zip(_ALONG, _SIDE, strict=True))
_SIDEWAYS = tuple(constants.ABDUCTION * side for side in _SIDE)
# The foot's centre is off the calf's axis: together they act as one straight shank, slightly turned and longer.
_SHANK = (constants.CALF**2 + constants.FOOT_OFFSET_X**2) ** 0.5


def hip_positions(like: Tensor) -> Tensor:
    """Positions of the hip joints in the base frame [m], ``[4, 3]``, with the dtype and device of ``like``.

    They are shared (:func:`agility_rl.tensors.constant`): never change them in place.
    """
    return constant(_HIPS, like.device, like.dtype)


def forward(joint_position: Tensor) -> Tensor:
    """Centres of the four foot spheres in the base frame.

    .. math:: p = h + R_x(q_0) \\big( (0, \\pm a, 0) + R_y(q_1) ((0, 0, -l_1) + R_y(q_2) (o_x, 0, -l_2)) \\big)

    Source: MuJoCo Menagerie ``unitree_go2/go2.xml``, body and geom positions.

    Args:
        joint_position: ``[*B, 12]`` [rad].

    Returns:
        ``[*B, 4, 3]`` [m], legs FL, FR, RL, RR. Subtract :data:`~agility_rl.go2.constants.FOOT_RADIUS` from the
        world height for the sole.

    Raises:
        ValueError: if the last dimension is not 12.

    Example:
        >>> feet = forward(torch.tensor(constants.DEFAULT_POSE))
        >>> round(constants.FOOT_RADIUS - feet[0, 2].item(), 4)
        0.2884
    """
    if joint_position.shape[-1:] != (constants.NUM_JOINTS,):
        raise ValueError(
            f"joint_position must be [*B, 12] (FL, FR, RL, RR x hip, thigh, calf), got {tuple(joint_position.shape)}"
        )
    q = joint_position.unflatten(-1, (4, 3))
    hip, thigh, knee = q[..., 0], q[..., 1], q[..., 1] + q[..., 2]
    side = constant(_SIDEWAYS, q.device, q.dtype)
    sin_knee, cos_knee = torch.sin(knee), torch.cos(knee)
    x = -constants.THIGH * torch.sin(thigh) - constants.CALF * sin_knee + constants.FOOT_OFFSET_X * cos_knee
    z = -constants.THIGH * torch.cos(thigh) - constants.CALF * cos_knee - constants.FOOT_OFFSET_X * sin_knee
    sin_hip, cos_hip = torch.sin(hip), torch.cos(hip)
    leg = torch.stack((x, cos_hip * side - sin_hip * z, sin_hip * side + cos_hip * z), -1)
    return leg + hip_positions(q)


def inverse(feet: Tensor) -> Tensor:
    """Joint angles that put the feet somewhere, with the knees bent as the robot's are; closed form.

    With ``d`` the distance from the hip axis to the foot in the y-z plane, the thigh joint lies ``sqrt(d^2 - a^2)``
    above the foot; the law of cosines gives the knee. A foot out of reach is approached as closely as the straight
    (or fully folded) leg allows. Joint limits are not applied.

    Source: trigonometry of :func:`forward`.

    Args:
        feet: ``[*B, 4, 3]`` foot-sphere centres [m], base frame.

    Returns:
        ``[*B, 12]`` joint angles [rad], calf angles in ``[-pi, 0]``.

    Raises:
        ValueError: if the last dimensions are not 4 and 3.

    Example:
        >>> pose = torch.tensor(constants.DEFAULT_POSE, dtype=torch.float64)
        >>> torch.allclose(inverse(forward(pose)), pose)
        True
    """
    if feet.shape[-2:] != (4, 3):
        raise ValueError(f"feet must be [*B, 4, 3] (legs FL, FR, RL, RR), got {tuple(feet.shape)}")
    x, y, z = (feet - hip_positions(feet)).unbind(-1)
    side = constant(_SIDEWAYS, feet.device, feet.dtype)
    drop = (y * y + z * z - constants.ABDUCTION**2).clamp(min=0.0).sqrt()
    # In the leg's plane the foot is at (side, -drop) before the hip turns it to (y, z).
    hip = torch.atan2(z, y) - torch.atan2(-drop, side)
    hip = torch.atan2(torch.sin(hip), torch.cos(hip))

    reach = (x * x + drop * drop).sqrt()
    longest, shortest = constants.THIGH + _SHANK, abs(constants.THIGH - _SHANK)
    reach = reach.clamp(shortest + 1e-9, longest)
    cos_bend = (reach * reach - constants.THIGH**2 - _SHANK**2) / (2 * constants.THIGH * _SHANK)
    bend = -torch.acos(cos_bend.clamp(-1.0, 1.0))  # angle of the shank against the thigh; negative: knee backwards
    across, along = _SHANK * torch.sin(bend), constants.THIGH + _SHANK * torch.cos(bend)
    thigh = torch.atan2(-x, drop) - torch.atan2(across, along)
    # The shank points to the foot's centre, which the calf's own axis misses by a small constant angle.
    calf = bend - math.atan2(-constants.FOOT_OFFSET_X, constants.CALF)
    return torch.stack((hip, thigh, calf), -1).flatten(-2)
