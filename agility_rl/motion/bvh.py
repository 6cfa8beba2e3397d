"""Reads BVH motion capture and computes where every joint is (forward kinematics), in pure torch.

Source: the BVH format as the MANN dog recordings use it (data notes, part B.3): centimetres, y up, any hierarchy, any
order of rotation channels; a root with position channels takes its position from them alone, without its offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.keypoints import Keypoints, z_up

CENTIMETRE = 0.01
_AXES = {"X": 0, "Y": 1, "Z": 2}


@dataclass(frozen=True)
class Skeleton:
    """A hierarchy of joints in the order of the file (depth first), end sites included.

    Attributes:
        names: joint names; the end site of joint ``J`` is ``J_End``.
        parents: index of each joint's parent, -1 for the root.
        offsets: ``[P, 3]`` from the parent, file units.
        channels: channel names of each joint, such as ``("Zrotation", "Xrotation", "Yrotation")``; none for end sites.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Tensor
    channels: tuple[tuple[str, ...], ...]

    @property
    def num_channels(self) -> int:
        """Numbers a frame has."""
        return sum(len(channels) for channels in self.channels)


@dataclass(frozen=True)
class BVHMotion:
    """A recording: skeleton, seconds between two frames, and channel values ``[T, C]`` (file units and degrees)."""

    name: str
    skeleton: Skeleton
    dt: float
    values: Tensor

    def keypoints(self, unit: float = CENTIMETRE) -> Keypoints:
        """World position of every joint and end site in metres, z up.

        Args:
            unit: metres in a unit of the file.
        """
        position = z_up(forward(self.skeleton, self.values) * unit)
        return Keypoints(self.name, self.dt, position, self.skeleton.names, source="BVH")


def read_bvh(path: str | Path) -> BVHMotion:
    """Parse a BVH file.

    Raises:
        MotionError: if the file is missing or no BVH, its hierarchy is broken, or a frame has too few or many values.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise MotionError(f"{path}: expected a BVH file, got {error}") from error
    if not lines or lines[0].strip() != "HIERARCHY":
        raise MotionError(f"{path}, line 1: expected HIERARCHY, got {lines[0][:40] if lines else 'an empty file'!r}")
    skeleton, line = _parse_hierarchy(lines, path)
    return BVHMotion(path.stem, skeleton, *_parse_motion(lines, line, skeleton, path))


def read_bvh_clip(path: str | Path) -> MotionClip:
    """Read a BVH recording of the dog and retarget it to the Go2 with default settings, on the recording's own floor.

    Raises:
        MotionError: see :func:`read_bvh` and :func:`agility_rl.motion.retarget.retarget`.
    """
    from agility_rl.motion.retarget import retarget  # retarget reads through this module

    return retarget(read_bvh(path), grounding=None)


def forward(skeleton: Skeleton, values: Tensor) -> Tensor:
    """Positions of all joints.

    .. math:: R_j = R_{p(j)} \\prod_k R_{axis_k}(\\theta_k), \\quad x_j = x_{p(j)} + R_{p(j)} o_j

    with the rotations multiplied in the order of the channels. Position channels take the place of the offset o.

    Args:
        skeleton: hierarchy of ``P`` joints.
        values: ``[*B, C]`` channel values, file units and degrees.

    Returns:
        ``[*B, P, 3]`` in file units and axes.

    Example:
        >>> channels = (("Zrotation", "Xrotation", "Yrotation"), ())
        >>> bone = Skeleton(("A", "A_End"), (-1, 0), torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]), channels)
        >>> forward(bone, torch.tensor([90.0, 0.0, 0.0]))[1, 1]
        tensor(2.)
    """
    batch = values.shape[:-1]
    offsets = skeleton.offsets.to(values)
    positions: list[Tensor] = []
    turns: list[Tensor] = []
    column = 0
    for joint, (parent, channels) in enumerate(zip(skeleton.parents, skeleton.channels, strict=True)):
        around = torch.eye(3, dtype=values.dtype).expand(*batch, 3, 3) if parent < 0 else turns[parent]
        turn = around
        placed: dict[int, Tensor] = {}
        for channel in channels:
            axis, value = _AXES[channel[0]], values[..., column]
            if channel.endswith("position"):
                placed[axis] = value
            else:
                turn = turn @ _axis_rotation(axis, torch.deg2rad(value))
            column += 1
        offset = offsets[joint].expand(*batch, 3)
        if placed:
            offset = torch.stack([placed.get(axis, offset[..., axis]) for axis in range(3)], -1)
        position = (around @ offset[..., None])[..., 0]
        positions.append(position if parent < 0 else positions[parent] + position)
        turns.append(turn)
    return torch.stack(positions, -2)


def _axis_rotation(axis: int, angle: Tensor) -> Tensor:
    """Rotation matrices ``[*B, 3, 3]`` about one coordinate axis."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.zeros((*angle.shape, 3, 3), dtype=angle.dtype)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    matrix[..., axis, axis] = 1.0
    matrix[..., first, first] = cosine
    matrix[..., second, second] = cosine
    matrix[..., first, second] = -sine
    matrix[..., second, first] = sine
    return matrix


