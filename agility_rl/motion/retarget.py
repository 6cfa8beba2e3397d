"""Moves a dog's motion onto the Go2: scaled trunk, feet where the dog put them, joints by inverse kinematics.

Source: keypoint retargeting by inverse kinematics as in Peng et al. 2020, "Learning agile robotic locomotion skills by
imitating animals", section IV; scale, hip limits, re-grounding per window and slip report: data notes B.2, B.3, C.4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2 import constants, kinematics
from agility_rl.motion.bvh import BVHMotion, read_bvh
from agility_rl.motion.clip import MotionClip, MotionError, clip_from_joints
from agility_rl.motion.edit import foot_slip, ground
from agility_rl.motion.keypoints import Keypoints, read_keypoints

SCALE = 0.7
"""Go2 metres per dog metre: the released clips trot at 1.2 to 1.3 m/s where the dog does 1.7 to 2.0 (data notes)."""

TRUNK_LIFT = 0.065
"""Added to the scaled trunk height [m]: the dog's 0.36 m between hips and shoulders become the Go2's 0.32 m."""

TOE_END = 0.011
"""Height of the end of a standing toe over the dog's floor [m], mean of all four: 0.009 to 0.015 in twelve recordings
of the MANN dog."""

NEUTRAL_PITCH = 0.06
"""The dog's line from hips to shoulders falls forward by this angle [rad] when it walks; the robot's trunk is level."""

HIP_LIMIT = 0.3
"""Largest sideways angle of a hip [rad]; the released clips stop at 0.2."""

SWING_LIFT = 0.02
"""Added to the height of a swinging foot [m]: dogs' toes skim the ground, lower than the robot's contact threshold."""

STANCE_HEIGHT = 0.045
"""A toe lower than this over the dog's floor [m] ..."""
STANCE_SPEED = 0.45
"""... and slower than this [m/s] stands."""

_HIPS = ("LeftArm", "RightArm", "LeftUpLeg", "RightUpLeg")
_TOES = ("LeftHand_End", "RightHand_End", "LeftFoot_End", "RightFoot_End")
_NEUTRAL = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))


@dataclass(frozen=True)
class _Trunk:
    """The dog's trunk: middle between hips and shoulders ``[T, 3]`` [m], orientation, smooth yaw-only orientation."""

    position: Tensor
    quaternion: Tensor
    heading: Tensor


