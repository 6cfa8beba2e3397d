"""How far each robot has come on its course: way-points reached, obstacles passed or walked around."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from agility_rl.envs.layout import CourseLayout

GOAL_RADIUS = 0.4
"""Distance at which a way-point counts as reached [m]; 0.45 for students and evaluation (method notes, section 5.5)."""
GOAL_STEPS = 2
"""Control steps that the robot must be there (more than 0.02 s, section 5.5)."""
_BEYOND = 0.1
"""The goal after the last one lies this far on in y [m] (section 5.5)."""
_BUFFERS = ("leg", "point", "end", "inside", "local", "around", "detour", "finished")


class Events(NamedTuple):
    """What one control step brought, each bool ``[N]``."""

    at_goal: Tensor
    """Inside the goal radius."""
    passed: Tensor
    """The last way-point of an obstacle was reached."""
    bypassed: Tensor
    """The same, but the robot had walked around the obstacle."""


class CourseProgress:
    """Current way-point of ``N`` robots.

    A way-point is reached when the trunk has been within ``radius`` for two control steps; then the next one counts.
    Walking around: the trunk crosses the middle of the obstacle outside its passage. The release knows no such rule
    (ours): a robot that avoids the tunnel on its way to the goal behind it must not count as one that went through.

    Source: method notes, section 5.5.

    Args:
        layout: where the obstacles stand and in which order they are passed.
        radius: of a goal [m].

    Attributes:
        leg: int64 ``[N]``, place in the row's route.
        point: int64 ``[N]``, way-point of that obstacle.
        finished: bool ``[N]``, all way-points reached.
        detour: bool ``[N]``, some obstacle was walked around.

    Example:
        >>> from agility_rl.envs.course_presets import COURSES
        >>> layout = CourseLayout(COURSES["tunnel"], 1, torch.Generator())
        >>> progress = CourseProgress(layout)
        >>> progress.goal()  # the tunnel stands at (2.0, 3.5) and is entered along y
        tensor([[2.0000, 1.4750]])
    """

    def __init__(self, layout: CourseLayout, radius: float = GOAL_RADIUS) -> None:
        self.layout, self.radius, device = layout, radius, layout.device
        goals = [slot.goals for slot in layout.course.slots]
        self._longest = longest = layout.course.most_way_points
        filled = [(*points, *(points[-1],) * (longest - len(points))) for points in goals]
        self._points = torch.tensor(filled, device=device)
        self._usual = self._points.mean(0)
        self._count = torch.tensor([len(points) for points in goals], device=device)
        self._passage = torch.tensor([kind.passage for kind in layout.kinds], device=device)
        self._beyond = torch.tensor([0.0, _BEYOND], device=device)
        n = len(layout.length)
        self.leg, self.point, self.inside = (torch.zeros(n, dtype=torch.int64, device=device) for _ in range(3))
        self.end = layout.length.clone()
        self.local = torch.zeros(n, 2, device=device)
        self.around, self.detour, self.finished = (torch.zeros(n, dtype=torch.bool, device=device) for _ in range(3))

    def begin(self, mask: Tensor, leg: Tensor, end: Tensor) -> None:
        """Let the rows of a bool mask ``[N]`` start before obstacle ``leg`` of their route and finish before ``end``.

        :meth:`locate` must follow, once the robots stand where they start.
        """
        self.leg, self.end = torch.where(mask, leg, self.leg), torch.where(mask, end, self.end)
        for name in ("point", "inside", "around", "detour", "finished"):
            setattr(self, name, getattr(self, name).masked_fill(mask, 0))

    def locate(self, mask: Tensor, position: Tensor) -> None:
        """Tell where the robots of the rows of a mask stand, ``[N, 2]`` [m]."""
        self.local = torch.where(mask[:, None], self._local(position), self.local)

    @property
    def obstacle(self) -> Tensor:
        """Index of the current obstacle in the course, int64 ``[N]``."""
        return self._obstacle(self.leg)

    @property
    def next_obstacle(self) -> Tensor:
        """Index of the obstacle of the way-point after the current one, int64 ``[N]``."""
        return self._obstacle(self._after()[0])

    @property
    def stage(self) -> Tensor:
        """Index of the current way-point among those of all obstacles of all routes, int64 ``[N]``."""
        return (self.layout.first_leg + self.leg) * self._longest + self.point

    @property
    def num_stages(self) -> int:
        """How many there are, if all obstacles had as many as the one that has most."""
        return sum(map(len, self.layout.course.routes)) * self._longest

    def _obstacle(self, leg: Tensor) -> Tensor:
        last = torch.minimum(leg, self.end - 1)
        return self.layout.route.gather(1, last[:, None])[:, 0]

    def _local(self, position: Tensor) -> Tensor:
        return self.layout.local_to(self.obstacle, position)

    def local_goal(self) -> Tensor:
        """Current way-point in the frame of its obstacle, ``[N, 2]`` [m]."""
        return self._points[self.obstacle, self.point]

    def goal(self) -> Tensor:
        """Current way-point in the world, ``[N, 2]`` [m]."""
        return self.layout.world(self.obstacle, self.local_goal())

    def goals(self, unknown: tuple[Tensor, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Current and next way-point in the world, each ``[N, 2]`` [m].

        Args:
            unknown: of the types of the current obstacle and of the next one, each ``[N]`` from 0 to 1. As far as they
                are, way-points are where those of all obstacles of the course are on average.
        """
        leg, point = self._after()
        coming = self._obstacle(leg)
        now, after = self.local_goal(), self._points[coming, point]
        if unknown is not None:
            here, further = unknown
            elsewhere = torch.where(coming == self.obstacle, here, further)
            now = now.lerp(self._usual[self.point], here[:, None])
            after = after.lerp(self._usual[point], elsewhere[:, None])
        current, following = self.layout.world(self.obstacle, now), self.layout.world(coming, after)
        beyond = current + self._beyond
        return current, torch.where((leg >= self.end)[:, None], beyond, following)

    def _after(self) -> tuple[Tensor, Tensor]:
        last = self.point + 1 >= self._count[self.obstacle]
        return self.leg + last.long(), torch.where(last, 0, self.point + 1)

    def update(self, position: Tensor) -> Events:
        """Let the robots stand at ``[N, 2]`` [m] one control step later."""
        near = torch.linalg.vector_norm(self.goal() - position, dim=-1) < self.radius
        self._watch(position)
        self.inside = torch.where(near, self.inside + 1, 0)
        reached = (self.inside >= GOAL_STEPS) & ~self.finished
        leg, point = self._after()
        passed = reached & (leg > self.leg)
        bypassed = passed & self.around
        self.detour = self.detour | bypassed
        self.finished = self.finished | (reached & (leg >= self.end))
        moved = reached & ~self.finished
        self.leg, self.point = torch.where(moved, leg, self.leg), torch.where(moved, point, self.point)
        self.inside = self.inside.masked_fill(reached, 0)
        self.around = self.around & ~passed
        self.locate(passed, position)
        return Events(near, passed, bypassed)

    def _watch(self, position: Tensor) -> None:
        """Remember who crosses the middle of the obstacle beside its passage, forget it of those who come back."""
        before, self.local = self.local, self._local(position)
        onwards = (before[:, 0] < 0.0) & (self.local[:, 0] >= 0.0)
        back = (before[:, 0] >= 0.0) & (self.local[:, 0] < 0.0)
        outside = self.local[:, 1].abs() > self._passage[self.obstacle]
        self.around = (self.around & ~back & ~onwards) | (onwards & outside)

    def state_dict(self) -> dict[str, Any]:
        """The counters."""
        return {name: getattr(self, name).clone() for name in _BUFFERS}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, value in state.items():
            setattr(self, name, value.clone())
