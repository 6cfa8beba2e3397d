"""The BVH parser: a skeleton by hand, the dog's golden keypoints, and what is wrong with broken files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agility_rl.motion.bvh import forward, read_bvh, read_bvh_clip
from agility_rl.motion.clip import MotionError
from agility_rl.motion.keypoints import read_keypoints

SMALL = """HIERARCHY
ROOT Hips
{
  OFFSET 5 5 5
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Leg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 20 0
    }
  }
}
MOTION
Frames:	2
Frame Time:	0.0166667
100 200 300 0 0 0 0 0 0
100 200 300 90 0 0 0 90 0
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.bvh"
    path.write_text(SMALL)
    return path


def test_positions_of_a_small_skeleton(small: Path) -> None:
    motion = read_bvh(small)
    assert motion.skeleton.names == ("Hips", "Leg", "Leg_End")
    assert motion.skeleton.parents == (-1, 0, 1)
    assert motion.dt == pytest.approx(1 / 60, abs=1e-6)
    position = forward(motion.skeleton, motion.values)
    # Frame 0: no rotation; the root stands at its channels, without its own offset.
    expected = torch.tensor([[100.0, 200, 300], [110, 200, 300], [110, 220, 300]], dtype=torch.float64)
    torch.testing.assert_close(position[0], expected)
    # Frame 1: a quarter turn about z brings x to y; then the leg turns about its own x, now the world's y, and its own
    # y, now the world's -x, goes to the world's z.
    expected = torch.tensor([[100.0, 200, 300], [100, 210, 300], [100, 210, 320]], dtype=torch.float64)
    torch.testing.assert_close(position[1], expected)


def test_a_byte_order_mark_is_passed_over(small: Path) -> None:
    plain = read_bvh(small)
    small.write_text(SMALL, encoding="utf-8-sig")
    assert torch.equal(read_bvh(small).values, plain.values)


def test_position_channels_of_a_joint_lie_in_its_parents_frame(small: Path) -> None:
    text = SMALL.replace("CHANNELS 3 Zrot", "CHANNELS 6 Xposition Yposition Zposition Zrot")
    text = text.replace("300 0 0 0 0 0 0", "300 0 0 0 10 0 0 0 0 0").replace(
        "300 90 0 0 0 90 0", "300 90 0 0 12 0 0 0 90 0"
    )
    small.write_text(text)
    motion = read_bvh(small)
    position = forward(motion.skeleton, motion.values)
    # As above, but the leg of frame 1 is 12 long, along the y that x has become.
    expected = torch.tensor([[100.0, 200, 300], [100, 212, 300], [100, 212, 320]], dtype=torch.float64)
    torch.testing.assert_close(position[1], expected)


def test_keypoints_are_metres_with_z_up(small: Path) -> None:
    points = read_bvh(small).keypoints()
    torch.testing.assert_close(points.point("Leg_End")[0], torch.tensor([1.1, -3.0, 2.2], dtype=torch.float64))
    assert points.source == "BVH"


@pytest.mark.parametrize(
    ("recording", "table"),
    [
        ("D1_010_KAN01_003", "dog_run02"),
        ("D1_007_KAN01_001", "dog_walk00"),
        ("D1_010_KAN01_001", "dog_run00"),
    ],
)
def test_agrees_with_the_published_keypoints(data: Path, recording: str, table: str) -> None:
    points = read_bvh(data / "mann_bvh" / f"{recording}.bvh").keypoints()
    golden = read_keypoints(data / "mann_keypoints" / f"{table}_joint_pos.txt")
    assert points.names == golden.names
    position = points.position.clone()
    position[..., :2] -= points.position[0, 0, :2]
    assert (position - golden.position).abs().max() < 1e-4


def test_agrees_with_a_published_cut_out_turned_about_the_vertical(data: Path) -> None:
    """``dog_pace`` is a piece of a recording, somewhere else and heading elsewhere: the same heights, and the same
    horizontal places in all frames once one translation and one turn are undone. A mirror image would not pass."""
    points = read_bvh(data / "mann_bvh" / "D1_007_KAN01_001.bvh").keypoints().slice(226, 265)
    golden = read_keypoints(data / "mann_keypoints" / "dog_pace_joint_pos.txt")
    assert points.position.shape == golden.position.shape == (39, 27, 3)
    assert (points.position[..., 2] - golden.position[..., 2]).abs().max() < 1e-4
    found, expected = (torch.view_as_complex(p.position[..., :2].contiguous()) for p in (points, golden))
    found, expected = found - found.mean(), expected - expected.mean()
    turn = (expected * found.conj()).sum().angle()  # of the least squares
    assert turn.abs() > 0.1, "nothing to undo: compare it with the tables above"
    assert (found * torch.polar(torch.ones_like(turn), turn) - expected).abs().max() < 1e-4


def test_a_recording_becomes_a_clip(data: Path) -> None:
    clip = read_bvh_clip(data / "mann_bvh" / "D1_010_KAN01_003.bvh")
    assert clip.num_frames == 203
    assert clip.source == "BVH, retargeted"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "NOTHING", "line 1: expected HIERARCHY, got 'NOTHING'"),
        (SMALL[SMALL.index("MOTION") :], "", "expected a MOTION section after the hierarchy"),
        ("Frames:	2", "Frames:	3", "expected 3 frames as its header announces, got 2"),
        ("100 200 300 90 0 0 0 90 0", "100 200 300", "line 20: expected 9 numbers, got 3"),
        ("100 200 300 90 0 0 0 90 0", "100 200 300 90 0 0 0 90 nonsense", "line 20: expected numbers"),
        ("100 200 300 90 0 0 0 90 0", "100 200 300 90 0 0 0 90 nan", "NaN or infinity, first in frame 1 of 2"),
        ("OFFSET 10 0 0", "OFFSET 10 0", "line 8: expected 3 numbers, got 2"),
        ("3 Zrotation Xrotation Yrotation", "3 Zrotation Xrotation Wrotation", "line 9: expected a number of channels"),
        ("3 Zrotation Xrotation Yrotation", "", "line 9: expected a number of channels"),
        ("ROOT Hips", "End Site", "line 2: expected one hierarchy, its ROOT first, got 'End Site'"),
        ("Frames:	2", "Frames", "line 17: expected 'Frames:' and 'Frame Time:'"),
        ("Frames:	2", "Frames:	nan", "expected -1 frames"),
        ("0.0166667", "0", "positive frame time"),
        ("  }\n}\n", "  }\n", "the hierarchy is incomplete"),
        ("JOINT Leg", "BONE Leg", "'BONE' is no BVH keyword"),
    ],
)
def test_broken_files_say_where_and_why(small: Path, old: str, new: str, message: str) -> None:
    assert old in SMALL
    small.write_text(SMALL.replace(old, new))
    with pytest.raises(MotionError) as raised:
        read_bvh(small).keypoints()
    assert message in str(raised.value)
    assert "small" in str(raised.value)


def test_missing_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="expected a BVH file"):
        read_bvh(tmp_path / "none.bvh")
    (tmp_path / "empty.bvh").write_text("")
    with pytest.raises(MotionError, match="an empty file"):
        read_bvh(tmp_path / "empty.bvh")


def test_another_animal_is_refused_by_the_retargeter(small: Path) -> None:
    with pytest.raises(MotionError, match="no point 'LeftArm'; there are Hips, Leg, Leg_End"):
        read_bvh_clip(small)
