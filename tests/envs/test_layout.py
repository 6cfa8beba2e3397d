"""Draws of a course: each robot its own, inside the ranges, masked, saved; poses that simulator and rays confirm."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from agility_rl.envs.course import Course, Jitter, Slot
from agility_rl.envs.course_presets import COURSES, full_course
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import SEESAW_TILT
from agility_rl.simulation import BatchSimulator


def everyone(n: int) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def drawn(course: Course, n: int, seed: int = 0) -> CourseLayout:
    layout = CourseLayout(course, n, torch.Generator().manual_seed(seed))
    layout.draw(everyone(n))
    return layout


def test_every_robot_has_every_obstacle_once_in_one_of_the_slots() -> None:
    layout = drawn(COURSES["full"], 400)
    assert torch.equal(layout.route.sort(-1).values, torch.arange(6).repeat(400, 1))
    assert (layout.length == 6).all()
    centres = torch.tensor([slot.position for slot in layout.course.slots])
    yaw = torch.tensor([slot.yaw for slot in layout.course.slots])
    place = layout.position[torch.arange(400)[:, None], layout.route]  # in the order of passing: slot by slot
    shift = place - centres
    assert shift[..., 0].abs().max() <= 0.25 and shift[..., 1].abs().max() <= 0.15
    assert shift[..., 0].std() > 0.12 and shift[..., 1].std() > 0.07
    turn = layout.yaw[torch.arange(400)[:, None], layout.route] - yaw
    assert turn.abs().max() <= math.radians(5.0) + 1e-6 and turn.std() > math.radians(2.5)
    # Each obstacle is about equally often first.
    assert torch.bincount(layout.route[:, 0], minlength=6).min() > 40


def test_heights_are_drawn_from_the_share_of_their_range() -> None:
    layout = CourseLayout(COURSES["full"], 500, torch.Generator())
    names = [kind.name for kind in layout.kinds]
    bar, tire = names.index("bar_jump"), names.index("tire_jump")
    for share in (1.0, 0.4, 0.0):
        layout.difficulty = share
        layout.draw(everyone(500))
        for index, (low, high) in ((bar, (0.05, 0.20)), (tire, (0.40, 0.55))):
            lift = layout.lift[:, index]
            top = low + share * (high - low)
            assert lift.min() >= low - 1e-6 and lift.max() <= top + 1e-6
            assert lift.max() > top - 0.01
    others = [index for index in range(6) if index not in (bar, tire)]
    assert (layout.lift[:, others] == 0.0).all()


def test_only_the_rows_of_the_mask_are_drawn_and_kept_tensors_stay() -> None:
    layout = drawn(full_course((0.5, 5.0)), 6)
    before = layout.state_dict()
    kept = layout.position
    mask = torch.tensor([True, False, True, False, False, True])
    layout.draw(mask)
    after = layout.state_dict()
    for name in ("position", "yaw", "lift", "wall_height"):
        assert torch.equal(after[name][~mask], before[name][~mask]) and not torch.equal(after[name], before[name])
    assert torch.equal(kept, before["position"])
    other = CourseLayout(full_course((0.5, 5.0)), 6, torch.Generator())
    other.load_state_dict(after)
    assert torch.equal(other.position, layout.position) and torch.equal(other.route, layout.route)
    with pytest.raises(ValueError, match=r"holds \[6, 6\] robots x obstacles, expected \[2, 6\]"):
        CourseLayout(COURSES["full"], 2, torch.Generator()).load_state_dict(after)


def test_routes_are_drawn_evenly() -> None:
    layout = drawn(COURSES["bidirectional"], 400)
    assert (layout.route[:, 0] == 0).all() and (layout.length == 2).all()
    assert 150 < (layout.route[:, 1] == 1).sum() < 250
    slots = COURSES["full"].slots
    unequal = drawn(replace(COURSES["full"], shuffle=False, slots=slots, routes=((0, 1, 2), (5,))), 50)
    assert set(unequal.length.tolist()) == {1, 3}
    assert (unequal.route[unequal.length == 1] == 5).all()


def test_frames_there_and_back() -> None:
    layout = drawn(COURSES["full"], 5)
    points = torch.randn(5, 3, 2, generator=torch.Generator().manual_seed(1))
    local = layout.local(points)
    assert local.shape == (5, 6, 3, 2)
    for obstacle in range(6):
        back = layout.world(torch.full((5,), obstacle), local[:, obstacle, 1])
        torch.testing.assert_close(back, points[:, 1], atol=1e-5, rtol=0)
    # A metre ahead of an obstacle that is passed along y lies a metre further in y.
    slot = Slot("tunnel", (2.0, 3.5), math.pi / 2)
    tunnel = drawn(Course("t", (4.0, 7.0), (slot,)), 1)
    torch.testing.assert_close(
        tunnel.world(torch.zeros(1, dtype=torch.int64), torch.tensor([[1.0, 0.5]])), torch.tensor([[1.5, 4.5]])
    )


def test_obstacles_stand_in_the_simulator_where_the_layout_says() -> None:
    layout = drawn(full_course((0.5, 5.0)), 4)
    simulator = BatchSimulator(4, num_threads=1, scenery=layout.pieces)
    simulator.place(everyone(4), *layout.poses())
    names = [kind.name for kind in layout.kinds]
    torch.testing.assert_close(simulator.hinge_angle, torch.full((4, 1), SEESAW_TILT))

    def height(points: torch.Tensor) -> torch.Tensor:
        origin = torch.cat((points, torch.full((4, 1), 6.0)), -1)[:, None]
        return 6.0 - simulator.ray(origin, torch.tensor([0.0, 0.0, -1.0]).expand(4, 1, 3))[:, 0]

    def at(name: str, x: float, y: float) -> torch.Tensor:
        return height(layout.world(torch.full((4,), names.index(name)), torch.tensor([[x, y]]).repeat(4, 1)))

    bar = layout.lift[:, names.index("bar_jump")]
    torch.testing.assert_close(at("bar_jump", 0.0, 0.4), bar + 0.03, atol=1e-3, rtol=0)
    torch.testing.assert_close(at("a_frame", 0.0, 0.2), torch.full((4,), 0.333), atol=1e-3, rtol=0)
    torch.testing.assert_close(at("weave_poles", 1.5, 0.0), torch.full((4,), 1.0))
    torch.testing.assert_close(at("tunnel", 0.9, 0.0), torch.full((4,), 0.855), atol=1e-3, rtol=0)
    assert (at("seesaw", 1.4, 0.0) > 0.5).all() and (at("seesaw", -1.4, 0.0) < 0.06).all()
    for x, y in ((-0.05, 5.0), (7.05, 5.0), (3.5, -0.05), (3.5, 10.05)):
        torch.testing.assert_close(height(torch.tensor([[x, y]]).repeat(4, 1)), layout.wall_height, atol=1e-4, rtol=0)
    parameter = layout.parameter(simulator.hinge_angle)
    assert torch.equal(parameter[:, names.index("bar_jump")], bar)
    torch.testing.assert_close(parameter[:, names.index("seesaw")], torch.full((4,), math.tan(SEESAW_TILT)))


def test_walls_may_stand_farther_out_in_every_episode_anew() -> None:
    layout = drawn(COURSES["full_walls"], 300)
    distance = layout.wall_distance
    assert distance.min() >= 0.0 and 1.9 < distance.max() <= 2.0 and distance.std(0).min() > 0.4
    assert torch.corrcoef(distance.T).fill_diagonal_(0.0).abs().max() < 0.3  # each wall by itself
    simulator = BatchSimulator(300, num_threads=1, scenery=layout.pieces)
    simulator.place(everyone(300), *layout.poses())
    down = torch.tensor([0.0, 0.0, -1.0]).expand(300, 1, 3)
    low_y, high_y, low_x, high_x = distance.unbind(-1)
    middle, across = torch.full((300,), 3.5), torch.full((300,), 5.0)
    faces = (
        (middle, -low_y, 0, -1),
        (middle, 10.0 + high_y, 0, 1),
        (-low_x, across, -1, 0),
        (7.0 + high_x, across, 1, 0),
    )
    for x, y, out_x, out_y in faces:
        for beyond, stands in ((-0.02, False), (0.02, True)):
            origin = torch.stack((x + beyond * out_x, y + beyond * out_y, torch.full((300,), 6.0)), -1)[:, None]
            height = 6.0 - simulator.ray(origin, down)[:, 0]
            torch.testing.assert_close(height, layout.wall_height if stands else torch.zeros(300), atol=1e-4, rtol=0)
    mask = torch.arange(300) < 3
    layout.draw(mask)
    assert torch.equal((layout.wall_distance != distance).any(-1), mask)


def test_a_layout_that_was_saved_when_courses_held_less_is_refused() -> None:
    layout = drawn(COURSES["full"], 3)
    older = {name: value for name, value in layout.state_dict().items() if name != "wall_distance"}
    with pytest.raises(ValueError, match="the saved layout holds no wall_distance: it is older"):
        layout.load_state_dict(older)


def test_two_obstacles_of_a_type_are_two() -> None:
    layout = drawn(COURSES["hurdles"], 3)
    assert len({piece.name for piece in layout.pieces}) == len(layout.pieces) == 8
    assert (layout.lift[:, 0] != layout.lift[:, 1]).all()
    field = Course("open", (9.0, 9.0), (Slot("a_frame", (4.0, 4.0), jitter=Jitter()),), wall_height=None)
    assert [piece.name for piece in drawn(field, 1).pieces] == ["0_a_frame_boards"]


def test_every_piece_has_its_obstacle_and_walls_have_none() -> None:
    layout = drawn(COURSES["full"], 1)
    for piece, owner in zip(layout.pieces, layout.owners.tolist(), strict=True):
        expected = "wall" if owner < 0 else f"{owner}_{layout.kinds[owner].name}"
        assert piece.name.startswith(f"{expected}_"), piece.name
    assert set(layout.owners.tolist()) == {-1, 0, 1, 2, 3, 4, 5}
