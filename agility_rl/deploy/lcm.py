"""States and commands over LCM, both ends: the controller's, and that of a simulated robot.

LCM is UDP multicast: whoever is in the group hears everything, and everybody may command. Needs the extra ``lcm``;
without it this module can be imported, but nothing in it can be made. Nothing leaves this machine unless the user asks
for a time to live (ttl) of 1 or more.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from agility_rl.deploy.lcm_messages import (
    MessageError,
    Sent,
    pack_command,
    pack_state,
    unpack_command,
    unpack_state,
)
from agility_rl.deploy.loopback import Commanders
from agility_rl.deploy.transport import JointCommand, RobotState

if TYPE_CHECKING:  # the robot's end only, and no simulator is needed to drive a real one
    from agility_rl.deploy.simulated import SimulatedRobot

logger = logging.getLogger(__name__)

GROUP, PORT = "239.255.76.67", 7667
"""LCM's own multicast address."""
LARGEST_DOMAIN = 999
"""Domains are ports above :data:`PORT`; this many are enough."""
STATE_CHANNEL, COMMAND_CHANNEL = "AGILITY_RL_STATE", "AGILITY_RL_COMMAND"
HEAD = 20
"""Bytes of fingerprint, version and robot: the same in all states of one robot."""
HEARD_AT_ONCE = 8
"""Commands, of this program and of others, that are looked at in one control step."""
LISTEN_MILLISECONDS = 100
"""Time after which the listening thread looks whether it is to end [ms]."""


def address(domain: int = 0, ttl: int = 0) -> str:
    """Where LCM meets.

    Args:
        domain: keeps robots apart: added to LCM's port.
        ttl: routers that a message may pass, plus one. 0: it stays on this machine; 1: it reaches the local network,
            where everybody may listen and command.

    Raises:
        ValueError: if one of them is out of range.

    Example:
        >>> address()
        'udpm://239.255.76.67:7667?ttl=0'
    """
    if not 0 <= domain <= LARGEST_DOMAIN or not 0 <= ttl <= 255:
        raise ValueError(
            f"expected a domain from 0 to {LARGEST_DOMAIN} and a ttl from 0 to 255, got {domain} and {ttl}"
        )
    return f"udpm://{GROUP}:{PORT + domain}?ttl={ttl}"


def connect(url: str) -> Any:
    """Join an LCM network.

    Raises:
        ModuleNotFoundError: if LCM is not installed.
        ConnectionError: if the network cannot be joined.
    """
    try:
        import lcm
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "LCM needs the package lcm, which is not installed; install it with pip install 'agility_rl[lcm]'",
            name=error.name,
        ) from error
    try:
        return lcm.LCM(url)
    except RuntimeError as error:
        raise ConnectionError(
            f"LCM cannot join {url}: no such address, or no route for multicast, as on a machine without a network; "
            "as root: ip route add 224.0.0.0/4 dev lo"
        ) from error


class _Refusals:
    """Counts what is not acted on; says every reason once.

    Attributes:
        count: messages.
        reason: of the last one.
    """

    SAID = 20
    """Reasons that are said; a noisy network must not fill a disk."""

    def __init__(self) -> None:
        self.count, self.reason = 0, ""
        self._said: set[str] = set()

    def add(self, reason: str) -> None:
        if reason not in self._said and len(self._said) < self.SAID:
            self._said.add(reason)
            logger.warning("refused a message: %s", reason)
        self.count, self.reason = self.count + 1, reason


