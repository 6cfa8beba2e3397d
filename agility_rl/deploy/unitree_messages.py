"""What a Unitree Go2 says and obeys, byte for byte: LowState and LowCmd as numpy records, from ours and back.

The layouts are those of Unitree's published IDL, module ``unitree_go.msg.dds_``. A record lies in memory as the robot's
own C structures do, padding included, because the checksum of a command is taken over that memory. Nothing here needs a
network; :mod:`agility_rl.deploy.dds` carries these messages.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants

COMMAND_TOPIC, STATE_TOPIC = "rt/lowcmd", "rt/lowstate"
"""Names of the two topics on a Go2."""
MOTORS = 20
"""Motors in a message; a Go2 has the first 12."""
HEAD = (0xFE, 0xEF)
"""First bytes of every low-level command."""
LOW_LEVEL = 0xFF
"""``level_flag`` of a command that goes to the motors themselves."""
SERVO = 0x01
"""``mode`` of a motor that obeys; with 0 it is off."""
NO_POSITION, NO_VELOCITY = 2.146e9, 16000.0
"""Targets that a motor takes for none."""
REMOTE_L2, REMOTE_B = (2, 1 << 5), (3, 1 << 1)
"""Byte of ``wireless_remote`` and bit in it that is set while a button of the remote control is pressed.

Source: ``xKeySwitchUnion`` of Unitree's SDK: R1, L1, start, select, R2, L2 from the lowest bit of byte 2 on, A, B, X, Y
from that of byte 3 on.
"""

MOTOR_COMMAND = np.dtype(
    [("mode", "u1"), ("q", "<f4"), ("dq", "<f4"), ("tau", "<f4"), ("kp", "<f4"), ("kd", "<f4"), ("reserve", "<u4", 3)],
    align=True,
)
"""``MotorCmd_``: 36 bytes."""
_HEADER: list[Any] = [
    *(("head", "u1", 2), ("level_flag", "u1"), ("frame_reserve", "u1")),
    *(("sn", "<u4", 2), ("version", "<u4", 2), ("bandwidth", "<u2")),
]
"""With these every low-level message begins."""
BATTERY_COMMAND = np.dtype([("off", "u1"), ("reserve", "u1", 3)], align=True)
"""``BmsCmd_``: 4 bytes."""
LOW_COMMAND = np.dtype(
    [
        *_HEADER,
        ("motor_cmd", MOTOR_COMMAND, MOTORS),
        ("bms_cmd", BATTERY_COMMAND),
        ("wireless_remote", "u1", 40),
        ("led", "u1", 12),
        ("fan", "u1", 2),
        ("gpio", "u1"),
        ("reserve", "<u4"),
        ("crc", "<u4"),
    ],
    align=True,
)
"""``LowCmd_``: 812 bytes."""
IMU_STATE = np.dtype(
    [
        ("quaternion", "<f4", 4),
        ("gyroscope", "<f4", 3),
        ("accelerometer", "<f4", 3),
        ("rpy", "<f4", 3),
        ("temperature", "u1"),
    ],
    align=True,
)
"""``IMUState_``: 56 bytes."""
MOTOR_STATE = np.dtype(
    [
        ("mode", "u1"),
        ("q", "<f4"),
        ("dq", "<f4"),
        ("ddq", "<f4"),
        ("tau_est", "<f4"),
        ("q_raw", "<f4"),
        ("dq_raw", "<f4"),
        ("ddq_raw", "<f4"),
        ("temperature", "u1"),
        ("lost", "<u4"),
        ("reserve", "<u4", 2),
    ],
    align=True,
)
"""``MotorState_``: 48 bytes."""
BATTERY_STATE = np.dtype(
    [
        ("version_high", "u1"),
        ("version_low", "u1"),
        ("status", "u1"),
        ("soc", "u1"),
        ("current", "<i4"),
        ("cycle", "<u2"),
        ("bq_ntc", "u1", 2),
        ("mcu_ntc", "u1", 2),
        ("cell_vol", "<u2", 15),
    ],
    align=True,
)
"""``BmsState_``: 44 bytes."""
LOW_STATE = np.dtype(
    [
        *_HEADER,
        ("imu_state", IMU_STATE),
        ("motor_state", MOTOR_STATE, MOTORS),
        ("bms_state", BATTERY_STATE),
        ("foot_force", "<i2", 4),
        ("foot_force_est", "<i2", 4),
        ("tick", "<u4"),
        ("wireless_remote", "u1", 40),
        ("bit_flag", "u1"),
        ("adc_reel", "<f4"),
        ("temperature_ntc1", "u1"),
        ("temperature_ntc2", "u1"),
        ("power_v", "<f4"),
        ("power_a", "<f4"),
        ("fan_frequency", "<u2", 4),
        ("reserve", "<u4"),
        ("crc", "<u4"),
    ],
    align=True,
)
"""``LowState_``: 1180 bytes."""
STRUCTURES = {
    "MotorCmd_": MOTOR_COMMAND,
    "BmsCmd_": BATTERY_COMMAND,
    "LowCmd_": LOW_COMMAND,
    "IMUState_": IMU_STATE,
    "MotorState_": MOTOR_STATE,
    "BmsState_": BATTERY_STATE,
    "LowState_": LOW_STATE,
}
"""Names of the structures in the IDL; what a structure holds comes before it."""

UNITREE_LEGS = ("FR", "FL", "RR", "RL")
"""Unitree's order of legs, in motors and feet alike."""
UNITREE_JOINTS = tuple(f"{leg}_{link}_joint" for leg in UNITREE_LEGS for link in constants.LINKS)
"""Names of the first 12 motors."""
MOTOR_OF = [UNITREE_JOINTS.index(name) for name in constants.JOINT_NAMES]
"""Of each of our joints, the number of its motor."""
FOOT_OF = [UNITREE_LEGS.index(leg) for leg in constants.LEGS]
"""Of each of our feet, its number at the robot."""

