"""A course around one robot: obstacles where the course says, and the robot's start as the origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.envs.arena import START_BEHIND
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.layout import CourseLayout
from agility_rl.go2.model import build_spec
from agility_rl.simulation.scenery import Piece, add_scenery

FLOOR = ("type", "size", "contype", "conaffinity", "condim", "priority", "friction", "solref")
"""What a course takes over from the floor on which it stands."""
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

    return lambda spec: add_course(spec, layout.pieces, position, quaternion)


def add_course(spec: mujoco.MjSpec, pieces: Sequence[Piece], position: Tensor, quaternion: Tensor) -> None:
    """Add pieces to a robot's model where they stand, ``[P, 3]`` [m] and ``[P, 4]``, with walls to see through."""
    add_scenery(spec, pieces)
    for piece, at, turn in zip(pieces, position.tolist(), quaternion.tolist(), strict=True):
        body = spec.body(piece.name)
        body.pos, body.quat = at, turn
        if piece.name.startswith("wall"):
            for geom in body.geoms:
                geom.rgba = (*geom.rgba[:3], SEE_THROUGH)


def write_world(name: str, seed: int, file: Path) -> None:
    """The same course as an MJCF file, for a robot in another process (:func:`agility_rl.deploy.simulated.add_world`).

    Raises:
        ValueError: if there is no such course.
    """
    add = surround(name, seed)
    robot, world = build_spec().geom("floor"), mujoco.MjSpec()
    like = {entry: getattr(robot, entry) for entry in FLOOR}
    floor = world.worldbody.add_geom(name="floor", **like)
    add(world)
    world.delete(floor)  # the robot has brought its own
    file.write_text(world.to_xml(), encoding="utf-8")
