"""The robot and its surroundings as Foxglove primitives: frames of the 13 bodies, and shapes fixed to frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity

from agility_rl.go2 import constants

WORLD = "world"
TRUNK = "trunk"
BODIES = (TRUNK, *(f"{leg}_{link}" for leg in constants.LEGS for link in constants.LINKS))
"""The 13 moving frames."""

GREY, DARK, ORANGE, BROWN = (0.75, 0.77, 0.8, 1.0), (0.25, 0.27, 0.3, 1.0), (1.0, 0.45, 0.05, 1.0), (0.6, 0.5, 0.4, 1.0)
_HALF_TURN = math.sqrt(0.5)


@dataclass(frozen=True)
class Shape:
    """A box, cylinder or sphere fixed to a frame; obstacles are given in the world frame.

    Attributes:
        kind: ``box``, ``cylinder`` (axis z) or ``sphere``.
        size: full extents along x, y, z [m].
        position: centre in the frame [m].
        quaternion: ``(w, x, y, z)``, from the shape to the frame.
        color: red, green, blue, opacity, each 0..1.

    Raises:
        ValueError: if the kind is another, or a size is not positive.

    Example:
        >>> Shape("box", (1.0, 0.1, 0.3), (2.0, 0.0, 0.15)).color[3]
        1.0
    """

    kind: str
    size: tuple[float, float, float]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    color: tuple[float, float, float, float] = BROWN

    def __post_init__(self) -> None:
        if self.kind not in ("box", "cylinder", "sphere"):
            raise ValueError(f"expected a box, cylinder or sphere, got {self.kind!r}")
        if min(self.size) <= 0.0:
            raise ValueError(f"expected positive sizes [m] of a {self.kind}, got {self.size}")


def entity(identity: str, frame: str, shapes: Sequence[Shape]) -> SceneEntity:
    """Shapes that move with a frame, as one Foxglove entity; sent again, it replaces the former one.

    Example:
        >>> entity("bar", "world", [Shape("box", (1.0, 0.1, 0.1))]).cubes[0].size.x
        1.0
    """
    result = SceneEntity(id=identity, frame_id=frame, frame_locked=True)
    for shape in shapes:
        if shape.kind == "box":
            primitive: Any = result.cubes.add()
        elif shape.kind == "sphere":
            primitive = result.spheres.add()
        else:
            primitive = result.cylinders.add(bottom_scale=1.0, top_scale=1.0)
        primitive.size.x, primitive.size.y, primitive.size.z = shape.size
        set_pose(primitive.pose.position, primitive.pose.orientation, shape.position, shape.quaternion)
        primitive.color.r, primitive.color.g, primitive.color.b, primitive.color.a = shape.color
    return result


def robot_entities() -> list[SceneEntity]:
    """Trunk, head, hips, thighs and calves; the feet are separate, because contact colours them.

    Source: the sizes of the model's collision primitives (MuJoCo Menagerie, ``unitree_go2``), simplified.
    """
    trunk = [
        Shape("box", (0.376, 0.094, 0.114), color=GREY),
        Shape("sphere", (0.09, 0.09, 0.09), (0.285, 0, 0.01), color=DARK),
    ]
    entities = [entity(TRUNK, TRUNK, trunk)]
    sideways = (_HALF_TURN, _HALF_TURN, 0.0, 0.0)  # turns a cylinder's axis from z to y
    for leg in constants.LEGS:
        outwards = 1.0 if leg.endswith("L") else -1.0
        hip = Shape("cylinder", (0.092, 0.092, 0.04), (0.0, 0.08 * outwards, 0.0), sideways, GREY)
        thigh = Shape("box", (0.034, 0.0245, constants.THIGH), (0.0, 0.0, -constants.THIGH / 2), color=DARK)
        calf = Shape("cylinder", (0.026, 0.026, constants.CALF), (0.0, 0.0, -constants.CALF / 2), color=GREY)
        for link, shape in zip(constants.LINKS, (hip, thigh, calf), strict=True):
            entities.append(entity(f"{leg}_{link}", f"{leg}_{link}", [shape]))
    return entities


def foot_entity(leg: str, contact: bool) -> SceneEntity:
    """Foot of a leg, orange while it touches something."""
    diameter = 2 * constants.FOOT_RADIUS
    centre = (constants.FOOT_OFFSET_X, 0.0, -constants.CALF)
    shape = Shape("sphere", (diameter, diameter, diameter), centre, color=ORANGE if contact else DARK)
    return entity(f"{leg}_foot", f"{leg}_calf", [shape])


def body_transforms(
    root_position: Sequence[float], root_quaternion: Sequence[float], joint_position: Sequence[float]
) -> list[FrameTransform]:
    """Pose of every body in its parent: 13 transforms, trunk first.

    .. math:: T_{hip} = (x_h, y_h, 0) R_x(q_0), T_{thigh} = (0, y_a, 0) R_y(q_1), T_{calf} = (0, 0, -l) R_y(q_2)

    Source: the Go2's joint axes (MuJoCo Menagerie, ``unitree_go2``), lengths of :mod:`agility_rl.go2.constants`.

    Args:
        root_position: 3 [m], world frame.
        root_quaternion: 4, ``(w, x, y, z)``.
        joint_position: 12 [rad].

    Example:
        >>> transforms = body_transforms((0.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0), (0.0,) * 12)
        >>> len(transforms), transforms[3].parent_frame_id, transforms[3].translation.z
        (13, 'FL_thigh', -0.213)
    """
    result = [_transform(WORLD, TRUNK, root_position, root_quaternion)]
    for index, leg in enumerate(constants.LEGS):
        hip, thigh, calf = joint_position[3 * index : 3 * index + 3]
        ahead = 1.0 if leg.startswith("F") else -1.0
        left = 1.0 if leg.endswith("L") else -1.0
        offset = (constants.HIP_OFFSET_X * ahead, constants.HIP_OFFSET_Y * left, 0.0)
        result += [
            _transform(TRUNK, f"{leg}_hip", offset, (math.cos(hip / 2), math.sin(hip / 2), 0.0, 0.0)),
            _transform(f"{leg}_hip", f"{leg}_thigh", (0.0, constants.ABDUCTION * left, 0.0), _about_y(thigh)),
            _transform(f"{leg}_thigh", f"{leg}_calf", (0.0, 0.0, -constants.THIGH), _about_y(calf)),
        ]
    return result


def set_pose(point: Any, rotation: Any, position: Sequence[float], quaternion: Sequence[float]) -> None:
    """Fill a Foxglove vector and quaternion from a position and a quaternion ``(w, x, y, z)``."""
    point.x, point.y, point.z = position
    rotation.w, rotation.x, rotation.y, rotation.z = quaternion


def _about_y(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)


def _transform(parent: str, child: str, position: Sequence[float], quaternion: Sequence[float]) -> FrameTransform:
    result = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    set_pose(result.translation, result.rotation, position, quaternion)
    return result
