"""Quaternions ``(w, x, y, z)`` and frames, in pure torch, for any leading batch shape.

Frames: *world* (z up), *base* (the trunk: x forward, y left, z up), *heading* (the world turned by the trunk's yaw).
A quaternion turns base coordinates into world coordinates.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Turn base-frame vectors into the world frame.

    .. math:: v' = v + 2 w (u \\times v) + 2 u \\times (u \\times v), \\quad q = (w, u)

    Args:
        quaternion: ``[*B, 4]``, unit.
        vector: ``[*B, 3]``.

    Example:
        >>> quarter_turn = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])
        >>> rotate(quarter_turn, torch.tensor([1.0, 0.0, 0.0])).round(decimals=3)
        tensor([0., 1., 0.])
    """
    w, u = quaternion[..., :1], quaternion[..., 1:]
    u, vector = torch.broadcast_tensors(u, vector)
    twice = 2.0 * torch.linalg.cross(u, vector)
    return vector + w * twice + torch.linalg.cross(u, twice)


def rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Turn world-frame vectors into the base frame; the inverse of :func:`rotate`."""
    return rotate(conjugate(quaternion), vector)


def conjugate(quaternion: Tensor) -> Tensor:
    """Inverse rotation of unit quaternions ``[*B, 4]``."""
    return torch.cat((quaternion[..., :1], -quaternion[..., 1:]), -1)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product ``[*B, 4]``: the rotation ``right`` followed by ``left``."""
    w1, u1 = left[..., :1], left[..., 1:]
    w2, u2 = right[..., :1], right[..., 1:]
    u1b, u2b = torch.broadcast_tensors(u1, u2)
    w = w1 * w2 - (u1b * u2b).sum(-1, keepdim=True)
    return torch.cat((w, w1 * u2b + w2 * u1b + torch.linalg.cross(u1b, u2b)), -1)


def from_euler(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Quaternion of intrinsic z-y-x angles [rad].

    Example:
        >>> q = from_euler(torch.tensor(0.1), torch.tensor(-0.2), torch.tensor(3.0))
        >>> torch.stack(to_euler(q)).round(decimals=4)
        tensor([ 0.1000, -0.2000,  3.0000])
    """
    cr, sr = torch.cos(roll / 2), torch.sin(roll / 2)
    cp, sp = torch.cos(pitch / 2), torch.sin(pitch / 2)
    cy, sy = torch.cos(yaw / 2), torch.sin(yaw / 2)
    return torch.stack(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ),
        -1,
    )


def to_euler(quaternion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Roll, pitch, yaw [rad] of unit quaternions (intrinsic z-y-x), each ``[*B]``."""
    w, x, y, z = quaternion.unbind(-1)
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = torch.asin((2 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def heading(quaternion: Tensor) -> Tensor:
    """Yaw-only part of unit quaternions ``[*B, 4]``: the rotation from heading frame to world frame."""
    yaw = to_euler(quaternion)[2]
    zero = torch.zeros_like(yaw)
    return torch.stack((torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)), -1)


def slerp(start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """Shortest-arc spherical interpolation of unit quaternions.

    Args:
        start: ``[*B, 4]``.
        end: ``[*B, 4]``.
        fraction: ``[*B, 1]`` in 0..1.

    Example:
        >>> one, half_turn = torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, 0, 1.0])
        >>> slerp(one, half_turn, torch.tensor([0.5])).round(decimals=4)
        tensor([0.7071, 0.0000, 0.0000, 0.7071])
    """
    cosine = (start * end).sum(-1, keepdim=True)
    end = torch.where(cosine < 0, -end, end)
    angle = torch.acos(cosine.abs().clamp(max=1.0))
    sine = torch.sin(angle)
    near = sine < 1e-6
    safe = torch.where(near, torch.ones_like(sine), sine)
    a = torch.where(near, 1 - fraction, torch.sin((1 - fraction) * angle) / safe)
    b = torch.where(near, fraction, torch.sin(fraction * angle) / safe)
    return torch.nn.functional.normalize(a * start + b * end, dim=-1)


def difference(start: Tensor, end: Tensor) -> Tensor:
    """World-frame rotation vector [rad] that turns ``start`` into ``end`` by the shortest arc, ``[*B, 3]``."""
    delta = multiply(end, conjugate(start))
    delta = torch.where(delta[..., :1] < 0, -delta, delta)
    norm = delta[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(norm, delta[..., :1])
    return delta[..., 1:] * torch.where(norm > 1e-8, angle / norm.clamp(min=1e-8), torch.full_like(norm, 2.0))


def turn(vector: Tensor, yaw: Tensor) -> Tensor:
    """Turn vectors of the plane ``[*B, 2]`` by angles ``[*B]`` [rad], to the left."""
    cosine, sine = torch.cos(yaw), torch.sin(yaw)
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap angles [rad] to (-pi, pi]."""
    return torch.atan2(torch.sin(angle), torch.cos(angle))
