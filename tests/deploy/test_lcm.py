"""States and commands over LCM: between threads, and between two processes, on the loopback interface."""

from __future__ import annotations

import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from agility_rl.deploy import lcm_messages
from agility_rl.deploy.artifact import Artifact
from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import BehaviourCommand, Operator
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.lcm import COMMAND_CHANNEL, STATE_CHANNEL, LCMRobot, LCMTransport, address, connect
from agility_rl.deploy.lcm_messages import Sent, pack_command, pack_state
from agility_rl.deploy.robot_process import RobotProcess, in_real_time
from agility_rl.deploy.safety import SafetyLimits
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants
from tests.waiting import until

DOMAIN = 1 + os.getpid() % 900
"""Tests that run at the same time must not command each other's robots."""


@pytest.fixture
def url() -> str:
    pytest.importorskip("lcm", reason="needs the extra lcm")
    try:
        connect(address(DOMAIN))
    except ConnectionError as error:
        pytest.skip(str(error))
    return address(DOMAIN)


@pytest.fixture
def robot(url: str) -> Iterator[LCMRobot]:
    found = LCMRobot(SimulatedRobot(command_timeout=None), url)
    stop = threading.Event()
    thread = threading.Thread(target=in_real_time, args=(found,), kwargs={"stopped": stop.is_set})
    thread.start()
    yield found
    stop.set()
    thread.join()
    found.close()


def test_states_come_and_commands_arrive(robot: LCMRobot, url: str) -> None:
    transport = LCMTransport(url, patience=60.0)
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
    assert transport.other_commanders() == () and robot.refused.count == transport.refused.count == 0
    transport.close()
    transport.close()


def test_the_last_word_of_a_silent_robot_grows_old_though_it_is_repeated(robot: LCMRobot, url: str) -> None:
    transport = LCMTransport(url, patience=60.0)
    last = replace(transport.read(), sequence=10**6)
    repeater = connect(url)
    message = pack_state(last, robot.name)
    assert until(lambda: repeater.publish(STATE_CHANNEL, message) or transport.read().sequence == 10**6)
    heard = transport.read().time
    for _ in range(5):
        repeater.publish(STATE_CHANNEL, message)
        time.sleep(0.02)
        assert transport.read().time == heard
    transport.close()


def test_a_second_commander_is_seen_by_both(robot: LCMRobot, url: str) -> None:
    one, two = (LCMTransport(url, patience=60.0) for _ in range(2))

    def both_seen() -> bool:
        one.send(JointCommand.damped(3.0))
        two.send(JointCommand.damped(3.0))
        return bool(one.other_commanders()) and bool(two.other_commanders())

    assert until(both_seen)
    assert one.other_commanders() == ("1 other program",)
    two.close()
    assert until(lambda: one.send(JointCommand.damped(3.0)) or not one.other_commanders())
    one.close()


def test_commands_of_another_version_for_another_robot_or_overtaken_do_nothing(robot: LCMRobot, url: str) -> None:
    stiff = JointCommand(torch.zeros(12), torch.full((12,), 99.0), torch.ones(12))
    good = pack_command(stiff, Sent(robot.name, 5, 10), 0.0)
    newer = good[:8] + struct.pack(">i", lcm_messages.VERSION + 1) + good[12:]
    refused = {
        newer: "joint_command_t: its version is 2, expected 1; install the same version of agility_rl on both",
        b"\1" + good[1:]: "the other side has another layout",
        good[:-4]: "damaged at byte",
        pack_command(stiff, Sent(robot.name + 1, 5, 11), 0.0): "it is meant for the robot",
    }
    line = connect(url)
    for count, (message, reason) in enumerate(refused.items(), 1):
        assert until(
            lambda message=message, count=count: robot.refused.count >= count or line.publish(COMMAND_CHANNEL, message)
        )
        assert reason in robot.refused.reason
        robot.refused.count = count
    assert not (robot.robot.model.actuator_gainprm[:, 0] == 99.0).any()
    line.publish(COMMAND_CHANNEL, good)
    assert until(lambda: (robot.robot.model.actuator_gainprm[:, 0] == 99.0).all())
    limp = pack_command(JointCommand.damped(0.0), Sent(robot.name, 5, 9), 0.0)
    assert until(lambda: line.publish(COMMAND_CHANNEL, limp) or "overtaken" in robot.refused.reason)
    assert (robot.robot.model.actuator_gainprm[:, 0] == 99.0).all()