def retarget(
    motion: Keypoints | BVHMotion | str | Path,
    *,
    scale: float = SCALE,
    trunk_lift: float = TRUNK_LIFT,
    neutral_pitch: float = NEUTRAL_PITCH,
    hip_limit: float = HIP_LIMIT,
    smoothing: float = 1 / 60,
    lock_stance: bool = True,
    grounding: float | None = 1.0,
    start: int = 0,
    stop: int | None = None,
    label: str | None = None,
) -> MotionClip:
    """Retarget a dog recording to the Go2, at the recording's frame rate.

    The trunk follows the middle of hips and shoulders over the dog's floor, scaled and lifted; the floor is where the
    toes of the stretch stand, at whatever height. Each foot follows the scaled toe, shifted by a constant in the
    heading frame that puts its mean place under its hip,

    .. math:: p_i(t) = s\\, toe_i(t) + R_{yaw}(t) \\left(n_i - \\overline{s R_{yaw}^{-1} (toe_i - trunk)}\\right)

    so that a standing toe stays a standing foot although dog and robot differ in width; while a toe stands the target
    is held still (``lock_stance``). Joints beyond the limits are clipped, and what that cost is in the clip's notes.

    Source: Peng et al. 2020, section IV; data notes C.4.

    Args:
        motion: keypoints, a parsed BVH recording, or the path of either (``.bvh`` or 81-column table).
        scale: robot metres per dog metre.
        trunk_lift: added to the scaled trunk height [m].
        neutral_pitch: subtracted from the dog's downward pitch [rad].
        hip_limit: largest hip angle [rad].
        smoothing: standard deviation of the Gaussian over keypoints [s]; 0 leaves them as they are.
        lock_stance: hold a foot still while the dog's toe stands.
        grounding: window [s] in which the floor is found anew; None keeps the floor of the whole stretch.
        start: first frame of the recording to use.
        stop: frame after the last one; None takes all.
        label: behaviour name, or None.

    Returns:
        A clip whose notes tell the mean and greatest foot error [m], the share of clipped joint samples, and the slip.

    Raises:
        MotionError: if the recording cannot be read, lacks the dog's points, a number is impossible, or the label is no
            behaviour.

    Example:
        >>> from agility_rl.motion.keypoints import POINTS
        >>> dog = torch.zeros(30, 27, 3)
        >>> for name, x, y in zip(_HIPS, (0.24, 0.24, -0.24, -0.24), (0.08, -0.08, 0.05, -0.05)):
        ...     dog[:, POINTS.index(name)] = torch.tensor([x, y, 0.36])
        >>> robot = retarget(Keypoints("standing", 1 / 60, dog))
        >>> round(robot.root_position[0, 2].item(), 3), robot.foot_contact.all().item()
        (0.325, True)
    """
    if label is not None and label not in BEHAVIOURS:
        raise MotionError(f"label {label!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)}")
    if not 0.1 <= scale <= 3.0:
        raise MotionError(f"expected a scale of 0.1 to 3 robot metres per dog metre, got {scale}")
    if not 0.0 < hip_limit <= constants.JOINT_UPPER[0]:
        raise MotionError(
            f"expected a hip limit of more than 0 and at most {constants.JOINT_UPPER[0]} rad, got {hip_limit}"
        )
    points = _keypoints(motion)
    if start or stop is not None:
        points = points.slice(start, stop)
    points = _smooth_keypoints(points, smoothing)
    trunk = _trunk(points, neutral_pitch)
    toes = torch.stack([points.point(name).double() for name in _TOES], 1)
    # A low quantile, because single frames dip below the floor; per foot, because toes end at different heights.
    lowest = toes[..., 2].quantile(0.05, dim=0)
    root = trunk.position * scale
    root[:, 2] += trunk_lift - (lowest.mean() - TOE_END) * scale
    height = (toes[..., 2] - lowest).clamp(min=0.0)
    target = _foot_targets(toes, height, points.dt, trunk, scale, lock_stance)

    joints = kinematics.inverse(rotations.rotate_inverse(trunk.quaternion[:, None], target - root[:, None]))
    low, high = torch.tensor(constants.JOINT_LOWER), torch.tensor(constants.JOINT_UPPER)
    low[::3], high[::3] = -hip_limit, hip_limit
    clipped = ((joints < low) | (joints > high)).double().mean()
    joints = joints.clamp(low.to(joints), high.to(joints))
    clip = clip_from_joints(
        points.name, points.dt, root, trunk.quaternion, joints, label=label, source=f"{points.source}, retargeted"
    )
    error = (clip.foot_position - target).norm(dim=-1)
    if grounding is not None:
        clip = ground(clip, grounding)
    slip = foot_slip(clip)
    return replace(
        clip,
        notes=(
            *clip.notes,
            f"dog to Go2: scale {scale:.2f}, foot error {error.mean():.3f} m mean, {error.max():.3f} m greatest, "
            f"{100 * float(clipped):.1f} % of joint samples clipped",
            f"foot slip {slip.mean:.2f} m/s, worst foot {slip.worst_foot:.2f} m/s",
        ),
    )


def _keypoints(motion: Keypoints | BVHMotion | str | Path) -> Keypoints:
    if isinstance(motion, Keypoints):
        return motion
    if isinstance(motion, BVHMotion):
        return motion.keypoints()
    path = Path(motion)
    return read_bvh(path).keypoints() if path.suffix.lower() == ".bvh" else read_keypoints(path)


def _smooth_keypoints(points: Keypoints, deviation: float) -> Keypoints:
    """Gaussian low-pass over time; the inverse kinematics of a near-straight leg amplifies marker noise."""
    if deviation <= 0.0:
        return points
    return replace(
        points, position=_gaussian(points.position.double().flatten(1), deviation / points.dt).view_as(points.position)
    )


def _gaussian(value: Tensor, deviation: float) -> Tensor:
    """Low-pass ``[T, D]`` with a Gaussian of a standard deviation in frames; the ends are repeated outwards."""
    half = max(1, round(3 * deviation))
    kernel = torch.exp(-0.5 * (torch.arange(-half, half + 1, dtype=value.dtype) / deviation).square())
    padded = torch.cat((value[:1].expand(half, -1), value, value[-1:].expand(half, -1)))
    return (padded.unfold(0, 2 * half + 1, 1) * (kernel / kernel.sum())).sum(-1)


