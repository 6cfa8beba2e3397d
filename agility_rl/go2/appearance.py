"""How the Go2 and its world look to a person: visible shapes, a chequered floor, light, sky."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from agility_rl.go2 import constants
from agility_rl.go2.model import ROBOT_GROUP

VISIBLE_GROUP = 0
"""Geom group that every viewer shows."""
BONE_GROUP = 2
"""Geom group of what only eyes see, and no camera of the robot; viewers show it too."""
_LIMB = (0.15, 0.15, 0.17, 1.0)
_TRUNK = (0.93, 0.55, 0.16, 1.0)
_SKY = ((0.62, 0.75, 0.88), (0.93, 0.95, 0.97))
_FLOOR = ((0.40, 0.45, 0.40), (0.46, 0.51, 0.46))


def dress(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Make a model worth looking at, without a change of its physics; returns it.

    The robot's shapes come into a visible group, unless a skin hides them, and its legs are joined by bones.

    Args:
        spec: what :func:`agility_rl.go2.model.build_spec` made, with whatever was added.

    Example:
        >>> from agility_rl.go2.model import build_spec
        >>> model = dress(build_spec()).compile()
        >>> sorted(set(model.geom_group.tolist()))
        [0, 2]
    """
    for geom in list(spec.geoms):
        if geom.group == ROBOT_GROUP and geom.rgba[3] > 0.0:
            geom.group = VISIBLE_GROUP
            if geom.name.endswith(("foot", "calf", "shin")):
                geom.rgba = _LIMB
            elif geom.name == "trunk":
                geom.rgba = _TRUNK
            elif geom.name.endswith("thigh"):
                _add_bones(spec, geom.name.removesuffix("_thigh"), geom.rgba)
    texture, chequer = mujoco.mjtTexture, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=_SKY[0],
        rgb2=_SKY[1],
        width=64,
        height=64,
    )
    spec.add_texture(
        name="floor", type=texture.mjTEXTURE_2D, builtin=chequer, rgb1=_FLOOR[0], rgb2=_FLOOR[1], width=256, height=256
    )
    material = spec.add_material(name="floor", texrepeat=(1.0, 1.0), texuniform=True, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = spec.geom("floor")
    floor.material, floor.rgba = "floor", (1.0, 1.0, 1.0, 1.0)
    spec.visual.headlight.ambient = (0.45, 0.45, 0.45)
    return spec


def _add_bones(spec: mujoco.MjSpec, leg: str, rgba: Sequence[float]) -> None:
    """Join what collides, of which thigh and calf have less than their length, by what is only seen."""
    for part, end, radius, colour in (
        ("thigh", (0.0, 0.0, -constants.THIGH), 0.016, rgba),
        ("calf", (constants.FOOT_OFFSET_X, 0.0, -constants.CALF), 0.010, _LIMB),
    ):
        spec.body(f"{leg}_{part}").add_geom(
            name=f"{leg}_{part}_bone",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(0.0, 0.0, 0.0, *end),
            size=(radius, 0.0, 0.0),
            rgba=colour,
            mass=0.0,
            contype=0,
            conaffinity=0,
            group=BONE_GROUP,
        )
