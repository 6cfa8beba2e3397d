"""A simulated robot in a process of its own, in real time: 1,000 Hz motors, 500 Hz states, as the Go2 has them."""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import torch

from agility_rl.deploy.loopback import (
    COMMAND,
    GREETING,
    HOST,
    LARGEST,
    NAMES,
    Commanders,
    PacketError,
    pack_depth,
    pack_state,
    seal,
    unpack_command,
    unseal,
)
from agility_rl.deploy.simulated import SimulatedRobot, add_world
from agility_rl.deploy.simulated_camera import FRAME_PERIOD, SimulatedCamera
from agility_rl.go2 import constants

STATE_PERIOD = 0.002
"""Time between two states [s]: 500 Hz."""
MOST_BEHIND = 0.02
"""Simulated time that is made up for after a delay [s]; what is lost beyond it makes the robot slower than life."""
SETTLE_SECONDS = 1.0
"""Simulated time in which the robot comes to rest before anybody may command it [s]."""
PATIENCE = 10.0
"""Time that the process gets to end by itself [s]."""
LISTENER_MEMORY = 2.0
"""Time without a word after which a listener gets no more states [s]."""


class Served(Protocol):
    """A simulated robot at one end of some line."""

    robot: SimulatedRobot

    def receive(self) -> None:
        """Obey what has arrived."""

    def publish(self) -> None:
        """Say the state."""

    def close(self) -> None:
        """Release the line."""


def in_real_time(served: Served, seconds: float | None = None, stopped: Callable[[], bool] = lambda: False) -> float:
    """Step a robot in real time, obeying and telling, until told to stop or for some time.

    Source: supplement S3 (motors at 1,000 Hz).

    Returns:
        Simulated seconds that could not be made up for.
    """
    begun = due = time.monotonic()
    lost = 0.0
    while not stopped() and (seconds is None or time.monotonic() - begun < seconds):
        due += STATE_PERIOD
        now = time.monotonic()
        if now < due:
            time.sleep(due - now)
        elif now - due > MOST_BEHIND:
            lost += now - due - MOST_BEHIND
            due = now - MOST_BEHIND
        served.receive()
        served.robot.advance(STATE_PERIOD)
        served.publish()
    return lost


class RobotServer:
    """A simulated robot's end of the loopback line: obeys the commands that arrive, tells its state to who asked.

    :func:`in_real_time` runs it.

    Source: supplement S3 (motors at 1,000 Hz).

    Args:
        robot: what is stepped.
        port: to listen on; 0 takes a free one.
        eye: the robot's camera; ``None`` if it is blind.

    Attributes:
        port: the port.
        rejected: packets that were damaged or unknown.
    """

    def __init__(self, robot: SimulatedRobot, port: int = 0, eye: SimulatedCamera | None = None) -> None:
        self.robot, self.eye = robot, eye
        self._seen = -FRAME_PERIOD
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, port))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self.commanders = Commanders()
        self.rejected = 0
        self._listeners: dict[tuple[str, int], float] = {}

    def receive(self) -> None:
        """Take everything that has arrived; the newest command counts, whoever sent it."""
        while True:
            try:
                packet, sender = self._socket.recvfrom(LARGEST)
            except (BlockingIOError, ConnectionRefusedError):
                return
            now = time.monotonic()
            try:
                kind, body = unseal(packet)
                if kind == COMMAND:
                    command, session = unpack_command(body)
                    self.robot.command(command)
                    self.commanders.heard(session, now)
                elif kind == GREETING:
                    self._socket.sendto(seal(NAMES, json.dumps(constants.JOINT_NAMES).encode()), sender)
                else:
                    self.rejected += 1
                    continue
                self._listeners[sender] = now
            except PacketError:
                self.rejected += 1

    def publish(self) -> None:
        """Tell the state, and at its own rate what the camera sees, to everybody who has lately been heard."""
        now = time.monotonic()
        self._listeners = {who: last for who, last in self._listeners.items() if now - last <= LISTENER_MEMORY}
        if not self._listeners:
            return
        self._tell(pack_state(self.robot.state(now), self.commanders.count(now)))
        if self.eye is not None and now - self._seen >= FRAME_PERIOD:
            self._seen = now
            self._tell(pack_depth(now, self.eye.counts()))

    def _tell(self, packet: bytes) -> None:
        for listener in self._listeners:
            try:
                self._socket.sendto(packet, listener)
            except (ConnectionRefusedError, BlockingIOError):
                continue

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()


