"""Motion files that no training can use, given as a user gives them: one line that names the file, and no run."""

from __future__ import annotations

import json
import pickle
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.motion import MotionClip, load_clips, synthesize_gait

Command = Callable[..., subprocess.CompletedProcess[str]]
Rows = list[list[float]]

NAN = float("nan")


def sixty_one(clip: MotionClip) -> Rows:
    """The 61 columns of a clip in the order of the Go2, feet in the world frame, velocities zero."""
    quaternion = torch.roll(clip.root_quaternion, -1, -1)
    feet, zeros = clip.foot_position.flatten(1), torch.zeros(clip.num_frames, 30)
    rows: Rows = torch.cat((clip.root_position, quaternion, clip.joint_position, feet, zeros), -1).tolist()
    return rows


def eighteen(clip: MotionClip) -> Rows:
    """The 18 columns of a MimicKit pickle."""
    turn = rotations.difference(torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(clip.num_frames, 4), clip.root_quaternion)
    rows: Rows = torch.cat((clip.root_position, turn, clip.joint_position), -1).tolist()
    return rows


def write(path: Path, rows: Rows) -> Path:
    """Frames as the format that the extension names."""
    if path.suffix == ".pkl":
        path.write_bytes(pickle.dumps({"loop_mode": 0, "fps": 50.0, "frames": rows}))
    else:
        path.write_text(json.dumps({"FrameDuration": 0.02, "Frames": rows}))
    return path


@pytest.fixture
def motion(tmp_path: Path) -> Path:
    """Folders ``labelled`` and ``unlabelled`` with one sound clip each; ``runs`` beside them does not exist yet."""
    clip = synthesize_gait("trot", duration=1.0)
    for folder, name in (("labelled", "trot_0.json"), ("unlabelled", "0.json")):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / name, sixty_one(clip))
    return tmp_path


def refused(command: Command, motion: Path) -> str:
    """What a training on these folders prints to stderr before it ends, having made nothing."""
    folders = ("--motion.labelled", motion / "labelled", "--motion.unlabelled", motion / "unlabelled")
    result = command("bbc_pretrain", "smoke", "--runs", motion / "runs", *folders)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1 and result.stderr.endswith("\n")
    assert not (motion / "runs").exists()
    return result.stderr


def test_the_clips_are_sound_before_they_are_spoilt(motion: Path) -> None:
    write(motion / "unlabelled" / "1.pkl", eighteen(synthesize_gait("pace", duration=1.0)))
    assert [clip.label for clip in load_clips(motion / "labelled", label="from name")] == ["trot"]
    assert [clip.num_frames for clip in load_clips(motion / "unlabelled")] == [51, 51]


def with_nan(rows: Rows) -> Rows:
    rows[7][9] = NAN
    return rows


def with_a_short_frame(rows: Rows) -> Rows:
    return [*rows[:7], rows[7][:-1], *rows[8:]]


def with_a_column_less(rows: Rows) -> Rows:
    return [row[:-1] for row in rows]


def with_calf_first(rows: Rows) -> Rows:
    """Every leg as calf, hip, thigh, which no known file has."""
    order = [7 + 3 * leg + joint for leg in range(4) for joint in (2, 0, 1)]
    return [[*row[:7], *(row[column] for column in order), *row[19:]] for row in rows]


def without_frames(rows: Rows) -> Rows:
    return []


@pytest.mark.parametrize("folder", ["labelled", "unlabelled"])
@pytest.mark.parametrize(
    ("name", "spoil", "expected"),
    [
        ("trot_1.json", with_nan, "NaN or infinity in frame 7, column 9"),
        ("trot_1.json", with_a_short_frame, "frame 7 expected 61 columns, got 60"),
        ("trot_1.json", with_a_column_less, "frame 0 expected 61 or 19 columns, got 60"),
        ("trot_1.pkl", with_a_short_frame, "frame 7 expected 18 columns, got 17"),
        ("trot_1.json", with_calf_first, "unknown leg order: expected some order of legs to put the feet within 3 cm"),
        ("trot_1.json", without_frames, "expected at least 2 frames, got 0: a clip of zero length"),
        ("trot_1.pkl", without_frames, "expected a list of at least 2 frames, got 0: a clip of zero length"),
    ],
)
def test_a_bad_clip_is_named(
    motion: Path, command: Command, folder: str, name: str, spoil: Callable[[Rows], Rows], expected: str
) -> None:
    clip = synthesize_gait("trot", duration=1.0)
    rows = eighteen(clip) if name.endswith(".pkl") else sixty_one(clip)
    path = write(motion / folder / name, spoil(rows))
    message = refused(command, motion)
    assert f"{path}: {expected}" in message


@pytest.mark.parametrize("name", ["trot_1.json", "trot_1.pkl", "trot_1.npz", "trot_1.bvh", "trot_1.csv"])
def test_an_empty_file_is_named(motion: Path, command: Command, name: str) -> None:
    path = motion / "unlabelled" / name
    path.write_bytes(b"")
    message = refused(command, motion)
    assert str(path) in message and "expected" in message


@pytest.mark.parametrize("label", ["gallop", "skill"])
def test_a_label_that_is_no_skill_is_named(motion: Path, command: Command, label: str) -> None:
    path = (motion / "labelled" / "trot_0.json").rename(motion / "labelled" / f"{label}_0.json")
    message = refused(command, motion)
    assert f"{path}: label {label!r} is no behaviour; expected one of walk, pace, trot, canter, jump" in message
