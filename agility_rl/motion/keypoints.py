"""Tracked points of a dog, and the reader of 81-column keypoint tables (27 points x 3 coordinates, one row a frame).

The tables come from the same recordings as the BVH files: metres, y up, 60 frames a second, points in depth-first order
of the skeleton with its end sites, shifted so that the first frame's root stands at x = z = 0.

Source: data notes, part B.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from agility_rl.motion.clip import MotionClip, MotionError

FRAME_TIME = 1 / 60
"""Seconds between two rows of a keypoint table, which does not store it."""

POINTS: tuple[str, ...] = (
    *("Hips", "Spine", "Spine1", "Neck", "Head", "Head_End"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "LeftHand_End"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand", "RightHand_End"),
    *("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftFoot_End"),
    *("RightUpLeg", "RightLeg", "RightFoot", "RightFoot_End"),
    *("Tail", "Tail1", "Tail1_End"),
)
"""Names of the 27 points; ``_End`` marks the end site of a bone. Hips is the joint at the tail end of the spine."""


@dataclass(frozen=True)
class Keypoints:
    """Points of a moving animal.

    Attributes:
        name: recording it comes from.
        dt: seconds between two frames.
        position: ``[T, P, 3]`` [m], world frame, z up.
        names: names of the ``P`` points.
        source: file format.

    Raises:
        MotionError: if shapes disagree, a number is not finite, or there are fewer than two frames.
    """

    name: str
    dt: float
    position: Tensor
    names: tuple[str, ...] = POINTS
    source: str = "keypoints"

    def __post_init__(self) -> None:
        frames = self.position.shape[0] if self.position.ndim else 0
        if tuple(self.position.shape) != (frames, len(self.names), 3):
            raise MotionError(
                f"keypoints {self.name!r}: expected positions [T, {len(self.names)}, 3] for {len(self.names)} names, "
                f"got {tuple(self.position.shape)}"
            )
        if frames < 2:
            raise MotionError(f"keypoints {self.name!r}: expected at least 2 frames, got {frames}")
        finite = torch.isfinite(self.position).flatten(1).all(-1)
        if not bool(finite.all()):
            first = int((~finite).nonzero()[0])
            raise MotionError(f"keypoints {self.name!r}: NaN or infinity, first in frame {first} of {frames}")

    def point(self, name: str) -> Tensor:
        """Track of one point, ``[T, 3]`` [m].

        Raises:
            MotionError: if there is no such point.
        """
        if name not in self.names:
            raise MotionError(f"keypoints {self.name!r}: no point {name!r}; there are {', '.join(self.names)}")
        return self.position[:, self.names.index(name)]

    def slice(self, start: int, stop: int | None = None) -> Keypoints:
        """Frames ``start`` to ``stop`` (exclusive)."""
        return Keypoints(self.name, self.dt, self.position[start:stop], self.names, self.source)


def z_up(position: Tensor) -> Tensor:
    """Turn coordinates ``[*B, 3]`` with y up into coordinates with z up: ``(x, y, z) -> (x, -z, y)``, a pure rotation.

    Example:
        >>> z_up(torch.tensor([1.0, 2.0, 3.0]))
        tensor([ 1., -3.,  2.])
    """
    x, y, z = position.unbind(-1)
    return torch.stack((x, -z, y), -1)


def read_keypoints(path: str | Path, dt: float = FRAME_TIME) -> Keypoints:
    """Read a table of 81 comma-separated columns, one row a frame.

    Args:
        path: the table.
        dt: seconds between two rows.

    Raises:
        MotionError: if the file is missing or empty, a row has another number of columns, or a field is no number.
    """
    path = Path(path)
    columns = 3 * len(POINTS)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(f"{path}: expected a table of {columns} columns, got {error}") from error
    rows = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        fields = line.strip().rstrip(",").split(",")
        if len(fields) != columns:
            hint = "; a table of 87 columns holds poses, read its _joint_pos sibling" if len(fields) == 87 else ""
            raise MotionError(f"{path}, line {number}: expected {columns} columns (27 points), got {len(fields)}{hint}")
        try:
            rows.append([float(field) for field in fields])
        except ValueError as error:
            raise MotionError(f"{path}, line {number}: expected numbers, {error}") from error
    if not rows:
        raise MotionError(f"{path}: expected rows of {columns} columns, found an empty file")
    table = torch.from_numpy(np.asarray(rows)).unflatten(-1, (len(POINTS), 3))
    name = path.stem.removesuffix("_joint_pos")
    return Keypoints(name, dt, z_up(table), source="keypoint table")


def read_keypoint_clip(path: str | Path) -> MotionClip:
    """Read a keypoint table and retarget it to the Go2 with default settings, on the recording's own floor.

    Raises:
        MotionError: see :func:`read_keypoints` and :func:`agility_rl.motion.retarget.retarget`.
    """
    from agility_rl.motion.retarget import retarget  # retarget reads through this module

    return retarget(read_keypoints(path), grounding=None)
