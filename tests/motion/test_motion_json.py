from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl.motion.clip import MotionError
from agility_rl.motion.motion_json import read_frames, unit_quaternion

Writer = Callable[..., Path]


def test_frames_are_read_as_they_stand(write_json: Writer) -> None:
    rows = [[float(row * 19 + column) for column in range(19)] for row in range(3)]
    duration, frames = read_frames(write_json(rows, duration=0.021))
    assert duration == 0.021
    assert frames.dtype == torch.float64 and torch.equal(frames, torch.arange(57.0, dtype=torch.float64).reshape(3, 19))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "zero length"),
        ([[0.0] * 61], "at least 2 frames, got 1"),
        ("none", "at least 2 frames, got str"),
        ([[0.0] * 60] * 3, "frame 0 expected 61 or 19 columns, got 60"),
        ([[0.0] * 61, [0.0] * 61, [0.0] * 62], "frame 2 expected 61 columns, got 62"),
        ([[0.0] * 19, [0.0] * 61], "frame 1 expected 19 columns, got 61"),
        ([[0.0] * 61, 5], "frame 1 expected 61 columns, got int"),
        ([[0.0] * 61, [0.0] * 60 + [float("nan")]], "NaN or infinity in frame 1, column 60"),
        ([[0.0] * 61, [float("inf")] + [0.0] * 60], "NaN or infinity in frame 1, column 0"),
        ([["a"] * 61, ["b"] * 61], "expected numbers"),
    ],
)
def test_broken_frames_are_refused(write_json: Writer, frames: object, message: str) -> None:
    with pytest.raises(MotionError, match=message) as caught:
        read_frames(write_json(frames))
    assert "clip.json" in str(caught.value)


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan")])
def test_a_time_step_must_be_positive(write_json: Writer, duration: float) -> None:
    with pytest.raises(MotionError, match="positive 'FrameDuration'"):
        read_frames(write_json([[0.0] * 61] * 2, duration=duration))


@pytest.mark.parametrize(("text", "message"), [("{", "JSON motion file"), ("[1]", "'Frames' and 'FrameDuration'")])
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "clip.json"
    path.write_text(text)
    with pytest.raises(MotionError, match=message):
        read_frames(path)


def test_quaternions_are_reordered_and_normalised() -> None:
    stored = torch.tensor([[0.0, 0.0, 0.6, 0.79], [0.0, 0.0, 0.0, 1.01]], dtype=torch.float64)
    unit = unit_quaternion(stored, Path("x"))
    assert torch.allclose(unit.norm(dim=-1), torch.ones(2, dtype=torch.float64))
    assert unit[0, 0] > 0.78 and unit[0, 3] > 0.59
    with pytest.raises(MotionError, match=r"frame 1, columns 3-6: expected a unit quaternion, got length 0.500"):
        unit_quaternion(torch.tensor([[0.0, 0, 0, 1], [0, 0, 0, 0.5]]), Path("x"))
