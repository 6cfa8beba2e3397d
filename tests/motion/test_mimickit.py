from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.formats import load_clip
from agility_rl.motion.mimickit import load_plain_pickle, quaternion_from_rotation_vector, read_mimickit


class Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("evil_was_here",)


def write(path: Path, data: object) -> Path:
    path.write_bytes(pickle.dumps(data))
    return path


def frames(clip: MotionClip) -> list[list[float]]:
    zero = torch.zeros(4)
    rotation = torch.stack(
        [rotations.difference(zero.index_fill(0, torch.tensor(0), 1.0), q) for q in clip.root_quaternion]
    )
    rows: list[list[float]] = torch.cat((clip.root_position, rotation, clip.joint_position), -1).tolist()
    return rows


def test_a_clip_is_read_as_written(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    clip = make_clip()
    path = write(tmp_path / "go2_swing.pkl", {"loop_mode": 0, "fps": 50, "frames": frames(clip)})
    again = read_mimickit(path)
    assert again.dt == pytest.approx(0.02) and again.name == "go2_swing"
    assert torch.allclose(again.joint_position, clip.joint_position)
    assert torch.allclose(again.root_quaternion, clip.root_quaternion, atol=1e-5)
    assert torch.allclose(again.foot_position, clip.foot_position, atol=1e-5)


def test_a_pickle_cannot_run_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path / "evil.pkl", {"fps": 60, "frames": Evil()})
    with pytest.raises(MotionError, match=r"evil.pkl: the pickle asks for .*mkdir"):
        load_plain_pickle(path)
    assert not (tmp_path / "evil_was_here").exists()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([1, 2], "expected a dict with 'fps' and 'frames', got list"),
        ({"fps": 60, "frames": []}, "zero length"),
        ({"fps": 60, "frames": [[0.0] * 18, [0.0] * 17]}, "frame 1 expected 18 columns, got 17"),
        ({"fps": 0, "frames": [[0.0] * 18] * 3}, "positive 'fps'"),
        ({"fps": 60, "frames": [["a"] * 18] * 3}, "expected numbers"),
        ({"fps": 60, "frames": [[float("nan")] + [0.0] * 17] * 3}, "NaN"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, data: object, message: str) -> None:
    with pytest.raises(MotionError, match=message):
        read_mimickit(write(tmp_path / "x.pkl", data))


def test_a_damaged_pickle_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.pkl"
    path.write_bytes(pickle.dumps({"fps": 60, "frames": [[0.0] * 18] * 9})[:40])
    with pytest.raises(MotionError, match="damaged"):
        read_mimickit(path)


def test_rotation_vectors() -> None:
    small = torch.tensor([[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.3, -0.4, 1.2]], dtype=torch.float64)
    q = quaternion_from_rotation_vector(small)
    assert torch.allclose(q.norm(dim=-1), torch.ones(3, dtype=torch.float64))
    assert torch.allclose(rotations.difference(q[0].expand(3, 4), q), small, atol=1e-7)


@pytest.mark.parametrize("name", ["pace", "trot", "walk0"])
def test_the_stored_order_slips_least_on_real_clips(data: Path, name: str) -> None:
    clip = load_clip(data / "mimickit_go2_pkl" / f"go2_{name}.pkl")
    assert any("the stored order fits the path" in note for note in clip.notes)
