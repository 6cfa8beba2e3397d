"""What episodes on a course add up to: success, speeds, obstacles, behaviours, against the targets of stage 3."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from course_rollouts import Episode, way_points
from judgement import make_table, show
from rich.console import Console
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS
from agility_rl.envs import Course
from agility_rl.envs.course_presets import CHALLENGE
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2.constants import CONTROL_DT
from agility_rl.training import metrics

SPEED_WINDOW = 10
"""Control steps over which a speed is taken (0.2 s): the sway of a stride is no speed, nor is one kick a peak."""


def layout_of(course: Course, episode: Episode) -> CourseLayout:
    """The course as it stood around one robot."""
    layout = CourseLayout(course, 1, torch.Generator())
    layout.load_state_dict(episode.layout)
    return layout


def speeds(path: Tensor) -> tuple[float, float]:
    """Mean and peak speed [m/s] along a path ``[T + 1, 2]`` of one point a control step.

    The mean is the length of the path, taken in straight pieces of 0.2 s, over its time; the peak is the longest of
    such pieces, wherever it begins. A shorter path is one piece.
    """
    window = min(SPEED_WINDOW, len(path) - 1)
    pieces = torch.linalg.vector_norm(path[window:] - path[:-window], dim=-1)
    rest = torch.linalg.vector_norm(path[-1] - path[(len(path) - 1) // window * window])
    length = pieces[::window].sum() + rest
    return (length / ((len(path) - 1) * CONTROL_DT)).item(), (pieces.max() / (window * CONTROL_DT)).item()


def route_length(path: Tensor, goals: Tensor) -> float:
    """Metres from the start to the end of a path ``[T + 1, 2]``, in straight lines over all way-points but the last.

    The last way-point is reached from a distance, so the end of the path stands in its place.
    """
    return torch.linalg.vector_norm(torch.cat((path[:1], goals[:-1], path[-1:])).diff(dim=0), dim=-1).sum().item()


def behaviour_seconds(episodes: Sequence[Episode]) -> Tensor:
    """Time in each behaviour before each type of obstacle, ``[7, 5]`` [s]."""
    steps = torch.zeros(len(OBSTACLES) * NUM_BEHAVIOURS, dtype=torch.int64)
    for episode in episodes:
        cell = episode.steps["obstacle"] * NUM_BEHAVIOURS + episode.steps["behaviour"]
        steps += cell.bincount(minlength=len(steps))
    return steps.view(len(OBSTACLES), NUM_BEHAVIOURS) * CONTROL_DT


def summarise(course: Course, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Every figure of one course; times and speeds are means of the successful episodes, unless they say otherwise."""
    success = torch.tensor([episode.success for episode in episodes])
    seconds = torch.tensor([len(episode.steps) * CONTROL_DT for episode in episodes])
    speed, peak = torch.tensor([speeds(episode.path) for episode in episodes]).unbind(-1)
    collisions = torch.tensor([float(episode.collisions().sum()) for episode in episodes])
    route = torch.tensor([route_length(one.path, way_points(layout_of(course, one))) for one in episodes])
    return {
        "episodes": len(episodes),
        "success": metrics.wilson_interval(int(success.sum()), len(episodes)),
        "causes": _count(episode.cause for episode in episodes if episode.cause),
        "time": _mean(seconds[success]),
        "speed": _mean(speed[success]),
        "speed_of_all": _mean(speed),
        "route_speed": _mean((route / seconds)[success]),
        "peak_speed": _mean(peak[success]),
        "fastest": peak[success].max().item() if bool(success.any()) else None,
        "collisions_of_all": metrics.bootstrap_interval(
            collisions, torch.Generator().manual_seed(0)
        ),  # far from normal
        "obstacles": _obstacles(episodes),
        "each": {
            "cause": [episode.cause for episode in episodes],
            "seconds": seconds,
            "speed": speed,
            "peak_speed": peak,
            "collisions": collisions,
        },
    }


def _mean(values: Tensor) -> metrics.Interval | None:
    return metrics.mean_interval(values) if len(values) else None


def _count(causes: Iterable[str]) -> dict[str, int]:
    """How often each came, the most frequent first."""
    return dict(Counter(causes).most_common())


