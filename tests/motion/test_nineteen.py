from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants
from agility_rl.motion.clip import MotionError
from agility_rl.motion.edit import foot_slip
from agility_rl.motion.formats import load_clip
from agility_rl.motion.nineteen import laikago_joints, read_nineteen


def upright(frames: int = 4) -> torch.Tensor:
    rows = torch.zeros(frames, 19, dtype=torch.float64)
    rows[:, 2] = 0.4
    rows[:, 3:7] = 0.5
    rows[:, 7:] = torch.tensor([0.1, 0.3, -0.9], dtype=torch.float64).repeat(4)
    return rows


def test_the_laikagos_trunk_frame_is_upright() -> None:
    clip = read_nineteen("x.txt", 0.0167, upright())
    assert torch.allclose(clip.root_quaternion, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4), atol=1e-6)


def test_a_turn_about_the_vertical_stays_one() -> None:
    rows = upright(3)
    for index, yaw in enumerate((0.0, 0.2, 0.4)):
        q = rotations.multiply(
            torch.tensor([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)], dtype=torch.float64),
            torch.full((4,), 0.5, dtype=torch.float64),
        )
        rows[index, 3:7] = torch.roll(q, -1)
    clip = read_nineteen("x.txt", 0.1, rows)
    assert torch.allclose(clip.root_angular_velocity, torch.tensor([0.0, 0.0, 2.0]).expand(3, 3), atol=1e-4)


def test_hips_that_count_outwards_spread_all_feet() -> None:
    inward, outward = upright(), upright()
    inward[:, 7::3], outward[:, 7::3] = -0.2, 0.2
    narrow = read_nineteen("x.txt", 0.02, inward).foot_position[0, :, 1]
    wide = read_nineteen("x.txt", 0.02, outward).foot_position[0, :, 1]
    assert (wide[[0, 2]] > narrow[[0, 2]]).all() and (wide[[1, 3]] < narrow[[1, 3]]).all()


def test_the_first_block_is_the_front_right_leg() -> None:
    stored = torch.zeros(1, 12, dtype=torch.float64)
    stored[0, :3] = torch.tensor([0.3, 0.1, -1.0])
    joints, cut = laikago_joints(stored)
    # Knee back by atan(.1422 / .20833), toe back by atan(.022 / .25), from the URDF's origins.
    assert joints[0, 3:6].tolist() == pytest.approx([-0.3, 0.1 + 0.59891, -1.0 - 0.59891 + 0.08777], abs=1e-4)
    assert cut == pytest.approx(3 / 12)


def test_columns_that_are_no_quaternion_are_refused() -> None:
    rows = upright()
    rows[2, 3:7] = 0.1
    with pytest.raises(MotionError, match="frame 2, columns 3-6"):
        read_nineteen("x.txt", 0.02, rows)


@pytest.mark.parametrize("name", ["dog_pace", "dog_trot", "hopturn", "sidesteps", "turn"])
def test_real_clips_stand_on_the_floor(data: Path, name: str) -> None:
    """Their floor comes out at 0 +- 3 cm without grounding: the conversion of angles and lengths fits."""
    clip = load_clip(data / "laikago_clips" / f"{name}.txt", grounding=None)
    lowest = clip.foot_position[..., 2].amin(-1) - constants.FOOT_RADIUS
    assert lowest.quantile(0.1).abs() < 0.03
    lower, upper = torch.tensor(constants.JOINT_LOWER), torch.tensor(constants.JOINT_UPPER)
    assert ((clip.joint_position >= lower - 1e-6) & (clip.joint_position <= upper + 1e-6)).all()


def test_a_real_trot_slips_less_forward_than_reversed(data: Path) -> None:
    clip = load_clip(data / "laikago_clips" / "dog_trot.txt")
    speed = clip.root_linear_velocity[:, :2].norm(dim=-1).mean()
    assert foot_slip(clip).mean < 0.6 * speed
