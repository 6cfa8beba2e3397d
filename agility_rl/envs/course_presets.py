"""The courses of the paper: the agility challenge, each obstacle alone, the box, the hurdles, the ambiguous route."""

from __future__ import annotations

import math
from dataclasses import replace

from agility_rl.envs.course import Course, CourseError, Jitter, Slot
from agility_rl.envs.obstacles import OBSTACLES

CHALLENGE = tuple(name for name in OBSTACLES if name != "box_jump")
"""The six obstacles of the challenge."""
ARENA = (7.0, 10.0)
"""Size of the arena [m] (method notes, section 5.7)."""
JITTER = Jitter(0.25, 0.15, math.radians(5.0))
"""Half-widths [m, m, rad] (section 5.7)."""
CAMERA_WALLS = (0.5, 5.0)
"""Lowest and highest top of the walls where there is a camera [m] (section 5.7)."""

_UP, _DOWN = math.pi / 2, -math.pi / 2
_S_ROUTE = ((5.5, 3.0, _UP), (5.5, 7.0, _UP), (3.5, 7.0, _DOWN), (3.5, 3.0, _DOWN), (1.5, 3.0, _UP), (1.5, 7.0, _UP))
"""Slot centres [m] and directions of the S-shaped route (section 5.7)."""


def full_course(wall_height: tuple[float, float] = (0.72, 0.72)) -> Course:
    """The challenge: one of each of the six obstacles, in random order, on the S-shaped route.

    Source: method notes, section 5.7. For cameras the release draws the walls' height from 0.5 to 5 m.
    """
    slots = tuple(Slot(name, (x, y), yaw, JITTER) for name, (x, y, yaw) in zip(CHALLENGE, _S_ROUTE, strict=True))
    return Course("full", ARENA, slots, shuffle=True, wall_height=wall_height)


def full_course_for_cameras() -> Course:
    """The challenge between walls that no camera can go by: of any height, each up to two metres farther out.

    In one arena its walls say where an obstacle should stand, not where it does; what learns from images here cannot
    learn that.

    Source: heights: method notes, section 5.7; distances: ours.
    """
    return replace(full_course(CAMERA_WALLS), name="full_walls", wall_distance=(0.0, 2.0))


def single_course(obstacle: str) -> Course:
    """One obstacle alone, in an arena that leaves two metres before and behind it (ours).

    Raises:
        CourseError: if there is no such obstacle.
    """
    if obstacle not in OBSTACLES:
        raise CourseError(f"unknown obstacle {obstacle!r}; expected one of {', '.join(OBSTACLES)}")
    return Course(obstacle, (4.0, 7.0), (Slot(obstacle, (2.0, 3.5), _UP, JITTER),))


def box_course(height: float = 0.30) -> Course:
    """Onto a box of 30 cm (supplement, Fig. S3; size of the arena ours)."""
    return Course("box", (4.0, 7.0), (Slot("box_jump", (2.0, 3.5), _UP, JITTER, (height, height)),))


def hurdle_course() -> Course:
    """Two hurdles in a straight run, with way to gather speed (supplement, Fig. S4; distances ours).

    The way-points draw the run out: from 2.5 m before the first hurdle to 2.5 m behind the second.
    """
    first = ((-2.5, 0.0), (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0))
    second = ((-1.8, 0.0), (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0), (2.5, 0.0))
    jitter = Jitter(0.1, 0.15, math.radians(2.0))
    slots = (
        Slot("bar_jump", (2.0, 4.0), _UP, jitter, way_points=first),
        Slot("bar_jump", (2.0, 8.5), _UP, jitter, way_points=second),
    )
    return Course("hurdles", (4.0, 12.5), slots)


def bidirectional_course() -> Course:
    """After the first hurdle the way goes left at once, or straight on: the operator says which (supplement, S7).

    Which obstacles stand there is ours.
    """
    slots = (
        Slot("bar_jump", (4.5, 2.7), _UP),
        Slot("a_frame", (1.9, 5.2), math.pi),
        Slot("tunnel", (4.5, 7.2), _UP),
    )
    return Course("bidirectional", (7.0, ARENA[1]), slots, routes=((0, 1), (0, 2)))


COURSES: dict[str, Course] = {
    course.name: course
    for course in (
        full_course(),
        full_course_for_cameras(),
        *(single_course(name) for name in CHALLENGE),
        box_course(),
        hurdle_course(),
        bidirectional_course(),
    )
}
"""Every preset by name."""