class RobotProcess:
    """Context manager that runs a :class:`RobotServer` in a process of its own.

    Args:
        pose: ``lying`` or ``standing``.
        port: to listen on; 0 takes a free one.
        dds: speak as a Go2 over DDS instead: keyword arguments ``interface`` and ``domain`` of
            :class:`agility_rl.deploy.dds.DDSRobot`; :attr:`port` is then 0.
        lcm: speak over LCM instead: keyword argument ``url`` of :class:`agility_rl.deploy.lcm.LCMRobot`; likewise.
        camera: the robot sees, and sends its depths; over the loopback line only.
        world: MJCF file of what stands around the robot (:func:`agility_rl.deploy.simulated.add_world`).
        **robot_options: keyword arguments of :class:`agility_rl.deploy.simulated.SimulatedRobot`, as JSON values.

    Attributes:
        port: where to reach it.
        lost: simulated seconds by which it fell behind; known after the end.

    Raises:
        ConnectionError: if the process does not come up.
    """

    def __init__(
        self,
        *,
        pose: str = "lying",
        port: int = 0,
        dds: dict[str, Any] | None = None,
        lcm: dict[str, Any] | None = None,
        camera: bool = False,
        world: str | None = None,
        **robot_options: Any,
    ) -> None:
        line = {"port": port, "dds": dds, "lcm": lcm, "camera": camera}
        options = {"pose": pose, "world": world, "line": line, **robot_options}
        command = [sys.executable, "-m", __name__, json.dumps(options)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
        self.lost = 0.0
        assert self._process.stdout is not None
        first = self._process.stdout.readline()
        if not first:
            self._process.communicate()
            raise ConnectionError(
                f"the robot's process ended with status {self._process.returncode} before it began; see its message"
            )
        self.port: int = json.loads(first)["port"]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process; calling it again does nothing."""
        if self._process.returncode is not None:
            return
        try:
            output, _ = self._process.communicate(timeout=PATIENCE)  # closes its input, at which it ends
        except subprocess.TimeoutExpired:
            self._process.kill()
            output, _ = self._process.communicate()
        if output:
            self.lost = float(json.loads(output)["lost"])


def serve_on(line: dict[str, Any], robot: SimulatedRobot) -> tuple[Served, int]:
    """The robot's end of the line that was asked for, and its port."""
    if line["dds"] is not None:
        from agility_rl.deploy.dds import DDSRobot  # only who uses DDS needs it

        return DDSRobot(robot, **line["dds"]), 0
    if line["lcm"] is not None:
        from agility_rl.deploy.lcm import LCMRobot

        return LCMRobot(robot, **line["lcm"]), 0
    server = RobotServer(robot, line["port"], SimulatedCamera(robot) if line["camera"] else None)
    return server, server.port


def main(options: dict[str, Any]) -> None:
    """Body of the process: says its port, and ends when its input is closed, also by the death of who started it."""
    pose, world, line = (options.pop(name) for name in ("pose", "world", "line"))
    robot = SimulatedRobot(**options) if world is None else SimulatedRobot(**options, surround=add_world(Path(world)))
    robot.reset(pose)
    robot.advance(SETTLE_SECONDS)
    served, port = serve_on(line, robot)
    sys.stdout.write(json.dumps({"port": port}) + "\n")
    sys.stdout.flush()
    lost = in_real_time(served, stopped=lambda: bool(select.select([sys.stdin], [], [], 0)[0]))
    served.close()
    sys.stdout.write(json.dumps({"lost": lost}) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(json.loads(sys.argv[1]))
