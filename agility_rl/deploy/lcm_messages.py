"""States and commands as LCM messages: types of our own, byte for byte what ``lcm-gen`` would make of them.

The paper's deployment names LCM (supplement S3), but no types. Ours are declared once, in :data:`TYPES`; the same in
LCM's own language, for a program on the robot in C++ or anything else, comes from

    python -m agility_rl.deploy.lcm_messages > agility_rl.lcm

Nothing here needs the package ``lcm``; :mod:`agility_rl.deploy.lcm` carries these messages.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants

PACKAGE = "agility_rl_lcm"
"""Of the types; another name than ours, so that Python code generated of them does not hide it."""
VERSION = 1
"""Raised whenever a number means something else although the layout is the same: units, order, sign."""
_NUMPY = {"int32_t": ">i4", "int64_t": ">i8", "float": ">f4", "double": ">f8", "boolean": "u1"}
_JOINTS, _FEET = constants.NUM_JOINTS, len(constants.LEGS)


@dataclass(frozen=True)
class Member:
    """One member of a message.

    Attributes:
        kind: LCM's name of its type.
        name: its name.
        length: entries of an array; ``None`` for a single value.
        meaning: unit and order.
    """

    kind: str
    name: str
    length: int | None = None
    meaning: str = ""


_HEAD = (
    Member("int32_t", "version", meaning=f"{VERSION}"),
    Member("int64_t", "robot", meaning="drawn by the robot's end when it starts"),
)
_TAIL = (
    Member("int64_t", "sequence", meaning="rising"),
    Member("double", "time", meaning="the sender's clock, s"),
)
TYPES: dict[str, tuple[Member, ...]] = {
    "robot_state_t": (
        *_HEAD,
        *_TAIL,
        Member("string", "joint_names", _JOINTS, "order of the joints below; legs have the same"),
        Member("float", "quaternion", 4, "w, x, y, z; trunk to world"),
        Member("float", "angular_velocity", 3, "rad/s, base frame"),
        Member("float", "linear_acceleration", 3, "m/s^2, base frame, gravity included"),
        Member("float", "joint_position", _JOINTS, "rad"),
        Member("float", "joint_velocity", _JOINTS, "rad/s"),
        Member("float", "joint_torque", _JOINTS, "N m"),
        Member("float", "foot_force", _FEET, "N"),
        Member("boolean", "trunk_known", meaning="whether anything measures the next"),
        Member("float", "trunk_position", 3, "m, world frame"),
    ),
    "joint_command_t": (
        *_HEAD,
        Member("int64_t", "sender", meaning="drawn by a program when it starts to command"),
        *_TAIL,
        Member("float", "position", _JOINTS, "rad"),
        Member("float", "stiffness", _JOINTS, "N m/rad"),
        Member("float", "damping", _JOINTS, "N m s/rad"),
        Member("float", "velocity", _JOINTS, "rad/s"),
        Member("float", "torque", _JOINTS, "N m, added as it is"),
    ),
}
"""Members of every message, in order; ``robot`` of a command is that of the state which it answers."""
_STATE = ("quaternion", "angular_velocity", "linear_acceleration", "joint_position", "joint_velocity", "joint_torque")
_COMMAND = ("position", "stiffness", "damping", "velocity", "torque")


class MessageError(ValueError):
    """A message that must not be acted on."""


def fingerprint(name: str) -> int:
    """Hash of a type's layout, with which every message of it begins.

    ``v <- ((v << 8) xor (v >> 55)) + c`` in signed 64 bits over lengths and letters of the members' names and types,
    and over their dimensions; rotated left by one bit at the end.

    Source: LCM type specification language, section "Fingerprint computation".

    Example:
        >>> fingerprint("robot_state_t") == fingerprint("joint_command_t")
        False
    """
    value = 0x12345678

    def update(number: int) -> None:
        nonlocal value
        signed = value - (1 << 64) if value >> 63 else value
        value = (((signed << 8) ^ (signed >> 55)) + number) & (1 << 64) - 1

    def spell(text: str) -> None:
        update(len(text))
        for letter in text.encode():
            update(letter)

    for member in TYPES[name]:
        spell(member.name)
        spell(member.kind)
        if member.length is None:
            update(0)
        else:  # one dimension, of constant size
            update(1)
            update(0)
            spell(str(member.length))
    return (value << 1 & (1 << 64) - 1) + (value >> 63)


FINGERPRINTS = {name: fingerprint(name) for name in TYPES}


def definition() -> str:
    """The types in LCM's own language.

    Example:
        >>> print(definition().splitlines()[0])
        package agility_rl_lcm;
    """
    lines = [f"package {PACKAGE};"]
    for name, members in TYPES.items():
        lines += ["", f"struct {name} {{", f"    const int32_t VERSION = {VERSION};"]
        for member in members:
            size = "" if member.length is None else f"[{member.length}]"
            lines += [f"    // {member.meaning}", f"    {member.kind} {member.name}{size};"]
        lines.append("}")
    return "\n".join(lines) + "\n"


def encode(name: str, values: Mapping[str, Any]) -> bytes:
    """Message of a type: fingerprint and members, all big-endian.

    Raises:
        KeyError: if a member has no value.
    """
    parts = [struct.pack(">Q", FINGERPRINTS[name])]
    for member in TYPES[name]:
        value = values[member.name]
        if member.kind == "string":
            parts += [struct.pack(">i", len(text) + 1) + text.encode("ascii") + b"\0" for text in value]
        else:
            parts.append(np.asarray(value, _NUMPY[member.kind]).tobytes())
    return b"".join(parts)


def decode(name: str, data: bytes) -> dict[str, Any]:
    """Members of a message.

    Raises:
        MessageError: if it is of another type or version, or damaged.

    Example:
        >>> decode("robot_state_t", b"hello")
        Traceback (most recent call last):
        agility_rl.deploy.lcm_messages.MessageError: robot_state_t: 5 bytes are no message
    """
    if len(data) < 12:
        raise MessageError(f"{name}: {len(data)} bytes are no message")
    found, version = struct.unpack_from(">Qi", data)
    if found != FINGERPRINTS[name]:
        raise MessageError(
            f"{name}: its fingerprint is {found:016x}, expected {FINGERPRINTS[name]:016x}; the other side has another "
            "layout: install the same version of agility_rl on both, or generate its types anew"
        )
    if version != VERSION:
        raise MessageError(
            f"{name}: its version is {version}, expected {VERSION}; install the same version of agility_rl on both"
        )
    values: dict[str, Any] = {}
    position = 8
    try:
        for member in TYPES[name]:
            if member.kind == "string":
                values[member.name], position = _strings(data, position, member.length or 1)
            else:
                count = 1 if member.length is None else member.length
                found = np.frombuffer(data, _NUMPY[member.kind], count, position)
                values[member.name] = found[0].item() if member.length is None else found
                position += found.nbytes
    except (ValueError, struct.error) as error:  # it ends too early, or a string is none
        raise MessageError(f"{name}: damaged at byte {position} of {len(data)}: {error}") from error
    if position != len(data):
        raise MessageError(f"{name}: {len(data)} bytes, expected {position}")
    return values


def _strings(data: bytes, position: int, count: int) -> tuple[tuple[str, ...], int]:
    found = []
    for _ in range(count):
        (length,) = struct.unpack_from(">i", data, position)
        end = position + 4 + length
        if length < 1 or end > len(data) or data[end - 1]:
            raise ValueError(f"a string of {length} bytes")
        found.append(data[position + 4 : end - 1].decode("ascii"))
        position = end
    return tuple(found), position


def pack_state(state: RobotState, robot: int, joint_names: Sequence[str] = constants.JOINT_NAMES) -> bytes:
    """Message of a state."""
    trunk = torch.zeros(3) if state.trunk_position is None else state.trunk_position
    values = {name: getattr(state, name).numpy() for name in (*_STATE, "foot_force")}
    values |= {"version": VERSION, "robot": robot, "sequence": state.sequence, "time": state.time}
    values |= {"joint_names": joint_names, "trunk_known": state.trunk_position is not None, "trunk_position": trunk}
    return encode("robot_state_t", values)


def unpack_state(data: bytes, time: float) -> tuple[RobotState, int, tuple[str, ...]]:
    """State as it arrived at a time, which robot said it, and the names of its joints.

    Raises:
        MessageError: if it is of another type or version, or damaged.
    """
    values = decode("robot_state_t", data)
    state = RobotState(
        time=time,
        foot_force=_tensor(values["foot_force"]),
        trunk_position=_tensor(values["trunk_position"]) if values["trunk_known"] else None,
        sequence=values["sequence"],
        **{name: _tensor(values[name]) for name in _STATE},
    )
    return state, values["robot"], values["joint_names"]


@dataclass(frozen=True)
class Sent:
    """Who sent a command to whom.

    Attributes:
        robot: whom it is meant for.
        sender: who sent it.
        sequence: number of the command, rising for every sender.
    """

    robot: int
    sender: int
    sequence: int


def pack_command(command: JointCommand, sent: Sent, time: float) -> bytes:
    """Message of a command."""
    values: dict[str, Any] = {name: getattr(command, name).numpy() for name in _COMMAND}
    values |= {"version": VERSION, "time": time, **vars(sent)}
    return encode("joint_command_t", values)


def unpack_command(data: bytes) -> tuple[JointCommand, Sent]:
    """Command, and who sent it to whom.

    Raises:
        MessageError: if it is of another type or version, or damaged.
    """
    values = decode("joint_command_t", data)
    sent = Sent(values["robot"], values["sender"], values["sequence"])
    return JointCommand(**{name: _tensor(values[name]) for name in _COMMAND}), sent


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


if __name__ == "__main__":
    sys.stdout.write(definition())
