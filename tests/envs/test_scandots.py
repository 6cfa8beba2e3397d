"""Scandots against rays of the engine, and by hand where a ray would meet a roof."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from agility_rl.envs.course import Course, Slot
from agility_rl.envs.course_presets import COURSES, full_course
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.scandots import GRID_X, GRID_Y, NUM_SCANDOTS, HeightScan
from agility_rl.simulation import BatchSimulator


def everyone(n: int) -> Tensor:
    return torch.ones(n, dtype=torch.bool)


def lay(course: Course, n: int) -> CourseLayout:
    layout = CourseLayout(course, n, torch.Generator().manual_seed(0))
    layout.draw(everyone(n))
    return layout


def grid(position: Tensor, yaw: Tensor) -> Tensor:
    """World points of the scandots, written down independently: rows from right to left, points from near to far."""
    rows = []
    for left in GRID_Y:
        for ahead in GRID_X:
            x = position[:, 0] + yaw.cos() * ahead - yaw.sin() * left
            y = position[:, 1] + yaw.sin() * ahead + yaw.cos() * left
            rows.append(torch.stack((x, y), -1))
    return torch.stack(rows, 1)


def test_the_grid_is_that_of_the_notes() -> None:
    assert pytest.approx([0.1 * i for i in range(12)]) == list(GRID_X)
    assert pytest.approx([-0.5 + 0.1 * i for i in range(11)]) == list(GRID_Y)
    assert NUM_SCANDOTS == 132


def test_random_poses_against_rays() -> None:
    """Everything that is not below a roof, on courses whose obstacles are solid from above."""
    n = 64
    course = full_course()
    solid = tuple(slot for slot in course.slots if slot.obstacle in ("a_frame", "seesaw", "weave_poles"))
    layout = lay(replace(course, slots=solid, routes=((0,),)), n)
    simulator = BatchSimulator(n, num_threads=1, scenery=layout.pieces)
    position, quaternion, _ = layout.poses()
    generator = torch.Generator().manual_seed(3)
    simulator.place(everyone(n), position, quaternion, 0.32 * torch.rand(n, 1, generator=generator) - 0.16)
    place = torch.rand(n, 2, generator=generator) * torch.tensor([7.0, 10.0])
    yaw = 2.0 * math.pi * torch.rand(n, generator=generator)
    scan = HeightScan(layout, neighbours=False)
    seen = scan.heights(place, yaw, layout.parameter(simulator.hinge_angle))
    points = grid(place, yaw)
    origin = torch.cat((points, torch.full((n, NUM_SCANDOTS, 1), 3.0)), -1)
    hit = 3.0 - simulator.ray(origin, torch.tensor([0.0, 0.0, -1.0]).expand_as(origin))
    inside = ((points > 0.02) & (points < torch.tensor([6.98, 9.98]))).all(-1)
    assert ((seen > 0.02) & inside).sum() > 250
    miss = (seen - hit).abs()[inside]
    assert (miss > 0.01).float().mean() < 0.01  # rims: looked up to half a cell, 12.5 mm
    outside = ((points < 0.0) | (points > torch.tensor([7.0, 10.0]))).any(-1)
    assert outside.any() and (seen[outside] >= 0.72).all()  # behind a wall is wall


def test_walls_are_seen_where_they_stand() -> None:
    layout = lay(COURSES["full_walls"], 400)
    generator = torch.Generator().manual_seed(1)
    low_y, high_y, low_x, high_x = layout.wall_distance.unbind(-1)
    low, high = -torch.stack((low_x, low_y), -1), torch.tensor([7.0, 10.0]) + torch.stack((high_x, high_y), -1)
    place = low + torch.rand(400, 2, generator=generator) * (high - low)
    yaw = 2.0 * math.pi * torch.rand(400, generator=generator)
    seen = HeightScan(layout, neighbours=False).heights(place, yaw, layout.lift)
    points = grid(place, yaw)
    outside = ((points < low[:, None]) | (points > high[:, None])).any(-1)
    assert outside.any(-1).sum() > 30
    assert (seen >= layout.wall_height[:, None] - 1e-6)[outside].all()
    free = ~outside & ((points < -0.5) | (points > torch.tensor([7.5, 10.5]))).any(-1)  # nothing stands out there
    assert free.sum() > 100 and (seen[free] == 0.0).all()


@pytest.mark.parametrize("name", ["bar_jump", "tire_jump", "tunnel", "box_jump", "a_frame", "weave_poles", "seesaw"])
def test_looked_up_heights_are_the_profile(name: str) -> None:
    layout = lay(Course("one", (10.0, 10.0), (Slot(name, (5.0, 5.0), 0.7),), wall_height=None), 1)
    scan = HeightScan(layout, neighbours=False)
    parameter = layout.parameter(torch.full((1, 1 if name == "seesaw" else 0), 0.1))
    place, yaw = torch.tensor([[4.6, 4.7]]), torch.tensor([0.3])
    x, y = layout.local(grid(place, yaw))[0, 0].unbind(-1)
    base, gain = layout.kinds[0].profile(x, y)
    exact = (base + gain * parameter[0, 0]).clamp(min=0.0)
    seen = scan.heights(place, yaw, parameter)[0]
    assert exact.max() > 0.1
    assert ((seen - exact).abs() > 0.02).float().mean() < 0.1


def test_before_a_bar_by_hand() -> None:
    """A robot 0.55 m before a bar of 0.2 m sees a ridge from 0.45 to 0.65 m, whatever lies above and behind it."""
    course = Course("one", (10.0, 10.0), (Slot("bar_jump", (5.0, 5.0), difficulty=(0.2, 0.2)),), wall_height=None)
    layout = lay(course, 1)
    seen = HeightScan(layout).scandots(torch.tensor([[4.45, 5.0, 0.32]]), torch.zeros(1), layout.lift)
    dots = seen.view(len(GRID_Y), len(GRID_X))
    expected = torch.full((12,), 0.02)
    expected[[5, 6]] = 0.32 - 0.3 - 0.23
    torch.testing.assert_close(dots[5], expected, atol=1e-6, rtol=0)
    assert dots.shape == (11, 12) and torch.allclose(dots[0], expected)  # 0.5 m to the side is bar too


def test_a_tunnel_is_seen_as_its_floor() -> None:
    layout = lay(Course("one", (10.0, 10.0), (Slot("tunnel", (5.0, 5.0)),), wall_height=None), 1)
    dots = HeightScan(layout, neighbours=False).heights(torch.tensor([[3.5, 5.0]]), torch.zeros(1), layout.lift)
    dots = dots.view(11, 12)
    assert (dots[:, :5] == 0.0).all()  # the mouth is 0.475 m ahead
    torch.testing.assert_close(dots[5, 5:], torch.full((7,), 0.42 - 0.385))
    torch.testing.assert_close(dots[2, 5:], torch.full((7,), 0.42 - (0.385**2 - 0.3**2) ** 0.5), atol=0.01, rtol=0)
    assert (dots[0] == 0.0).all() and (dots[1, 5:] >= 0.41).all()  # outside, wall of the tube


def test_clipping_and_standing_offset() -> None:
    layout = lay(Course("one", (30.0, 30.0), (Slot("tunnel", (5.0, 5.0)),), wall_height=(5.0, 5.0)), 3)
    scan = HeightScan(layout)
    place = torch.tensor([[20.0, 20.0, 0.3], [20.0, 20.0, 2.0], [29.5, 20.0, 0.3]])
    dots = scan.scandots(place, torch.zeros(3), layout.lift)
    assert (dots[0] == 0.0).all() and (dots[1] == 1.0).all() and dots[2].min() == -1.0


def test_the_lowest_of_three_neighbours_only_shrinks() -> None:
    layout = lay(full_course(), 40)
    generator = torch.Generator().manual_seed(1)
    place = torch.rand(40, 2, generator=generator) * torch.tensor([7.0, 10.0])
    yaw = 6.0 * torch.rand(40, generator=generator)
    parameter = layout.parameter(torch.full((40, 1), -0.167))
    plain, lowest = (HeightScan(layout, neighbours=flag).heights(place, yaw, parameter) for flag in (False, True))
    assert (lowest <= plain + 1e-3).all()
    changed = (plain - lowest) > 0.01
    assert 0.0 < changed.float().mean() < 0.2 * (plain > 0.01).float().mean()


def test_support_is_what_carries_and_edges_are_where_no_foot_should_be() -> None:
    slots = (Slot("bar_jump", (5.0, 2.0)), Slot("a_frame", (5.0, 5.0)), Slot("seesaw", (5.0, 8.0)))
    layout = lay(Course("three", (10.0, 10.0), slots, routes=((0,),), wall_height=None), 1)
    scan = HeightScan(layout)
    parameter = layout.parameter(torch.tensor([[0.1]]))
    points = torch.tensor([[[5.0, 2.0], [5.0, 5.0], [4.0, 5.1], [6.0, 8.0], [1.0, 1.0]]])
    expected = torch.tensor([[0.0, 0.333, 0.333 * (1 - 1 / 1.4625), 0.275 - math.tan(0.1), 0.0]])
    torch.testing.assert_close(scan.support(points, parameter), expected, atol=3e-3, rtol=0)
    feet = torch.tensor([[[5.05, 2.3], [5.15, 2.3], [5.5, 5.27], [5.5, 5.2], [5.5, 5.32], [4.0, 7.73]]])
    assert scan.on_edge(feet).tolist() == [[True, False, True, False, False, True]]
    layout.yaw = layout.yaw + math.pi / 2
    assert scan.on_edge(torch.tensor([[[4.73, 5.5], [5.0, 5.28]]])).tolist() == [[True, False]]


def test_a_course_without_edges() -> None:
    layout = lay(Course("one", (10.0, 10.0), (Slot("tunnel", (5.0, 5.0)),)), 2)
    assert not HeightScan(layout).on_edge(torch.full((2, 4, 2), 5.0)).any()
