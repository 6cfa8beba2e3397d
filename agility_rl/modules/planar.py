"""Where a robot stands in the plane, and how that changes with it and with what it is seen from."""

from __future__ import annotations

import torch
from torch import Tensor

from agility_rl.go2 import features

_ROLL_PITCH = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "roll_pitch")
_ANGULAR = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "angular_velocity")
_LINEAR = features.layout_slice(features.EXPLICIT_LAYOUT, "linear_velocity")


def seen_from(obstacle: Tensor, points: Tensor) -> Tensor:
    """Points of an obstacle's frame in the frame of a robot there.

    Source: ours; a shift and a turn of the plane.

    Args:
        obstacle: ``[*B, 4]``: x, y [m], sine and cosine of the robot's yaw, in the obstacle's frame.
        points: ``[*B, W, 2]`` [m].

    Returns:
        ``[*B, W, 2]``, ahead and to the left [m].

    Example:
        >>> seen_from(torch.tensor([-2.0, 0.0, 1.0, 0.0]), torch.tensor([[1.0, 0.5]]))  # turned to the left
        tensor([[ 0.5000, -3.0000]])
    """
    x, y = (points - obstacle[..., None, :2]).unbind(-1)
    sine, cosine = obstacle[..., None, 2], obstacle[..., None, 3]
    return torch.stack((cosine * x + sine * y, cosine * y - sine * x), -1)


def within(pose: Tensor, frames: Tensor) -> Tensor:
    r"""A pose of the plane in each of several frames.

    .. math:: (x', y') = R(-\varphi)\,(x - x_o, y - y_o), \qquad \psi' = \psi - \varphi

    Source: ours; a shift and a turn of the plane.

    Args:
        pose: ``[*B, 4]``: x, y [m], sine and cosine of the yaw.
        frames: ``[L, 3]``: x, y [m] and yaw [rad] of each frame, given as the pose is.

    Returns:
        ``[*B, L, 4]``.

    Example:
        >>> behind = torch.tensor([1.0, 0.0, 0.0, 1.0])  # 1 m behind an obstacle
        >>> within(behind, torch.tensor([[4.0, 0.0, 0.0], [0.0, 2.0, torch.pi]])).round(decimals=3)
        tensor([[-3.,  0.,  0.,  1.],
                [-1.,  2.,  0., -1.]])
    """
    x, y = (pose[..., None, :2] - frames[:, :2]).unbind(-1)
    sine, cosine = pose[..., None, 2], pose[..., None, 3]
    cos, sin = frames[:, 2].cos(), frames[:, 2].sin()
    return torch.stack((cos * x + sin * y, cos * y - sin * x, cos * sine - sin * cosine, cos * cosine + sin * sine), -1)


def inverted(pose: Tensor) -> Tensor:
    r"""Where the origin is seen from a pose, and how it is turned there.

    .. math:: (x', y') = -R(-\psi)\,(x, y), \qquad \psi' = -\psi

    Source: ours; a shift and a turn of the plane.

    Args:
        pose: ``[*B, 4]``: x, y [m], sine and cosine of the yaw.

    Example:
        >>> inverted(torch.tensor([-2.0, 0.5, 0.0, 1.0])).tolist()  # it lies 2 m ahead and 0.5 m to the right
        [2.0, -0.5, -0.0, 1.0]
    """
    x, y, sine, cosine = pose.unbind(-1)
    return torch.stack((-cosine * x - sine * y, sine * x - cosine * y, -sine, cosine), -1)


def composed(pose: Tensor, other: Tensor) -> Tensor:
    r"""A pose that is given as seen from another one.

    .. math:: (x, y) + R(\psi)\,(x', y'), \qquad \psi + \psi'

    Source: ours; a turn and a shift of the plane.

    Args:
        pose: ``[*B, 4]``: x, y [m], sine and cosine of the yaw.
        other: ``[*B, 4]``, in the frame of the first.

    Example:
        >>> left = torch.tensor([1.0, 0.0, 1.0, 0.0])
        >>> composed(left, torch.tensor([2.0, 0.5, -1.0, 0.0]))
        tensor([0.5000, 2.0000, 0.0000, 1.0000])
    """
    x, y, sine, cosine = pose.unbind(-1)
    ahead, left, sin, cos = other.unbind(-1)
    return torch.stack(
        (
            x + cosine * ahead - sine * left,
            y + sine * ahead + cosine * left,
            sine * cos + cosine * sin,
            cosine * cos - sine * sin,
        ),
        -1,
    )


