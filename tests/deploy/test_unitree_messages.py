"""Layouts, checksum, order of motors and feet, and what becomes of a command and a state on their way."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from agility_rl.deploy import unitree_messages as unitree
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants


def crc_by_hand(words: list[int]) -> int:
    """Long division by the polynomial, one bit after the other."""
    register = 0xFFFFFFFF
    for word in words:
        for place in reversed(range(32)):
            fed_back = (register >> 31) ^ ((word >> place) & 1)
            register = (register << 1) & 0xFFFFFFFF ^ (0x04C11DB7 if fed_back else 0)
    return register


def counting_state() -> RobotState:
    """A state in which every number is another."""
    numbers = torch.arange(12.0)
    return replace(
        RobotState.standing(),
        quaternion=torch.tensor([0.5, 0.5, -0.5, 0.5]),
        angular_velocity=torch.tensor([1.0, 2.0, 3.0]),
        linear_acceleration=torch.tensor([4.0, 5.0, 6.0]),
        joint_position=0.1 * numbers,
        joint_velocity=1.0 + numbers,
        joint_torque=-numbers,
        foot_force=torch.tensor([10.0, 20.0, 30.0, 40.0]),
        sequence=77,
    )


def test_the_structures_are_as_large_as_the_robots() -> None:
    sizes = {name: layout.itemsize for name, layout in unitree.STRUCTURES.items()}
    # Added up by hand from the members, each padded to its own size, every structure to that of its largest member.
    assert sizes["MotorCmd_"] == 1 + 3 + 5 * 4 + 3 * 4
    assert sizes["MotorState_"] == 1 + 3 + 7 * 4 + 1 + 3 + 4 + 2 * 4
    assert sizes["IMUState_"] == 13 * 4 + 1 + 3 and sizes["BmsCmd_"] == 4
    assert sizes["BmsState_"] == 4 + 4 + 2 + 2 + 2 + 2 * 15
    assert sizes["LowCmd_"] == 2 + 1 + 1 + 8 + 8 + 2 + 2 + 20 * 36 + 4 + 40 + 12 + 2 + 1 + 1 + 4 + 4 == 812
    head, tail = 2 + 1 + 1 + 8 + 8 + 2 + 2, 8 + 8 + 4 + 40 + 1 + 3 + 4 + 2 + 2 + 4 + 4 + 8 + 4 + 4
    assert sizes["LowState_"] == head + 56 + 20 * 48 + 44 + tail == 1180
    assert unitree.LOW_COMMAND.fields["motor_cmd"][1] == 24 and unitree.LOW_COMMAND.fields["crc"][1] == 808


def test_the_checksum_by_hand() -> None:
    # The last bit of a word changes the last step only: by one feedback, which is the polynomial itself.
    assert unitree.crc32(bytes(4)) == crc_by_hand([0]) == 0xC704DD7B
    assert unitree.crc32(b"\1\0\0\0") == 0xC704DD7B ^ 0x04C11DB7
    assert unitree.crc32(b"") == 0xFFFFFFFF
    # The order of bytes: a word goes in from its highest bit on, so the last byte in memory comes first.
    assert unitree.crc32(b"4321") == crc_by_hand([0x31323334])
    words = [0xDEADBEEF, 0x01234567, 0x80000001, 0xFFFFFFFF]
    assert unitree.crc32(np.array(words, "<u4").tobytes()) == crc_by_hand(words)
    with pytest.raises(ValueError, match="whole words of 4 bytes, got 5"):
        unitree.crc32(bytes(5))


def test_every_bit_of_a_command_is_under_its_checksum() -> None:
    record = unitree.to_low_command(JointCommand(*torch.arange(60.0).reshape(5, 12)))
    words = np.frombuffer(record.tobytes(), "<u4").tolist()
    assert words[-1] == int(record["crc"]) == crc_by_hand(words[:-1]) and len(words) == 203
    for index in range(0, 812, 11):
        damaged = bytearray(record.tobytes())
        damaged[index] ^= 16
        assert not unitree.is_intact(np.frombuffer(bytes(damaged), unitree.LOW_COMMAND)[0])


def test_a_command_goes_to_the_motors_in_unitrees_order() -> None:
    command = JointCommand(*torch.arange(60.0).reshape(5, 12))
    record = unitree.to_low_command(command)
    motors = record["motor_cmd"]
    # Motors 0 to 2 are the front right leg, our joints 3 to 5; then front left, rear right, rear left.
    assert motors["q"][:12].tolist() == [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
    assert motors["kp"][:3].tolist() == [15, 16, 17] and motors["kd"][:3].tolist() == [27, 28, 29]
    assert motors["dq"][:3].tolist() == [39, 40, 41] and motors["tau"][:3].tolist() == [51, 52, 53]
    assert motors["mode"].tolist() == [1] * 20 and record["head"].tolist() == [0xFE, 0xEF]
    assert record["level_flag"] == 0xFF and record["bms_cmd"]["off"] == 0 and record["gpio"] == 0
    unused = motors[12:]
    assert (unused["q"] == np.float32(2.146e9)).all() and (unused["dq"] == 16000).all()
    assert not unused["kp"].any() and not unused["kd"].any() and not unused["tau"].any()


def test_a_command_comes_back_bit_for_bit(generator: torch.Generator) -> None:
    command = JointCommand(*torch.randn(5, 12, generator=generator))
    found = unitree.from_low_command(unitree.to_low_command(command))
    for entry in fields(JointCommand):
        assert torch.equal(getattr(found, entry.name), getattr(command, entry.name)), entry.name


def test_a_motor_that_is_off_or_has_no_target_does_nothing() -> None:
    record = unitree.to_low_command(JointCommand(*torch.ones(5, 12)))
    record["motor_cmd"]["mode"][0] = 0  # front right hip: our joint 3
    record["motor_cmd"]["q"][1], record["motor_cmd"]["dq"][2] = unitree.NO_POSITION, unitree.NO_VELOCITY
    found = unitree.from_low_command(record)
    assert [found.stiffness[3], found.damping[3], found.torque[3]] == [0, 0, 0]
    assert [found.position[4], found.stiffness[4], found.damping[4]] == [0, 0, 1]
    assert [found.velocity[5], found.damping[5], found.stiffness[5]] == [0, 0, 1]
    assert record["motor_cmd"]["q"][1] == np.float32(unitree.NO_POSITION), "the message itself is left alone"


def test_a_state_goes_out_in_unitrees_order_and_comes_back() -> None:
    state = counting_state()
    record = unitree.to_low_state(state)
    assert record["motor_state"]["dq"][:12].tolist() == [4, 5, 6, 1, 2, 3, 10, 11, 12, 7, 8, 9]
    assert record["foot_force"].tolist() == [20, 10, 40, 30] and record["tick"] == 77
    found = unitree.from_low_state(record.view(np.recarray), 2.5, unitree.FootCalibration())
    assert found.time == 2.5 and found.trunk_position is None and unitree.is_intact(record)
    for entry in fields(RobotState):
        value = getattr(state, entry.name)
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(found, entry.name), value), entry.name
    # sin(pitch) = 2 (w y - z x) = 2 (-0.25 - 0.25) = -1.
    assert record["imu_state"]["rpy"][1] == pytest.approx(-np.pi / 2, abs=1e-3)
    assert unitree.MOTOR_OF[constants.JOINT_NAMES.index("RL_calf_joint")] == 11


def test_feet_from_counts_to_newtons() -> None:
    hanging, standing = torch.tensor([10.0, 20.0, 30.0, 40.0]), torch.tensor([60.0, 50.0, 90.0, 100.0])
    calibration = unitree.FootCalibration.from_counts(hanging, standing, mass=20.0)
    assert calibration.newtons_per_count == pytest.approx(9.81 * 20.0 / 200.0)
    assert float(calibration.force(standing).sum()) == pytest.approx(9.81 * 20.0), "they carry the whole robot"
    assert calibration.force(hanging - 5.0).tolist() == [0.0] * 4, "no foot pulls"
    record = unitree.to_low_state(counting_state()).view(np.recarray)
    assert unitree.from_low_state(
        record, 0.0, unitree.FootCalibration((10.0, 0.0, 0.0, 0.0), 2.0)
    ).foot_force.tolist() == [
        0.0,
        40.0,
        60.0,
        80.0,
    ]
    with pytest.raises(ValueError, match="more counts standing than hanging"):
        unitree.FootCalibration.from_counts(standing, hanging)


def test_the_remote_stops_only_with_both_buttons() -> None:
    for pressed, stops in (((0, 0), False), ((32, 0), False), ((0, 2), False), ((32, 2), True), ((255, 255), True)):
        assert unitree.stop_is_pressed([0x55, 0x51, *pressed, *[0] * 36]) is stops
