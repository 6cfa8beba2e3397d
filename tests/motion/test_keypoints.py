"""Keypoint tables: axes, names, and broken rows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agility_rl.motion.clip import MotionError
from agility_rl.motion.keypoints import POINTS, Keypoints, read_keypoint_clip, read_keypoints, z_up


def row(number: int) -> list[float]:
    """Point ``p`` of row ``n`` stands at (p, 100 + p, 200 + n)."""
    return [value for point in range(27) for value in (point, 100 + point, 200 + number)]


def write(path: Path, rows: list[list[float]], separator: str = ",\t") -> Path:
    path.write_text("\n".join(separator.join(str(value) for value in values) for values in rows) + "\n")
    return path


def test_columns_become_points_with_z_up(tmp_path: Path) -> None:
    points = read_keypoints(write(tmp_path / "dog_joint_pos.txt", [row(0), row(1), row(2)]))
    assert points.name == "dog"
    assert points.position.shape == (3, 27, 3)
    assert points.dt == pytest.approx(1 / 60)
    # Point 4 (Head) in row 2: x = 4, y up = 104, z = 202, hence z-up (4, -202, 104).
    assert points.point("Head")[2].tolist() == [4.0, -202.0, 104.0]


def test_a_byte_order_mark_is_no_number(tmp_path: Path) -> None:
    path = write(tmp_path / "dog.csv", [row(0), row(1)], separator=",")
    plain = read_keypoints(path)
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert torch.equal(read_keypoints(path).position, plain.position)


def test_z_up_is_a_rotation() -> None:
    matrix = z_up(torch.eye(3)).T
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(3))
    assert torch.linalg.det(matrix).item() == pytest.approx(1.0)


def test_names_are_the_skeleton_depth_first() -> None:
    assert len(POINTS) == len(set(POINTS)) == 27
    assert POINTS[0] == "Hips"
    assert sum(name.endswith("_End") for name in POINTS) == 6


def test_slices_keep_everything_else(tmp_path: Path) -> None:
    points = read_keypoints(write(tmp_path / "a.csv", [row(n) for n in range(5)], ","))
    part = points.slice(1, 4)
    assert torch.equal(part.position, points.position[1:4])
    assert (part.names, part.dt, part.name) == (points.names, points.dt, "a")


def test_a_published_table_becomes_a_clip(data: Path) -> None:
    clip = read_keypoint_clip(data / "mann_keypoints" / "dog_trot_joint_pos.txt")
    assert clip.num_frames == 33
    assert clip.source == "keypoint table, retargeted"


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([row(0), row(1)[:80]], "line 2: expected 81 columns (27 points), got 80"),
        ([row(0) + [0.0] * 6], "got 87; a table of 87 columns holds poses"),
        ([row(0)], "expected at least 2 frames, got 1"),
        ([row(0), [float("nan")] * 81], "NaN or infinity, first in frame 1 of 2"),
        ([], "found an empty file"),
    ],
)
def test_broken_tables_say_where_and_why(tmp_path: Path, rows: list[list[float]], message: str) -> None:
    with pytest.raises(MotionError) as raised:
        read_keypoints(write(tmp_path / "broken.txt", rows))
    assert message in str(raised.value)
    assert "broken" in str(raised.value)


def test_words_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "words.txt").write_text(",".join(["word"] * 81))
    with pytest.raises(MotionError, match="line 1: expected numbers"):
        read_keypoints(tmp_path / "words.txt")
    with pytest.raises(MotionError, match="81 columns"):
        read_keypoints(tmp_path / "none.txt")


def test_unknown_points_and_wrong_shapes() -> None:
    points = Keypoints("dog", 0.02, torch.zeros(3, 2, 3), ("a", "b"))
    with pytest.raises(MotionError, match="no point 'c'; there are a, b"):
        points.point("c")
    with pytest.raises(MotionError, match=r"expected positions \[T, 2, 3\]"):
        Keypoints("dog", 0.02, torch.zeros(3, 3, 3), ("a", "b"))
