"""A course around one robot: obstacles where the course says, and the robot's start as the origin."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import torch

from agility_rl import rotations
from agility_rl.envs.arena import START_BEHIND
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.layout import CourseLayout
from agility_rl.simulation.scenery import add_scenery

SEE_THROUGH = 0.25
"""Opacity of the walls, for the sake of whoever looks over them."""


def surround(name: str, seed: int) -> Callable[[mujoco.MjSpec], None]:
    """What adds a course to a robot's model; the robot starts at the origin, before the first obstacle, towards it.

    Raises:
        ValueError: if there is no such course.
    """
    if name not in COURSES:
        raise ValueError(f"expected --course to be one of {', '.join(COURSES)}, got {name!r}")
    course = COURSES[name]
    layout = CourseLayout(course, 1, torch.Generator().manual_seed(seed))
    layout.draw(torch.ones(1, dtype=torch.bool))
    first = layout.route[:, 0]
    goal = torch.tensor([course.slots[int(first)].goals[0]]) - torch.tensor([[START_BEHIND, 0.0]])
    start = torch.cat((layout.world(first, goal)[0], torch.zeros(1)))
    half = -layout.yaw[0, first] / 2
    turn = torch.cat((half.cos(), torch.zeros(2), half.sin()))
    position, quaternion, _ = (rows[0] for rows in layout.poses())
    position = rotations.rotate(turn.expand(len(position), 4), position - start)
    quaternion = rotations.multiply(turn.expand(len(quaternion), 4), quaternion)

    def add(spec: mujoco.MjSpec) -> None:
        add_scenery(spec, layout.pieces)
        for piece, at, to in zip(layout.pieces, position.tolist(), quaternion.tolist(), strict=True):
            body = spec.body(piece.name)
            body.pos, body.quat = at, to
            if piece.name.startswith("wall"):
                for geom in body.geoms:
                    geom.rgba = (*geom.rgba[:3], SEE_THROUGH)

    return add