def inverse(frames: Tensor) -> Tensor:
    """The frames ``[L, 3]`` in which what :func:`within` gives is the pose again.

    Source: ours; a shift and a turn of the plane.

    Example:
        >>> frame, pose = torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([3.0, 4.0, 0.6, 0.8])
        >>> within(within(pose, frame)[0], inverse(frame)).round(decimals=3)
        tensor([[3.0000, 4.0000, 0.6000, 0.8000]])
    """
    x, y, yaw = frames.unbind(-1)
    cos, sin = yaw.cos(), yaw.sin()
    return torch.stack((-cos * x - sin * y, sin * x - cos * y, -yaw), -1)


def attitude(proprioception: Tensor) -> tuple[Tensor, Tensor]:
    """Roll and pitch ``[*B, 2]`` [rad] and angular velocity in the base frame ``[*B, 3]`` [rad/s] of ``[*B, 45]``.

    Example:
        >>> [part.shape[-1] for part in attitude(torch.zeros(45))]
        [2, 3]
    """
    return proprioception[..., _ROLL_PITCH], proprioception[..., _ANGULAR] / features.ANGULAR_VELOCITY_SCALE


def planar_motion(proprioception: Tensor, estimate: Tensor) -> Tensor:
    r"""Velocity of a robot over the ground, in the frame of its heading.

    .. math:: v_{xy} = (R_y(\theta) R_x(\phi) v)_{xy}, \qquad
              \dot\psi = (\omega_y \sin\phi + \omega_z \cos\phi) / \cos\theta

    Source: kinematics of Euler angles (yaw, pitch, roll); ours.

    Args:
        proprioception: ``[*B, 45]``: roll and pitch [rad], angular velocity in the base frame.
        estimate: ``[*B, 4]``: linear velocity in the base frame (:data:`agility_rl.keys.ESTIMATE`).

    Returns:
        ``[*B, 3]``: forward and to the left [m/s], yaw rate [rad/s].

    Example:
        >>> proprioception, estimate = torch.zeros(45), torch.tensor([0.3, 0.5, 0.0, 0.0])  # 1 m/s forward
        >>> planar_motion(proprioception, estimate)
        tensor([1., 0., 0.])
    """
    (roll, pitch), (_, rate_y, rate_z) = (part.unbind(-1) for part in attitude(proprioception))
    x, y, z = (estimate[..., _LINEAR] / features.LINEAR_VELOCITY_SCALE).unbind(-1)
    down = roll.sin() * y + roll.cos() * z
    yaw_rate = (rate_y * roll.sin() + rate_z * roll.cos()) / pitch.cos().clamp(min=0.2)  # nobody walks so steeply
    return torch.stack((pitch.cos() * x + pitch.sin() * down, roll.cos() * y - roll.sin() * z, yaw_rate), -1)


def moved(pose: Tensor, motion: Tensor) -> Tensor:
    """A pose after the robot has moved: shifted, then turned.

    Source: ours; a rotation and a translation of the plane.

    Args:
        pose: ``[*B, 4]``: x, y [m], sine and cosine of the yaw.
        motion: ``[*B, 3]``: forward and to the left [m], counterclockwise [rad].

    Example:
        >>> moved(torch.tensor([-2.0, 0.0, 0.0, 1.0]), torch.tensor([0.5, 0.0, torch.pi / 2])).round(decimals=3)
        tensor([-1.5000,  0.0000,  1.0000, -0.0000])
    """
    return composed(pose, _step(motion))


def seen_earlier(seen: Tensor, motion: Tensor) -> Tensor:
    """Where what a robot sees was seen before it moved.

    Source: ours; a rotation and a translation of the plane.

    Args:
        seen: ``[*B, 4]``: x, y [m], sine and cosine of the yaw, in the robot's frame.
        motion: ``[*B, 3]``: forward and to the left [m], counterclockwise [rad].

    Example:
        >>> seen_earlier(torch.tensor([2.0, 0.0, 0.0, 1.0]), torch.tensor([0.5, 0.0, 0.0]))
        tensor([2.5000, 0.0000, 0.0000, 1.0000])
    """
    return composed(_step(motion), seen)


def _step(motion: Tensor) -> Tensor:
    """The pose ``[*B, 4]`` after a motion from the origin."""
    forward, left, turn = motion.unbind(-1)
    return torch.stack((forward, left, turn.sin(), turn.cos()), -1)


def bearings(place: Tensor) -> Tensor:
    """Heading errors to the way-points of a place ``[*B, 8]``, ``[*B, 2]`` [rad]; without gradient.

    Source: definition of the heading error (method notes, section 5.5).

    Example:
        >>> bearings(torch.tensor([1.0, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        tensor([0.7854, 0.0000])
    """
    place = place.detach()
    return torch.atan2(place[..., 1:4:2], place[..., 0:3:2])