def _parse_hierarchy(lines: list[str], path: Path) -> tuple[Skeleton, int]:
    """The skeleton and the index of the line after ``MOTION``."""
    names: list[str] = []
    parents: list[int] = []
    offsets: dict[int, list[float]] = {}
    channels: dict[int, tuple[str, ...]] = {}
    stack: list[int] = []
    for index, line in enumerate(lines[1:], 1):
        words = line.split()
        where = f"{path}, line {index + 1}"
        if not words:
            continue
        match words[0]:
            case "ROOT" | "JOINT" | "End":
                parent = stack[-1] if stack else -1
                if (words[0] == "ROOT") == bool(names):
                    raise MotionError(f"{where}: expected one hierarchy, its ROOT first, got {line.strip()!r}")
                names.append(f"{names[parent]}_End" if words[0] == "End" else words[-1])
                parents.append(parent)
            case "{":
                stack.append(len(names) - 1)
            case "}":
                if not stack:
                    raise MotionError(f"{where}: a closing brace without an opening one")
                stack.pop()
            case "OFFSET":
                offsets[len(names) - 1] = _numbers(words[1:], 3, where)
            case "CHANNELS":
                declared = tuple(words[2:])
                known = all(word[:1] in _AXES and word[1:] in ("position", "rotation") for word in declared)
                if not known or words[1:2] != [str(len(declared))]:
                    raise MotionError(f"{where}: expected a number of channels and their names, got {line.strip()!r}")
                channels[len(names) - 1] = declared
            case "MOTION":
                if stack or not names or len(offsets) != len(names):
                    raise MotionError(f"{where}: the hierarchy is incomplete: unclosed brace or joint without OFFSET")
                ordered = torch.tensor([offsets[joint] for joint in range(len(names))], dtype=torch.float64)
                per_joint = tuple(channels.get(joint, ()) for joint in range(len(names)))
                return Skeleton(tuple(names), tuple(parents), ordered, per_joint), index + 1
            case _:
                raise MotionError(f"{where}: {words[0]!r} is no BVH keyword")
    raise MotionError(f"{path}: expected a MOTION section after the hierarchy, found the end of the file")


def _parse_motion(lines: list[str], line: int, skeleton: Skeleton, path: Path) -> tuple[float, Tensor]:
    """Seconds between frames and values ``[T, C]``, float64."""
    header = [entry.partition(":") for entry in lines[line : line + 2]]
    if [(name.strip(), colon) for name, colon, _ in header] != [("Frames", ":"), ("Frame Time", ":")]:
        raise MotionError(f"{path}, line {line + 1}: expected 'Frames:' and 'Frame Time:' after MOTION")
    announced = _numbers(header[0][2].split(), 1, f"{path}, line {line + 1}")[0]
    frames = int(announced) if math.isfinite(announced) else -1
    dt = _numbers(header[1][2].split(), 1, f"{path}, line {line + 2}")[0]
    if not 0 < dt < math.inf:
        raise MotionError(f"{path}, line {line + 2}: expected a positive frame time in seconds, got {dt}")
    rows = [
        _numbers(text.split(), skeleton.num_channels, f"{path}, line {number}")
        for number, text in enumerate(lines[line + 2 :], line + 3)
        if text.strip()
    ]
    if len(rows) != frames:
        raise MotionError(f"{path}: expected {frames} frames as its header announces, got {len(rows)}; truncated?")
    if frames < 2:
        raise MotionError(f"{path}: expected at least 2 frames, got {frames}")
    return dt, torch.from_numpy(np.asarray(rows, dtype=np.float64))


def _numbers(words: list[str], count: int, where: str) -> list[float]:
    if len(words) != count:
        raise MotionError(f"{where}: expected {count} numbers, got {len(words)}")
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise MotionError(f"{where}: expected numbers, {error}") from error
