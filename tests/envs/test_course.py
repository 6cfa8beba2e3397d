"""Courses that can be built, and the one clear message of those that cannot."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from agility_rl.envs.course import Course, CourseError, Jitter, Slot
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.obstacles import OBSTACLES

HURDLE = Slot("bar_jump", (2.0, 3.0), yaw=math.pi / 2)
TUNNEL = Slot("tunnel", (2.0, 7.0), yaw=math.pi / 2)
COURSE = Course("two", (4.0, 10.0), (HURDLE, TUNNEL))


def test_a_course_passes_its_slots_in_order_unless_told_otherwise() -> None:
    assert COURSE.routes == ((0, 1),)
    assert replace(COURSE, routes=((1,), (0, 1))).routes == ((1,), (0, 1))


def test_legs_are_the_slots_of_every_route_in_order() -> None:
    there_and_back = replace(COURSE, routes=((1,), (0, 1)))
    tunnel, hurdle = (2.0, 7.0, math.pi / 2), (2.0, 3.0, math.pi / 2)
    assert there_and_back.legs == ((tunnel,), (hurdle, tunnel))


def test_the_stock_is_how_many_of_each_type_stand_there() -> None:
    counts = {name: dict(zip(OBSTACLES, COURSES[name].stock, strict=True)) for name in ("full", "hurdles")}
    assert counts["full"] == dict.fromkeys(OBSTACLES, 1) | {"box_jump": 0}
    assert counts["hurdles"] == dict.fromkeys(OBSTACLES, 0) | {"bar_jump": 2}


def test_what_a_slot_leaves_open_comes_from_its_type() -> None:
    assert HURDLE.heights == (0.05, 0.20) and TUNNEL.heights == (0.0, 0.0)
    assert replace(HURDLE, difficulty=(0.1, 0.3)).heights == (0.1, 0.3)
    assert HURDLE.goals == ((-1.8, 0.0), (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0))
    assert replace(HURDLE, way_points=((0.5, 0.0),)).goals == ((0.5, 0.0),)


@pytest.mark.parametrize(
    ("slot", "message"),
    [
        ({"obstacle": "hurdle"}, r"slot 0 \(hurdle\): unknown obstacle; expected one of bar_jump, a_frame"),
        ({"difficulty": (0.1, 0.4)}, r"within 0.05 to 0.3 m, got \(0.1, 0.4\)"),
        ({"difficulty": (0.2, 0.1)}, "difficulty must be"),
        ({"obstacle": "a_frame", "difficulty": (0.2, 0.3)}, "takes no difficulty"),
        ({"way_points": ()}, "no way-points"),
        ({"way_points": ((-1.0, 0.0), (3.5, 0.0))}, r"way-points .* are more than 3.5 m apart"),
        ({"position": (0.5, 3.0)}, r"reaches \(-0.52, .*\) m, expected it, .* inside 4.0 x 10.0 m"),
        ({"position": (2.0, 1.0)}, "inside"),
        ({"position": (2.0, 2.3)}, r"expected it, its way-points, 0.6 m behind the first and its jitter inside"),
        ({"position": (math.nan, 1.0)}, "finite"),
        ({"jitter": Jitter(-0.1)}, "must not be negative"),
        ({"jitter": Jitter(1.5)}, "its jitter inside"),
        ({"position": (2.0, 6.5)}, r"slot 0 \(bar_jump\) and slot 1 \(tunnel\) overlap"),
    ],
)
def test_a_bad_slot_is_refused(slot: dict[str, object], message: str) -> None:
    with pytest.raises(CourseError, match=message):
        replace(COURSE, slots=(replace(HURDLE, **slot), TUNNEL))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slots": ()}, "has no slots"),
        ({"size": (4.0, 0.0)}, "two positive lengths"),
        ({"routes": ((0, 2),)}, r"slots 0 to 1, each at most once, got \(0, 2\)"),
        ({"routes": ((0, 0),)}, "at most once"),
        ({"routes": ((1, 0),)}, r"from slot 1 \(tunnel\) to slot 0 \(bar_jump\) is "),
        ({"wall_height": (0.5, 9.0)}, "wall_height"),
        ({"wall_distance": (-0.5, 1.0)}, "wall_distance must be"),
    ],
)
def test_a_bad_course_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(CourseError, match=message):
        replace(COURSE, **changes)  # type: ignore[arg-type]


def test_a_way_must_not_be_too_long_wherever_jitter_moves_its_ends() -> None:
    """Way-points 0.9 m behind the first bar and 1.8 m before the second, which lie on one line."""
    first, second = Slot("bar_jump", (3.0, 5.0)), Slot("bar_jump", (3.0 + 0.9 + 3.0 + 1.8, 5.0))
    assert Course("long", (12.0, 10.0), (first, second))
    for jitter, most in ((Jitter(0.2, 0.1), math.hypot(0.4, 0.2)), (Jitter(0.0, 0.0, 0.2), 2.0 * 2.7 * math.sin(0.1))):
        slots = tuple(replace(slot, jitter=jitter) for slot in (first, second))
        assert Course("long", (12.0, 10.0), slots)
        slots = (slots[0], replace(slots[1], position=(slots[1].position[0] + 0.5, 5.0)))
        with pytest.raises(CourseError, match=rf"is 3\.50 m and {3.5 + most:.2f} m with jitter, expected"):
            Course("long", (12.0, 10.0), slots)


def test_shuffled_obstacles_must_fit_in_every_slot() -> None:
    slots = (Slot("tunnel", (1.2, 3.0), math.pi / 2), Slot("bar_jump", (1.2, 7.0), math.pi / 2))
    assert Course("narrow", (4.0, 10.0), slots)
    beside = (Slot("tunnel", (0.8, 3.0), math.pi / 2), Slot("bar_jump", (1.2, 7.0), math.pi / 2))
    assert Course("narrow", (4.0, 10.0), beside)
    with pytest.raises(CourseError, match=r"slot 0 \(bar_jump\) reaches"):
        Course("narrow", (4.0, 10.0), beside, shuffle=True)


def test_turned_footprints_overlap_only_where_they_do() -> None:
    # A-frames of 2.9 x 0.6 m: side by side they fit at 0.7 m, crosswise not.
    frame = Slot("a_frame", (5.0, 5.0))
    Course("open", (10.0, 10.0), (frame, replace(frame, position=(5.0, 5.7))), routes=((0,), (1,)))
    with pytest.raises(CourseError, match="overlap"):
        crossed = replace(frame, position=(5.0, 5.7), yaw=math.pi / 2)
        Course("open", (10.0, 10.0), (frame, crossed), routes=((0,), (1,)))
