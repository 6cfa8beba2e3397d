"""The numbers of the robot agree with each other."""

from __future__ import annotations

import pytest

from agility_rl.go2 import constants


def test_one_entry_a_joint() -> None:
    for values in (
        constants.JOINT_NAMES,
        constants.ACTUATOR_NAMES,
        constants.DEFAULT_POSE,
        constants.ACTION_SCALE,
        constants.JOINT_LOWER,
        constants.JOINT_UPPER,
        constants.TORQUE_LIMIT,
        constants.VELOCITY_LIMIT,
    ):
        assert len(values) == constants.NUM_JOINTS == 12


def test_names_are_ordered_leg_by_leg() -> None:
    assert constants.JOINT_NAMES[:4] == ("FL_hip_joint", "FL_thigh_joint", "FL_calf_joint", "FR_hip_joint")
    assert constants.ACTUATOR_NAMES[-1] == "RR_calf"


def test_contact_groups_are_where_their_indices_say() -> None:
    groups = constants.CONTACT_GROUPS
    assert len(groups) == 17 and groups[constants.TRUNK_GROUP] == "trunk"
    for indices, link in (
        (constants.HIP_GROUPS, "hip"),
        (constants.THIGH_GROUPS, "thigh"),
        (constants.CALF_GROUPS, "calf"),
        (constants.FOOT_GROUPS, "foot"),
    ):
        assert [groups[i] for i in indices] == [f"{leg}_{link}" for leg in constants.LEGS]


def test_default_pose_is_within_the_limits() -> None:
    for low, angle, high in zip(constants.JOINT_LOWER, constants.DEFAULT_POSE, constants.JOINT_UPPER, strict=True):
        assert low < angle < high


def test_hip_actions_are_halved() -> None:
    assert constants.ACTION_SCALE[:3] == (0.125, 0.25, 0.25)


def test_soft_limits_by_hand() -> None:
    lower, upper = constants.soft_joint_limits()
    # Hip: 0.9 of +-1.0472. Front thigh: middle 0.95995, half range 2.53075, of which 0.9 is 2.277675.
    assert lower[:2] == pytest.approx((-0.94248, -1.317725))
    assert upper[:2] == pytest.approx((0.94248, 3.237625))


def test_control_period_is_whole_physics_steps() -> None:
    assert pytest.approx(4.0) == constants.CONTROL_DT / constants.SIM_DT
