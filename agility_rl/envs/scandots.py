"""Heights of the course around a robot, from the exact profiles of the obstacles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import SEESAW_TILT
from agility_rl.tensors import rows_of

GRID_X = tuple(0.1 * index for index in range(12))
"""Distances ahead of the trunk [m] (method notes, section 5.4)."""
GRID_Y = tuple(0.1 * (index - 5) for index in range(11))
"""Distances to the left of the trunk [m] (section 5.4)."""
NUM_SCANDOTS = len(GRID_X) * len(GRID_Y)
STANDING_OFFSET = 0.3
"""Trunk height at which flat ground reads zero [m] (section 5.4)."""
CELL = 0.025
"""Distance of the heights that are kept of an obstacle [m] (ours)."""


class HeightScan:
    """Heights of ``K`` obstacles around ``N`` robots, looked up in tables of their profiles.

    A gate or tube is perceived by its lower half, through which the robot passes; bars and tires 0.2 m deep. The
    tables hold a profile at the corners of a grid in the obstacle's own frame, so a height is exact to half a cell
    (12.5 mm) sideways.

    Source: method notes, sections 5.4 and 5.7.

    Args:
        layout: where the obstacles stand.
        neighbours: give for each point the lowest of three: itself and its neighbours one cell on in x and in y, as the
            release does on its height field.

    Example:
        >>> from agility_rl.envs.course_presets import COURSES
        >>> layout = CourseLayout(COURSES["a_frame"], 1, torch.Generator())
        >>> scan = HeightScan(layout)
        >>> top = layout.position[:, :1]  # the middle of the A-frame
        >>> round(scan.support(top, layout.lift).item(), 3)
        0.333
    """

    def __init__(self, layout: CourseLayout, *, neighbours: bool = True) -> None:
        self.layout, device = layout, layout.device
        kinds = layout.kinds
        axes = []
        for axis in (0, 1):
            cells = int(max(kind.half_extents[axis] for kind in kinds) / CELL) + 2  # the rim is ground
            axes.append(torch.arange(-cells, cells + 1, device=device) * CELL)
        grid = torch.meshgrid(*axes, indexing="ij")
        profiles = [kind.profile(*grid) for kind in kinds]
        # One table [K, X, Y] for each part of a profile; its rim stands for everything outside.
        self._exact = tuple(torch.stack(part) for part in zip(*profiles, strict=True))
        usual = [math.tan(SEESAW_TILT) if kind.difficulty is None else kind.difficulty.high for kind in kinds]
        usual_parameter = torch.tensor(usual, device=device)[:, None, None]
        self._tables = _lowest(self._exact, usual_parameter) if neighbours else self._exact
        self._supports = torch.tensor([kind.supports for kind in kinds], device=device)
        self._circle = torch.tensor([kind.half_extents for kind in kinds], device=device).norm(dim=-1)
        zones = [(index, *zone) for index, kind in enumerate(kinds) for zone in kind.edges]
        self._zone_owner = torch.tensor([index for index, *_ in zones], dtype=torch.int64, device=device)
        self._zones = torch.tensor([zone for _, *zone in zones], device=device).reshape(-1, 4)
        points = [(x, y, 1.0) for y in GRID_Y for x in GRID_X]
        self._grid = torch.tensor(points, device=device).T.contiguous()  # [3, 132]
        self._size = torch.tensor(layout.course.size, device=device)
        self._ahead = (GRID_X[0] + GRID_X[-1]) / 2  # middle of the grid; a circle about it holds all points
        self._radius = math.hypot(self._ahead, GRID_Y[-1])

    def scandots(self, position: Tensor, yaw: Tensor, parameter: Tensor) -> Tensor:
        """Scandots ``clip(z - 0.3 - height, -1, 1)``, 11 rows from right to left of 12 points ahead, as ``[N, 132]``.

        Args:
            position: ``[N, 3]`` of the trunk [m].
            yaw: ``[N]`` [rad].
            parameter: ``[N, K]`` of the profiles, from :meth:`CourseLayout.parameter`.
        """
        heights = self.heights(position[:, :2], yaw, parameter)
        return (position[:, 2:] - STANDING_OFFSET - heights).clamp_(-1.0, 1.0)

    def heights(self, position: Tensor, yaw: Tensor, parameter: Tensor) -> Tensor:
        """Height [m] of the course at each scandot, ``[N, 132]``."""
        layout = self.layout
        # Only the obstacles that reach into a robot's grid are looked up: mostly one or none of them.
        middle = position + self._ahead * torch.stack((yaw.cos(), yaw.sin()), -1)
        near = (layout.position - middle[:, None]).norm(dim=-1) < self._circle + self._radius
        pair = rows_of(near.flatten())
        row, obstacle = pair // near.shape[1], pair % near.shape[1]
        turn = yaw[row] - layout.yaw[row, obstacle]
        local = layout.local(position[:, None])[row, obstacle, 0]
        points = (_frame(turn, local) / CELL).flatten(0, 1) @ self._grid  # cells, [2M, 132]
        value = self._look_up(self._tables, obstacle, points.unflatten(0, (-1, 2)), parameter[row, obstacle])
        heights = torch.zeros(len(position), NUM_SCANDOTS, device=position.device)
        heights.scatter_reduce_(0, row[:, None].expand_as(value), value, "amax")
        if layout.course.wall_height is not None:
            heights = self._with_walls(heights, position, yaw)
        return heights

    def _look_up(self, tables: tuple[Tensor, ...], obstacle: Tensor, cells: Tensor, parameter: Tensor) -> Tensor:
        """Heights at points ``[M, 2, P]`` in the frame of an obstacle, counted in cells, as ``[M, P]``."""
        rows, columns = tables[0].shape[1:]
        x = cells[:, 0].add(rows // 2 + 0.5).clamp_(0.0, rows - 0.5).long()
        y = cells[:, 1].add(columns // 2 + 0.5).clamp_(0.0, columns - 0.5).long()
        index = x.mul_(columns).add_(y).add_((obstacle * (rows * columns))[:, None])
        base, gain = (table.view(-1).take(index) for table in tables)
        return torch.addcmul(base, gain, parameter[:, None])

    def _with_walls(self, heights: Tensor, position: Tensor, yaw: Tensor) -> Tensor:
        rim = self._ahead + self._radius
        low_y, high_y, low_x, high_x = self.layout.wall_distance.unbind(-1)
        low, high = -torch.stack((low_x, low_y), -1), self._size + torch.stack((high_x, high_y), -1)
        near = ((position < low + rim) | (position > high - rim)).any(-1)
        close = rows_of(near)
        points = _frame(yaw[close], position[close]) @ self._grid  # [M, 2, 132]
        outside = ((points < low[close, :, None]) | (points > high[close, :, None])).any(1)
        wall = torch.where(outside, self.layout.wall_height[close, None], 0.0)
        return heights.index_copy_(0, close, torch.maximum(heights[close], wall))

    def support(self, points: Tensor, parameter: Tensor) -> Tensor:
        """Height [m] of what a robot can stand on at world points ``[N, P, 2]``, as ``[N, P]``; gates carry nobody."""
        n, p = points.shape[:2]
        cells = self.layout.local(points).div_(CELL).flatten(0, 1).transpose(1, 2)  # [N K, 2, P]
        obstacle = torch.arange(len(self.layout.kinds), device=points.device).repeat(n)
        height = self._look_up(self._exact, obstacle, cells, parameter.flatten()).view(n, -1, p)
        return torch.where(self._supports[:, None], height, 0.0).amax(1).clamp_(min=0.0)

    def on_edge(self, points: Tensor) -> Tensor:
        """Whether world points ``[N, P, 2]`` lie in an edge zone of an obstacle, bool ``[N, P]``."""
        local = self.layout.local(points)[:, self._zone_owner]  # [N, Z, P, 2]
        middle, half = self._zones[:, None, :2], self._zones[:, None, 2:]
        return ((local - middle).abs() <= half).all(-1).any(1)


def _frame(yaw: Tensor, origin: Tensor) -> Tensor:
    """Matrices ``[M, 2, 3]`` that turn points (x, y, 1) by a yaw ``[M]`` and move them to an origin ``[M, 2]``."""
    cos, sin = yaw.cos(), yaw.sin()
    return torch.stack((cos, -sin, origin[:, 0], sin, cos, origin[:, 1]), -1).view(-1, 2, 3)


def _lowest(tables: tuple[Tensor, ...], parameter: Tensor) -> tuple[Tensor, ...]:
    """Of each entry and its next neighbours in x and y, the one that is lowest at a usual parameter ``[K, 1, 1]``."""
    choices = [torch.stack((table, table.roll(-1, 1), table.roll(-1, 2))) for table in tables]
    lowest = (choices[0] + choices[1] * parameter).argmin(0, keepdim=True)
    return tuple(choice.gather(0, lowest)[0] for choice in choices)
