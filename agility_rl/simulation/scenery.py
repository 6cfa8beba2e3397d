"""Rigid pieces that stand around a robot and that every simulation may place for itself, without a new model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import torch

from agility_rl import rotations

PARKED_DEPTH = -10.0
"""Height at which pieces wait that no one has placed yet [m]: below the ground, out of every robot's reach."""

_KINDS = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, 3),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, 2),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, 2),
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, 1),
}


@dataclass(frozen=True)
class Shape:
    """A primitive in the frame of its piece.

    Attributes:
        kind: what it is.
        size: half extents of a box; radius of a sphere; radius and half length of a cylinder or capsule (along z) [m].
        position: of its centre [m].
        quaternion: of its frame (w, x, y, z).
        colour: red, green, blue, opacity.
    """

    kind: Literal["box", "cylinder", "capsule", "sphere"]
    size: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    colour: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise ValueError(f"a shape must be one of {', '.join(_KINDS)}, got {self.kind!r}")
        if len(self.size) != _KINDS[self.kind][1] or min(self.size) <= 0.0:
            raise ValueError(f"a {self.kind} needs {_KINDS[self.kind][1]} positive sizes in metres, got {self.size}")


@dataclass(frozen=True)
class Hinge:
    """The part of a piece that turns freely about an axis.

    Attributes:
        shapes: what turns, in the frame of the hinge.
        mass: of all of it [kg].
        position: of the hinge in the frame of the piece [m].
        axis: unit vector.
        limits: lowest and highest angle [rad].
        damping: viscous friction [N m s/rad].
    """

    shapes: tuple[Shape, ...]
    mass: float
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    limits: tuple[float, float] = (-0.1, 0.1)
    damping: float = 0.0

    def resting(self) -> list[tuple[Shape, tuple[float, ...], tuple[float, ...]]]:
        """What turns, with position [m] and quaternion (w, x, y, z) in the frame of the piece, at the lowest angle."""
        half = 0.5 * self.limits[0]
        turn = torch.tensor([math.cos(half), *(math.sin(half) * along for along in self.axis)])
        placed = []
        for shape in self.shapes:
            position = torch.tensor(self.position) + rotations.rotate(turn, torch.tensor(shape.position))
            quaternion = rotations.multiply(turn, torch.tensor(shape.quaternion))
            placed.append((shape, tuple(position.tolist()), tuple(quaternion.tolist())))
        return placed


@dataclass(frozen=True)
class Piece:
    """Shapes that are placed together; robots collide with them, they do not collide with each other.

    Attributes:
        name: unique in a simulation.
        shapes: what stands still.
        hinge: what turns.

    Example:
        >>> Piece("step", (Shape("box", (0.5, 0.5, 0.15)),)).hinge is None
        True
    """

    name: str
    shapes: tuple[Shape, ...]
    hinge: Hinge | None = None


def add_scenery(spec: mujoco.MjSpec, pieces: Sequence[Piece]) -> None:
    """Add pieces to a robot's model as mocap bodies, whose poses are state; a hinge is a child body of one.

    Friction and softness of their contacts are those of the geom ``floor``.

    Raises:
        ValueError: if two pieces have one name.

    Example:
        >>> from agility_rl.go2.model import build_spec
        >>> spec = build_spec()
        >>> add_scenery(spec, [Piece("step", (Shape("box", (0.5, 0.5, 0.15)),))])
        >>> spec.compile().nmocap
        1
    """
    names = [piece.name for piece in pieces]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"pieces of scenery need names of their own, got {', '.join(twice)} more than once")
    for piece in pieces:
        body = spec.worldbody.add_body(name=piece.name, mocap=True, pos=(0.0, 0.0, PARKED_DEPTH))
        _add_shapes(spec, body, piece.shapes)
        if piece.hinge is not None:
            hinge = piece.hinge
            child = body.add_body(name=f"{piece.name}/moving", pos=hinge.position)
            joint = child.add_joint(
                name=hinge_name(piece), type=mujoco.mjtJoint.mjJNT_HINGE, axis=hinge.axis, range=hinge.limits
            )
            joint.damping = (hinge.damping, 0.0, 0.0)  # linear coefficient only
            _add_shapes(spec, child, hinge.shapes, mass=hinge.mass / len(hinge.shapes))


def hinge_name(piece: Piece) -> str:
    """Name of the joint of a piece that has a hinge."""
    return f"{piece.name}/hinge"


def _add_shapes(spec: mujoco.MjSpec, body: mujoco.MjsBody, shapes: Sequence[Shape], mass: float = 0.0) -> None:
    floor = spec.geom("floor")
    for number, shape in enumerate(shapes):
        body.add_geom(
            name=f"{body.name}/{number}",
            type=_KINDS[shape.kind][0],
            size=(*shape.size, 0.0, 0.0)[:3],
            pos=shape.position,
            quat=shape.quaternion,
            rgba=shape.colour,
            mass=mass,
            contype=floor.contype,
            conaffinity=floor.conaffinity,
            condim=floor.condim,
            priority=floor.priority,
            friction=floor.friction,
            solref=floor.solref,
        )
