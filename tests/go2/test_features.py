"""Feature vectors: layout, scales and contact rule by hand, and the same numbers for a clip and for a simulation."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants, features, kinematics

POSE = torch.tensor(constants.DEFAULT_POSE)


def test_sizes_follow_from_the_layouts() -> None:
    assert features.NUM_PROPRIOCEPTION == 2 + 3 + 12 + 12 + 12 + 4 == 45
    assert features.NUM_EXPLICIT == 4
    assert features.NUM_MEASUREMENT == 2 + 3 + 12 + 12 == 29
    assert features.NUM_MOTION == 2 + 1 + 3 + 3 + 12 + 12 + 12 + 4 == 49


def test_slices_are_contiguous_and_unknown_names_are_refused() -> None:
    assert features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "joint_velocity") == slice(17, 29)
    with pytest.raises(KeyError, match="no entry 'tail'"):
        features.layout_slice(features.MOTION_LAYOUT, "tail")


@pytest.mark.parametrize("offsets", [(), (1, 2), (0, 3, 3), (0, -1)])
def test_offsets_rise_from_zero(offsets: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="rise from 0"):
        features.check_motion_offsets(offsets)


def test_noise_is_scaled_like_its_entry() -> None:
    noise = features.noise_scale(features.PROPRIOCEPTION_LAYOUT)
    assert noise[2].item() == pytest.approx(0.2 * 0.25)
    assert noise[17].item() == pytest.approx(1.5 * 0.05)
    assert noise[29:].abs().sum().item() == 0.0


def test_proprioception_by_hand() -> None:
    vector = features.proprioception(
        torch.tensor([0.1, -0.2]),
        torch.tensor([1.0, 2.0, 3.0]),
        POSE + 0.5,
        torch.full((12,), 10.0),
        torch.full((12,), 7.0),
        torch.tensor([True, False, True, False]),
    )
    assert vector[:5].tolist() == pytest.approx([0.1, -0.2, 0.25, 0.5, 0.75])
    assert vector[5:17].tolist() == pytest.approx([0.5] * 12)
    assert vector[17:29].tolist() == pytest.approx([0.5] * 12)
    assert vector[29:41].tolist() == [7.0] * 12
    assert vector[41:].tolist() == [0.5, -0.5, 0.5, -0.5]


def test_a_measurement_is_in_plain_units_and_without_trunk_velocity() -> None:
    parts = {"roll_pitch": torch.randn(2), "angular_velocity": torch.randn(3)}
    parts |= {"joint_position": torch.randn(12), "joint_velocity": torch.randn(12)}
    vector = features.measurement(**parts)
    assert [entry.name for entry in features.MEASUREMENT_LAYOUT] == list(parts)
    for name, value in parts.items():
        assert torch.equal(vector[features.layout_slice(features.MEASUREMENT_LAYOUT, name)], value)


def test_feet_are_turned_upright_but_not_by_yaw() -> None:
    roll, pitch = torch.tensor(0.3), torch.tensor(-0.4)
    feet = features.in_heading_frame(roll, pitch, kinematics.forward(POSE))
    full = rotations.from_euler(roll, pitch, torch.tensor(1.2))
    world = rotations.rotate(full, kinematics.forward(POSE))
    c, s = math.cos(1.2), math.sin(1.2)
    turned_back = torch.stack((c * world[:, 0] + s * world[:, 1], -s * world[:, 0] + c * world[:, 1], world[:, 2]), -1)
    torch.testing.assert_close(feet, turned_back, atol=1e-5, rtol=0)


def test_contact_is_the_height_of_the_sole() -> None:
    def contact(height: float) -> list[float]:
        zero = torch.zeros(())
        args = (torch.tensor([height]), zero, zero, torch.zeros(3), torch.zeros(3), POSE, torch.zeros(12))
        return features.motion_frame(*args)[-4:].tolist()

    standing = constants.STANDING_HEIGHT
    assert contact(standing) == [1.0] * 4
    assert contact(standing + features.CONTACT_HEIGHT - 0.001) == [1.0] * 4
    assert contact(standing + features.CONTACT_HEIGHT + 0.001) == [0.0] * 4


def test_a_clip_and_a_simulation_in_the_same_state_give_the_same_frame() -> None:
    generator = torch.Generator().manual_seed(3)
    quaternion = torch.nn.functional.normalize(
        torch.randn(4, generator=generator) + torch.tensor([3.0, 0, 0, 0]), dim=0
    )
    linear, angular = torch.randn(3, generator=generator), torch.randn(3, generator=generator)
    joints = POSE + 0.1 * torch.randn(12, generator=generator)
    speed = torch.randn(12, generator=generator)
    clip = features.clip_frames(torch.tensor(0.3), quaternion, linear, angular, joints, speed)
    roll, pitch, _ = rotations.to_euler(quaternion)
    local = rotations.rotate_inverse(quaternion, linear), rotations.rotate_inverse(quaternion, angular)
    simulated = features.motion_frame(torch.tensor([0.3]), roll, pitch, *local, joints, speed)
    torch.testing.assert_close(clip, simulated)


def test_frames_do_not_depend_on_yaw() -> None:
    turn = rotations.from_euler(torch.zeros(()), torch.zeros(()), torch.tensor(2.0))
    tilt = rotations.from_euler(torch.tensor(0.2), torch.tensor(0.1), torch.zeros(()))
    linear, angular = torch.tensor([1.0, 0.2, 0.0]), torch.tensor([0.0, 0.3, 1.0])
    rest = (POSE, torch.zeros(12))
    straight = features.clip_frames(torch.tensor(0.3), tilt, linear, angular, *rest)
    turned = features.clip_frames(
        torch.tensor(0.3),
        rotations.multiply(turn, tilt),
        rotations.rotate(turn, linear),
        rotations.rotate(turn, angular),
        *rest,
    )
    torch.testing.assert_close(straight, turned, atol=1e-6, rtol=0)


def test_a_foot_stands_that_is_slower_than_half_of_the_trunk_or_than_a_tenth_of_a_metre_a_second() -> None:
    foot = torch.tensor([-0.5, 0.09, 0.11, 0.7, 0.8])
    assert features.in_stance(foot, torch.tensor(1.5)).tolist() == [True, True, True, True, False]
    assert features.in_stance(foot, torch.tensor(-1.0)).tolist() == [True, True, False, False, False]
