"""The JSON motion files of the AMP family: ``{"FrameDuration": seconds, "Frames": [[...], ...]}``, 61 or 19 columns."""

from __future__ import annotations

import json
import math
from pathlib import Path

import torch
from torch import Tensor

from agility_rl.motion.clip import MotionError

COLUMNS = (61, 19)
"""Widths of the two known forms."""


def read_frames(path: str | Path) -> tuple[float, Tensor]:
    """Seconds a frame and all frames, float64 ``[T, 61]`` or ``[T, 19]``, of a JSON motion file.

    Raises:
        MotionError: if it is no such file, naming the first row of a wrong width, the first NaN, or the missing frames.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, OSError) as error:
        raise MotionError(f"{path}: expected a JSON motion file, got {error}") from error
    if not isinstance(data, dict) or not {"Frames", "FrameDuration"} <= data.keys():
        raise MotionError(f"{path}: expected a JSON object with 'Frames' and 'FrameDuration', got another form")
    rows = data["Frames"]
    if not isinstance(rows, list) or len(rows) < 2:
        found = len(rows) if isinstance(rows, list) else type(rows).__name__
        raise MotionError(f"{path}: expected at least 2 frames, got {found}: a clip of zero length")
    columns = len(rows[0]) if isinstance(rows[0], list) else 0
    for index, row in enumerate(rows):
        found = len(row) if isinstance(row, list) else type(row).__name__
        if found not in COLUMNS or found != columns:
            expected = columns if columns in COLUMNS else " or ".join(map(str, COLUMNS))
            raise MotionError(f"{path}: frame {index} expected {expected} columns, got {found}")
    try:
        frames = torch.tensor(rows, dtype=torch.float64)
        duration = float(data["FrameDuration"])
    except (TypeError, ValueError, OverflowError) as error:
        raise MotionError(f"{path}: expected numbers in 'Frames' and 'FrameDuration', got {error}") from error
    finite = torch.isfinite(frames)
    if not bool(finite.all()):
        row_index, column = (~finite).nonzero()[0].tolist()
        raise MotionError(f"{path}: NaN or infinity in frame {row_index}, column {column}; cut the clip there")
    if not (math.isfinite(duration) and duration > 0):
        raise MotionError(f"{path}: expected a positive 'FrameDuration' in seconds, got {duration}")
    return duration, frames


def unit_quaternion(xyzw: Tensor, path: Path) -> Tensor:
    """Quaternions ``(w, x, y, z)`` of length 1 from stored ``(x, y, z, w)``, ``[T, 4]``.

    Raises:
        MotionError: if one is off length 1 by more than 5 %, because then these columns hold something else.
    """
    norm = xyzw.norm(dim=-1, keepdim=True)
    wrong = ((norm - 1).abs() > 0.05).nonzero()
    if len(wrong):
        first = int(wrong[0, 0])
        raise MotionError(
            f"{path}: frame {first}, columns 3-6: expected a unit quaternion, got length {float(norm[first]):.3f}"
        )
    return torch.roll(xyzw / norm, 1, -1)
