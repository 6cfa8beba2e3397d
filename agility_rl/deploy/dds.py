"""The way to a Unitree Go2, and to a simulated robot that speaks like one: LowCmd and LowState over CycloneDDS.

Needs the extra ``dds``; without it this module can be imported, but nothing in it can be made. Both ends stay on the
loopback interface of this machine unless the user names another one.
"""

from __future__ import annotations

import functools
import socket
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from agility_rl.deploy import unitree_messages as unitree
from agility_rl.deploy.loopback import Commanders
from agility_rl.deploy.transport import JointCommand, RobotState

if TYPE_CHECKING:  # the robot's end only, and no simulator is needed to drive a real one
    from agility_rl.deploy.simulated import SimulatedRobot

DOMAIN = 0
"""Domain of a Go2."""
LARGEST_DOMAIN = 232
"""Beyond it, the port numbers of DDS run out."""
LONGEST_WRITE = 1
"""Time for which sending a command may wait for a slow reader [ms]; it never has to, as only the newest is kept."""
CALLS_PER_STATE = 2
"""The simulated robot says every second state, 250 Hz: to pack one takes Python almost a millisecond."""
HEARD_AT_ONCE = 4
"""Commands of others that are looked at in one control step."""
_STRUCTURE_OF = {layout: name for name, layout in unitree.STRUCTURES.items()}
_domains: dict[int, tuple[str, Any]] = {}


@functools.cache
def message_types() -> dict[str, Any]:
    """The structures of :data:`agility_rl.deploy.unitree_messages.STRUCTURES` as CycloneDDS dataclasses, by name.

    Source: Unitree's IDL, module ``unitree_go.msg.dds_``; final, members numbered in order.

    Raises:
        ModuleNotFoundError: if CycloneDDS is not installed.
    """
    try:
        from cyclonedds import idl
        from cyclonedds.idl import annotations, types
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "DDS needs the package cyclonedds, which is not installed; install it with pip install 'agility_rl[dds]'",
            name=error.name,
        ) from error
    found: dict[str, Any] = {}
    for name, layout in unitree.STRUCTURES.items():
        members = {}
        for member, (base, shape) in zip(layout.names or (), _members(name), strict=True):
            kind = found[_STRUCTURE_OF[base]] if base.names else getattr(types, base.name)
            members[member] = types.array[kind, shape[0]] if shape else kind
        structure = idl.make_idl_struct(name, f"unitree_go.msg.dds_.{name}", members)
        found[name] = annotations.autoid("sequential")(annotations.final(structure))
    return found


def to_message(record: np.ndarray) -> Any:
    """Message to send, of a record."""
    return _message(_STRUCTURE_OF[record.dtype], record.tolist())


def _message(name: str, values: Sequence[Any]) -> Any:
    found = []
    for (base, shape), value in zip(_members(name), values, strict=True):
        if base.names:
            inner = _STRUCTURE_OF[base]
            value = [_message(inner, part) for part in value] if shape else _message(inner, value)
        elif shape:
            value = value.tolist()
        found.append(value)
    return message_types()[name](*found)


def to_record(message: Any, name: str) -> np.ndarray:
    """Record of a message that has arrived, whose structure has this name."""
    record = np.zeros((), unitree.STRUCTURES[name])
    record[()] = _values(name, message)
    return record


def _values(name: str, message: Any) -> tuple:
    found = []
    for member, (base, shape) in zip(unitree.STRUCTURES[name].names or (), _members(name), strict=True):
        value = getattr(message, member)
        if base.names:
            inner = _STRUCTURE_OF[base]
            value = [_values(inner, part) for part in value] if shape else _values(inner, value)
        elif shape:
            value = list(value)  # bytes, if it is an array of them
        found.append(value)
    return tuple(found)


@functools.cache
def _members(name: str) -> list[tuple[np.dtype, tuple[int, ...]]]:
    """Type and shape of every member of a structure."""
    layout = unitree.STRUCTURES[name]
    return [layout[member].subdtype or (layout[member], ()) for member in layout.names or ()]


