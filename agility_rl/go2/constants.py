"""The Unitree Go2 as numbers, each with its source.

Joint order everywhere: FL, FR, RL, RR x (hip, thigh, calf). Foot order: FL, FR, RL, RR. SI units.

Sources: [M] MuJoCo Menagerie ``unitree_go2/go2.xml`` (BSD-3-Clause, Unitree Robotics); [P] the URDF and configuration
published with "Learning Diverse Natural Behaviors for Enhancing the Agility of Quadrupedal Robots" (2025).
"""

from __future__ import annotations

import functools

LEGS = ("FL", "FR", "RL", "RR")
"""Front left, front right, rear left, rear right: the order of legs, joints and feet."""

LINKS = ("hip", "thigh", "calf")
"""The moving links of a leg, from the trunk outwards."""

NUM_JOINTS = 12

JOINT_NAMES = tuple(f"{leg}_{link}_joint" for leg in LEGS for link in LINKS)
"""Names of the 12 joints in the model [M]."""

ACTUATOR_NAMES = tuple(f"{leg}_{link}" for leg in LEGS for link in LINKS)
"""Names of the 12 actuators in the model [M]."""

CONTACT_GROUPS = ("trunk", *(f"{leg}_{link}" for leg in LEGS for link in (*LINKS, "foot")))
"""The 17 body groups whose contact force is measured; the trunk includes the head."""

TRUNK_GROUP = 0
HIP_GROUPS = (1, 5, 9, 13)
THIGH_GROUPS = (2, 6, 10, 14)
CALF_GROUPS = (3, 7, 11, 15)
FOOT_GROUPS = (4, 8, 12, 16)
"""Indices into :data:`CONTACT_GROUPS`, legs in the order of :data:`LEGS`."""

FOOT_PAIRS = ((0, 1), (2, 3), (0, 2), (1, 3), (0, 3), (1, 2))
"""Feet between which a gait has phases, in the order of :data:`LEGS`: FL-FR, RL-RR, FL-RL, FR-RR, FL-RR, FR-RL."""

# Posture and control -------------------------------------------------------------------------------------------------

DEFAULT_POSE = (0.0, 0.9, -1.8) * 4
"""Joint angles [rad] that an action of zero asks for. [P]"""

STIFFNESS = 40.0
"""Proportional gain of the joint position controller [N m/rad]. [P]"""

DAMPING = 1.0
"""Derivative gain of the joint position controller [N m s/rad]. [P]"""

ACTION_SCALE = (0.125, 0.25, 0.25) * 4
"""Joint angle [rad] of an action of one: 0.25, halved again at the hips. [P]"""

CONTROL_DT = 0.02
"""Period of the policy [s]. [P]"""

SIM_DT = 0.005
"""Physics time step [s]: four to a control step. [P]"""

# Limits --------------------------------------------------------------------------------------------------------------

JOINT_LOWER = (-1.0472, -1.5708, -2.7227) * 2 + (-1.0472, -0.5236, -2.7227) * 2
"""Lower joint stops [rad]. [M]"""

JOINT_UPPER = (1.0472, 3.4907, -0.83776) * 2 + (1.0472, 4.5379, -0.83776) * 2
"""Upper joint stops [rad]. [M]"""

SOFT_LIMIT_FACTOR = 0.9
"""Share of the joint range, about its middle, outside which a joint position is penalised. [P]"""

TORQUE_LIMIT = (20.0, 20.0, 40.0) * 4
"""Largest joint torques [N m]. [P]; the vendor states 23.7, 23.7 and 35.55 to 45.43."""

VELOCITY_LIMIT = (30.1, 30.1, 20.07) * 4
"""Largest joint speeds [rad/s]. [P], and the vendor's URDF."""

# Joints --------------------------------------------------------------------------------------------------------------

ARMATURE = 0.01
"""Rotor inertia seen at the joint [kg m^2]. [M]"""

FRICTION_LOSS = 0.2
"""Dry friction of a joint [N m]. [M]"""

JOINT_DAMPING = 0.1
"""Viscous friction of a joint [N m s/rad], beside the controller's :data:`DAMPING`.

[M] has 2, twice the controller's own gain; identified values lie between 0.10 and 0.30, so 0.1 is used here.
"""

# Geometry ------------------------------------------------------------------------------------------------------------

HIP_OFFSET_X = 0.1934
"""Distance of the hip joints ahead of, or behind, the trunk's origin [m]. [M]"""

HIP_OFFSET_Y = 0.0465
"""Distance of the hip joints left, or right, of the trunk's origin [m]. [M]"""

ABDUCTION = 0.0955
"""Distance from the hip joint outwards to the thigh joint [m]. [M]"""

THIGH = 0.213
"""Distance from the thigh joint to the calf joint [m]. [M]"""

THIGH_BOX = 0.11
"""Length of the thigh's collision box, half-way down the thigh [m] (robot description of the released code: method
notes, section 4.1; Menagerie's reaches down to the knee). So a knee that touches is the calf's, and no failure."""

CALF = 0.213
"""Distance from the calf joint down to the foot's centre [m]. [M]"""

FOOT_OFFSET_X = -0.002
"""Foot centre along the calf link's x [m]. [M]"""

FOOT_RADIUS = 0.022
"""Radius of the spherical foot [m]. [M]"""

IMU_POSITION = (-0.02557, 0.0, 0.04232)
"""The inertial measurement unit in the trunk's frame [m]. [M]"""

STANDING_HEIGHT = 0.2884
"""Trunk height [m] at which the soles touch flat ground in :data:`DEFAULT_POSE` (from the geometry above)."""

# Inertia -------------------------------------------------------------------------------------------------------------

GRAVITY = 9.81
"""MuJoCo's default [m/s^2]."""

TOTAL_MASS = 15.2064
"""Sum of the link masses [kg]. [M]"""

TRUNK_MASS = 6.921
"""Mass of the trunk with the head [kg]. [M]"""


@functools.cache
def soft_joint_limits() -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lower and upper joint positions [rad], of 12 joints each, at :data:`SOFT_LIMIT_FACTOR` of the range."""
    shrink = (1.0 - SOFT_LIMIT_FACTOR) / 2.0
    ranges = tuple(zip(JOINT_LOWER, JOINT_UPPER, strict=True))
    lower = tuple(low + shrink * (high - low) for low, high in ranges)
    return lower, tuple(high - shrink * (high - low) for low, high in ranges)
