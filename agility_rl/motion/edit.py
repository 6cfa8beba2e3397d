"""Clips made from clips: another frame rate, the mirror image, a bent path, feet on the floor; and how far feet slip.

A clip and its edits describe the same motion, so every edit keeps name, label and source and adds a note.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.bending import bend_points
from agility_rl.go2 import constants, kinematics
from agility_rl.go2.mirror import AXIAL, OTHER_SIDE, POLAR, mirror_joints
from agility_rl.motion.clip import (
    CONTROL_DT,
    MotionClip,
    MotionError,
    central_difference,
    clip_from_joints,
    contacts,
)

FLOOR_QUANTILE = 0.1
"""Share of the frames of a window that may lie lower than the floor found in it: glitches, not stances."""

ROUNDING = 0.3
"""Share of the window over which steps of the floor are rounded."""


def resample(clip: MotionClip, dt: float = CONTROL_DT) -> MotionClip:
    """The same motion at another frame rate: numbers linearly, orientation by slerp, feet by kinematics.

    Source: method notes, section 3.3 (linear interpolation, slerp for orientation, dt 0.02).

    Args:
        clip: any clip.
        dt: new seconds between two frames.

    Raises:
        MotionError: if the clip is shorter than one new frame step.

    Example:
        >>> from agility_rl.motion.clip import clip_from_joints
        >>> standing = torch.tensor(constants.DEFAULT_POSE).expand(31, 12)
        >>> level = torch.tensor([1.0, 0, 0, 0]).expand(31, 4)
        >>> resample(clip_from_joints("stand", 1 / 30, torch.zeros(31, 3), level, standing)).num_frames
        51
    """
    if abs(clip.dt - dt) < 1e-6:
        return clip
    frames = int(clip.duration / dt + 1e-4) + 1
    if frames < 2:
        raise MotionError(f"clip {clip.name!r}: {clip.duration:.3f} s long, too short for frames {dt} s apart")
    time = torch.arange(frames, dtype=torch.float64) * (dt / clip.dt)
    index = time.long().clamp(max=clip.num_frames - 2)
    fraction = (time - index).float()[:, None].clamp(0.0, 1.0)

    def linear(value: Tensor) -> Tensor:
        return value[index] + fraction * (value[index + 1] - value[index])

    position = linear(clip.root_position)
    quaternion = rotations.slerp(clip.root_quaternion[index], clip.root_quaternion[index + 1], fraction)
    joints = linear(clip.joint_position)
    feet = position[:, None] + rotations.rotate(quaternion[:, None], kinematics.forward(joints))
    return replace(
        clip,
        dt=dt,
        root_position=position,
        root_quaternion=quaternion,
        joint_position=joints,
        root_linear_velocity=linear(clip.root_linear_velocity),
        root_angular_velocity=linear(clip.root_angular_velocity),
        joint_velocity=linear(clip.joint_velocity),
        foot_position=feet,
        foot_contact=contacts(feet),
        notes=(*clip.notes, f"resampled from {clip.dt * 1000:.1f} ms to {dt * 1000:.1f} ms"),
    )


def mirror(clip: MotionClip) -> MotionClip:
    """The left-right mirror image: y changes sign, left and right legs change places.

    .. math:: y \\to -y, \\; (w, x, y, z) \\to (w, -x, y, -z), \\; \\omega \\to (-\\omega_x, \\omega_y, -\\omega_z)

    A mirror image of a mirror image is the clip itself. The label stays: all five behaviours look alike in a mirror.
    """
    polar, axial = torch.tensor(POLAR), torch.tensor(AXIAL)
    swap = list(OTHER_SIDE)
    return replace(
        clip,
        root_position=clip.root_position * polar,
        root_quaternion=clip.root_quaternion * torch.tensor([1.0, -1.0, 1.0, -1.0]),
        joint_position=mirror_joints(clip.joint_position),
        root_linear_velocity=clip.root_linear_velocity * polar,
        root_angular_velocity=clip.root_angular_velocity * axial,
        joint_velocity=mirror_joints(clip.joint_velocity),
        foot_position=clip.foot_position[:, swap] * polar,
        foot_contact=clip.foot_contact[:, swap],
        notes=(*clip.notes, "mirrored"),
    )


def bend(clip: MotionClip, curvature: float) -> MotionClip:
    """The same motion along a curve: the ground is bent as a whole, so that a foot that stands still goes on doing so.

    Every point goes where :func:`~agility_rl.bending.bend_points` puts it, x along the clip's travel; the trunk turns
    with the ground under it. Heights, contacts, roll and pitch stay (no leaning into the curve); the joints follow from
    the feet by inverse kinematics. A dog's labelled clips lead straight ahead; a robot that has seen nothing else takes
    a turn for bad style.

    Source: the same idea as the mirror image, an assumption about what else the animal would have done; ours.

    Args:
        clip: any clip whose trunk travels.
        curvature: [1/m], positive to the left; at a speed of v it turns at ``curvature * v`` rad/s.

    Raises:
        MotionError: if the curvature is outside :func:`curvature_limits`.

    Example:
        >>> from agility_rl.motion import synthesize_gait
        >>> curve = bend(synthesize_gait("trot"), 0.5)
        >>> speed = curve.root_linear_velocity[:, :2].norm(dim=-1).mean()
        >>> round((curve.root_angular_velocity[:, 2].mean() / speed).item(), 2)
        0.5
    """
    low, high = curvature_limits(clip)
    if not low <= curvature <= high:
        raise MotionError(
            f"clip {clip.name!r}: curvature {curvature:g} /m, expected {low:.2f} to {high:.2f}: its path is too wide "
            "to be bent further"
        )
    to_world, along, left = _along_and_left(clip)
    level = bend_points(torch.stack((along, left), -1), curvature) @ to_world.T + clip.root_position[0, :2]
    position = torch.cat((level[:, 0], clip.root_position[:, 2:]), -1)
    feet = torch.cat((level[:, 1:], clip.foot_position[..., 2:]), -1)
    turn, none = curvature * along[:, 0], torch.zeros_like(along[:, 0])
    quaternion = rotations.multiply(rotations.from_euler(none, none, turn), clip.root_quaternion)
    joints = kinematics.inverse(rotations.rotate_inverse(quaternion[:, None], feet - position[:, None]))
    image = clip_from_joints(clip.name, clip.dt, position, quaternion, joints)
    kept = {name: getattr(clip, name) for name in ("label", "weight", "source", "synthetic", "foot_contact")}
    return replace(image, **kept, notes=(*clip.notes, f"bent by {curvature:+.2f} /m"))


def curvature_limits(clip: MotionClip) -> tuple[float, float]:
    """Curvatures [1/m] to which :func:`bend` can bend a clip: no point comes nearer to the curve's centre than halfway.

    Example:
        >>> from agility_rl.motion import synthesize_gait
        >>> low, high = curvature_limits(synthesize_gait("trot"))
        >>> low < -2 and high > 2
        True
    """
    _, _, left = _along_and_left(clip)
    widest = left.new_tensor(1e-6)
    return -0.5 / float(torch.maximum(-left.min(), widest)), 0.5 / float(torch.maximum(left.max(), widest))


def floor_height(clip: MotionClip, window: float = 1.0) -> Tensor:
    """Height of the floor under a clip as its own feet tell it, ``[T]`` [m].

    The lowest sole of every frame is the floor, except in flight. A moving low quantile finds the floor of each window,
    a moving high quantile puts its steps back to where they were: together they cut off peaks shorter than the window,
    such as the flight of a jump, and follow a step up or a drift. A short moving mean rounds the steps.

    Source: released motion with a floor that is wrong per window, not per clip (data notes, section B.2).

    Args:
        clip: any clip.
        window: seconds; longer than any flight phase.
    """
    sole = clip.foot_position[..., 2].min(-1).values - constants.FOOT_RADIUS
    half = min(max(round(window / clip.dt / 2), 1), (clip.num_frames - 1) // 2)
    # Windows at the ends are whole, not cut: half a window may be all flight.
    low = _edges(torch.quantile(sole.unfold(0, 2 * half + 1, 1), FLOOR_QUANTILE, dim=-1), half)
    opened = torch.quantile(_edges(low, half).unfold(0, 2 * half + 1, 1), 1 - FLOOR_QUANTILE, dim=-1)
    round_half = max(round(ROUNDING * window / clip.dt / 2), 1)
    return _edges(opened, round_half).unfold(0, 2 * round_half + 1, 1).mean(-1)


def ground(clip: MotionClip, window: float = 1.0) -> MotionClip:
    """Shift a clip vertically, per window, so that its lowest sole stands on z = 0; flight phases stay in the air.

    .. math:: z \\to z - h(t), \\quad \\dot z \\to \\dot z - \\dot h(t)

    with the floor height h of :func:`floor_height`.

    Args:
        clip: any clip.
        window: seconds; longer than any flight phase.
    """
    floor = floor_height(clip, window)
    shift = torch.stack((torch.zeros_like(floor), torch.zeros_like(floor), floor), -1)
    feet = clip.foot_position - shift[:, None]
    return replace(
        clip,
        root_position=clip.root_position - shift,
        root_linear_velocity=clip.root_linear_velocity - central_difference(shift, clip.dt),
        foot_position=feet,
        foot_contact=contacts(feet),
        notes=(*clip.notes, f"grounded: floor found at {floor.min():+.3f} to {floor.max():+.3f} m"),
    )


class FootSlip(NamedTuple):
    """Horizontal speed of feet while they touch the ground [m/s], and the share of foot-frames that touch it."""

    mean: float
    worst_foot: float
    contact_share: float


def foot_slip(clip: MotionClip) -> FootSlip:
    """How far a clip is from exact contacts: mean horizontal speed of touching feet, of all and of the worst."""
    feet = clip.foot_position[..., :2].flatten(1)
    speed = central_difference(feet, clip.dt).unflatten(-1, (4, 2)).norm(dim=-1)
    touching = clip.foot_contact.float()
    per_foot = (speed * touching).sum(0) / touching.sum(0).clamp(min=1.0)
    mean = float((speed * touching).sum() / touching.sum().clamp(min=1.0))
    return FootSlip(mean, float(per_foot.max()), float(touching.mean()))


def _along_and_left(clip: MotionClip) -> tuple[Tensor, Tensor, Tensor]:
    """Columns of the clip's travel and of its left in the world ``[2, 2]``, and how far trunk and feet ``[T, 5]`` lie
    along both from where the trunk starts [m]."""
    travel = clip.root_position[-1, :2] - clip.root_position[0, :2]
    course = torch.atan2(travel[1], travel[0])
    cos, sin = course.cos(), course.sin()
    to_world = torch.stack((torch.stack((cos, -sin)), torch.stack((sin, cos))))
    points = torch.cat((clip.root_position[:, None], clip.foot_position), 1)[..., :2] - clip.root_position[0, :2]
    along, left = (points @ to_world).unbind(-1)
    return to_world, along, left


def _edges(value: Tensor, count: int) -> Tensor:
    """A sequence ``[T]`` with its first and last number repeated ``count`` times more."""
    return torch.cat((value[:1].expand(count), value, value[-1:].expand(count)))
