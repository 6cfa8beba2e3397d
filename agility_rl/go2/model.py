"""Builds the Go2's MuJoCo model from primitives: no mesh, no download.

Source of masses, inertias and collision shapes (but for the length of the thighs'): MuJoCo Menagerie
``unitree_go2/go2.xml`` (BSD-3-Clause, Unitree Robotics), see NOTICE in LICENSE. Structure, sensors and actuators are
our own.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from agility_rl.go2 import constants

ROBOT_GROUP = 3
"""Geom group of the robot's shapes; rays and cameras may leave it out."""

# One side's numbers; the other legs follow by mirroring. Inertial frames are quaternions of the left front leg.
_TRUNK_INERTIAL = ((0.021112, 0.0, -0.005366), (-0.000543471, 0.713435, -0.00173769, 0.700719), 6.921)
_TRUNK_INERTIA = (0.107027, 0.0980771, 0.0244531)
_HIP_INERTIA = (0.00088403, 0.000596003, 0.000479967)
_THIGH_INERTIA = (0.00594973, 0.00584149, 0.000878787)
_CALF_INERTIA = (0.0014901, 0.00146356, 5.31397e-05)
_HIP_FRAME = {
    "FL": (0.497014, 0.499245, 0.505462, 0.498237),
    "FR": (0.498237, 0.505462, 0.499245, 0.497014),
    "RL": (0.505462, 0.498237, 0.497014, 0.499245),
    "RR": (0.499245, 0.497014, 0.498237, 0.505462),
}
_THIGH_FRAME = {"L": (0.829533, 0.0847635, -0.0200632, 0.551623), "R": (0.551623, -0.0200632, 0.0847635, 0.829533)}
_CALF_FRAME = {"L": (0.710672, 0.00154099, -0.00450087, 0.703508), "R": (0.703508, -0.00450087, 0.00154099, 0.710672)}


_CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}


def build_spec(
    *,
    sim_dt: float = constants.SIM_DT,
    stiffness: float | Sequence[float] = constants.STIFFNESS,
    damping: float | Sequence[float] = constants.DAMPING,
    joint_damping: float = constants.JOINT_DAMPING,
    armature: float = constants.ARMATURE,
    friction_loss: float = constants.FRICTION_LOSS,
    torque_limit: Sequence[float] = constants.TORQUE_LIMIT,
    ground_friction: float = 1.0,
    contact_time: float = 0.02,
    cone: Literal["pyramidal", "elliptic"] = "pyramidal",
    self_collision: bool = False,
    heights: np.ndarray | None = None,
    height_field_size: tuple[float, float] = (10.0, 10.0),
    iterations: int = 10,
    ls_iterations: int = 10,
    skin: Path | None = None,
) -> mujoco.MjSpec:
    """Model of one Go2 on a floor or a height field.

    Twelve position actuators carry the PD controller, so that the engine computes it in every physics step; sensors
    measure the IMU, the joints, and the net contact force of the 17 groups of
    :data:`agility_rl.go2.constants.CONTACT_GROUPS`.

    Source: method notes, section 4.1; geometry as named at the head of this module.

    Args:
        sim_dt: physics step [s].
        stiffness: proportional gain [N m/rad], one number or twelve.
        damping: derivative gain [N m s/rad], one number or twelve.
        joint_damping: viscous friction [N m s/rad].
        armature: rotor inertia [kg m^2].
        friction_loss: dry friction [N m].
        torque_limit: twelve limits [N m].
        ground_friction: sliding friction coefficient.
        contact_time: time constant of contacts with the ground [s]: the engine's 0.02, larger is softer.
        cone: shape of the friction cone.
        self_collision: let the robot's own links collide with each other.
        heights: height field [rows (y), columns (x)] in metres instead of a plane.
        height_field_size: half sizes of the height field in x and y [m].
        iterations: most solver iterations of a physics step.
        ls_iterations: most line-search iterations.
        skin: folder with the Menagerie's meshes (``base_0.obj`` ...), for looks only.

    Raises:
        ValueError: if a list does not have twelve entries, ``skin`` lacks a mesh, there is no such ``cone``, or
            ``contact_time`` is too short for ``sim_dt``.

    Example:
        >>> model = build_spec().compile()
        >>> (model.nq, model.nv, model.nu, round(float(model.body_mass.sum()), 4))
        (19, 18, 12, 15.2064)
    """
    spec = mujoco.MjSpec()
    spec.modelname = "go2"
    spec.compiler.autolimits = True
    spec.compiler.degree = False
    spec.option.timestep = sim_dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if cone not in _CONES:
        raise ValueError(f"cone must be one of {', '.join(_CONES)}, got {cone!r}")
    if contact_time < 2.0 * sim_dt:
        raise ValueError(f"contact_time must be at least twice sim_dt, {2.0 * sim_dt} s, got {contact_time}")
    spec.option.cone = _CONES[cone]
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # MuJoCo 4.0.0 has a bug with sparse ones
    spec.option.iterations = iterations
    spec.option.ls_iterations = ls_iterations
    _add_ground(spec, ground_friction, contact_time, heights, height_field_size)

    trunk = spec.worldbody.add_body(name="trunk", pos=(0.0, 0.0, constants.STANDING_HEIGHT))
    trunk.add_freejoint(name="root")
    position, frame, mass = _TRUNK_INERTIAL
    _set_inertial(trunk, position, frame, mass, _TRUNK_INERTIA)
    collide: dict[str, Any] = {"contype": int(self_collision), "conaffinity": 1, "condim": 1, "group": ROBOT_GROUP}
    collide |= {"friction": (0.6, 0.005, 0.0001), "mass": 0.0, "rgba": (0.55, 0.57, 0.62, 1.0)}
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    trunk.add_geom(name="trunk", type=box, size=(0.1881, 0.04675, 0.057), **collide)
    trunk.add_geom(name="head", type=cylinder, size=(0.05, 0.045, 0), pos=(0.285, 0, 0.01), **collide)
    trunk.add_geom(
        name="snout", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.047, 0, 0), pos=(0.293, 0, -0.06), **collide
    )
    trunk.add_site(name="imu", pos=constants.IMU_POSITION)

    gains = np.broadcast_to(stiffness, 12), np.broadcast_to(damping, 12)
    if len(torque_limit) != constants.NUM_JOINTS:
        raise ValueError(f"torque_limit must have {constants.NUM_JOINTS} entries, got {len(torque_limit)}")
    for index, leg in enumerate(constants.LEGS):
        _add_leg(spec, trunk, index, leg, collide, (joint_damping, armature, friction_loss), gains, torque_limit)
    _add_sensors(spec)
    if skin is not None:
        _add_skin(spec, Path(skin))
    return spec


