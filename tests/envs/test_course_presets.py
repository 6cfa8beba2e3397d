"""The courses of the paper, to the number."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from agility_rl.envs.course import CourseError
from agility_rl.envs.course_presets import CHALLENGE, COURSES, box_course, single_course


def test_the_full_course_is_that_of_the_challenge() -> None:
    course = COURSES["full"]
    assert course.size == (7.0, 10.0) and course.shuffle and course.wall_height == (0.72, 0.72)
    assert [slot.position for slot in course.slots] == [(5.5, 3), (5.5, 7), (3.5, 7), (3.5, 3), (1.5, 3), (1.5, 7)]
    assert [round(math.degrees(slot.yaw)) for slot in course.slots] == [90, 90, -90, -90, 90, 90]
    assert sorted(slot.obstacle for slot in course.slots) == sorted(CHALLENGE) and len(CHALLENGE) == 6
    jitter = course.slots[0].jitter
    assert (jitter.x, jitter.y, round(math.degrees(jitter.yaw), 6)) == (0.25, 0.15, 5.0)
    assert sum(len(slot.goals) for slot in course.slots) == 24
    walls = COURSES["full_walls"]
    assert walls.wall_height == (0.5, 5.0) and walls.wall_distance == (0.0, 2.0)
    assert replace(walls, name="full", wall_height=(0.72, 0.72), wall_distance=(0.0, 0.0)) == course


def test_every_obstacle_alone_the_box_the_hurdles_and_two_ways() -> None:
    assert set(COURSES) == {"full", "full_walls", *CHALLENGE, "box", "hurdles", "bidirectional"}
    assert all(COURSES[name].slots[0].obstacle == name for name in CHALLENGE)
    assert COURSES["box"].slots[0].heights == (0.30, 0.30) and box_course(0.2).slots[0].heights == (0.2, 0.2)
    assert [slot.obstacle for slot in COURSES["hurdles"].slots] == ["bar_jump", "bar_jump"]
    left, straight = COURSES["bidirectional"].routes
    assert left[0] == straight[0] and left[1] != straight[1]
    with pytest.raises(CourseError, match="unknown obstacle 'pool'"):
        single_course("pool")
