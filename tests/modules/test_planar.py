from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import features
from agility_rl.modules.planar import (
    bearings,
    composed,
    inverted,
    moved,
    planar_motion,
    seen_earlier,
    seen_from,
    within,
)
from agility_rl.rotations import from_euler, rotate


def test_moved_against_complex_numbers() -> None:
    position, yaw, motion = torch.tensor([0.4, -0.7]), torch.tensor(0.8), torch.tensor([0.5, -0.2, 0.6])
    step = torch.polar(torch.tensor(1.0), yaw) * torch.complex(motion[0], motion[1])
    there, turned = position + torch.view_as_real(step), yaw + motion[2]
    expected = torch.cat((there, turned.sin()[None], turned.cos()[None]))
    pose = torch.cat((position, yaw.sin()[None], yaw.cos()[None]))
    torch.testing.assert_close(moved(pose, motion), expected)


def test_there_and_back_again() -> None:
    pose = torch.randn(5, 4)
    turn, way = torch.tensor([0.0, 0.0, 0.9]), torch.tensor([0.3, 0.1, 0.0])
    back = moved(moved(moved(pose, way), turn), -turn)
    torch.testing.assert_close(moved(back, -way), pose)
    assert not torch.allclose(back, pose)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.3, 0.0), (0.0, -0.4), (0.2, 0.5)])
def test_planar_motion_against_quaternions(angles: tuple[float, float]) -> None:
    """Velocity in the frame of the heading, and how fast yaw changes when the attitude turns for a moment."""
    roll, pitch = (torch.tensor(angle, dtype=torch.float64) for angle in angles)
    velocity = torch.tensor([0.8, -0.3, 0.2], dtype=torch.float64)
    rate = torch.tensor([0.4, 0.5, -0.7], dtype=torch.float64)
    proprioception, estimate = torch.zeros(45, dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
    proprioception[:2] = torch.stack((roll, pitch))
    proprioception[2:5] = rate * features.ANGULAR_VELOCITY_SCALE
    estimate[1:] = velocity * features.LINEAR_VELOCITY_SCALE
    found = planar_motion(proprioception, estimate)
    attitude = from_euler(roll, pitch, torch.zeros_like(roll))
    torch.testing.assert_close(found[:2], rotate(attitude, velocity)[:2])
    # The base's x axis moves with rate x e_x; yaw is its direction in the plane.
    along = rotate(attitude, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    change = rotate(attitude, torch.linalg.cross(rate, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)))
    yaw_rate = (along[0] * change[1] - along[1] * change[0]) / along[:2].square().sum()
    torch.testing.assert_close(found[2], yaw_rate)


def test_what_is_seen_from_where_it_sees_from() -> None:
    """The origin in the frame of a pose is the pose in the frame of the origin, inverted: twice is not at all."""
    pose = torch.cat((torch.randn(5, 2), torch.nn.functional.normalize(torch.randn(5, 2), dim=-1)), -1)
    there = inverted(pose)
    torch.testing.assert_close(there[:, :2], seen_from(pose, torch.zeros(1, 2))[:, 0])
    torch.testing.assert_close(inverted(there), pose)


def test_what_was_seen_before_a_motion_stands_where_it_stood() -> None:
    robot, seen = (
        torch.cat((torch.randn(5, 2), torch.nn.functional.normalize(torch.randn(5, 2), dim=-1)), -1) for _ in range(2)
    )
    motion = torch.randn(5, 3)
    before = composed(robot, seen_earlier(seen, motion))
    torch.testing.assert_close(before, composed(moved(robot, motion), seen))
    assert torch.equal(seen_earlier(seen, torch.zeros(5, 3)), seen), "to the last digit, where nothing moved"


def test_a_pose_within_a_frame() -> None:
    """1.3 m along and 0.2 m beside, turned by 0.4: the same by complex numbers."""
    position, yaw = torch.tensor([1.3, 0.2]), torch.tensor(0.4)
    pose = torch.cat((position, yaw.sin()[None], yaw.cos()[None]))
    x, y, turn = frame = (0.5, 2.0, 2.5)
    there = complex(1.3 - x, 0.2 - y) * complex(math.cos(turn), -math.sin(turn))
    expected = torch.tensor([there.real, there.imag, math.sin(0.4 - turn), math.cos(0.4 - turn)])
    torch.testing.assert_close(within(pose, torch.tensor([frame]))[0], expected)


def place_of(position: torch.Tensor, yaw: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Place ``[8]`` of a robot in the plane, from points ``[2, 2]``; the obstacle is the origin."""
    offset = torch.complex(*(points - position).unbind(-1)) * torch.exp(torch.complex(torch.zeros(()), -yaw))
    return torch.cat((torch.view_as_real(offset).flatten(), position, yaw.sin()[None], yaw.cos()[None]))


def test_way_points_of_an_obstacle_lie_where_its_place_says() -> None:
    """Turned by 0.8 at (0.4, -0.7): the same as by complex numbers."""
    points, position, yaw = torch.tensor([[2.0, 1.0], [-1.0, 3.0]]), torch.tensor([0.4, -0.7]), torch.tensor(0.8)
    place = place_of(position, yaw, points)
    torch.testing.assert_close(seen_from(place[4:], points).flatten(), place[:4])


def test_bearings_have_no_gradient_even_on_a_way_point() -> None:
    place = torch.zeros(8, requires_grad=True)
    found = bearings(place)
    assert not found.requires_grad and (found == 0).all()
    torch.testing.assert_close(
        bearings(torch.tensor([0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0])), torch.tensor([math.pi / 2, math.pi])
    )