def participant(interface: str | None, domain: int) -> Any:
    """Take part in a domain, through one network interface.

    Args:
        interface: its name, as in ``ip link``; ``None`` for the loopback interface.
        domain: number of the domain.

    Raises:
        ValueError: if there is no such interface or domain, or this process is in the domain by another interface.
        ConnectionError: if the interface is there and the network cannot be joined by it.
        ModuleNotFoundError: if CycloneDDS is not installed.
    """
    if not 0 <= domain <= LARGEST_DOMAIN:
        raise ValueError(f"expected a DDS domain between 0 and {LARGEST_DOMAIN}, got {domain}")
    names = [name for _, name in socket.if_nameindex()]
    if interface is not None and interface not in names:
        raise ValueError(f"expected a network interface of this machine ({', '.join(names)}), got {interface!r}")
    message_types()
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant

    # The loopback interface does carry multicast, but Linux does not say so: it has to be told.
    chosen = 'address="127.0.0.1" multicast="true"' if interface is None else f"name={quoteattr(interface)}"
    if domain in _domains and _domains[domain][0] != chosen:
        raise ValueError(f"this process is in DDS domain {domain} by another interface already; expected one interface")
    try:
        if domain not in _domains:
            settings = f"<General><Interfaces><NetworkInterface {chosen}/></Interfaces></General>"
            _domains[domain] = chosen, Domain(domain, f'<CycloneDDS><Domain Id="any">{settings}</Domain></CycloneDDS>')
        return DomainParticipant(domain)
    except DDSException as error:
        place = "the loopback interface" if interface is None else f"the interface {interface}"
        raise ConnectionError(
            f"cannot join DDS domain {domain} by {place}: is it up, its cable in, and has it an address? {error}"
        ) from error


class _Line:
    """The two topics of one robot, and what reads and writes them."""

    def __init__(self, interface: str | None, domain: int, *, depths: dict[str, int], writes: str) -> None:
        self.participant = participant(interface, domain)
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        structures = {unitree.COMMAND_TOPIC: "LowCmd_", unitree.STATE_TOPIC: "LowState_"}
        topics = {name: Topic(self.participant, name, message_types()[kind]) for name, kind in structures.items()}
        sure = Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=LONGEST_WRITE))
        self.writer = DataWriter(self.participant, topics[writes], Qos(sure, Policy.History.KeepLast(1)))
        self.readers = {
            name: DataReader(
                self.participant,
                topics[name],
                Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(depth), Policy.IgnoreLocal.Participant),
            )
            for name, depth in depths.items()
        }
        self._depths = depths

    def take(self, topic: str) -> list[Any]:
        """Messages that have arrived since the last call, oldest first; those that only say farewell left out."""
        return [found for found in self.readers[topic].take(N=self._depths[topic]) if hasattr(found, "crc")]

    def close(self) -> None:
        """Leave the domain, by letting go of all that takes part in it; calling it again does nothing."""
        for reader in self.readers.values():
            reader.set_listener(None)
        self.readers.clear()
        self.writer = self.participant = None


