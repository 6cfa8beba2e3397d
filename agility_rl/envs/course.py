"""A course as data: which obstacles stand where in an arena, and in which order the robot passes them.

In Python a :class:`Course` of :class:`Slot` objects; as a file, see :mod:`agility_rl.envs.course_file`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from agility_rl.envs.obstacles import OBSTACLES, Obstacle, Points

GOAL_DISTANCE = 4.0
"""A robot further than this from its goal has lost its way [m] (method notes, section 5.6)."""
LONGEST_WAY = 3.5
"""Longest way between two way-points [m]."""
FARTHEST = GOAL_DISTANCE - 0.45
"""The same wherever jitter has moved them [m]: the next one counts when a robot is within the radius of goals of the
first, up to 0.45 m before it, and whoever is farther from it than :data:`GOAL_DISTANCE` is lost."""
ROOM = 0.6
"""What a robot needs behind a first way-point to start there [m]: half its length, and up to 0.2 m (section 5.7)."""
WALL_HEIGHT = 0.72
"""Height of the walls [m] (section 5.7)."""
TALLEST_WALL = 5.0


class CourseError(ValueError):
    """A course that cannot be built; the message says where, what was expected, and what was found."""


class Jitter(NamedTuple):
    """Half-widths of the uniform draws that move an obstacle: along the arena's x and y [m], and in yaw [rad]."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0


_STILL = Jitter()


@dataclass(frozen=True)
class Slot:
    """A place in the arena and the obstacle that stands there.

    Attributes:
        obstacle: a name of :data:`agility_rl.envs.obstacles.OBSTACLES`.
        position: in the arena, whose corner is the origin [m].
        yaw: direction in which it is passed, from the arena's x axis [rad].
        jitter: random shift at each draw.
        difficulty: lowest and highest height [m]; ``None`` for the released range.
        way_points: local (x, y) [m]; ``None`` for those of the type.
    """

    obstacle: str
    position: tuple[float, float]
    yaw: float = 0.0
    jitter: Jitter = _STILL
    difficulty: tuple[float, float] | None = None
    way_points: Points | None = None

    @property
    def kind(self) -> Obstacle:
        """The obstacle's type."""
        return OBSTACLES[self.obstacle]

    @property
    def goals(self) -> Points:
        """Way-points in the obstacle's frame [m]."""
        return self.kind.way_points if self.way_points is None else self.way_points

    @property
    def heights(self) -> tuple[float, float]:
        """Range of the lifted piece's height [m]; zeros for an obstacle without."""
        if self.difficulty is not None:
            return self.difficulty
        return (0.0, 0.0) if self.kind.difficulty is None else self.kind.difficulty[:2]