def _trunk(points: Keypoints, neutral_pitch: float) -> _Trunk:
    """Trunk pose from the four leg roots: forward from hips to shoulders, left across both."""
    left_arm, right_arm, left_leg, right_leg = (points.point(name).double() for name in _HIPS)
    shoulders, hips = (left_arm + right_arm) / 2, (left_leg + right_leg) / 2
    forward = torch.nn.functional.normalize(shoulders - hips, dim=-1)
    across = (left_arm - right_arm) + (left_leg - right_leg)
    across = across - (across * forward).sum(-1, keepdim=True) * forward
    left = torch.nn.functional.normalize(across, dim=-1)
    up = torch.linalg.cross(forward, left)
    yaw = torch.atan2(forward[:, 1], forward[:, 0])
    pitch = -torch.asin(forward[:, 2].clamp(-1.0, 1.0)) - neutral_pitch
    roll = torch.atan2(left[:, 2], up[:, 2])
    # The heading must not wag with the spine, or standing feet, placed relative to it, would wag as well.
    smooth = _gaussian(torch.stack((torch.cos(yaw), torch.sin(yaw)), -1), 0.25 / points.dt)
    smooth_yaw = torch.atan2(smooth[:, 1], smooth[:, 0])
    zero = torch.zeros_like(yaw)
    return _Trunk(
        position=(shoulders + hips) / 2,
        quaternion=rotations.from_euler(roll, pitch, yaw),
        heading=rotations.from_euler(zero, zero, smooth_yaw),
    )


def _foot_targets(toes: Tensor, height: Tensor, dt: float, trunk: _Trunk, scale: float, lock_stance: bool) -> Tensor:
    """World foot-sphere centres ``[T, 4, 3]`` [m] that the robot's legs shall reach, by toes and heights over floor."""
    relative = rotations.rotate_inverse(trunk.heading[:, None], toes - trunk.position[:, None]) * scale
    sides = torch.tensor(_NEUTRAL, dtype=torch.float64)
    width = constants.HIP_OFFSET_Y + constants.ABDUCTION
    neutral = sides * torch.tensor([constants.HIP_OFFSET_X, width], dtype=torch.float64)
    offset = torch.zeros(4, 3, dtype=torch.float64)
    offset[:, :2] = neutral - relative.mean(0)[:, :2]
    target = toes * scale + rotations.rotate(trunk.heading[:, None], offset)
    share = (height / STANCE_HEIGHT).clamp(max=1.0)
    target[..., 2] = height * scale + SWING_LIFT * share.square() * (3 - 2 * share) + constants.FOOT_RADIUS
    if lock_stance:
        speed = torch.zeros_like(height)
        speed[1:] = (toes[1:, :, :2] - toes[:-1, :, :2]).norm(dim=-1) / dt
        speed[0] = speed[1]
        standing = (height < STANCE_HEIGHT) & (speed < STANCE_SPEED)
        for foot in range(4):
            target[:, foot, :2] += _hold(target[:, foot, :2], standing[:, foot])
    return target


def _hold(target: Tensor, standing: Tensor) -> Tensor:
    """Correction ``[T, 2]`` that keeps a foot at its mean place in every stance and fades from one to the next."""
    correction = torch.zeros_like(target)
    edges = torch.diff(
        standing.to(torch.int8), prepend=torch.zeros(1, dtype=torch.int8), append=torch.zeros(1, dtype=torch.int8)
    )
    starts, ends = (edges == 1).nonzero().flatten().tolist(), (edges == -1).nonzero().flatten().tolist()
    last, last_value = 0, torch.zeros(2, dtype=target.dtype)
    for begin, end in zip(starts, ends, strict=True):
        stance = target[begin:end]
        correction[begin:end] = stance.mean(0) - stance
        correction[last:begin] = _fade(last_value, correction[begin], begin - last)
        last, last_value = end, correction[end - 1]
    correction[last:] = _fade(last_value, torch.zeros_like(last_value), len(target) - last)
    return correction


def _fade(start: Tensor, end: Tensor, steps: int) -> Tensor:
    """``steps`` values strictly between two corrections."""
    fraction = torch.arange(1, steps + 1, dtype=start.dtype)[:, None] / (steps + 1)
    return start + fraction * (end - start)