def _add_ground(
    spec: mujoco.MjSpec, friction: float, contact_time: float, heights: np.ndarray | None, size: tuple[float, float]
) -> None:
    floor = {"name": "floor", "contype": 1, "conaffinity": 0, "condim": 3, "friction": (friction, 0.005, 0.0001)}
    floor |= {"priority": 1, "solref": (contact_time, 1.0), "rgba": (0.32, 0.36, 0.3, 1.0)}
    spec.worldbody.add_light(pos=(0, 0, 4), dir=(0.2, 0.2, -1), type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    if heights is None:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), **floor)
        return
    heights = np.asarray(heights, dtype=np.float64)
    low, span = float(heights.min()), max(float(np.ptp(heights)), 1e-3)
    spec.add_hfield(
        name="terrain",
        nrow=heights.shape[0],
        ncol=heights.shape[1],
        size=(*size, span, 0.5),
        userdata=((heights - low) / span).astype(np.float32).flatten(),
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="terrain", pos=(0, 0, low), **floor)


def _set_inertial(body, position, frame, mass, inertia) -> None:  # type: ignore[no-untyped-def]
    body.explicitinertial = True
    body.ipos, body.iquat, body.mass, body.inertia = position, frame, mass, inertia


def _add_leg(spec, trunk, index, leg, collide, passive, gains, torque_limit) -> None:  # type: ignore[no-untyped-def]
    front, left = (1.0 if leg[0] == "F" else -1.0), (1.0 if leg[1] == "L" else -1.0)
    side = leg[1]
    damping, armature, friction_loss = passive

    def add_joint(body, link, axis):  # type: ignore[no-untyped-def]
        at = 3 * index + constants.LINKS.index(link)
        limits = (constants.JOINT_LOWER[at], constants.JOINT_UPPER[at])
        joint = body.add_joint(
            name=constants.JOINT_NAMES[at],
            axis=axis,
            range=limits,
            armature=armature,
            frictionloss=friction_loss,
        )
        joint.damping = (damping, 0.0, 0.0)  # linear coefficient only
        stiffness, velocity_gain, limit = float(gains[0][at]), float(gains[1][at]), float(torque_limit[at])
        actuator = spec.add_actuator(
            name=constants.ACTUATOR_NAMES[at],
            target=constants.JOINT_NAMES[at],
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcerange=(-limit, limit),
        )
        actuator.set_to_position(kp=stiffness, kv=velocity_gain)

    cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
    hip = trunk.add_body(name=f"{leg}_hip", pos=(front * constants.HIP_OFFSET_X, left * constants.HIP_OFFSET_Y, 0))
    _set_inertial(hip, (-front * 0.0054, left * 0.00194, -0.000105), _HIP_FRAME[leg], 0.678, _HIP_INERTIA)
    add_joint(hip, "hip", (1, 0, 0))
    hip.add_geom(
        name=f"{leg}_hip", type=cylinder, size=(0.046, 0.02, 0), pos=(0, left * 0.08, 0), quat=(1, 1, 0, 0), **collide
    )
    thigh = hip.add_body(name=f"{leg}_thigh", pos=(0, left * constants.ABDUCTION, 0))
    _set_inertial(thigh, (-0.00374, -left * 0.0223, -0.0327), _THIGH_FRAME[side], 1.152, _THIGH_INERTIA)
    add_joint(thigh, "thigh", (0, 1, 0))
    thigh.add_geom(
        name=f"{leg}_thigh",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(constants.THIGH_BOX / 2, 0.01225, 0.017),
        pos=(0, 0, -constants.THIGH / 2),
        quat=(0.5**0.5, 0, 0.5**0.5, 0),
        **collide,
    )
    calf = thigh.add_body(name=f"{leg}_calf", pos=(0, 0, -constants.THIGH))
    _set_inertial(calf, (0.00629595, -left * 0.000622121, -0.141417), _CALF_FRAME[side], 0.241352, _CALF_INERTIA)
    add_joint(calf, "calf", (0, 1, 0))
    upper = {"size": (0.012, 0.06, 0), "pos": (0.008, 0, -0.06), "quat": (0.994493, 0, -0.104807, 0)}
    if leg != "FL":
        upper = {"size": (0.013, 0.06, 0), "pos": (0.01, 0, -0.06), "quat": (0.995004, 0, -0.0998334, 0)}
    calf.add_geom(name=f"{leg}_calf", type=cylinder, **upper, **collide)
    calf.add_geom(
        name=f"{leg}_shin",
        type=cylinder,
        size=(0.011, 0.0325, 0),
        pos=(0.02, 0, -0.148),
        quat=(0.999688, 0, 0.0249974, 0),
        **collide,
    )
    # The foot is a body of its own, welded to the calf, so that its contact can be told from the calf's.
    foot = calf.add_body(name=f"{leg}_foot", pos=(constants.FOOT_OFFSET_X, 0, -constants.CALF))
    foot.add_geom(
        name=f"{leg}_foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(constants.FOOT_RADIUS, 0, 0),
        **{**collide, "condim": 3, "friction": (0.8, 0.02, 0.01), "rgba": (0.1, 0.1, 0.1, 1.0)},
    )
    foot.explicitinertial = True
    foot.mass, foot.inertia = 0.0, (0.0, 0.0, 0.0)


