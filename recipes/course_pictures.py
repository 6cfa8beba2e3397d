"""Pictures of an evaluation on a course: what stands in the arena, and which episodes are worth looking at."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from course_judgement import layout_of
from course_rollouts import Episode, way_points
from torch import Tensor

from agility_rl import rotations, simulation
from agility_rl.envs import Course
from agility_rl.envs.layout import CourseLayout
from agility_rl.go2.constants import CONTROL_DT
from agility_rl.record import Shape
from agility_rl.record.course_plots import PlanView


def parts(shape: simulation.Shape) -> list[tuple[str, tuple[float, float, float], float]]:
    """A simulated shape as kinds and full extents [m] that are drawn, and how far along its z axis each stands [m]."""
    if shape.kind == "box":
        x, y, z = shape.size
        return [("box", (2 * x, 2 * y, 2 * z), 0.0)]
    width = 2 * shape.size[0]
    ball, half = (width, width, width), shape.size[-1]
    if shape.kind == "sphere":
        return [("sphere", ball, 0.0)]
    tube = ("cylinder", (width, width, 2 * half), 0.0)
    return [tube] if shape.kind == "cylinder" else [tube, ("sphere", ball, half), ("sphere", ball, -half)]


def drawable(layout: CourseLayout) -> list[Shape]:
    """The obstacles and walls of a layout's first row in the world frame; a seesaw as it stands before the robot."""
    shapes: list[Shape] = []
    position, quaternion, angle = (x[0] for x in layout.poses())
    angles = iter(angle.tolist())

    def add(piece: Sequence[simulation.Shape], place: Tensor, turn: Tensor) -> None:
        for shape in piece:
            middle = place + rotations.rotate(turn, torch.tensor(shape.position))
            own = rotations.multiply(turn, torch.tensor(shape.quaternion))
            for kind, size, along in parts(shape):
                centre = middle + rotations.rotate(own, torch.tensor([0.0, 0.0, along]))
                shapes.append(Shape(kind, size, tuple(centre.tolist()), tuple(own.tolist()), shape.colour))

    for piece, place, turn in zip(layout.pieces, position, quaternion, strict=True):
        add(piece.shapes, place, turn)
        if (hinge := piece.hinge) is not None:
            half = next(angles) / 2
            swing = torch.cat((torch.tensor([half]).cos(), torch.tensor([half]).sin() * torch.tensor(hinge.axis)))
            at = place + rotations.rotate(turn, torch.tensor(hinge.position))
            add(hinge.shapes, at, rotations.multiply(turn, swing))
    return shapes


def view(course: Course, episode: Episode, goal_radius: float) -> PlanView:
    """One episode as it is drawn."""
    layout = layout_of(course, episode)
    labels = []
    for place, index in enumerate(layout.route[0, : layout.length[0]].tolist()):
        kind, direction = layout.kinds[index], layout.yaw[0, index].item()
        along, aside = kind.half_extents  # a short obstacle's name stands behind it, a long one's beside it
        aside = max(min(aside, 0.45), *(abs(y) + 0.15 for _, y in course.slots[index].goals))
        beside = torch.tensor([[max(0.0, 0.7 - along), -0.25 - aside]])
        x, y = layout.world(torch.tensor([index]), beside)[0].tolist()
        name = kind.name.replace("_", " ")
        labels.append((f"{place + 1} {name}" if layout.length[0] > 1 else name, (x, y), direction))
    seconds = len(episode.steps) * CONTROL_DT
    ending = episode.cause.replace("_", " ")
    result = f"failed after {seconds:.1f} s: {ending}" if ending else f"passed in {seconds:.1f} s"
    return PlanView(
        course.size,
        drawable(layout),
        labels,
        way_points(layout),
        goal_radius,
        episode.path,
        episode.steps["behaviour"],
        episode.success,
        f"{course.name.replace('_', ' ')}: {result}",
        episode.path[1:][episode.collisions().any(-1)],
    )


def typical(episodes: Sequence[Episode]) -> list[Episode]:
    """The success of median time and the failure that came farthest along its route, as far as there are any."""
    successes = sorted((episode for episode in episodes if episode.success), key=lambda episode: len(episode.steps))
    failures = [episode for episode in episodes if not episode.success]
    chosen = successes[len(successes) // 2 : len(successes) // 2 + 1]
    return chosen + sorted(failures, key=lambda episode: -int(episode.passed.sum()))[:1]
