"""Every check by itself: what it lets pass, what it does not, and what it says."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from agility_rl import rotations
from agility_rl.deploy import safety
from agility_rl.deploy.artifact import build_manifest
from agility_rl.deploy.safety import Safety, SafetyLimits
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants

STANDING = RobotState.standing()


def state(**changes: torch.Tensor) -> RobotState:
    return replace(STANDING, **changes)


def joints(index: int, value: float) -> torch.Tensor:
    pose = torch.tensor(constants.DEFAULT_POSE)
    pose[index] = value
    return pose


def lean(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    return rotations.from_euler(torch.tensor(roll), torch.tensor(pitch), torch.tensor(yaw))


def test_a_standing_robot_is_fine() -> None:
    checks = Safety(SafetyLimits())
    assert checks.check_state(STANDING, now=0.05) is None
    assert checks.check_bus(constants.JOINT_NAMES, ()) is None
    assert checks.check_loop(0.4, {"operator": 0.0, "depth": 0.3}, missed=4) is None
    hold = JointCommand(STANDING.joint_position, torch.full((12,), 40.0), torch.ones(12))
    assert checks.check_command(hold, STANDING) is None


@pytest.mark.parametrize(
    ("changed", "check", "reason"),
    [
        ({"joint_velocity": torch.full((12,), float("nan"))}, "not a number", r"joint_velocity\[0\] is nan"),
        ({"quaternion": torch.tensor([1.0, 0.0, float("inf"), 0.0])}, "not a number", r"quaternion\[2\] is inf"),
        ({"trunk_position": torch.tensor([0.0, 0.0, float("nan")])}, "not a number", r"trunk_position\[2\]"),
        ({"joint_position": joints(2, 0.0)}, "joint limits", "joint 2 is at 0.00 rad, its stops are -2.72 and -0.84"),
        ({"joint_position": joints(3, -1.4)}, "joint limits", "joint 3 is at -1.40 rad"),
        ({"quaternion": torch.zeros(4)}, "orientation", "the quaternion has length 0.00, expected 1"),
        ({"quaternion": lean(roll=1.3)}, "tilt", "leans by 1.30 rad, expected at most 1.20"),
        ({"quaternion": lean(pitch=-1.3)}, "tilt", "leans by 1.30 rad"),
        ({"quaternion": lean(roll=1.0, pitch=1.0)}, "tilt", "the trunk leans"),
    ],
)
def test_states_that_end_a_run(changed: dict[str, torch.Tensor], check: str, reason: str) -> None:
    fault = Safety(SafetyLimits()).check_state(state(**changed), now=0.0)
    assert fault is not None and fault.check == check
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(fault.reason)


def test_turning_on_the_spot_is_no_tilt() -> None:
    assert Safety(SafetyLimits()).check_state(state(quaternion=lean(yaw=3.0, pitch=1.1)), now=0.0) is None


def test_swapped_joints_are_found_by_name_and_by_their_stops() -> None:
    checks = Safety(SafetyLimits())
    swapped = ("FR_hip_joint", *constants.JOINT_NAMES[1:3], "FL_hip_joint", *constants.JOINT_NAMES[4:])
    fault = checks.check_bus(swapped, ())
    assert fault is not None
    assert str(fault) == "joint order: joint 0 is 'FR_hip_joint', expected 'FL_hip_joint'"
    assert checks.check_bus(constants.JOINT_NAMES[:11], ()).reason == "there are 11 joints, expected 12"
    by_link = torch.tensor([0.0] * 4 + [0.9] * 4 + [-1.8] * 4)  # hips first, as some simulators have them
    assert checks.check_state(state(joint_position=by_link), 0.0).check == "joint limits"


def test_how_much_is_forgiven_by_default() -> None:
    upper = constants.JOINT_UPPER[2]
    for position, length, fine in ((upper + 0.2, 0.96, True), (upper + 0.3, 1.0, False), (upper, 0.94, False)):
        changed = state(joint_position=joints(2, position), quaternion=torch.tensor([length, 0.0, 0.0, 0.0]))
        assert (Safety(SafetyLimits()).check_state(changed, now=0.0) is None) == fine, (position, length)
    for ahead, fine in ((0.4, True), (0.6, False)):
        assert (Safety(SafetyLimits()).check_loop(1.0, {"depth": 1.0 + ahead}, 0) is None) == fine, ahead
    checks, fast = Safety(SafetyLimits()), state(joint_velocity=1.01 * torch.tensor(constants.VELOCITY_LIMIT))
    assert [checks.check_state(fast, now=0.0) is None for _ in range(5)] == [True] * 4 + [False]


def test_speed_and_torque_must_last() -> None:
    limits = SafetyLimits(sustained=3)
    for entry, unit, limit in (
        ("joint_velocity", "rad/s", constants.VELOCITY_LIMIT[2]),
        ("joint_torque", "N m", safety.VENDOR_TORQUE_LIMIT[2]),
    ):
        checks = Safety(limits)
        fast, fine = torch.zeros(12), torch.zeros(12)
        fast[2] = -1.01 * limit
        fine[2] = 0.99 * limit
        found = [checks.check_state(state(**{entry: value}), 0.0) for value in (fast, fast, fine, fast, fast, fast)]
        assert found[:5] == [None] * 5
        assert found[5] is not None and found[5].check == entry.replace("_", " ").replace("velocity", "speed")
        assert unit in found[5].reason and "for 3 control steps" in found[5].reason
        checks.reset()
        assert checks.check_state(state(**{entry: fast}), 0.0) is None


def test_ages() -> None:
    checks = Safety(SafetyLimits())
    assert checks.check_state(None, 0.0).reason == "the state never arrived"
    assert checks.check_state(STANDING, 0.0501).check == "stale state"
    assert checks.check_loop(1.0, {"operator": 0.4}, 0).check == "lost operator"
    stale_depth = checks.check_loop(1.0, {"operator": 1.0, "depth": 0.7}, 0)
    assert stale_depth.check == "stale depth" and "is 300 ms old, expected at most 200 ms" in stale_depth.reason
    assert checks.check_loop(1.0, {"operator": 1.3, "depth": math.inf}, 0) is None
    other_clock = checks.check_loop(1.0, {"operator": 1.0, "depth": 1.7e9}, 0)
    assert other_clock.check == "stale depth" and "dated 1.7e+09 s ahead, expected a time of" in other_clock.reason
    with pytest.raises(KeyError, match="lidar"):
        checks.check_loop(1.0, {"lidar": 1.0}, 0)


def test_misses_and_other_commanders() -> None:
    checks = Safety(SafetyLimits(missed_deadlines=3))
    assert checks.check_loop(0.0, {}, 2) is None
    assert checks.check_loop(0.0, {}, 3).check == "missed deadlines"
    assert str(checks.check_bus(constants.JOINT_NAMES, ("sport mode",))).startswith("second commander: sport mode")


def test_commands_that_no_motor_should_get() -> None:
    checks = Safety(SafetyLimits())
    gains = torch.full((12,), 40.0), torch.ones(12)
    target = STANDING.joint_position.clone()
    target[4] += 1.9  # 76 N m, the limit is 4 x 20
    assert checks.check_command(JointCommand(target, *gains), STANDING) is None
    target[4] += 0.2
    fault = checks.check_command(JointCommand(target, *gains), STANDING)
    assert fault.check == "commanded torque" and "joint 4 has 84.0 N m, expected at most 80.0" in fault.reason
    bad = checks.check_command(JointCommand(target * float("nan"), *gains), STANDING)
    assert bad.check == "not a number" and "the command's position[0] is nan" in bad.reason


def test_the_motors_law() -> None:
    command = JointCommand(
        torch.full((12,), 1.0), torch.full((12,), 40.0), torch.full((12,), 2.0), torch.full((12,), 3.0), torch.ones(12)
    )
    found = safety.pd_torque(command, state(joint_position=torch.full((12,), 0.5), joint_velocity=torch.ones(12)))
    assert found.tolist() == [1.0 + 40.0 * 0.5 + 2.0 * 2.0] * 12


def test_limits_come_from_the_manifest_and_make_sense() -> None:
    manifest = build_manifest("bbc", {}, control_period=0.02, limits={"joint_speed": [5.0] * 12})
    limits = SafetyLimits.from_manifest(manifest, tilt=0.5)
    assert list(limits.joint_speed) == [5.0] * 12 and limits.tilt == 0.5
    assert list(limits.joint_lower) == list(constants.JOINT_LOWER)
    with pytest.raises(ValueError, match="tilt must be positive"):
        SafetyLimits(tilt=0.0)
    with pytest.raises(ValueError, match="joint_speed must have 12 entries, got 3"):
        SafetyLimits(joint_speed=(1.0,) * 3)
