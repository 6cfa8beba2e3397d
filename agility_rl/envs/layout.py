"""Where the obstacles of a course stand for each of ``N`` robots, drawn anew at every reset."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from agility_rl.envs.course import TALLEST_WALL, Course
from agility_rl.envs.obstacles import SEESAW_TILT
from agility_rl.simulation import Piece, Shape

_WALL = 0.05
"""Half thickness of a wall [m] (ours)."""
_OUTWARDS = ((0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0))
_BUFFERS = ("position", "yaw", "lift", "route", "length", "first_leg", "wall_height", "wall_distance")


class CourseLayout:
    """Poses and heights of ``K`` obstacles (a course's slots) around ``N`` robots, and the order to pass them in.

    Every row is drawn for itself: which obstacle stands in which slot, position, yaw, height of bars, tires and boxes,
    height of the walls, route.

    Source: method notes, section 5.7.

    Args:
        course: what to draw.
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.

    Attributes:
        pieces: what the simulator must hold.
        position: ``[N, K, 2]`` [m].
        yaw: ``[N, K]`` [rad].
        lift: ``[N, K]`` height of the lifted piece [m], 0 for obstacles without.
        route: int64 ``[N, L]``, obstacles in the order of passing.
        length: int64 ``[N]``, number of valid entries in a row of :attr:`route`.
        first_leg: int64 ``[N]``, how many obstacles are in the routes that the course lists before the row's.
        wall_height: ``[N]`` [m].
        wall_distance: ``[N, 4]``, how much farther out than the arena's edges at low y, high y, low x and high x they
            stand [m].
        difficulty: share of every range of heights that is drawn from, 0 to 1; assign for a curriculum.

    Example:
        >>> from agility_rl.envs.course_presets import COURSES
        >>> layout = CourseLayout(COURSES["full"], 3, torch.Generator())
        >>> layout.draw(torch.ones(3, dtype=torch.bool))
        >>> layout.position.shape, sorted(layout.route[0].tolist())
        (torch.Size([3, 6, 2]), [0, 1, 2, 3, 4, 5])
    """

    def __init__(self, course: Course, num_robots: int, generator: torch.Generator) -> None:
        self.course, self.generator = course, generator
        self.device = device = generator.device
        self.kinds = tuple(slot.kind for slot in course.slots)
        n = num_robots
        self.pieces = scenery(course)
        owners = [(index, number) for index, kind in enumerate(self.kinds) for number in range(len(kind.pieces))]
        self._owner = torch.tensor([index for index, _ in owners], device=device)
        self._lifted = torch.tensor([self.kinds[index].lifted == number for index, number in owners], device=device)
        hinged = [index for index, number in owners if self.kinds[index].pieces[number].hinge is not None]
        self._hinged = torch.tensor(hinged, dtype=torch.int64, device=device)  # obstacle of each hinge
        self._middles = torch.tensor(_wall_middles(course), device=device)
        self._outwards = torch.tensor(_OUTWARDS, device=device)
        self._upright = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device)

        self._place = torch.tensor([(*slot.position, slot.yaw) for slot in course.slots], device=device)
        self._jitter = torch.tensor([tuple(slot.jitter) for slot in course.slots], device=device)
        self._heights = torch.tensor([slot.heights for slot in course.slots], device=device)
        longest = max(len(route) for route in course.routes)
        routes = [(*route, *(route[-1],) * (longest - len(route))) for route in course.routes]
        self._routes = torch.tensor(routes, device=device)
        self._lengths = torch.tensor([len(route) for route in course.routes], device=device)
        self._first_legs = self._lengths.cumsum(0) - self._lengths
        self._wall_range, self._wall_distances = course.wall_height or (0.0, 0.0), course.wall_distance

        self.difficulty = 1.0
        self.position = self._place[:, :2].repeat(n, 1, 1)
        self.yaw = self._place[:, 2].repeat(n, 1)
        self.lift = self._heights[:, 0].repeat(n, 1)
        self.route = self._routes[0].repeat(n, 1)
        self.length = self._lengths[0].repeat(n)
        self.first_leg = self._first_legs[0].repeat(n)
        self.wall_height = torch.full((n,), self._wall_range[0], device=device)
        self.wall_distance = torch.full((n, len(_OUTWARDS)), self._wall_distances[0], device=device)

    def draw(self, mask: Tensor) -> None:
        """Draw the rows of a bool mask ``[N]`` anew."""
        n, k = self.yaw.shape

        def uniform(*shape: int) -> Tensor:
            return torch.rand(shape, generator=self.generator, device=self.device)

        order = uniform(n, k) if self.course.shuffle else torch.arange(k, device=self.device).repeat(n, 1)
        slot = order.argsort(-1)  # of each obstacle
        place = self._place[slot] + self._jitter[slot] * (2.0 * uniform(n, k, 3) - 1.0)
        low, high = self._heights.unbind(-1)
        lift = low + (high - low) * self.difficulty * uniform(n, k)
        choice = torch.randint(len(self._routes), (n,), generator=self.generator, device=self.device)
        route = slot.argsort(-1).gather(1, self._routes[choice])  # slots, then the obstacles that stand there
        walls = self._wall_range[0] + (self._wall_range[1] - self._wall_range[0]) * uniform(n)
        near, far = self._wall_distances
        distance = near + (far - near) * uniform(*self.wall_distance.shape) if far > near else self.wall_distance
        # New tensors, because observations of earlier steps may still refer to the old ones.
        which = (route, self._lengths[choice], self._first_legs[choice])
        drawn = (place[..., :2], place[..., 2], lift, *which, walls, distance)
        for name, value in zip(_BUFFERS, drawn, strict=True):
            rows = mask.view(-1, *(1,) * (value.ndim - 1))
            setattr(self, name, torch.where(rows, value, getattr(self, name)))

    @property
    def owners(self) -> Tensor:
        """Obstacle that each of :attr:`pieces` belongs to, int64 ``[P]``; -1 for walls."""
        return torch.nn.functional.pad(self._owner, (0, len(self.pieces) - len(self._owner)), value=-1)

    def poses(self) -> tuple[Tensor, Tensor, Tensor]:
        """Positions ``[N, P, 3]``, quaternions ``[N, P, 4]`` and hinge angles ``[N, H]`` of :attr:`pieces`."""
        n = len(self.yaw)
        height = torch.where(self._lifted, self.lift[:, self._owner], 0.0)
        position = torch.cat((self.position[:, self._owner], height[..., None]), -1)
        half = self.yaw[:, self._owner] / 2
        zero = torch.zeros_like(half)
        quaternion = torch.stack((half.cos(), zero, zero, half.sin()), -1)
        if walls := len(self.pieces) - len(self._owner):
            middle = self._middles + self._outwards * self.wall_distance[..., None]
            sunk = (self.wall_height - TALLEST_WALL / 2)[:, None, None].expand(n, walls, 1)
            position = torch.cat((position, torch.cat((middle, sunk), -1)), 1)
            upright = self._upright.repeat(n, walls, 1)
            quaternion = torch.cat((quaternion, upright), 1)
        return position, quaternion, torch.full((n, len(self._hinged)), SEESAW_TILT, device=self.device)

    def parameter(self, hinge_angle: Tensor) -> Tensor:
        """What the profiles of the obstacles take, ``[N, K]``: the height of the lifted piece, or a hinge's tangent."""
        if not len(self._hinged):
            return self.lift
        return self.lift.index_copy(1, self._hinged, hinge_angle.tan())

    def local(self, points: Tensor) -> Tensor:
        """World points ``[N, P, 2]`` in the frame of every obstacle, ``[N, K, P, 2]``."""
        cos, sin = self.yaw.cos()[..., None], self.yaw.sin()[..., None]
        x, y = (points[:, None] - self.position[:, :, None]).unbind(-1)
        return torch.stack((cos * x + sin * y, cos * y - sin * x), -1)

    def axis(self, obstacle: Tensor) -> Tensor:
        """Yaw [rad] of one obstacle each (int64 ``[N]``), ``[N]``."""
        return self.yaw.gather(1, obstacle[:, None])[:, 0]

    def local_to(self, obstacle: Tensor, point: Tensor) -> Tensor:
        """World points ``[N, 2]`` in the frame of one obstacle each (int64 ``[N]``), ``[N, 2]``."""
        row = torch.arange(len(obstacle), device=obstacle.device)
        yaw = self.yaw[row, obstacle]
        cos, sin = yaw.cos(), yaw.sin()
        x, y = (point - self.position[row, obstacle]).unbind(-1)
        return torch.stack((cos * x + sin * y, cos * y - sin * x), -1)

    def world(self, obstacle: Tensor, point: Tensor) -> Tensor:
        """Local points ``[N, 2]`` of one obstacle each (int64 ``[N]``) in the world, ``[N, 2]``."""
        row = torch.arange(len(obstacle), device=obstacle.device)
        yaw = self.yaw[row, obstacle]
        cos, sin = yaw.cos(), yaw.sin()
        x, y = point.unbind(-1)
        return self.position[row, obstacle] + torch.stack((cos * x - sin * y, sin * x + cos * y), -1)

    def state_dict(self) -> dict[str, Any]:
        """What was drawn, and the difficulty."""
        return {name: getattr(self, name).clone() for name in _BUFFERS} | {"difficulty": self.difficulty}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is of another course or number of robots, or was saved when courses held less.
        """
        if missing := [name for name in _BUFFERS if name not in state]:
            raise ValueError(
                f"the saved layout holds no {', '.join(missing)}: it is older than these; begin a new run, "
                "with --init-from to keep what was learned"
            )
        if state["yaw"].shape != self.yaw.shape:
            raise ValueError(
                f"the saved layout holds {list(state['yaw'].shape)} robots x obstacles, expected "
                f"{list(self.yaw.shape)}; resume with the course and the number of robots that wrote it"
            )
        for name in _BUFFERS:
            setattr(self, name, state[name].clone())
        self.difficulty = state["difficulty"]


def scenery(course: Course) -> tuple[Piece, ...]:
    """What a simulator must hold for a course: the pieces of its obstacles, slot by slot, then its walls.

    Raises:
        TypeError: if ``course`` is none, such as the name of one.

    Example:
        >>> from agility_rl.envs.course_presets import COURSES
        >>> [piece.name for piece in scenery(COURSES["bar_jump"])][:3]
        ['0_bar_jump_wings', '0_bar_jump_bar', 'wall_0']
    """
    if not isinstance(course, Course):
        raise TypeError(
            f"expected a Course, such as agility_rl.envs.COURSES['full'], got {type(course).__name__} {course!r}"
        )
    return tuple(
        Piece(f"{index}_{slot.kind.name}_{piece.name}", piece.shapes, piece.hinge)
        for index, slot in enumerate(course.slots)
        for piece in slot.kind.pieces
    ) + _walls(course)


def _wall_middles(course: Course) -> list[tuple[float, float]]:
    (x, y), out = course.size, _WALL
    return [(x / 2, -out), (x / 2, y + out), (-out, y / 2), (x + out, y / 2)]


def _walls(course: Course) -> tuple[Piece, ...]:
    """Four pieces as tall as the tallest wall; how far they are sunk makes their height."""
    if course.wall_height is None:
        return ()
    (x, y), farther = course.size, course.wall_distance[1]
    sizes = [(x / 2 + farther + 2 * _WALL, _WALL)] * 2 + [(_WALL, y / 2 + farther)] * 2
    colour = (0.75, 0.78, 0.8, 1.0)
    return tuple(
        Piece(f"wall_{index}", (Shape("box", (*half, TALLEST_WALL / 2), colour=colour),))
        for index, half in enumerate(sizes)
    )
