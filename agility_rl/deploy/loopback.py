"""States and commands as UDP packets on this machine: how the controller talks to a simulator in another process.

Every packet ends with a CRC-32. Whoever has sent a command or a greeting gets states. The robot answers a greeting with
the names of its joints, and says in every state how many programs have lately commanded it. One with a camera sends its
depths along, one number for each pixel of the network.
"""

from __future__ import annotations

import contextlib
import json
import math
import secrets
import socket
import struct
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from agility_rl.deploy.depth import Frame, sensor_image
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import camera

HOST = "127.0.0.1"
"""Only programs on this machine can reach the robot."""
GREETING, NAMES, STATE, COMMAND, DEPTH = b"AGLg", b"AGLn", b"AGLs", b"AGLc", b"AGLd"
"""What a packet is: its first four bytes."""
LARGEST = 16384
"""More bytes than any packet has."""
_STATE = struct.Struct("<IdII")  # sequence, time, commanders, whether the trunk's position is known
_COMMAND = struct.Struct("<QI")  # session, sequence
_DEPTH = struct.Struct("<d")  # time
_STATE_SIZES = {
    "quaternion": 4,
    "angular_velocity": 3,
    "joint_position": 12,
    "joint_velocity": 12,
    "joint_torque": 12,
    "foot_force": 4,
    "linear_acceleration": 3,
    "trunk_position": 3,
}
_COMMAND_SIZES = (12, 12, 12, 12, 12)


class PacketError(ValueError):
    """A packet that is damaged, or none of ours."""


def seal(kind: bytes, body: bytes) -> bytes:
    """Packet of a kind, with its checksum.

    Example:
        >>> unseal(seal(GREETING, b"hello"))
        (b'AGLg', b'hello')
    """
    return kind + body + struct.pack("<I", zlib.crc32(kind + body))


def unseal(packet: bytes) -> tuple[bytes, bytes]:
    """Kind and body of a packet.

    Raises:
        PacketError: if its checksum is wrong.
    """
    if len(packet) < 8 or struct.unpack("<I", packet[-4:])[0] != zlib.crc32(packet[:-4]):
        raise PacketError(f"a packet of {len(packet)} bytes has a wrong checksum")
    return packet[:4], packet[4:-4]


def pack_state(state: RobotState, commanders: int) -> bytes:
    """State as a packet, with the number of programs that command the robot."""
    known = state.trunk_position is not None
    head = _STATE.pack(state.sequence & 0xFFFFFFFF, state.time, commanders, int(known))
    values = [getattr(state, name) for name in _STATE_SIZES if name != "trunk_position"]
    values.append(torch.zeros(3) if state.trunk_position is None else state.trunk_position)
    return seal(STATE, head + torch.cat(values).numpy().astype("<f4").tobytes())


def unpack_state(body: bytes) -> tuple[RobotState, int]:
    """State and number of commanders.

    Raises:
        PacketError: if the length is wrong.
    """
    values = dict(zip(_STATE_SIZES, _floats(body, _STATE.size, tuple(_STATE_SIZES.values())), strict=True))
    sequence, moment, commanders, known = _STATE.unpack(body[: _STATE.size])
    trunk = values.pop("trunk_position")
    return RobotState(moment, trunk_position=trunk if known else None, sequence=sequence, **values), commanders


def pack_command(command: JointCommand, session: int, sequence: int) -> bytes:
    """Command as a packet, from a session: a random number that a program draws once."""
    values = (command.position, command.stiffness, command.damping, command.velocity, command.torque)
    head = _COMMAND.pack(session, sequence & 0xFFFFFFFF)
    return seal(COMMAND, head + torch.cat(values).numpy().astype("<f4").tobytes())


def unpack_command(body: bytes) -> tuple[JointCommand, int]:
    """Command and session.

    Raises:
        PacketError: if the length is wrong.
    """
    values = _floats(body, _COMMAND.size, _COMMAND_SIZES)
    return JointCommand(*values), _COMMAND.unpack(body[: _COMMAND.size])[0]


def pack_depth(moment: float, counts: np.ndarray) -> bytes:
    """Depths uint16 ``[58, 87]`` as a packet, with the time at which they were measured [s].

    Example:
        >>> kind, body = unseal(pack_depth(1.5, np.full((58, 87), 700, dtype=np.uint16)))
        >>> moment, counts = unpack_depth(body)
        >>> moment, counts.shape, int(counts.max())
        (1.5, (58, 87), 700)
    """
    return seal(DEPTH, _DEPTH.pack(moment) + counts.astype("<u2").tobytes())


def unpack_depth(body: bytes) -> tuple[float, np.ndarray]:
    """Time and depths.

    Raises:
        PacketError: if the length is wrong.
    """
    shape = (camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)
    _check_length(body, _DEPTH.size + 2 * shape[0] * shape[1])
    return _DEPTH.unpack_from(body)[0], np.frombuffer(body, "<u2", offset=_DEPTH.size).reshape(shape)