_BIT_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32(data: bytes) -> int:
    """CRC-32 as the robot takes it: polynomial 0x04C11DB7, begun with ones, highest bit first, nothing inverted.

    The words of 32 bits are little-endian in memory, and each goes through from its highest bit on, so the bytes of
    every word are turned round. This is the mirror image of zlib's CRC-32, which does the work.

    Source: Unitree's SDK (``Crc32Core`` in its low-level examples); CRC-32/MPEG-2 in the catalogues.

    Args:
        data: whole words.

    Raises:
        ValueError: if the length is not a multiple of 4.

    Example:
        >>> hex(crc32(bytes(4)))  # one word of zeros
        '0xc704dd7b'
    """
    if len(data) % 4:
        raise ValueError(f"expected whole words of 4 bytes, got {len(data)} bytes")
    ordered = np.frombuffer(data, "<u4").astype(">u4").tobytes()
    mirrored = zlib.crc32(ordered.translate(_BIT_REVERSED)) ^ 0xFFFFFFFF
    return int(f"{mirrored:032b}"[::-1], 2)


def seal(record: np.ndarray) -> None:
    """Enter the checksum of a command or state: over all its memory but the last word, which holds it."""
    record["crc"] = crc32(record.tobytes()[:-4])


def is_intact(record: np.ndarray) -> bool:
    """Whether the checksum fits.

    Example:
        >>> record = to_low_command(JointCommand.damped(3.0))
        >>> is_intact(record)
        True
        >>> record["motor_cmd"]["kd"][5] = 4.0
        >>> is_intact(record)
        False
    """
    return int(record["crc"]) == crc32(record.tobytes()[:-4])


@dataclass(frozen=True)
class FootCalibration:
    """From the numbers of the foot sensors to newtons: ``force = newtons_per_count (count - zero)``, at least 0.

    The sensors measure the pressure of air inside the foot. Their counts have no unit, differ from foot to foot when
    unloaded, and drift with temperature: calibrate before every run in which contacts matter. The default takes counts
    for newtons, which is right for the simulated robot and unknown for any other.

    Source: no formula of the paper; a straight line through two points, see ``docs/deployment.md``.

    Attributes:
        zero: counts of the unloaded feet, FL, FR, RL, RR.
        newtons_per_count: slope, the same for all feet [N].
    """

    zero: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    newtons_per_count: float = 1.0

    @classmethod
    def from_counts(cls, hanging: Tensor, standing: Tensor, *, mass: float = constants.TOTAL_MASS) -> Self:
        """Calibration from mean counts ``[4]`` of a robot that hangs, and that stands still on all four feet.

        The slope follows from the whole weight, so that it does not matter how the feet share it.

        Args:
            hanging: mean counts, feet off the ground.
            standing: mean counts, standing still.
            mass: of the robot with everything on it [kg].

        Raises:
            ValueError: if standing does not give more than hanging.

        Example:
            >>> calibration = FootCalibration.from_counts(torch.full((4,), 20.0), torch.full((4,), 70.0), mass=15.0)
            >>> round(calibration.newtons_per_count, 4)  # 15 kg x 9.81 m/s^2 / 200 counts
            0.7358
        """
        load = float((standing - hanging).sum())
        if load <= 0.0:
            raise ValueError(f"expected more counts standing than hanging, got {load:.1f} more; are the sensors alive?")
        front_left, front_right, rear_left, rear_right = hanging.tolist()
        return cls((front_left, front_right, rear_left, rear_right), constants.GRAVITY * mass / load)

    def force(self, counts: Tensor) -> Tensor:
        """Forces ``[4]`` [N] of counts ``[4]``, both in our order of legs."""
        return (self.newtons_per_count * (counts - torch.tensor(self.zero))).clamp(min=0.0)