class DDSTransport:
    """The controller's end of the line to a Go2, or to what speaks like one.

    It stays with the robot that it hears first, and what is said twice counts once: a repeater must not keep the last
    word of a silent robot young. Another program that commands the same robot is heard on the topic itself, the robot's
    own sport mode as well if it is still on and speaks there. Another robot in the domain obeys the same commands, and
    L2 and B held down on the remote control need not be obeyed in low-level control: both count as commanders too.

    Source: supplement S3 (low-level control of the motors); Unitree's IDL and topic names.

    Args:
        interface: network interface towards the robot; ``None`` for the loopback interface.
        domain: DDS domain.
        feet: from counts of the foot sensors to newtons.
        patience: time to wait for the robot's first state [s].

    Raises:
        ModuleNotFoundError: if CycloneDDS is not installed.
        ValueError: if there is no such interface or domain.
        ConnectionError: if the network cannot be joined, or no robot speaks.

    Example:
        >>> DDSTransport("none0")
        Traceback (most recent call last):
        ValueError: expected a network interface of this machine (...), got 'none0'
    """

    joint_names: Sequence[str] = tuple(unitree.UNITREE_JOINTS[motor] for motor in unitree.MOTOR_OF)

    def __init__(
        self,
        interface: str | None = None,
        *,
        domain: int = DOMAIN,
        feet: unitree.FootCalibration | None = None,
        patience: float = 10.0,
    ) -> None:
        depths = {unitree.STATE_TOPIC: 1, unitree.COMMAND_TOPIC: HEARD_AT_ONCE}
        self._line = _Line(interface, domain, depths=depths, writes=unitree.COMMAND_TOPIC)
        self._feet = unitree.FootCalibration() if feet is None else feet
        self._others, self._stop_pressed = Commanders(), False
        self._state: RobotState | None = None
        self._robot: int | None = None
        self._checksum: int | None = None
        self._strangers = Commanders()
        self._arrived = time.monotonic()
        self._listen()
        end = time.monotonic() + patience
        while self.read() is None:
            if time.monotonic() > end:
                self.close()
                place = "the loopback interface" if interface is None else f"the interface {interface}"
                raise ConnectionError(
                    f"no robot speaks on {unitree.STATE_TOPIC} in DDS domain {domain} on {place} within "
                    f"{patience:.0f} s; is it on, and is this the interface with its network?"
                )
            time.sleep(0.01)

    def _listen(self) -> None:
        """Note when states arrive: they are read later, and their senders have clocks of their own."""
        from cyclonedds.core import Listener

        def arrived(_: Any) -> None:
            self._arrived = time.monotonic()

        self._line.readers[unitree.STATE_TOPIC].set_listener(Listener(on_data_available=arrived))

    def read(self) -> RobotState | None:
        """Newest state; its time is that of its arrival here."""
        arrived = self._arrived  # before it is taken, so that a state never seems younger than it is
        for message in self._line.take(unitree.STATE_TOPIC):
            robot = message.sample_info.publication_handle
            if self._robot is None:
                self._robot = robot
            if robot != self._robot:
                self._strangers.heard(robot, time.monotonic())
            elif message.crc != self._checksum:
                self._checksum = message.crc
                self._state = unitree.from_low_state(message, arrived, self._feet)
                self._stop_pressed = unitree.stop_is_pressed(message.wireless_remote)
        return self._state

    def send(self, command: JointCommand) -> None:
        """Give the motors a command, sealed."""
        self._line.writer.write(to_message(unitree.to_low_command(command)))

    def other_commanders(self) -> Sequence[str]:
        """Who else has commanded this robot within half a second, other robots that speak, a remote that says stop."""
        now = time.monotonic()
        for message in self._line.take(unitree.COMMAND_TOPIC):
            self._others.heard(message.sample_info.publication_handle, now)
        count = self._others.count(now)
        others = {
            f"{count} other program{'s' if count > 1 else ''}": count,
            f"another robot on {unitree.STATE_TOPIC}": self._strangers.count(now),
            "the remote control (L2 + B)": self._stop_pressed,
        }
        return tuple(name for name, heard in others.items() if heard)

    def close(self) -> None:
        """Leave the domain."""
        self._line.close()


class DDSRobot:
    """The robot's end of the line: makes a simulated robot speak and obey as a Go2 does.

    As the robot, it ignores a command whose checksum, head or level is wrong.

    Source: Unitree's low-level examples.

    Args:
        robot: what is driven.
        interface: network interface; ``None`` for the loopback interface.
        domain: DDS domain.

    Attributes:
        rejected: commands that were ignored.
    """

    def __init__(self, robot: SimulatedRobot, interface: str | None = None, *, domain: int = DOMAIN) -> None:
        self.robot = robot
        self._line = _Line(interface, domain, depths={unitree.COMMAND_TOPIC: 8}, writes=unitree.STATE_TOPIC)
        self.rejected, self._calls = 0, 0

    def receive(self) -> None:
        """Obey what has arrived; the newest command counts, whoever sent it."""
        for message in self._line.take(unitree.COMMAND_TOPIC):
            record = to_record(message, "LowCmd_")
            addressed = tuple(record["head"]) == unitree.HEAD and record["level_flag"] == unitree.LOW_LEVEL
            if addressed and unitree.is_intact(record):
                self.robot.command(unitree.from_low_command(record))
            else:
                self.rejected += 1

    def publish(self) -> None:
        """Say the state, in every second call."""
        self._calls += 1
        if self._calls % CALLS_PER_STATE:
            return
        self._line.writer.write(to_message(unitree.to_low_state(self.robot.state(time.monotonic()))))

    def close(self) -> None:
        """Leave the domain."""
        self._line.close()
