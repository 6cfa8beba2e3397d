"""The obstacles' measures, and that their shapes are where the perceived heights say."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from agility_rl.behaviours import NUM_BEHAVIOURS
from agility_rl.envs.course import Course, Slot
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES, SEESAW_TILT
from agility_rl.go2 import constants
from agility_rl.modules.distance_field import signed_distance
from agility_rl.simulation import BatchSimulator

DOWN = torch.tensor([0.0, 0.0, -1.0])
POSE = torch.tensor(constants.DEFAULT_POSE)
ONE = torch.ones(1, dtype=torch.bool)


def stand(name: str, height: float | None = None) -> tuple[BatchSimulator, CourseLayout]:
    """An obstacle at (5, 5), passed along x, in an open field."""
    difficulty = None if height is None else (height, height)
    course = Course("one", (10.0, 10.0), (Slot(name, (5.0, 5.0), difficulty=difficulty),), wall_height=None)
    layout = CourseLayout(course, 1, torch.Generator())
    layout.draw(ONE)
    simulator = BatchSimulator(1, num_threads=1, scenery=layout.pieces)
    simulator.place(ONE, *layout.poses())
    return simulator, layout


def heights(simulator: BatchSimulator, x: Tensor, y: Tensor, start: float = 3.0) -> Tensor:
    """Height of the first surface below ``start`` at local points."""
    origin = torch.stack((x + 5.0, y + 5.0, torch.full_like(x, start)), -1)[None]
    return start - simulator.ray(origin, DOWN.expand_as(origin))[0]


def profile(layout: CourseLayout, simulator: BatchSimulator, x: Tensor, y: Tensor) -> Tensor:
    base, gain = layout.kinds[0].profile(x, y)
    return (base + gain * layout.parameter(simulator.hinge_angle)[0, 0]).clamp(min=0.0)


def test_the_six_of_the_challenge_and_the_box() -> None:
    six = ["bar_jump", "a_frame", "weave_poles", "seesaw", "tire_jump", "tunnel"]
    assert list(OBSTACLES) == [*six, "box_jump"]
    assert all(len(obstacle.way_points) == 4 for obstacle in OBSTACLES.values())
    assert {name for name, obstacle in OBSTACLES.items() if obstacle.target_speed == 2.5} == {
        "bar_jump", "tire_jump", "box_jump"
    }  # fmt: skip
    assert OBSTACLES["bar_jump"].difficulty[:2] == (0.05, 0.20) and OBSTACLES["tire_jump"].difficulty[:2] == (
        0.40,
        0.55,
    )
    assert math.degrees(SEESAW_TILT) == pytest.approx(-9.6, abs=0.01)
    assert NUM_BEHAVIOURS == 5


@pytest.mark.parametrize("name", ["a_frame", "seesaw", "box_jump", "weave_poles"])
def test_what_is_seen_from_above_is_where_a_ray_finds_it(name: str) -> None:
    simulator, layout = stand(name)
    generator = torch.Generator().manual_seed(0)
    reach = torch.tensor([*layout.kinds[0].half_extents]) + 0.2
    x, y = ((2.0 * torch.rand(4000, 2, generator=generator) - 1.0) * reach).unbind(-1)
    seen, hit = profile(layout, simulator, x, y), heights(simulator, x, y)
    assert (seen > 0.0).float().mean() > 0.05
    miss = (seen - hit).abs()
    assert (miss > 2e-3).float().mean() < 0.01  # points within a few mm of a rim
    x, y = torch.tensor([0.0, 0.3, -0.3]), torch.zeros(3)
    torch.testing.assert_close(profile(layout, simulator, x, y), heights(simulator, x, y), atol=1e-3, rtol=0)


@pytest.mark.parametrize("height", [0.05, 0.20, 0.30])
def test_bar_hangs_at_its_height(height: float) -> None:
    simulator, layout = stand("bar_jump", height)
    y = torch.linspace(-0.55, 0.55, 12)
    torch.testing.assert_close(heights(simulator, torch.zeros(12), y), torch.full((12,), height + 0.03))
    torch.testing.assert_close(profile(layout, simulator, torch.zeros(12), y), torch.full((12,), height + 0.03))
    # The bar is 6 cm thick, and perceived 20 cm deep.
    assert heights(simulator, torch.tensor([0.04]), torch.zeros(1)).item() == 0.0
    deep = profile(layout, simulator, torch.tensor([0.09, 0.11]), torch.zeros(2))
    torch.testing.assert_close(deep, torch.tensor([height + 0.03, 0.0]))
    wings = heights(simulator, torch.zeros(2), torch.tensor([0.8, -1.0]))
    torch.testing.assert_close(wings, torch.full((2,), 0.42))
    # Below a bar in the middle of its range there is air.
    if height == 0.20:
        assert heights(simulator, torch.zeros(1), torch.zeros(1), start=0.16).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("height", [0.40, 0.55])
def test_tire_is_a_ring_about_its_centre(height: float) -> None:
    simulator, layout = stand("tire_jump", height)
    angle = torch.arange(64) * 2.0 * math.pi / 64
    centre = torch.tensor([5.0, 5.0, height]).expand(1, 64, 3)
    outwards = torch.stack((torch.zeros(64), angle.sin(), angle.cos()), -1)[None]
    distance = simulator.ray(centre, outwards)
    torch.testing.assert_close(distance, torch.full((1, 64), 0.391), atol=6e-3, rtol=0)  # a polygon of 16
    y = torch.linspace(-0.3, 0.3, 13)
    from_inside = heights(simulator, torch.zeros(13), y, start=height)
    torch.testing.assert_close(profile(layout, simulator, torch.zeros(13), y), from_inside, atol=0.02, rtol=0)
    posts = heights(simulator, torch.zeros(2), torch.tensor([0.75, -0.75]))
    torch.testing.assert_close(posts, torch.full((2,), 1.5))


def test_tunnel_is_a_tube_that_a_robot_fits_in() -> None:
    simulator, layout = stand("tunnel")
    angle = torch.arange(72) * 2.0 * math.pi / 72
    centre = torch.tensor([5.0, 5.0, 0.42]).expand(1, 72, 3)
    outwards = torch.stack((torch.zeros(72), angle.sin(), angle.cos()), -1)[None]
    radius = simulator.ray(centre, outwards)
    assert radius.min() > 0.3849 and radius.max() < 0.3990  # section 5.7: 0.385 to 0.40
    along = torch.tensor([1.0, 0.0, 0.0]).expand(1, 2, 3)
    inside = torch.tensor([[[3.0, 5.0, 0.42], [3.0, 5.0, 0.02]]])
    free, rim = simulator.ray(inside, along)[0].tolist()
    assert math.isinf(free) and rim == pytest.approx(2.0 - 2.05 / 2, abs=1e-4)
    y = torch.linspace(-0.3, 0.3, 13)
    floor = heights(simulator, torch.zeros(13), y, start=0.42)
    torch.testing.assert_close(profile(layout, simulator, torch.zeros(13), y), floor, atol=0.015, rtol=0)
    # A standing robot inside: only its feet touch, and the roof is far.
    state = {"root_position": torch.tensor([[5.0, 5.0, 0.37]]), "root_quaternion": torch.tensor([[1.0, 0.0, 0.0, 0.0]])}
    rest = {name: torch.zeros(1, 3) for name in ("root_linear_velocity", "root_angular_velocity")}
    simulator.reset(ONE, **state, **rest, joint_position=POSE[None], joint_velocity=torch.zeros(1, 12))
    for _ in range(60):
        simulator.step(POSE[None])
    assert simulator.contact_force[0, list(constants.FOOT_GROUPS)].sum().item() > 100.0
    assert simulator.contact_force[0].sum() == simulator.contact_force[0, list(constants.FOOT_GROUPS)].sum()
    assert 0.25 < simulator.root_position[0, 2].item() < 0.32


def test_seesaw_tips_under_a_robot_that_has_crossed_the_pivot() -> None:
    simulator, layout = stand("seesaw")
    ends = torch.tensor([-1.45, 1.45])
    low, high = heights(simulator, ends, torch.zeros(2)).tolist()
    assert low == pytest.approx(0.275 - 1.45 * math.tan(-SEESAW_TILT), abs=2e-3) and low < 0.04 and high > 0.5
    for x, tipped in ((-0.5, False), (0.5, True)):
        simulator.place(ONE, *layout.poses())
        state = {"root_position": torch.tensor([[5.0 + x, 5.0, 0.75]])}
        state["root_quaternion"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        rest = {name: torch.zeros(1, 3) for name in ("root_linear_velocity", "root_angular_velocity")}
        simulator.reset(ONE, **state, **rest, joint_position=POSE[None], joint_velocity=torch.zeros(1, 12))
        for _ in range(75):
            simulator.step(POSE[None])
        assert (simulator.hinge_angle.item() > 0.1) is tipped
    x = torch.tensor([-1.2, -0.6, 0.6, 1.2])
    torch.testing.assert_close(
        profile(layout, simulator, x, 0.25 + 0 * x), heights(simulator, x, 0.25 + 0 * x), atol=3e-3, rtol=0
    )


@pytest.mark.parametrize("name", OBSTACLES)
def test_solids_are_what_rays_hit(name: str) -> None:
    """Rays from all around end on the surface of a solid, wherever they do not end on the ground."""
    simulator, layout = stand(name)
    generator = torch.Generator().manual_seed(0)
    away = torch.nn.functional.normalize(torch.randn(600, 3, generator=generator), dim=-1)
    middle = torch.tensor([5.0, 5.0, 0.0])
    origin = middle + 2.5 * torch.cat((away[:, :2], 0.1 + away[:, 2:].abs()), -1)
    reach = torch.tensor([*layout.kinds[0].half_extents, 0.3])
    aim = middle + reach * (2.0 * torch.rand(600, 3, generator=generator) - 1.0)
    direction = torch.nn.functional.normalize(aim - origin, dim=-1)
    distance = simulator.ray(origin[None], direction[None])[0]
    points = (origin + distance[:, None] * direction - middle)[distance.isfinite() & (distance > 0.0)]
    points = points[points[:, 2] > 0.01]
    assert len(points) > 50
    height = layout.lift[0, 0].item()
    solids = OBSTACLES[name].solids()
    drawn = [(*solid, (height, height) if low < high else (0.0, 0.0)) for *solid, (low, high) in solids]
    off, swept = (torch.stack([signed_distance(solid, points) for solid in kind]).amin(0) for kind in (drawn, solids))
    assert off.abs().max() < 1e-3
    assert swept.max() < 6e-3  # at any height; six stand for all of them


def test_edges_are_strips_of_five_centimetres_or_the_whole_gate() -> None:
    for name in ("a_frame", "seesaw"):
        zones = OBSTACLES[name].edges
        assert sorted((round(z.y - z.half_y, 3), round(z.y + z.half_y, 3)) for z in zones) == [
            (-0.3, -0.25),
            (0.25, 0.3),
        ]
    assert [len(OBSTACLES[name].edges) for name in ("bar_jump", "tire_jump", "weave_poles", "tunnel")] == [1, 1, 0, 0]
