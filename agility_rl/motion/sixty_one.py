"""Reader of 61-column clips (the paper's Go2 set, MetalHead, AMP), which finds the file's conventions by kinematics.

Columns: root position 3, root quaternion xyzw 4, joints 12, feet 12, root linear and angular velocity 3 + 3, joint
velocities 12, foot velocities 12. Files do not say in which order their legs come, in which direction a hip counts,
in which order their feet come, in which frame, or of which robot; released loaders get it wrong. One of these
combinations puts the feet of the stored joints on the stored feet; it is searched for, clip by clip.

Source: data notes, sections B.1 and B.2.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2.constants import LEGS
from agility_rl.motion.clip import MotionClip, MotionError, clip_from_joints
from agility_rl.motion.legs import A1, GO2, LegGeometry
from agility_rl.motion.motion_json import unit_quaternion

MAX_FOOT_ERROR = 0.03
"""A clip whose kinematics miss the stored feet by more than this, on average over one foot [m], is refused."""

_ORDERS = torch.tensor(list(itertools.permutations(range(4))))
_FRAMES = ("world", "base", "world axes from the root")
_TIE = 2e-5
"""Conventions that differ by less [m] are told apart by their order of preference: they mean the same poses."""


@dataclass(frozen=True)
class Convention:
    """What the columns of one file mean, found by :func:`find_convention`.

    Attributes:
        robot: dimensions that fit.
        joint_blocks: for FL, FR, RL, RR the block of three joint columns that holds it.
        hip_signs: for FL, FR, RL, RR the factor that turns the stored hip angle into Go2's.
        foot_blocks: for FL, FR, RL, RR the block of three foot columns that holds it.
        foot_frame: ``"world"``, ``"base"`` or ``"world axes from the root"``.
        error: mean distance between computed and stored feet [m], of the worst foot.
        max_error: the same in the worst frame [m].
    """

    robot: LegGeometry
    joint_blocks: tuple[int, ...]
    hip_signs: tuple[int, ...]
    foot_blocks: tuple[int, ...]
    foot_frame: str
    error: float
    max_error: float

    def joints(self, stored: Tensor) -> Tensor:
        """Stored joint columns ``[T, 12]`` in the order and signs of the Go2."""
        blocks = stored.unflatten(-1, (4, 3))[:, list(self.joint_blocks)].clone()
        blocks[..., 0] *= torch.tensor(self.hip_signs, dtype=stored.dtype)
        return blocks.flatten(1)

    def feet(self, stored: Tensor) -> Tensor:
        """Stored foot columns ``[T, 12]`` as ``[T, 4, 3]`` in the order FL, FR, RL, RR."""
        return stored.unflatten(-1, (4, 3))[:, list(self.foot_blocks)]

    def describe(self) -> str:
        """One line for the user."""
        hips = "as stored" if set(self.hip_signs) == {1} else "x " + ",".join(f"{sign:+d}" for sign in self.hip_signs)
        return (
            f"61 columns, {self.robot.name} legs: joints {_order(self.joint_blocks)}, hip angles {hips}, "
            f"feet {_order(self.foot_blocks)} in the {self.foot_frame} frame, "
            f"kinematic error {self.error * 1000:.2f} mm (worst frame {self.max_error * 1000:.2f} mm)"
        )


def _order(blocks: Sequence[int]) -> str:
    """Leg names in the order of the file, from the block of each leg."""
    return ",".join(LEGS[list(blocks).index(block)] for block in range(4))


def find_convention(
    root_position: Tensor,
    root_quaternion: Tensor,
    joints: Tensor,
    feet: Tensor,
    robots: Sequence[LegGeometry] = (GO2, A1),
) -> Convention:
    """The convention whose forward kinematics lie closest to the stored feet.

    All robots x joint orders x hip signs x foot orders x foot frames are compared; of ties the earlier named robot,
    then the foot frame, then the order nearest to FL, FR, RL, RR with unchanged signs wins.

    Args:
        root_position: ``[T, 3]`` [m].
        root_quaternion: ``[T, 4]``, base to world.
        joints: ``[T, 12]`` [rad] as stored.
        feet: ``[T, 12]`` [m] as stored.
        robots: dimensions to try.

    Returns:
        The best convention, however bad; the caller judges its error.
    """
    stored = feet.unflatten(-1, (4, 3))
    inverse = rotations.conjugate(root_quaternion)[:, None]
    targets = (rotations.rotate(inverse, stored - root_position[:, None]), stored, rotations.rotate(inverse, stored))
    blocks = joints.unflatten(-1, (4, 3))
    hip_flip = torch.tensor([-1.0, 1.0, 1.0], dtype=joints.dtype)
    candidates = torch.stack((blocks, blocks * hip_flip))  # [sign, T, joint block, 3]

    best, best_error = None, torch.inf
    for robot in robots:
        computed = torch.stack([robot.leg(leg, candidates) for leg in range(4)])  # [leg, sign, T, joint block, 3]
        for frame, target in zip(_FRAMES, targets, strict=True):
            gap = (computed[..., None, :] - target[None, None, :, None]).norm(dim=-1)  # [leg, sign, T, joint, foot]
            mean, worst = gap.mean(2), gap.amax(2)
            sign = (mean[:, 1] < mean[:, 0] - _TIE).long()  # [leg, joint block, foot block]
            cost = mean.gather(1, sign[:, None])[:, 0]
            # Mean error of every pair of orders, [24 joint orders, 24 foot orders].
            total = torch.stack([cost[leg][_ORDERS[:, leg]][:, _ORDERS[:, leg]] for leg in range(4)]).mean(0).flatten()
            first = int((total <= total.min() + _TIE).nonzero()[0])
            if total[first] >= best_error - _TIE:
                continue
            best_error = float(total[first])
            joint_blocks, foot_blocks = _ORDERS[first // len(_ORDERS)], _ORDERS[first % len(_ORDERS)]
            legs = torch.arange(4)
            signs = sign[legs, joint_blocks, foot_blocks]
            best = Convention(
                robot=robot,
                joint_blocks=tuple(joint_blocks.tolist()),
                hip_signs=tuple((1 - 2 * signs).tolist()),
                foot_blocks=tuple(foot_blocks.tolist()),
                foot_frame=frame,
                error=float(mean[legs, signs, joint_blocks, foot_blocks].max()),
                max_error=float(worst[legs, signs, joint_blocks, foot_blocks].max()),
            )
    assert best is not None, "no robots to try"
    return best


def read_sixty_one(path: str | Path, frame_duration: float, frames: Tensor) -> MotionClip:
    """A clip at its own frame rate from 61 columns.

    Joint angles of another robot are kept and its path is scaled by the ratio of leg lengths, so that the steps fit.

    Args:
        path: where the frames come from, for the name and for messages.
        frame_duration: seconds between two frames.
        frames: float64 ``[T, 61]`` from :func:`agility_rl.motion.motion_json.read_frames`.

    Returns:
        The clip; its notes say which convention was found.

    Raises:
        MotionError: if no convention puts the feet where the file stores them.
    """
    path = Path(path)
    position, joints = frames[:, :3], frames[:, 7:19]
    quaternion = unit_quaternion(frames[:, 3:7], path)
    convention = find_convention(position, quaternion, joints, frames[:, 19:31])
    if convention.error > MAX_FOOT_ERROR:
        raise MotionError(
            f"{path}: unknown leg order: expected some order of legs to put the feet within "
            f"{MAX_FOOT_ERROR * 100:.0f} cm of the stored ones, the best misses by {convention.error * 100:.1f} cm "
            f"({convention.describe()}); leave the clip out or retarget it from its source"
        )
    notes = [convention.describe()]
    if convention.robot is not GO2:
        scale = GO2.leg_length / convention.robot.leg_length
        position = position * scale
        notes.append(f"{convention.robot.name} joint angles kept, path scaled by {scale:.3f}")
    return clip_from_joints(
        path.stem,
        frame_duration,
        position.float(),
        quaternion.float(),
        convention.joints(joints).float(),
        source="61 columns",
        notes=tuple(notes),
    )