def _obstacles(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Passed, walked around and failed of every type that was met; each meeting ends in one of the three."""
    passed, around, failed = (
        torch.stack([getattr(episode, name) for episode in episodes]).sum(0)
        for name in ("passed", "bypassed", "failed")
    )
    seconds = behaviour_seconds(episodes)
    found: dict[str, Any] = {}
    for index, name in enumerate(OBSTACLES):
        met = int(passed[index] + around[index] + failed[index])
        if not met:
            continue
        found[name] = {
            "met": met,
            "passed": int(passed[index]),
            "walked_around": int(around[index]),
            "success": metrics.wilson_interval(int(passed[index]), met),
            "causes": _count(episode.cause for episode in episodes if episode.failed[index]),
            "seconds": seconds[index].sum().item() / met,
            "behaviours": dict(zip(BEHAVIOURS, (seconds[index] / seconds[index].sum()).tolist(), strict=True)),
        }
    return found


def targets(courses: Mapping[str, Mapping[str, Any]], kind: str = "teacher") -> list[dict[str, Any]]:
    """Every target that the evaluated courses speak about; ``passed`` judges the estimate.

    A student shall pass 0.9 times as many as a teacher.
    """
    share = 0.9 if kind == "student" else 1.0
    rows: list[dict[str, Any]] = []

    def add(course: str, name: str, key: str, limit: float) -> None:
        if course in courses:
            value = courses[course][key]
            passed = value is not None and value.estimate >= limit
            rows.append({"name": f"{course}: {name}", "value": value, "target": f">= {limit:g}", "passed": passed})

    add("full", "success", "success", round(share * 0.8, 3))
    add("full", "mean speed, m/s", "speed", 1.1)
    for name in CHALLENGE:
        add(name, "success", "success", round(share * 0.95, 3))
    add("hurdles", "peak speed, m/s", "peak_speed", 3.2)
    add("box", "success", "success", round(share * 0.9, 3))
    return rows


def print_courses(found: Mapping[str, Any], console: Console) -> None:
    """Print the tables of an evaluation."""
    columns = ("episodes", "success", "time, s", "speed, m/s", "peak, m/s", "route speed, m/s", "collisions of all")
    table = make_table("courses; times and speeds of successful episodes, means", "course", *columns)
    for name, entry in found["courses"].items():
        keys = ("success", "time", "speed", "peak_speed", "route_speed", "collisions_of_all")
        table.add_row(name, str(entry["episodes"]), *(_short(entry[key]) for key in keys))
    console.print(table)
    table = make_table("obstacles", "course", "obstacle", "met", "passed", "success", "walked around", "failed by")
    use = make_table("behaviours, shares of the time before an obstacle", "course", "obstacle", *BEHAVIOURS, "s each")
    for course, entry in found["courses"].items():
        for name, obstacle in entry["obstacles"].items():
            causes = ", ".join(f"{cause} {count}" for cause, count in obstacle["causes"].items()) or "-"
            numbers = (obstacle["met"], obstacle["passed"], _short(obstacle["success"]), obstacle["walked_around"])
            table.add_row(course, name, *map(str, numbers), causes)
            parts = (f"{share:.2f}" if share else "." for share in obstacle["behaviours"].values())
            use.add_row(course, name, *parts, f"{obstacle['seconds']:.1f}")
    console.print(table)
    console.print(use)
    if not found["targets"]:
        return
    table = make_table("targets, with 95 % intervals", "what", "measured", "target", "")
    for row in found["targets"]:
        verdict = "[green]pass[/]" if row["passed"] else "[red]FAIL[/]"
        table.add_row(row["name"], show(row["value"]), row["target"], verdict)
    console.print(table)
    passed = sum(row["passed"] for row in found["targets"])
    console.print(f"{passed} of {len(found['targets'])} targets reached", highlight=False)


def _short(value: metrics.Interval | None) -> str:
    """``0.93 (0.86-0.97)``, or a dash where nothing could be measured."""
    if value is None:
        return "-"
    if not all(math.isfinite(bound) for bound in value):
        return f"{value.estimate:.2f}"
    return f"{value.estimate:.2f} ({value.low:.2f}-{value.high:.2f})"
