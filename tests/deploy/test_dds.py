"""LowCmd and LowState over the loopback interface: between threads, and between two processes."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator

import pytest
import torch

from agility_rl.deploy import unitree_messages as unitree
from agility_rl.deploy.dds import DDSRobot, DDSTransport, message_types, participant, to_message, to_record
from agility_rl.deploy.robot_process import RobotProcess, in_real_time
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants
from tests.waiting import until

DOMAIN = 1 + os.getpid() % 100  # tests that run at the same time must not command each other's robots
"""Not that of a robot, which is 0."""


@pytest.fixture
def dds() -> None:
    pytest.importorskip("cyclonedds", reason="needs the extra dds")


@pytest.fixture
def robot(dds: None) -> Iterator[DDSRobot]:
    found = DDSRobot(SimulatedRobot(command_timeout=None), domain=DOMAIN)
    stop = threading.Event()
    thread = threading.Thread(target=in_real_time, args=(found,), kwargs={"stopped": stop.is_set})
    thread.start()
    yield found
    stop.set()
    thread.join()
    found.close()


def test_messages_have_unitrees_names_and_survive_the_wire(dds: None) -> None:
    state = unitree.to_low_state(RobotState.standing())
    state["wireless_remote"], state["bms_state"]["current"] = range(40), -1234
    unitree.seal(state)
    command = unitree.to_low_command(JointCommand(*torch.arange(60.0).reshape(5, 12)))
    for name, record in (("LowState_", state), ("LowCmd_", command)):
        structure = message_types()[name]
        assert structure.__idl_typename__.replace("::", ".") == f"unitree_go.msg.dds_.{name}"
        bytes_sent = to_message(record).serialize()
        assert bytes_sent[:4] == b"\0\1\0\0", "plain CDR, little-endian: what a final structure is sent as"
        found = to_record(structure.deserialize(bytes_sent), name)
        assert found.tobytes() == record.tobytes() and unitree.is_intact(found)


def test_states_come_and_commands_arrive(robot: DDSRobot) -> None:
    transport = DDSTransport(domain=DOMAIN, patience=60.0)
    assert tuple(transport.joint_names) == constants.JOINT_NAMES
    first = transport.read()
    assert until(lambda: transport.read().sequence > first.sequence)
    assert first.time < transport.read().time <= time.monotonic() and transport.other_commanders() == ()
    gains = torch.full((12,), 31.0), torch.full((12,), 2.0)
    transport.send(JointCommand(torch.arange(12.0), *gains))
    # The robot's thread sets the positions last.
    assert until(lambda: robot.robot.data.ctrl.tolist() == list(range(12))), "our joints, in our order"
    assert robot.robot.model.actuator_gainprm[0, 0] == 31.0
    assert robot.robot.model.actuator_biasprm[0, 2] == -2.0
    assert transport.other_commanders() == () and robot.rejected == 0
    transport.close()
    transport.close()


def test_a_command_with_a_wrong_checksum_is_ignored(robot: DDSRobot) -> None:
    transport = DDSTransport(domain=DOMAIN, patience=60.0)
    record = unitree.to_low_command(JointCommand(torch.zeros(12), torch.full((12,), 99.0), torch.ones(12)))
    record["crc"] ^= 1
    assert until(lambda: transport._line.writer.write(to_message(record)) or robot.rejected > 0)
    assert not (robot.robot.model.actuator_gainprm[:, 0] == 99.0).any()
    transport.close()


def test_a_second_commander_and_the_remote_are_seen(robot: DDSRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (DDSTransport(domain=DOMAIN, patience=60.0) for _ in range(2))

    def both_seen() -> bool:
        one.send(JointCommand.damped(3.0))
        two.send(JointCommand.damped(3.0))
        return bool(one.other_commanders()) and bool(two.other_commanders())

    assert until(both_seen)
    assert one.other_commanders() == ("1 other program",)
    two.close()
    assert until(lambda: not one.other_commanders())

    to_low_state = unitree.to_low_state

    def pressed(state: RobotState):
        record = to_low_state(state)
        record["wireless_remote"][2:4] = 32, 2
        return record

    monkeypatch.setattr(unitree, "to_low_state", pressed)  # the simulated robot has no remote control of its own
    assert until(lambda: one.read() is not None and one.other_commanders() == ("the remote control (L2 + B)",))
    one.close()


def test_another_robot_is_no_news_of_the_first_and_is_named(robot: DDSRobot) -> None:
    transport = DDSTransport(domain=DOMAIN, patience=60.0)
    stranger = DDSRobot(SimulatedRobot(), domain=DOMAIN)
    hip = constants.JOINT_NAMES.index("FL_hip_joint")
    stranger.robot.data.qpos[7 + hip] = 0.7
    seen: list[float] = []

    def named() -> bool:
        stranger.publish()
        seen.append(float(transport.read().joint_position[hip]))
        return transport.other_commanders() == (f"another robot on {unitree.STATE_TOPIC}",)

    assert until(named)
    for _ in range(50):
        time.sleep(0.002)
        named()
    assert max(seen) < 0.6
    stranger.close()
    transport.close()


def test_a_state_that_is_repeated_grows_old(dds: None) -> None:
    silent = DDSRobot(SimulatedRobot(), domain=DOMAIN)
    last_word = to_message(unitree.to_low_state(RobotState.standing()))
    stop = threading.Event()

    def repeat() -> None:
        while not stop.wait(0.002):
            silent._line.writer.write(last_word)

    thread = threading.Thread(target=repeat)
    thread.start()
    transport = DDSTransport(domain=DOMAIN, patience=60.0)
    begun = time.monotonic()
    assert until(lambda: transport.read().time < time.monotonic() - 0.2 or time.monotonic() > begun + 5.0)
    assert transport.read().time <= begun
    stop.set()
    thread.join()
    transport.close()
    silent.close()


def test_an_interface_that_cannot_be_used_is_named(dds: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(9, "eth9")])  # one that was there a moment ago
    with pytest.raises(ConnectionError, match=f"cannot join DDS domain {DOMAIN + 101} by the interface eth9: is it up"):
        participant("eth9", DOMAIN + 101)


def test_two_processes_and_a_robot_that_falls_silent(dds: None) -> None:
    with RobotProcess(pose="standing", friction_loss=0.0, dds={"domain": DOMAIN}) as robot:
        transport = DDSTransport(domain=DOMAIN, patience=60.0)
        first = transport.read()
        assert until(lambda: transport.read().sequence > first.sequence + 50)
        # It obeys: a target off the default pose is reached, at the joint that was meant.
        target = torch.tensor(constants.DEFAULT_POSE)
        target[constants.JOINT_NAMES.index("FL_calf_joint")] += 0.3
        command = JointCommand(target, torch.full((12,), 60.0), torch.full((12,), 3.0))

        def reached() -> bool:
            transport.send(command)
            return float(transport.read().joint_position[2]) > constants.DEFAULT_POSE[2] + 0.15

        assert until(reached)
        robot._process.send_signal(signal.SIGSTOP)
        time.sleep(0.2)
        last = transport.read()
        time.sleep(0.3)
        assert transport.read().time == last.time, "a stopped robot says nothing: its state grows old"
        robot._process.send_signal(signal.SIGCONT)
        assert until(lambda: transport.read().sequence > last.sequence)
        transport.close()
    assert robot._process.returncode == 0


def test_what_is_not_there_is_named(dds: None) -> None:
    with pytest.raises(ValueError, match=r"a network interface of this machine \(.*lo.*\), got 'none0'"):
        DDSTransport("none0")
    with pytest.raises(ValueError, match="a DDS domain between 0 and 232, got 233"):
        DDSTransport(domain=233)
    with pytest.raises(
        ConnectionError, match=rf"no robot speaks on rt/lowstate in DDS domain {DOMAIN} on the loopback"
    ):
        DDSTransport(domain=DOMAIN, patience=0.1)
    with pytest.raises(ValueError, match="by another interface already"):
        participant("lo", DOMAIN)


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    message_types.cache_clear()
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'agility_rl\[dds\]'"):
        DDSTransport(domain=DOMAIN)