@dataclass(frozen=True)
class Course:
    """Obstacles in an arena with walls.

    Attributes:
        name: for logs and messages.
        size: of the arena in x and y [m].
        slots: the obstacles.
        routes: orders in which slots are passed, by index; every episode draws one. Empty: all slots as listed.
        shuffle: draw anew for every robot which obstacle stands in which slot.
        wall_height: lowest and highest top of the walls [m]; ``None`` for an open field.
        wall_distance: by how much each wall stands farther out than the arena ends, at least and at most [m].

    Raises:
        CourseError: if the course cannot be built.

    Example:
        >>> hurdle = Slot("bar_jump", (2.0, 4.0), yaw=1.5708, difficulty=(0.1, 0.2))
        >>> Course("one hurdle", (4.0, 8.0), (hurdle,)).routes
        ((0,),)
    """

    name: str
    size: tuple[float, float]
    slots: tuple[Slot, ...]
    routes: tuple[tuple[int, ...], ...] = ()
    shuffle: bool = False
    wall_height: tuple[float, float] | None = (WALL_HEIGHT, WALL_HEIGHT)
    wall_distance: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.slots:
            raise CourseError(f"course {self.name!r} has no slots; expected at least one obstacle")
        if len(self.size) != 2 or not all(math.isfinite(side) and side > 0.0 for side in self.size):
            raise CourseError(f"course {self.name!r}: size must be two positive lengths in metres, got {self.size}")
        if not self.routes:
            object.__setattr__(self, "routes", (tuple(range(len(self.slots))),))
        for index, slot in enumerate(self.slots):
            _check_slot(slot, f"course {self.name!r}, slot {index} ({slot.obstacle})")
        walls = self.wall_height
        if walls is not None and not 0.0 < walls[0] <= walls[1] <= TALLEST_WALL:
            raise CourseError(
                f"course {self.name!r}: wall_height must be (low, high) in 0 to {TALLEST_WALL} m, got {walls}"
            )
        if not 0.0 <= self.wall_distance[0] <= self.wall_distance[1] < math.inf:
            raise CourseError(
                f"course {self.name!r}: wall_distance must be (low, high), 0 m or more, got {self.wall_distance}"
            )
        self._check_routes()
        self._check_places()

    @property
    def most_way_points(self) -> int:
        """Way-points of the obstacle that has most."""
        return max(len(slot.goals) for slot in self.slots)

    @property
    def legs(self) -> tuple[tuple[tuple[float, float, float], ...], ...]:
        """Of every route, where its slots lie in the arena: x, y [m], yaw [rad]."""
        return tuple(
            tuple((*self.slots[index].position, self.slots[index].yaw) for index in route) for route in self.routes
        )

    @property
    def stock(self) -> list[int]:
        """How many obstacles of each type stand there, as :data:`~agility_rl.envs.obstacles.OBSTACLES` has them."""
        return [sum(slot.obstacle == name for slot in self.slots) for name in OBSTACLES]

    def _check_routes(self) -> None:
        n = len(self.slots)
        for route in self.routes:
            if not route or len(set(route)) != len(route) or not all(0 <= index < n for index in route):
                raise CourseError(
                    f"course {self.name!r}: a route must name slots 0 to {n - 1}, each at most once, got {route}"
                )
            for first, second in pairwise(route):
                for leaving, coming in self._pairs(first, second):
                    ends = (self.slots[first], leaving.goals[-1]), (self.slots[second], coming.goals[0])
                    gap = math.dist(*(_world(slot, goal) for slot, goal in ends))
                    if gap > LONGEST_WAY or gap + _farther(*ends) > FARTHEST:
                        raise CourseError(
                            f"course {self.name!r}: the way from slot {first} ({leaving.obstacle}) to slot {second} "
                            f"({coming.obstacle}) is {gap:.2f} m and {gap + _farther(*ends):.2f} m with jitter, "
                            f"expected at most {LONGEST_WAY} m and {FARTHEST} m between way-points; move the slots "
                            "together or add way-points"
                        )

    def _check_places(self) -> None:
        for index, slot in enumerate(self.slots):
            for kind in self.slots if self.shuffle else (slot,):
                corners = [(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
                extent = kind.kind.half_extents
                points = [_world(slot, (x * extent[0], y * extent[1])) for x, y in corners]
                points += [_world(slot, point) for point in kind.goals]
                if self.wall_height is not None:  # robots start behind the first one, and are as long as that
                    points.append(_world(slot, (kind.goals[0][0] - ROOM, kind.goals[0][1])))
                for x, y in points:
                    if not (
                        slot.jitter.x <= x <= self.size[0] - slot.jitter.x
                        and slot.jitter.y <= y <= self.size[1] - slot.jitter.y
                    ):
                        raise CourseError(
                            f"course {self.name!r}, slot {index} ({kind.obstacle}) reaches ({x:.2f}, {y:.2f}) m, "
                            f"expected it, its way-points, {ROOM} m behind the first and its jitter inside "
                            f"{self.size[0]} x {self.size[1]} m; move it or enlarge size"
                        )
            for other in range(index):
                for one, two in self._pairs(other, index):
                    if _overlap(self.slots[other], one.kind, slot, two.kind):
                        raise CourseError(
                            f"course {self.name!r}: slot {other} ({one.obstacle}) and slot {index} ({two.obstacle}) "
                            "overlap; move them apart"
                        )

    def _pairs(self, first: int, second: int) -> Sequence[tuple[Slot, Slot]]:
        """Which obstacles may stand in two slots at once."""
        if not self.shuffle:
            return [(self.slots[first], self.slots[second])]
        return [(a, b) for a in self.slots for b in self.slots if a is not b]


def _world(slot: Slot, point: tuple[float, float]) -> tuple[float, float]:
    cos, sin = math.cos(slot.yaw), math.sin(slot.yaw)
    return (
        slot.position[0] + cos * point[0] - sin * point[1],
        slot.position[1] + sin * point[0] + cos * point[1],
    )


def _farther(*ends: tuple[Slot, tuple[float, float]]) -> float:
    """By how much jitter may move two way-points, each of a slot, apart at most [m]."""
    shift = math.hypot(sum(slot.jitter.x for slot, _ in ends), sum(slot.jitter.y for slot, _ in ends))
    return shift + sum(2.0 * math.hypot(*goal) * math.sin(min(slot.jitter.yaw, math.pi) / 2.0) for slot, goal in ends)


def _check_slot(slot: Slot, where: str) -> None:
    if slot.obstacle not in OBSTACLES:
        raise CourseError(f"{where}: unknown obstacle; expected one of {', '.join(OBSTACLES)}")
    numbers = (*slot.position, slot.yaw, *slot.jitter, *(value for point in slot.goals for value in point))
    if not all(math.isfinite(value) for value in numbers):
        raise CourseError(f"{where}: position, yaw, jitter and way-points must be finite")
    if min(slot.jitter) < 0.0:
        raise CourseError(f"{where}: jitter must not be negative, got {tuple(slot.jitter)}")
    if not slot.goals:
        raise CourseError(f"{where}: no way-points; expected at least one, or leave them to the type")
    for first, second in pairwise(slot.goals):
        if math.dist(first, second) > LONGEST_WAY:
            raise CourseError(f"{where}: way-points {first} and {second} are more than {LONGEST_WAY} m apart")
    if slot.difficulty is None:
        return
    known = slot.kind.difficulty
    if known is None:
        raise CourseError(f"{where}: takes no difficulty, got {slot.difficulty}")
    if not known.low <= slot.difficulty[0] <= slot.difficulty[1] <= known.hardest:
        raise CourseError(
            f"{where}: difficulty must be (low, high) within {known.low} to {known.hardest} m, got {slot.difficulty}"
        )


def _overlap(slot: Slot, kind: Obstacle, other: Slot, other_kind: Obstacle) -> bool:
    """Whether two footprints share a point, jitter left aside (the released course's may): no axis separates them."""
    between = (other.position[0] - slot.position[0], other.position[1] - slot.position[1])
    for angle in (slot.yaw, slot.yaw + math.pi / 2, other.yaw, other.yaw + math.pi / 2):
        axis = (math.cos(angle), math.sin(angle))
        reach = 0.0
        for yaw, extents in ((slot.yaw, kind.half_extents), (other.yaw, other_kind.half_extents)):
            reach += extents[0] * abs(math.cos(angle - yaw)) + extents[1] * abs(math.sin(angle - yaw))
        if abs(between[0] * axis[0] + between[1] * axis[1]) >= reach:
            return False
    return True