class LCMTransport:
    """The controller's end of the line.

    It stays with the robot that it hears first: states of another one are refused, and its own commands name the robot
    they are meant for. Who else commands that robot is heard on the channel itself. A robot that starts anew is another
    robot: the state of the old one grows old.

    Source: supplement S3 names LCM; the messages are ours (:data:`agility_rl.deploy.lcm_messages.TYPES`).

    Args:
        url: where LCM meets, from :func:`address` or as LCM writes it.
        patience: time to wait for the robot's first state [s].

    Attributes:
        refused: count and last reason of states that were refused.

    Raises:
        ModuleNotFoundError: if LCM is not installed.
        ConnectionError: if the network cannot be joined, or no robot speaks that can be understood.

    Example:
        >>> LCMTransport(address(domain=-1))
        Traceback (most recent call last):
        ValueError: expected a domain from 0 to 999 and a ttl from 0 to 255, got -1 and 0
    """

    def __init__(self, url: str | None = None, *, patience: float = 10.0) -> None:
        url = address() if url is None else url
        self._lcm = connect(url)
        self._me, self._sequence = secrets.randbits(63), 0
        self._others, self.refused = Commanders(), _Refusals()
        self.joint_names: Sequence[str] = ()
        self._state: RobotState | None = None
        self._robot = 0
        # Written by the listening thread, in single operations each.
        self._head: bytes | None = None
        self._newest: tuple[bytes, float] | None = None
        self._strange: bytes | None = None
        self._commands: deque[bytes] = deque(maxlen=HEARD_AT_ONCE)
        self._lcm.subscribe(STATE_CHANNEL, self._state_arrived)
        self._lcm.subscribe(COMMAND_CHANNEL, lambda channel, data: self._commands.append(data))
        self._closing = threading.Event()
        self._listener = threading.Thread(target=self._listen, name="lcm", daemon=True)
        self._listener.start()
        end = time.monotonic() + patience
        while self.read() is None:
            if time.monotonic() > end:
                self.close()
                heard = f"; heard and refused: {self.refused.reason}" if self.refused.count else "; is it running?"
                raise ConnectionError(f"no robot speaks on {STATE_CHANNEL} at {url} within {patience:.0f} s{heard}")
            time.sleep(0.01)

    def _listen(self) -> None:
        """Note when states arrive: they are read later, and their senders have clocks of their own."""
        with contextlib.suppress(OSError):  # the network is gone: the last state grows old
            while not self._closing.is_set():
                self._lcm.handle_timeout(LISTEN_MILLISECONDS)

    def _state_arrived(self, channel: str, data: bytes) -> None:
        if self._head is None or data[:HEAD] == self._head:
            self._newest = data, time.monotonic()
        else:
            self._strange = data

    def read(self) -> RobotState | None:
        """Newest state; its time is that of its arrival here."""
        newest, self._newest = self._newest, None
        strange, self._strange = self._strange, None
        try:
            if newest is not None:
                state, robot, names = unpack_state(*newest)
                if self._state is None:
                    self._head, self._robot = newest[0][:HEAD], robot
                # Datagrams may overtake each other, and a bridge may repeat the last word of a robot that is silent.
                if self._state is None or state.sequence > self._state.sequence:
                    self._state, self.joint_names = state, names
            if strange is not None:
                unpack_state(strange, 0.0)  # says why, if it cannot be understood
                self.refused.add(f"another robot speaks on {STATE_CHANNEL} too; give one of them another domain")
        except MessageError as error:
            self.refused.add(str(error))
        return self._state

    def send(self, command: JointCommand) -> None:
        """Give the motors a command; lost if the network is gone."""
        self._sequence += 1
        message = pack_command(command, Sent(self._robot, self._me, self._sequence), time.monotonic())
        with contextlib.suppress(OSError):
            self._lcm.publish(COMMAND_CHANNEL, message)

    def other_commanders(self) -> Sequence[str]:
        """Who else has commanded this robot within half a second."""
        now = time.monotonic()
        while self._commands:
            try:
                _, sent = unpack_command(self._commands.popleft())
            except MessageError:  # no robot obeys it, so it is no commander
                continue
            if sent.robot == self._robot and sent.sender != self._me:
                self._others.heard(sent.sender, now)
        count = self._others.count(now)
        return (f"{count} other program{'s' if count > 1 else ''}",) if count else ()

    def close(self) -> None:
        """Stop listening and leave the network; calling it again does nothing."""
        self._closing.set()
        self._listener.join()
        self._lcm = None


class LCMRobot:
    """The robot's end of the line: makes a simulated robot speak and obey.

    Source: as :class:`LCMTransport`.

    Args:
        robot: what is driven.
        url: where LCM meets, from :func:`address` or as LCM writes it.

    Attributes:
        refused: count and last reason of commands that were refused.
    """

    def __init__(self, robot: SimulatedRobot, url: str | None = None) -> None:
        self.robot = robot
        self.name = secrets.randbits(63)
        self.refused = _Refusals()
        self._last: Sent | None = None
        self._lcm = connect(address() if url is None else url)
        self._lcm.subscribe(COMMAND_CHANNEL, self._command_arrived)

    def _command_arrived(self, channel: str, data: bytes) -> None:
        try:
            command, sent = unpack_command(data)
        except MessageError as error:
            self.refused.add(str(error))
            return
        if sent.robot != self.name:
            self.refused.add(f"it is meant for the robot {sent.robot:x}, this is {self.name:x}")
        elif self._last is not None and sent.sender == self._last.sender and sent.sequence <= self._last.sequence:
            self.refused.add("it was overtaken by a newer one")
        else:
            self.robot.command(command)
            self._last = sent

    def receive(self) -> None:
        """Obey what has arrived; the newest command counts, whoever sent it."""
        while self._lcm.handle_timeout(0):
            pass

    def publish(self) -> None:
        """Say the state."""
        message = pack_state(self.robot.state(time.monotonic()), self.name)
        with contextlib.suppress(OSError):
            self._lcm.publish(STATE_CHANNEL, message)

    def close(self) -> None:
        """Leave the network; calling it again does nothing."""
        self._lcm = None
