"""Figures of episodes on a course: the arena from above with the path that was taken, and what was used where."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon, Rectangle
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS
from agility_rl.record.footprint import footprint
from agility_rl.record.plots import new_figure
from agility_rl.record.scene import Shape

BEHAVIOUR_COLOURS = tuple(f"C{index}" for index in range(NUM_BEHAVIOURS))
"""Of each behaviour, in every figure."""
_FLOOR, _INK, _GOOD, _BAD, _HIT = "#f4f3ef", "#222222", "#1a7f37", "#cf222e", "#ffd33d"
_END = {True: "o", False: "X"}
_INCHES_A_METRE = 0.62


@dataclass(frozen=True)
class PlanView:
    """One episode as it looks from above; positions in the arena, whose corner is the origin.

    Attributes:
        size: of the arena in x and y [m].
        shapes: what stands there, in the world frame.
        labels: text, (x, y) [m] and direction [rad] of each obstacle's name.
        goals: ``[G, 2]`` way-points in the order of passing [m].
        goal_radius: distance at which one is reached [m].
        path: ``[T + 1, 2]`` of the trunk [m].
        behaviour: int64 ``[T]``, between two points of the path.
        success: whether the course was passed.
        title: text above.
        collisions: ``[C, 2]``, where the legs hit something [m].
    """

    size: tuple[float, float]
    shapes: Sequence[Shape]
    labels: Sequence[tuple[str, tuple[float, float], float]]
    goals: Tensor
    goal_radius: float
    path: Tensor
    behaviour: Tensor
    success: bool
    title: str = ""
    collisions: Tensor | None = None

    def __post_init__(self) -> None:
        if self.path.shape != (len(self.behaviour) + 1, 2):
            raise ValueError(
                f"expected a path [{len(self.behaviour) + 1}, 2], one point more than behaviours, got "
                f"{list(self.path.shape)}"
            )


def plan_view(episodes: Sequence[PlanView]) -> Figure:
    """Episodes side by side, obstacles to scale, the path coloured by behaviour.

    Source: ours; no formula.

    Args:
        episodes: at least one.

    Raises:
        ValueError: if there is none.

    Example:
        >>> path = torch.tensor([[1.0, 1.0], [1.0, 2.0], [1.0, 3.0]])
        >>> bar = Shape("box", (1.2, 0.06, 0.06), (1.0, 2.0, 0.1))
        >>> view = PlanView((2.0, 4.0), [bar], [], path[1:], 0.4, path, torch.tensor([2, 4]), True, "one bar")
        >>> plan_view([view]).axes[0].get_title()
        'one bar'
    """
    if not episodes:
        raise ValueError("expected at least one episode to draw, got none")
    width = sum(max(episode.size[0], 3.5) for episode in episodes) + 1.2 * len(episodes)
    height = max(episode.size[1] for episode in episodes)
    figure = new_figure(_INCHES_A_METRE * width + 1.2, _INCHES_A_METRE * height + 0.9)
    for index, episode in enumerate(episodes):
        _draw(figure.add_subplot(1, len(episodes), index + 1), episode)
    figure.legend(handles=_legend(episodes), loc="outside right center", fontsize=8, frameon=False)
    return figure


def behaviour_use(seconds: Mapping[str, Tensor]) -> Figure:
    """Share of time of each behaviour before each obstacle, as one bar a row.

    Source: ours; no formula.

    Args:
        seconds: row label to ``[5]``, time (or any other count) in each behaviour.

    Raises:
        ValueError: if there is no row, or one has another shape.

    Example:
        >>> figure = behaviour_use({"tunnel": torch.tensor([0.0, 0.0, 1.0, 3.0, 0.0])})
        >>> [f"{bar.get_width():.2f}" for bar in figure.axes[0].patches]
        ['0.25', '0.75']
    """
    if not seconds or any(row.shape != (NUM_BEHAVIOURS,) for row in seconds.values()):
        shapes = {label: list(row.shape) for label, row in seconds.items()}
        raise ValueError(f"expected at least one row of {NUM_BEHAVIOURS} numbers, got {shapes or 'none'}")
    figure = new_figure(8.0, 1.0 + 0.36 * len(seconds))
    axes = figure.add_subplot()
    for row, times in enumerate(seconds.values()):
        shares = (times.double() / times.sum().clamp(min=1e-9)).tolist()
        left = 0.0
        for index, share in enumerate(shares):
            if share == 0.0:
                continue
            axes.barh(row, share, left=left, height=0.72, color=BEHAVIOUR_COLOURS[index], edgecolor="white")
            if share >= 0.06:
                axes.text(left + share / 2, row, f"{share:.2f}", ha="center", va="center", color="white", fontsize=8)
            left += share
    axes.set_yticks(range(len(seconds)), list(seconds))
    axes.tick_params(axis="y", length=0)
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("share of the time before the obstacle is passed")
    axes.spines[["top", "right", "left"]].set_visible(False)
    handles = [Rectangle((0, 0), 1, 1, color=colour) for colour in BEHAVIOUR_COLOURS]
    figure.legend(handles, BEHAVIOURS, loc="outside upper center", ncols=NUM_BEHAVIOURS, fontsize=8, frameon=False)
    return figure


def _draw(axes: Axes, episode: PlanView) -> None:
    """One arena: floor, obstacles (higher ones above lower ones), route, path."""
    x, y = episode.size
    axes.add_patch(Rectangle((0.0, 0.0), x, y, facecolor=_FLOOR, edgecolor="none", zorder=0))
    for shape in sorted(episode.shapes, key=lambda shape: shape.position[2]):
        outline = footprint(shape).numpy()
        axes.add_patch(Polygon(outline, facecolor=(*shape.color[:3], 0.6), edgecolor=_INK, linewidth=0.4, zorder=1))
    goals = episode.goals.tolist()
    axes.plot(*zip(*goals, strict=True), color=_INK, linewidth=0.6, linestyle=":", zorder=2)
    for goal in goals:
        axes.add_patch(
            Circle(goal, episode.goal_radius, fill=False, edgecolor=_INK, alpha=0.3, linewidth=0.5, zorder=2)
        )
        axes.plot(*goal, "+", color=_INK, markersize=4, markeredgewidth=0.8, zorder=2)
    path = episode.path.double().numpy()
    pieces = [path[step : step + 2] for step in range(len(path) - 1)]
    colours = [BEHAVIOUR_COLOURS[index] for index in episode.behaviour.tolist()]
    axes.plot(*path.T, color="white", linewidth=4.0, solid_capstyle="round", zorder=3)
    axes.add_collection(LineCollection(pieces, colors=colours, linewidths=2.2, capstyle="round", zorder=4))
    if episode.collisions is not None and len(episode.collisions):
        axes.plot(*episode.collisions.T.numpy(), "^", color=_HIT, markeredgecolor=_INK, markersize=4, zorder=5)
    axes.plot(*path[0], "o", color="white", markeredgecolor=_INK, markersize=7, zorder=6)
    axes.plot(*path[-1], _END[episode.success], color=_INK, markeredgecolor="white", markersize=10, zorder=6)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "boxstyle": "round,pad=0.2"}
    for text, place, direction in episode.labels:
        upright = (math.degrees(direction) + 80.0) % 180.0 - 80.0  # one way for all that are about vertical
        axes.text(
            *place,
            text,
            fontsize=7,
            ha="center",
            va="center",
            rotation=upright,
            rotation_mode="anchor",
            bbox=box,
            zorder=7,
        )
    axes.set_title(episode.title, fontsize=9, color=_GOOD if episode.success else _BAD)
    axes.set_aspect("equal")
    axes.set_xlim(-0.2, x + 0.2)
    axes.set_ylim(-0.2, y + 0.2)
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.spines[:].set_visible(False)


def _legend(episodes: Sequence[PlanView]) -> list[Line2D]:
    """Only what is there: the behaviours that were shown, start, ends, collisions."""
    shown = torch.cat([episode.behaviour for episode in episodes]).unique().tolist()

    def mark(label: str, marker: str, face: str, edge: str) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, color=face, markeredgecolor=edge, markersize=7, label=label)

    handles = [
        Line2D([], [], color=BEHAVIOUR_COLOURS[index], linewidth=2.5, label=BEHAVIOURS[index]) for index in shown
    ]
    handles += [mark("start", "o", "white", _INK), mark("way-point", "+", _INK, _INK)]
    for success in sorted({episode.success for episode in episodes}, reverse=True):
        handles.append(mark("passed" if success else "failed", _END[success], _INK, "white"))
    if any(episode.collisions is not None and len(episode.collisions) for episode in episodes):
        handles.append(mark("leg hits something", "^", _HIT, _INK))
    return handles
