from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants
from agility_rl.motion.clip import MotionClip, MotionError, central_difference, clip_from_joints, load, save


def test_velocities_are_the_derivatives_of_the_poses(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    assert torch.allclose(clip.root_linear_velocity, torch.tensor([0.5, 0.1, 0.0]).expand(60, 3), atol=1e-4)
    # A trunk that keeps roll and pitch while it yaws turns about the world's z alone.
    assert torch.allclose(clip.root_angular_velocity, torch.tensor([0.0, 0.0, 0.3]).expand(60, 3), atol=1e-4)
    expected = 0.6 * torch.cos(6.0 * torch.arange(60)[:, None] * 0.02 + torch.arange(12.0))
    assert torch.allclose(clip.joint_velocity[1:-1], expected[1:-1], atol=2e-3)


def test_standing_feet_touch_the_ground() -> None:
    position = torch.tensor([0.0, 0.0, constants.STANDING_HEIGHT]).expand(3, 3)
    level = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(3, 4)
    clip = clip_from_joints("stand", 0.02, position, level, torch.tensor(constants.DEFAULT_POSE).expand(3, 12))
    assert clip.foot_contact.all()
    assert torch.allclose(clip.foot_position[..., 2], torch.tensor(constants.FOOT_RADIUS), atol=1e-4)
    assert (clip.foot_position[0, :2, 0] > 0).all() and (clip.foot_position[0, [0, 2], 1] > 0).all()


def test_quaternions_keep_their_sign_along_a_clip(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    flipped = clip.root_quaternion.clone()
    flipped[20:40] *= -1
    again = clip_from_joints("x", clip.dt, clip.root_position, flipped, clip.joint_position)
    assert torch.equal(again.root_quaternion, clip.root_quaternion)
    assert torch.allclose(again.root_angular_velocity, clip.root_angular_velocity)


def test_central_difference_is_exact_for_parabolas_inside() -> None:
    time = torch.arange(10.0)[:, None] * 0.1
    assert torch.allclose(central_difference(time**2, 0.1)[1:-1], 2 * time[1:-1], atol=1e-5)


def test_a_slice_is_a_clip(make_clip: Callable[..., MotionClip]) -> None:
    part = make_clip(label="walk").slice(10, 20)
    assert part.num_frames == 10 and part.label == "walk"
    assert part.duration == pytest.approx(0.18)


def test_a_stored_clip_comes_back_as_it_was(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    clip = make_clip(label="trot", weight=2.5, source="hand", synthetic=True, notes=("a", "b, c"))
    again = load(save(clip, tmp_path / "folder" / "clip.npz"))
    for name, value in vars(clip).items():
        other = getattr(again, name)
        assert torch.equal(value, other) if isinstance(value, torch.Tensor) else value == other, name


def test_an_unlabelled_clip_stays_unlabelled(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    assert load(save(make_clip(), tmp_path / "clip")).label is None


def test_no_archive_can_smuggle_objects(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    path = tmp_path / "evil.npz"
    np.savez(path, name=np.array([{"a": 1}], dtype=object), dt=0.02)
    with pytest.raises(MotionError, match=r"evil.npz: expected an .npz archive"):
        load(path)


def test_an_incomplete_archive_names_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "part.npz"
    np.savez(path, name="x", dt=0.02)
    with pytest.raises(MotionError, match="joint_position"):
        load(path)
    path.write_bytes(b"no archive")
    with pytest.raises(MotionError, match=r"part.npz"):
        load(path)


def test_a_damaged_archive_is_one_clear_error(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    whole = save(make_clip(), tmp_path / "clip.npz").read_bytes()
    path = tmp_path / "damaged.npz"
    spoilt = bytearray(whole)
    spoilt[len(whole) // 2 : len(whole) // 2 + 64] = bytes(64)
    for content in (whole[: len(whole) // 2], bytes(spoilt)):
        path.write_bytes(content)
        with pytest.raises(MotionError, match=r"damaged.npz: expected an .npz archive"):
            load(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    path.write_bytes((tmp_path / "array.npy").read_bytes())
    with pytest.raises(MotionError, match=r"damaged.npz"):
        load(path)


def test_arrays_of_another_precision_become_ours(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    path = save(make_clip(), tmp_path / "clip.npz")
    with np.load(path) as archive:
        doubled = {name: x.astype(np.float64) if x.dtype == np.float32 else x for name, x in archive.items()}
    np.savez(path, **doubled)
    assert load(path).joint_position.dtype == torch.float32


def test_a_point_in_a_name_is_no_suffix(make_clip: Callable[..., MotionClip], tmp_path: Path) -> None:
    files = [save(make_clip(), tmp_path / name) for name in ("walk_0.3", "walk_0.6", "walk_0.6.npz")]
    assert [file.name for file in files] == ["walk_0.3.npz", "walk_0.6.npz", "walk_0.6.npz"]


def test_nan_is_refused_with_its_frame(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    joints = clip.joint_velocity.clone()
    joints[7, 3] = torch.nan
    with pytest.raises(
        MotionError, match=r"clip 'swing': joint_velocity holds NaN or infinity, first in frame 7 of 60"
    ):
        replace(clip, joint_velocity=joints)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": 0.0}, "positive time step"),
        ({"dt": float("nan")}, "positive time step"),
        ({"weight": -1.0}, "weight >= 0"),
        (
            {"foot_contact": torch.zeros(60, 3, dtype=torch.bool)},
            r"foot_contact expected shape \(60, 4\), got \(60, 3\)",
        ),
        ({"root_position": torch.zeros(1, 3)}, "at least 2 frames, got 1"),
        ({"root_quaternion": torch.zeros(60, 4)}, "length 1, got 0.0000 in frame 0"),
    ],
)
def test_a_broken_clip_is_refused(
    make_clip: Callable[..., MotionClip], change: dict[str, object], message: str
) -> None:
    with pytest.raises(MotionError, match=message):
        replace(make_clip(), **change)  # type: ignore[arg-type]


def test_zero_length_is_refused() -> None:
    empty = torch.zeros(0, 12)
    with pytest.raises(MotionError, match="at least 2 frames"):
        clip_from_joints("empty", 0.02, torch.zeros(0, 3), torch.zeros(0, 4), empty)


def test_feet_are_in_the_world(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    relative = rotations.rotate_inverse(clip.root_quaternion[:, None], clip.foot_position - clip.root_position[:, None])
    # Every foot stays in its own quarter of the trunk.
    assert (relative[:, :2, 0] > 0).all() and (relative[:, 2:, 0] < 0).all()
    assert (relative[:, [0, 2], 1] > 0).all() and (relative[:, [1, 3], 1] < 0).all()
