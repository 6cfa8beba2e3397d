from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import features
from agility_rl.modules.placed_memory import PlacedMemory, bearings, chosen, moved, planar_motion, seen_from
from agility_rl.rotations import from_euler, rotate

POINTS = torch.tensor([-1.5, -0.5, 0.5, 1.5])[:, None] * torch.tensor([1.0, 0.0]).expand(7, 1, 2)


def place_of(position: torch.Tensor, yaw: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Place ``[8]`` of a robot in the plane, from points ``[2, 2]``; the obstacle is the origin."""
    offset = torch.complex(*(points - position).unbind(-1)) * torch.exp(torch.complex(torch.zeros(()), -yaw))
    return torch.cat((torch.view_as_real(offset).flatten(), position, yaw.sin()[None], yaw.cos()[None]))


def test_moved_is_what_another_place_sees() -> None:
    points, position, yaw = torch.tensor([[2.0, 1.0], [-1.0, 3.0]]), torch.tensor([0.4, -0.7]), torch.tensor(0.8)
    motion = torch.tensor([0.5, -0.2, 0.6])
    step = torch.polar(torch.tensor(1.0), yaw) * torch.complex(motion[0], motion[1])
    expected = place_of(position + torch.view_as_real(step), yaw + motion[2], points)
    torch.testing.assert_close(moved(place_of(position, yaw, points), motion), expected)


def test_there_and_back_again() -> None:
    place = torch.randn(5, 8)
    turn, way = torch.tensor([0.0, 0.0, 0.9]), torch.tensor([0.3, 0.1, 0.0])
    back = moved(moved(moved(place, way), turn), -turn)
    torch.testing.assert_close(moved(back, -way), place)
    assert not torch.allclose(back, place)


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


def test_without_gains_it_only_counts_its_way() -> None:
    """Half a turn to the left at 1 m/s in 5 s: a circle whose radius is 5 / pi."""
    memory = PlacedMemory(32, 45, 8, 7, 0.05, POINTS)
    with torch.no_grad():
        memory.head[0].weight.zero_()
        memory.head[0].bias[-19:-10] = -100.0
    steps = 100
    proprioception, estimate = torch.zeros(steps, 1, 45), torch.zeros(steps, 1, 4)
    proprioception[..., 4] = math.pi / 5.0 * features.ANGULAR_VELOCITY_SCALE
    estimate[..., 1] = 1.0 * features.LINEAR_VELOCITY_SCALE
    hidden = torch.zeros(1, 16)
    hidden[0, 8:] = torch.tensor([4.0, 0.0, 0.0, 4.0, -1.0, 0.0, 0.0, 1.0])
    first = torch.zeros(steps, 1, 1, dtype=torch.bool)
    with torch.no_grad():
        *_, after, place = memory(torch.zeros(steps, 1, 32), proprioception, estimate, hidden[None], first)
    wide = 10.0 / math.pi
    expected = torch.tensor([-4.0, wide, 0.0, wide - 4.0, -1.0, wide, 0.0, -1.0])
    torch.testing.assert_close(after[-1, 0, 8:], expected, atol=0.06, rtol=0.0)  # half a step short of the end
    torch.testing.assert_close(place[0, 0], moved(hidden[0, 8:], torch.tensor([0.025, 0.0, math.pi / 200.0])))


def test_a_switch_puts_the_next_way_point_first_and_a_gain_believes_what_is_said() -> None:
    memory = PlacedMemory(32, 45, 8, 7, 0.04, POINTS)
    inputs = (torch.zeros(1, 32), torch.zeros(1, 45), torch.zeros(1, 4))
    hidden = torch.arange(16.0)[None]
    with torch.no_grad():
        memory.head[0].weight.zero_()
        memory.head[0].bias[-19:-11] = -100.0
        memory.head[0].bias[-11] = 100.0
        switched = memory.step(*inputs, hidden)[-1]
        memory.head[0].bias[-19:-11] = 100.0
        memory.head[0].bias[-27:-19] = 2.0 * torch.arange(8.0)
        memory.head[0].bias[[-6, -1]] = 100.0
        said = memory.step(*inputs, hidden)[-1]
    torch.testing.assert_close(switched[0], torch.tensor([10.0, 11.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0]))
    torch.testing.assert_close(said[0], 2.0 * torch.arange(8.0))


def test_way_points_of_an_obstacle_lie_where_its_place_says() -> None:
    """Turned by 0.8 at (0.4, -0.7): the same as by complex numbers; shares mix them with what was said."""
    points, position, yaw = torch.tensor([[2.0, 1.0], [-1.0, 3.0]]), torch.tensor([0.4, -0.7]), torch.tensor(0.8)
    place = place_of(position, yaw, points)
    candidates = seen_from(place[4:], points)
    torch.testing.assert_close(candidates.flatten(), place[:4])
    shares = torch.tensor([[1.0, 2.0, 1.0], [0.0, 1.0, 3.0]])
    found = chosen(shares.log().flatten(), candidates, torch.full((4,), 5.0)).unflatten(0, (2, 2))
    torch.testing.assert_close(found[0], 0.25 * candidates[0] + 0.5 * candidates[1] + 0.25 * 5.0)
    torch.testing.assert_close(found[1], 0.25 * candidates[1] + 0.75 * 5.0)


def test_way_points_are_those_of_the_likeliest_obstacle() -> None:
    points = POINTS.clone()
    points[3] += 1.0
    memory = PlacedMemory(32, 45, 8, 7, 0.04, points)
    with torch.no_grad():
        memory.head[0].weight.zero_()
        memory.head[0].bias[32 + 3] = 9.0  # its type
        memory.head[0].bias[-19:-11] = 100.0  # believed is what was said of the place at the obstacle,
        memory.head[0].bias[-27:-19] = torch.tensor([9.0, 9.0, 9.0, 9.0, -2.0, 0.0, 0.0, 1.0])
        memory.head[0].bias[[-10, -4]] = 100.0  # and the first and second way-point of it
        place = memory.step(torch.zeros(1, 32), torch.zeros(1, 45), torch.zeros(1, 4), torch.zeros(1, 16))[-1]
    torch.testing.assert_close(place[0], torch.tensor([1.5, 1.0, 2.5, 1.0, -2.0, 0.0, 0.0, 1.0]))


def test_gradients_reach_what_was_said_earlier() -> None:
    memory = PlacedMemory(32, 45, 8, 7, 0.04, POINTS)
    feature = torch.randn(6, 2, 32, requires_grad=True)
    first = torch.zeros(6, 2, 1, dtype=torch.bool)
    first[3, 0] = True
    *_, place = memory(feature, torch.randn(6, 2, 45), torch.randn(6, 2, 4), torch.randn(1, 2, 16), first)
    place[5].sum().backward()
    assert (feature.grad[3:].abs().sum(-1) > 0).all() and (feature.grad[:3, 1].abs().sum(-1) > 0).all()
    assert (feature.grad[:3, 0] == 0).all(), "an episode does not remember the one before it"


def test_bearings_have_no_gradient_even_on_a_way_point() -> None:
    place = torch.zeros(8, requires_grad=True)
    found = bearings(place)
    assert not found.requires_grad and (found == 0).all()
    torch.testing.assert_close(
        bearings(torch.tensor([0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0])), torch.tensor([math.pi / 2, math.pi])
    )
