"""The robot's end of the line, in a thread, and as a process of its own."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Iterator

import pytest
import torch

from agility_rl.deploy.loopback import LoopbackTransport, pack_command, seal
from agility_rl.deploy.robot_process import RobotProcess, RobotServer, in_real_time
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import JointCommand
from agility_rl.go2 import constants
from tests.waiting import until


@pytest.fixture
def server() -> Iterator[RobotServer]:
    found = RobotServer(SimulatedRobot(command_timeout=None))
    stop = threading.Event()
    thread = threading.Thread(target=in_real_time, args=(found,), kwargs={"stopped": stop.is_set})
    thread.start()
    yield found
    stop.set()
    thread.join()
    found.close()


def test_states_come_and_commands_arrive(server: RobotServer) -> None:
    transport = LoopbackTransport(server.port, patience=60.0)
    assert tuple(transport.joint_names) == constants.JOINT_NAMES
    first = transport.read()
    assert until(lambda: transport.read().sequence > first.sequence)
    assert transport.read().time <= time.monotonic() and transport.other_commanders() == ()
    gains = torch.full((12,), 31.0), torch.full((12,), 2.0)
    transport.send(JointCommand(torch.tensor(constants.DEFAULT_POSE), *gains))
    # The robot's thread sets the damping after the stiffness.
    assert until(lambda: server.robot.model.actuator_biasprm[0, 2] == -2.0)
    assert server.robot.model.actuator_gainprm[0, 0] == 31.0
    transport.close()


def test_a_second_commander_is_seen_by_both(server: RobotServer) -> None:
    one, two = (LoopbackTransport(server.port, patience=60.0) for _ in range(2))

    def both_seen() -> bool:
        one.send(JointCommand.damped(3.0))
        two.send(JointCommand.damped(3.0))
        for transport in (one, two):
            transport.read()
        return bool(one.other_commanders()) and bool(two.other_commanders())

    assert until(both_seen)
    assert one.other_commanders() == ("1 other program",)

    def gone() -> bool:
        one.send(JointCommand.damped(3.0))
        one.read()
        return not one.other_commanders()

    two.close()
    assert until(gone)
    one.close()


def test_damaged_and_foreign_packets_do_nothing(server: RobotServer) -> None:
    command = pack_command(JointCommand(torch.zeros(12), torch.full((12,), 99.0), torch.ones(12)), 1, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for packet in (b"", b"hello", command[:-1], command[:50] + b"\xff" + command[51:], seal(b"what", b"")):
            stranger.sendto(packet, ("127.0.0.1", server.port))
        assert until(lambda: server.rejected >= 5)
    assert not (server.robot.model.actuator_gainprm[:, 0] == 99.0).any()


def test_the_process_runs_in_real_time_and_dies_with_its_parent() -> None:
    with RobotProcess(pose="standing", friction_loss=0.0) as robot:
        transport = LoopbackTransport(robot.port, patience=60.0)
        first = transport.read()
        assert until(lambda: transport.read().time > first.time + 0.2)
        robot._process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        last = transport.read()
        time.sleep(0.3)
        assert transport.read().sequence == last.sequence, "a stopped robot says nothing: its state grows old"
        robot._process.send_signal(signal.SIGCONT)
        # It may have been stopped before it said what it says next; the state after that one it says late.
        assert until(lambda: transport.read().sequence > last.sequence + 1)
        transport.close()
    assert robot._process.returncode == 0 and robot.lost > 0.0


def test_a_process_that_cannot_begin_says_so() -> None:
    with pytest.raises(ConnectionError, match="ended with status 1 before it began"):
        RobotProcess(pose="sitting")
