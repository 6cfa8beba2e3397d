"""The course around ``N`` robots: where they start, what they perceive of it, how far they have come."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys, rotations
from agility_rl.envs.course import Course
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.misjudgement import Misjudgement
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.progress import GOAL_RADIUS, CourseProgress
from agility_rl.envs.robots import CLEARANCE
from agility_rl.envs.scandots import HeightScan
from agility_rl.go2 import constants
from agility_rl.simulation import Simulator
from agility_rl.tensors import constant

NUM_PLACE = 8
"""Numbers of ``keys.PLACE``."""
START_BEHIND, START_ASIDE, START_TURN = 0.2, 0.1, 0.2
"""Draw of the start: 0 to 0.2 m behind the first way-point, +-0.1 m beside it, +-0.2 rad (method notes, 5.7)."""
START_BEYOND = 0.5
"""How far behind an obstacle it has been left [m]: nothing of a robot that starts there is in it (ours)."""


class Arena:
    """A course, drawn for each robot, and the robots' progress on it.

    Source: method notes, sections 5.4, 5.5, 5.7.

    Args:
        course: what stands where.
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        goal_radius: distance at which a way-point is reached [m].
        start: before a random obstacle, or before the first.
        start_after: share of random starts that are where the obstacle before is left, so that robots come to the
            next as on the whole course (turned away from it in an S, say), and not straight from a stand before it.
        start_spread: how many times as far aside and turned as released; 4 covers how robots leave the obstacle before.
        misjudgement: how wrong what robots are told of their place, directions and terrain is; ``None``: not at all.

    Attributes:
        layout: where the obstacles stand.
        progress: current way-points.
        scan: heights.
        max_obstacles: most obstacles in an episode, from the one it starts before.
        start_weights: ``[K]``, how often episodes start before each obstacle of the course.
        types: bool ``[K, 7]``, one-hot type of each obstacle.

    Raises:
        ValueError: if ``start`` is something else, or ``start_spread`` or ``start_after`` out of its range,
            or ``start_after`` given where nobody starts at random.
    """

    def __init__(
        self,
        course: Course,
        num_robots: int,
        generator: torch.Generator,
        goal_radius: float = GOAL_RADIUS,
        start: Literal["random", "first"] = "random",
        start_spread: float = 1.0,
        start_after: float = 0.0,
        misjudgement: Misjudgement | None = None,
    ) -> None:
        if start not in ("random", "first"):
            raise ValueError(f"expected start 'random' or 'first', got {start!r}")
        if not 0.0 <= start_after <= 1.0:
            raise ValueError(f"start_after must be a share from 0 to 1, got {start_after}")
        if start == "first" and start_after:
            raise ValueError(f"start_after is a share of random starts, got {start_after} with start 'first'")
        if not 0.0 <= start_spread <= 10.0:
            raise ValueError(f"start_spread must be from 0 to 10, got {start_spread}")
        self.generator, self.random_start, self.start_spread = generator, start == "random", start_spread
        self.start_after, self.misjudgement = start_after, misjudgement
        self.layout = CourseLayout(course, num_robots, generator)
        self.progress = CourseProgress(self.layout, goal_radius)
        self.scan = HeightScan(self.layout)
        kinds, device = self.layout.kinds, generator.device
        self.max_obstacles = len(kinds)
        self.start_weights = torch.ones(len(kinds), device=device)
        names = list(OBSTACLES)
        self.types = torch.nn.functional.one_hot(
            torch.tensor([names.index(kind.name) for kind in kinds], device=device), len(names)
        ).bool()
        self._speeds = torch.tensor([kind.target_speed for kind in kinds], device=device)
        ends = [slot.goals[-1] for slot in course.slots]
        left = [(max(x, kind.half_extents[0] + START_BEYOND), y) for kind, (x, y) in zip(kinds, ends, strict=True)]
        self._left = torch.tensor(left, device=device)

    def set_curriculum(self, difficulty: float | None, obstacles: int | None, start_weights: Tensor | None) -> None:
        """Change what later episodes draw; what is ``None`` stays as it is.

        Raises:
            ValueError: if a value is outside its range.
        """
        count = len(self.layout.kinds)
        if difficulty is not None:
            if not 0.0 <= difficulty <= 1.0:
                raise ValueError(f"difficulty must be in 0 to 1, got {difficulty}")
            self.layout.difficulty = difficulty
        if obstacles is not None:
            if not 1 <= obstacles <= count:
                raise ValueError(f"obstacles must be in 1 to {count}, got {obstacles}")
            self.max_obstacles = obstacles
        if start_weights is not None:
            if start_weights.shape != (count,) or not bool((start_weights > 0.0).all()):
                raise ValueError(f"start_weights must be {count} positive numbers, got {start_weights.tolist()}")
            self.start_weights = start_weights.detach().to(self.start_weights.device, copy=True)

    def begin(self, mask: Tensor, simulator: Simulator) -> None:
        """Draw the courses of the rows of a bool mask ``[N]`` and stand their robots before an obstacle."""
        n, device = len(mask), mask.device
        self.layout.draw(mask)
        simulator.place(mask, *self.layout.poses())
        length = self.layout.length
        leg = torch.zeros(n, dtype=torch.int64, device=device)
        if self.random_start:
            valid = torch.arange(self.layout.route.shape[1], device=device) < length[:, None]
            weights = self.start_weights[self.layout.route] * valid
            leg = torch.multinomial(weights, 1, generator=self.generator)[:, 0]
        self.progress.begin(mask, leg, torch.minimum(leg + self.max_obstacles, length))

        behind, aside, turn = torch.rand(3, n, generator=self.generator, device=device)
        spread = self.start_spread
        shift = torch.stack((-START_BEHIND * behind, spread * START_ASIDE * (2.0 * aside - 1.0)), -1)
        obstacle, local = self._stand(leg)
        place = self.layout.world(obstacle, local + shift)
        yaw = self.layout.axis(obstacle) + spread * START_TURN * (2.0 * turn - 1.0)
        height = self.ground(place, simulator)[:, None] + constants.STANDING_HEIGHT + CLEARANCE
        level, still = torch.zeros_like(yaw), torch.zeros(n, 3, device=device)
        simulator.reset(
            mask,
            root_position=torch.cat((place, height), -1),
            root_quaternion=rotations.from_euler(level, level, yaw),
            root_linear_velocity=still,
            root_angular_velocity=still,
            joint_position=constant(constants.DEFAULT_POSE, device).repeat(n, 1),
            joint_velocity=torch.zeros(n, constants.NUM_JOINTS, device=device),
        )
        self.progress.locate(mask, place)
        if self.misjudgement is not None:
            self.misjudgement.begin(mask)

    def advance(self, before: Tensor, position: Tensor, yaw: Tensor) -> None:
        """One decision after the robots were at legs ``before``, int64 ``[N]``; they are at ``[N, 2]`` [m] now."""
        if self.misjudgement is not None:
            obstacle, changed = self.progress.obstacle, self.progress.leg != before
            self.misjudgement.advance(changed, *self._at(obstacle, position, yaw))

    def _at(self, obstacle: Tensor, position: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor]:
        """Place ``[N, 2]`` [m] and yaw ``[N]`` [rad] in the frames of obstacles."""
        return self.layout.local_to(obstacle, position), yaw - self.layout.axis(obstacle)

    def believed(self, position: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor]:
        """Where trunks at ``[N, 3]`` [m] with headings ``[N]`` [rad] are told that they are."""
        if self.misjudgement is None:
            return position, yaw
        obstacle = self.progress.obstacle
        local, turned = self.misjudgement.misjudged(*self._at(obstacle, position[:, :2], yaw))
        believed = torch.cat((self.layout.world(obstacle, local), position[:, 2:]), -1)
        return believed, self.layout.axis(obstacle) + turned

    def _stand(self, leg: Tensor) -> tuple[Tensor, Tensor]:
        """Obstacle by which the robots of legs ``[N]`` start, and where in its frame, int64 ``[N]`` and ``[N, 2]``."""
        ahead, first = self.progress.obstacle, self.progress.local_goal()
        if self.start_after == 0.0:
            return ahead, first
        behind = self.layout.route.gather(1, (leg - 1).clamp(min=0)[:, None])[:, 0]
        chosen = torch.rand(len(leg), generator=self.generator, device=leg.device) < self.start_after
        on_the_way = (leg > 0) & chosen
        return torch.where(on_the_way, behind, ahead), torch.where(on_the_way[:, None], self._left[behind], first)

    def ground(self, position: Tensor, simulator: Simulator) -> Tensor:
        """Height [m] of what robots stand on under horizontal positions ``[N, 2]``, as ``[N]``."""
        parameter = self.layout.parameter(simulator.hinge_angle)
        return simulator.ground_height(position) + self.scan.support(position[:, None], parameter)[:, 0]

    def target_speed(self) -> Tensor:
        """Speed towards the goal that is worth the full reward, ``[N]`` [m/s]."""
        return self._speeds[self.progress.obstacle]

    def heading_error(self, position: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor]:
        """Vector to the current way-point ``[N, 2]`` [m] and angles to it and the next one ``[N, 2]`` [rad]."""
        goals = torch.stack(self.progress.goals(), 1)  # [N, 2 goals, 2]
        return goals[:, 0] - position, self._bearings(goals, position, yaw)

    def _bearings(self, goals: Tensor, position: Tensor, yaw: Tensor) -> Tensor:
        x, y = (goals - position[:, None]).unbind(-1)
        return rotations.wrap_angle(torch.atan2(y, x) - yaw[:, None])

    def expected_goals(self) -> Tensor:
        """Way-points in the world as robots that misjudge their place expect them, ``[N, 2 goals, 2]``."""
        if self.misjudgement is None:
            return torch.stack(self.progress.goals(), 1)
        current, following = self.progress.goals(self.misjudgement.untyped())
        coming = self.progress.next_obstacle
        shift = self.misjudgement.expected(self.layout.axis(coming))
        return torch.stack((current, following + shift * (coming != self.progress.obstacle)[:, None]), 1)

    def expected_type(self) -> Tensor:
        """Type of the current obstacle, one-hot ``[N, 7]``; as far as it is unknown to those robots, of none."""
        kinds = self.types[self.progress.obstacle].float()
        return kinds if self.misjudgement is None else kinds * (1.0 - self.misjudgement.untyped()[0][:, None])

    def place(self, goals: Tensor, position: Tensor, yaw: Tensor) -> Tensor:
        """``keys.PLACE`` ``[N, 8]`` of robots at ``[N, 2]`` [m], yaws ``[N]`` [rad], goals ``[N, 2, 2]`` [m]."""
        offset = goals - position[:, None]
        forward = torch.stack((yaw.cos(), yaw.sin()), -1)[:, None]
        ahead = (offset * forward).sum(-1)
        left = offset[..., 1] * forward[..., 0] - offset[..., 0] * forward[..., 1]
        obstacle = self.progress.obstacle
        local, turned = self._at(obstacle, position, yaw)
        way_points = torch.stack((ahead, left), -1).flatten(1)
        return torch.cat((way_points, local, turned.sin()[:, None], turned.cos()[:, None]), -1)

    def observe(self, simulator: Simulator, yaw: Tensor) -> TensorDict:
        """What the Task-Specific Controller sees of the course, ``[N]``."""
        parameter = self.layout.parameter(simulator.hinge_angle)
        trunk, yaw = self.believed(simulator.root_position, yaw)
        told = self.expected_goals(), trunk[:, :2], yaw
        return TensorDict(
            {
                keys.HEADING_ERROR: self._bearings(*told),
                keys.PLACE: self.place(*told),
                keys.OBSTACLE: self.expected_type(),
                keys.PROGRESS: torch.nn.functional.one_hot(self.progress.stage, self.progress.num_stages).float(),
                keys.SCANDOTS: self.scan.scandots(trunk, yaw, parameter),
            },
            [len(yaw)],
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything but the generator."""
        return {
            "layout": self.layout.state_dict(),
            "progress": self.progress.state_dict(),
            "max_obstacles": self.max_obstacles,
            "start_weights": self.start_weights.clone(),
            **({} if self.misjudgement is None else {"misjudgement": self.misjudgement.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.layout.load_state_dict(state["layout"])
        self.progress.load_state_dict(state["progress"])
        self.max_obstacles = state["max_obstacles"]
        self.start_weights = state["start_weights"].clone()
        if self.misjudgement is not None:
            self.misjudgement.load_state_dict(state["misjudgement"])