def _check_length(body: bytes, expected: int) -> None:
    if len(body) != expected:
        raise PacketError(f"a packet has {len(body)} bytes, expected {expected}; made by another version?")


def _floats(body: bytes, start: int, sizes: Sequence[int]) -> list[Tensor]:
    _check_length(body, start + 4 * sum(sizes))
    values = torch.from_numpy(np.frombuffer(body, "<f4", offset=start).astype(np.float32))
    return list(values.split(list(sizes)))


class LoopbackTransport:
    """The controller's end of the line.

    Source: no formula; packets as the head of this module says.

    Args:
        port: of the robot, on this machine.
        patience: time to wait for the robot's first answer [s].

    Attributes:
        rejected: packets that were damaged or unknown.

    Raises:
        ConnectionError: if no robot answers.

    Example:
        >>> import threading
        >>> from agility_rl.deploy.robot_process import RobotServer, in_real_time
        >>> from agility_rl.deploy.simulated import SimulatedRobot
        >>> server = RobotServer(SimulatedRobot())
        >>> thread = threading.Thread(target=in_real_time, args=(server, 0.2))
        >>> thread.start()
        >>> transport = LoopbackTransport(server.port)
        >>> transport.joint_names[0], transport.read().joint_position.shape
        ('FL_hip_joint', torch.Size([12]))
        >>> thread.join()
        >>> transport.close(); server.close()
    """

    def __init__(self, port: int, *, patience: float = 10.0) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self._robot = (HOST, port)
        self._session, self._sequence, self._sent = secrets.randbits(64), 0, -math.inf
        self._state: RobotState | None = None
        self._frame: Frame | None = None
        self._commanders = 0
        self.rejected = 0
        self.joint_names: Sequence[str] = ()
        end = time.monotonic() + patience
        try:
            while not self.joint_names or self._state is None:
                if time.monotonic() > end:
                    raise ConnectionError(
                        f"no robot answers on {HOST}, port {port}, within {patience:.0f} s; is its process running?"
                    )
                self._socket.sendto(seal(GREETING, b""), self._robot)
                self._socket.settimeout(0.1)
                try:
                    self._take(self._socket.recv(LARGEST))
                except (TimeoutError, ConnectionRefusedError):
                    continue
        except BaseException:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def _take(self, packet: bytes) -> None:
        try:
            kind, body = unseal(packet)
            if kind == STATE:
                state, self._commanders = unpack_state(body)
                if self._state is None or state.time >= self._state.time:  # datagrams may overtake each other
                    self._state = state
            elif kind == DEPTH:
                moment, counts = unpack_depth(body)
                if self._frame is None or moment >= self._frame.time:
                    self._frame = Frame(moment, sensor_image(counts))
            elif kind == NAMES:
                self.joint_names = tuple(json.loads(body))
            else:
                self.rejected += 1
        except PacketError:
            self.rejected += 1

    def read(self) -> RobotState | None:
        """Newest state; its time is the robot's, which on one machine is also the controller's."""
        while True:
            try:
                self._take(self._socket.recv(LARGEST))
            except BlockingIOError:
                return self._state
            except ConnectionRefusedError:  # the robot's process has ended: its last state grows old
                return self._state

    def latest(self) -> Frame | None:
        """Newest image that came in with the states, if the robot has a camera."""
        return self._frame

    def send(self, command: JointCommand) -> None:
        """Give the motors a command; lost if the robot's process has ended."""
        self._sequence, self._sent = self._sequence + 1, time.monotonic()
        with contextlib.suppress(ConnectionRefusedError, BlockingIOError):
            self._socket.sendto(pack_command(command, self._session, self._sequence), self._robot)

    def other_commanders(self) -> Sequence[str]:
        """Whether the robot hears commands of more programs than this one."""
        # The robot forgets who is silent; who is silent knows it a little earlier, and never takes itself for alone.
        mine = 1 if time.monotonic() - self._sent < Commanders.memory else 0
        others = self._commanders - mine
        return (f"{others} other program{'s' if others > 1 else ''}",) if others > 0 else ()

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


@dataclass
class Commanders:
    """Who has lately commanded a robot: sessions, and when each was last heard.

    Example:
        >>> commanders = Commanders(memory=0.5)
        >>> commanders.heard(7, now=0.0); commanders.heard(8, now=0.4)
        >>> commanders.count(now=0.45), commanders.count(now=0.6)
        (2, 1)
    """

    memory: float = 0.5

    def __post_init__(self) -> None:
        self._last: dict[int, float] = {}

    def heard(self, session: int, now: float) -> None:
        """A command came in."""
        self._last[session] = now

    def count(self, now: float) -> int:
        """How many have commanded within the memory."""
        self._last = {session: last for session, last in self._last.items() if now - last <= self.memory}
        return len(self._last)