def to_low_command(command: JointCommand) -> np.ndarray:
    """Sealed LowCmd of a command for the 12 joints; the other 8 motors are told nothing.

    Source: Unitree's low-level examples (head, level flag, mode, stop values).

    Example:
        >>> record = to_low_command(JointCommand.damped(3.0))
        >>> record["motor_cmd"]["kd"][11:13].tolist(), record["motor_cmd"]["mode"].min().item()
        ([3.0, 0.0], 1)
    """
    record = np.zeros((), LOW_COMMAND)
    record["head"], record["level_flag"] = HEAD, LOW_LEVEL
    motors = record["motor_cmd"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, NO_POSITION, NO_VELOCITY
    for name, value in _columns(command).items():
        motors[name][MOTOR_OF] = value.numpy()
    seal(record)
    return record


def from_low_command(record: np.ndarray) -> JointCommand:
    """What the motors make of a LowCmd: those that are off go limp, and targets that are none have no gain.

    Example:
        >>> command = JointCommand.damped(3.0)
        >>> torch.equal(from_low_command(to_low_command(command)).damping, command.damping)
        True
    """
    motors = record["motor_cmd"][MOTOR_OF].copy()
    for target, gain, none in (("q", "kp", NO_POSITION), ("dq", "kd", NO_VELOCITY)):
        untargeted = motors[target] == np.float32(none)
        motors[target][untargeted] = motors[gain][untargeted] = 0.0
    for name in ("kp", "kd", "tau"):
        motors[name][motors["mode"] != SERVO] = 0.0
    columns = {name: torch.from_numpy(motors[name].astype(np.float32)) for name in ("q", "kp", "kd", "dq", "tau")}
    return JointCommand(*columns.values())


def _columns(command: JointCommand) -> dict[str, Tensor]:
    """Entries of a command under the names of Unitree."""
    return {
        "q": command.position,
        "kp": command.stiffness,
        "kd": command.damping,
        "dq": command.velocity,
        "tau": command.torque,
    }


def to_low_state(state: RobotState) -> np.ndarray:
    """Sealed LowState of a robot, as a Go2 in the same state would send it; feet in newtons for counts.

    Example:
        >>> record = to_low_state(RobotState.standing())
        >>> record["motor_state"]["mode"].sum().item(), record["foot_force"].tolist()
        (12, [37, 37, 37, 37])
    """
    record = np.zeros((), LOW_STATE)
    record["head"], record["level_flag"] = HEAD, LOW_LEVEL
    imu, motors = record["imu_state"], record["motor_state"]
    imu["quaternion"], imu["gyroscope"] = state.quaternion.numpy(), state.angular_velocity.numpy()
    imu["accelerometer"] = state.linear_acceleration.numpy()
    imu["rpy"] = [float(angle) for angle in rotations.to_euler(state.quaternion)]
    motors["mode"][MOTOR_OF] = SERVO
    motors["q"][MOTOR_OF] = state.joint_position.numpy()
    motors["dq"][MOTOR_OF] = state.joint_velocity.numpy()
    motors["tau_est"][MOTOR_OF] = state.joint_torque.numpy()
    limits = np.iinfo(np.int16)
    record["foot_force"][FOOT_OF] = np.clip(np.rint(state.foot_force.numpy()), limits.min, limits.max)
    record["tick"] = state.sequence & 0xFFFFFFFF
    seal(record)
    return record


def from_low_state(message: Any, time: float, calibration: FootCalibration) -> RobotState:
    """State of a Go2 from its message: a record, or an object with attributes of the same names.

    Args:
        message: LowState.
        time: when it arrived [s].
        calibration: of the feet.

    Example:
        >>> message = to_low_state(RobotState.standing()).view(np.recarray)
        >>> from_low_state(message, 1.5, FootCalibration()).joint_position[3:6]
        tensor([ 0.0000,  0.9000, -1.8000])
    """
    motors = [message.motor_state[number] for number in MOTOR_OF]
    counts = _tensor(message.foot_force)[FOOT_OF]
    return RobotState(
        time=time,
        quaternion=_tensor(message.imu_state.quaternion),
        angular_velocity=_tensor(message.imu_state.gyroscope),
        joint_position=_tensor([motor.q for motor in motors]),
        joint_velocity=_tensor([motor.dq for motor in motors]),
        joint_torque=_tensor([motor.tau_est for motor in motors]),
        foot_force=calibration.force(counts),
        linear_acceleration=_tensor(message.imu_state.accelerometer),
        sequence=int(message.tick),
    )


def stop_is_pressed(wireless_remote: Any) -> bool:
    """Whether L2 and B are held down on the remote control, given the 40 bytes of LowState.

    Example:
        >>> stop_is_pressed(bytes([0x55, 0x51, 0b0010_0000, 0b0000_0010]) + bytes(36)), stop_is_pressed(bytes(40))
        (True, False)
    """
    return all(int(wireless_remote[byte]) & bit for byte, bit in (REMOTE_L2, REMOTE_B))


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32).copy())