def _add_sensors(spec: mujoco.MjSpec) -> None:
    sensor, kind = mujoco.mjtSensor, mujoco.mjtObj
    force_only, net_force = 2, 3  # "data" and "reduce" of a contact sensor
    for body in constants.CONTACT_GROUPS:
        spec.add_sensor(
            name=f"{body}_contact",
            type=sensor.mjSENS_CONTACT,
            objtype=kind.mjOBJ_BODY,
            objname=body,
            intprm=(force_only, net_force, 1),
        )
    for name, measured in (
        ("orientation", sensor.mjSENS_FRAMEQUAT),
        ("gyro", sensor.mjSENS_GYRO),
        ("accelerometer", sensor.mjSENS_ACCELEROMETER),
    ):
        spec.add_sensor(name=name, type=measured, objtype=kind.mjOBJ_SITE, objname="imu")
    for name, measured in (("position", sensor.mjSENS_JOINTPOS), ("velocity", sensor.mjSENS_JOINTVEL)):
        for joint in constants.JOINT_NAMES:
            spec.add_sensor(name=f"{joint}_{name}", type=measured, objtype=kind.mjOBJ_JOINT, objname=joint)


def _add_skin(spec: mujoco.MjSpec, folder: Path) -> None:
    """Add the Menagerie's meshes as shapes that touch nothing, and hide the primitives."""
    parts = {"trunk": [f"base_{i}" for i in range(5)]}
    for leg in constants.LEGS:
        mirrored = "mirror_" if leg[1] == "R" else ""
        parts[f"{leg}_hip"] = ["hip_0", "hip_1"]
        parts[f"{leg}_thigh"] = [f"thigh_{mirrored}0", f"thigh_{mirrored}1"]
        parts[f"{leg}_calf"] = [f"calf_{mirrored}0", f"calf_{mirrored}1"]
        parts[f"{leg}_foot"] = ["foot"]
    names = {name for meshes in parts.values() for name in meshes}
    if missing := sorted(name for name in names if not (folder / f"{name}.obj").is_file()):
        raise ValueError(f"skin folder {folder} lacks {', '.join(f'{name}.obj' for name in missing)}")
    for name in sorted(names):
        spec.add_mesh(name=name, file=str((folder / f"{name}.obj").resolve()))
    turned = {"FR_hip": (0, 1, 0, 0), "RL_hip": (0, 0, 1, 0), "RR_hip": (0, 0, 0, 1)}
    for body, meshes in parts.items():
        for name in meshes:
            spec.body(body).add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                quat=turned.get(body, (1, 0, 0, 0)),
                pos=(-constants.FOOT_OFFSET_X, 0, 0) if name == "foot" else (0, 0, 0),
                contype=0,
                conaffinity=0,
                group=2,
                mass=0.0,
            )
    for geom in spec.geoms:
        if geom.group == ROBOT_GROUP:
            geom.rgba = (*geom.rgba[:3], 0.0)