def test_states_of_another_version_or_robot_are_refused_with_the_reason(robot: LCMRobot, url: str) -> None:
    transport, line = LCMTransport(url, patience=60.0), connect(url)
    mine = pack_state(RobotState.standing(), robot.name)
    other = pack_state(RobotState.standing(), robot.name + 1)
    newer = mine[:8] + struct.pack(">i", lcm_messages.VERSION + 1) + mine[12:]
    for message, reason in (
        (newer, "its version is 2, expected 1"),
        (other, f"another robot speaks on {STATE_CHANNEL}"),
    ):
        assert until(
            lambda m=message, r=reason: (
                (transport.read() and r in transport.refused.reason) or line.publish(STATE_CHANNEL, m)
            )
        )
    last = transport.read()
    assert until(lambda: transport.read().sequence > last.sequence)
    transport.close()


def test_a_robot_of_another_version_is_named(url: str) -> None:
    elsewhere = address(DOMAIN + 1)
    line, stop = connect(elsewhere), threading.Event()
    message = pack_state(RobotState.standing(), 1)
    message = message[:8] + struct.pack(">i", lcm_messages.VERSION + 1) + message[12:]

    def speak() -> None:
        while not stop.wait(0.01):
            line.publish(STATE_CHANNEL, message)

    thread = threading.Thread(target=speak)
    thread.start()
    with pytest.raises(ConnectionError, match="heard and refused: robot_state_t: its version is 2, expected 1"):
        LCMTransport(elsewhere, patience=1.0)
    stop.set()
    thread.join()
    with pytest.raises(ConnectionError, match=rf"no robot speaks on {STATE_CHANNEL} at udpm://.* within 0 s; is it"):
        LCMTransport(elsewhere, patience=0.1)


def test_two_processes_and_either_falls_silent(url: str, artifact: Artifact) -> None:
    with RobotProcess(pose="standing", friction_loss=0.0, lcm={"url": url}) as process:
        transport = LCMTransport(url, patience=60.0)
        still = DeployedBBC(lambda *inputs: (torch.zeros(1, 12), torch.zeros(1, 4)), artifact)
        patient = SafetyLimits(source_age={"operator": 1e6}, missed_deadlines=10**9, state_age=0.25)
        controller = Controller(transport, still, Operator(BehaviourCommand.of("walk"), 0.0), limits=patient)
        controller.request(Mode.STAND_UP)
        assert until(lambda: controller.step().mode is Mode.READY)
        # It obeys: it stands in the default pose.
        pose = torch.tensor(constants.DEFAULT_POSE)
        assert (transport.read().joint_position - pose).abs().max() < 0.35 and controller.fault is None
        # The robot falls silent: its last state grows old, and the controller gives up.
        process._process.send_signal(signal.SIGSTOP)
        assert until(lambda: controller.step().mode is Mode.DAMPING)
        assert controller.fault is not None and controller.fault.check == "stale state", controller.fault
        process._process.send_signal(signal.SIGCONT)
        # The controller falls silent: the motors damp by themselves, and the legs give way under the trunk.
        hold = JointCommand(pose, torch.full((12,), 60.0), torch.full((12,), 3.0))
        assert until(lambda: transport.send(hold) or float((transport.read().joint_position - pose).abs().max()) < 0.2)
        assert until(lambda: float((transport.read().joint_position - pose).abs().max()) > 0.4)
        transport.close()
    assert process._process.returncode == 0


def test_addresses_and_what_is_not_there() -> None:
    assert address(domain=3, ttl=1) == "udpm://239.255.76.67:7670?ttl=1"
    with pytest.raises(ValueError, match="got 1000 and 0"):
        address(domain=1000)
    with pytest.raises(ValueError, match="got 0 and 256"):
        address(ttl=256)
    pytest.importorskip("lcm", reason="needs the extra lcm")
    with pytest.raises(ConnectionError, match=r"LCM cannot join udpm://300\.0\.0\.1:7667: no such address, or no"):
        LCMTransport("udpm://300.0.0.1:7667")


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lcm", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'agility_rl\[lcm\]'"):
        LCMTransport()
