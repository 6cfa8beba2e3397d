"""Rotations against rotation matrices and MuJoCo's own quaternion functions, which are written independently."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from agility_rl import rotations


def random_quaternions(count: int, generator: torch.Generator) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=generator, dtype=torch.float64), dim=-1)


def matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices by MuJoCo."""
    out = np.zeros((len(quaternion), 9))
    for row, q in zip(out, quaternion.numpy(), strict=True):
        mujoco.mju_quat2Mat(row, q)
    return torch.from_numpy(out).view(-1, 3, 3)


def axis_matrix(axis: int, angle: float) -> np.ndarray:
    """Elementary rotation about x, y or z, written out."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array(
        [
            [[1, 0, 0], [0, c, -s], [0, s, c]],
            [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        ][axis]
    )


def test_rotate_is_the_rotation_matrix(generator: torch.Generator) -> None:
    quaternion = random_quaternions(200, generator)
    vector = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    expected = torch.einsum("nij,nj->ni", matrix(quaternion), vector)
    torch.testing.assert_close(rotations.rotate(quaternion, vector), expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(rotations.rotate_inverse(quaternion, expected), vector, atol=1e-12, rtol=0)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_leading_shapes_broadcast(shape: tuple[int, ...], generator: torch.Generator) -> None:
    vector = torch.randn(*shape, 3, generator=generator)
    turned = rotations.rotate(torch.tensor([0.0, 0.0, 0.0, 1.0]), vector)
    torch.testing.assert_close(turned, vector * torch.tensor([-1.0, -1.0, 1.0]))
    assert rotations.multiply(torch.tensor([1.0, 0, 0, 0]), torch.ones(*shape, 4)).shape == (*shape, 4)


def test_multiply_is_the_product_of_matrices(generator: torch.Generator) -> None:
    left, right = random_quaternions(100, generator), random_quaternions(100, generator)
    torch.testing.assert_close(
        matrix(rotations.multiply(left, right)), matrix(left) @ matrix(right), atol=1e-12, rtol=0
    )


def test_conjugate_undoes_a_rotation(generator: torch.Generator) -> None:
    quaternion = random_quaternions(50, generator)
    identity = rotations.multiply(quaternion, rotations.conjugate(quaternion))
    torch.testing.assert_close(identity, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(50, 4))


def test_euler_angles_are_yaw_then_pitch_then_roll() -> None:
    roll, pitch, yaw = 0.3, -0.7, 2.1
    expected = axis_matrix(2, yaw) @ axis_matrix(1, pitch) @ axis_matrix(0, roll)
    quaternion = rotations.from_euler(*(torch.tensor(angle, dtype=torch.float64) for angle in (roll, pitch, yaw)))
    np.testing.assert_allclose(matrix(quaternion[None])[0].numpy(), expected, atol=1e-12)


def test_euler_round_trip(generator: torch.Generator) -> None:
    angles = (torch.rand(300, 3, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([6.2, 3.0, 6.2])
    back = torch.stack(rotations.to_euler(rotations.from_euler(*angles.unbind(-1))), -1)
    torch.testing.assert_close(back, angles, atol=1e-9, rtol=0)


def test_pitch_stays_a_number_at_the_pole() -> None:
    pole = rotations.from_euler(torch.tensor(0.0), torch.tensor(math.pi / 2), torch.tensor(0.0)) * 1.0000002
    roll, pitch, yaw = rotations.to_euler(pole)
    assert torch.stack((roll, pitch, yaw)).isfinite().all()
    assert pitch.item() == pytest.approx(math.pi / 2, abs=1e-3)


def test_heading_keeps_only_yaw(generator: torch.Generator) -> None:
    angles = (torch.rand(100, 3, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([2.0, 2.0, 6.0])
    heading = rotations.heading(rotations.from_euler(*angles.unbind(-1)))
    zero = torch.zeros(100, dtype=torch.float64)
    torch.testing.assert_close(heading, rotations.from_euler(zero, zero, angles[:, 2]), atol=1e-9, rtol=0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slerp_moves_at_constant_speed_along_the_short_arc(sign: float) -> None:
    start = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    end = sign * rotations.from_euler(*(torch.tensor(a, dtype=torch.float64) for a in (0.0, 0.0, 1.2)))
    for fraction in (0.0, 0.25, 0.5, 1.0):
        between = rotations.slerp(start, end, torch.tensor([fraction], dtype=torch.float64))
        assert abs(rotations.to_euler(between)[2].item()) == pytest.approx(1.2 * fraction, abs=1e-9)
        assert between.norm().item() == pytest.approx(1.0)


def test_slerp_between_equal_orientations_is_that_orientation(generator: torch.Generator) -> None:
    quaternion = random_quaternions(20, generator).float()
    between = rotations.slerp(quaternion, quaternion, torch.full((20, 1), 0.3))
    torch.testing.assert_close(between, quaternion, atol=1e-6, rtol=0)


def test_difference_is_mujocos_velocity_between_quaternions(generator: torch.Generator) -> None:
    start, end = random_quaternions(100, generator), random_quaternions(100, generator)
    expected = np.zeros((100, 3))
    for row, a, b in zip(expected, start.numpy(), end.numpy(), strict=True):
        mujoco.mju_subQuat(row, b, a)  # rotation vector in the frame of `a`
    turned = torch.einsum("nij,nj->ni", matrix(start), torch.from_numpy(expected))
    torch.testing.assert_close(rotations.difference(start, end), turned, atol=1e-9, rtol=0)


def test_difference_of_a_small_turn_keeps_its_size() -> None:
    angle = torch.tensor(1e-6, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64)
    small = rotations.from_euler(angle, zero, zero)
    turn = rotations.difference(torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), small)
    torch.testing.assert_close(turn, torch.tensor([1e-6, 0.0, 0.0], dtype=torch.float64), atol=1e-12, rtol=0)


def test_wrap_angle() -> None:
    angles = torch.tensor([0.0, 3.0, -3.0, 2 * math.pi + 0.5, -7.0, 9.5], dtype=torch.float64)
    expected = torch.tensor([0.0, 3.0, -3.0, 0.5, 2 * math.pi - 7.0, 9.5 - 4 * math.pi], dtype=torch.float64)
    torch.testing.assert_close(rotations.wrap_angle(angles), expected, atol=1e-12, rtol=0)


def test_turn_is_a_product_of_complex_numbers() -> None:
    vector, yaw = torch.randn(6, 2, dtype=torch.float64), torch.linspace(-4.0, 4.0, 6, dtype=torch.float64)
    product = torch.view_as_complex(vector) * torch.polar(torch.ones_like(yaw), yaw)
    torch.testing.assert_close(rotations.turn(vector, yaw), torch.view_as_real(product))
