"""Packets, and the controller's end of the line."""

from __future__ import annotations

import contextlib
import socket
import threading
from dataclasses import fields, replace

import pytest
import torch

from agility_rl.deploy.loopback import (
    COMMAND,
    GREETING,
    STATE,
    Commanders,
    LoopbackTransport,
    PacketError,
    pack_command,
    pack_state,
    seal,
    unpack_command,
    unpack_state,
    unseal,
)
from agility_rl.deploy.robot_process import RobotServer, in_real_time
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import JointCommand, RobotState
from tests.waiting import until


def random_state(generator: torch.Generator) -> RobotState:
    sizes = {"quaternion": 4, "angular_velocity": 3, "joint_position": 12, "joint_velocity": 12, "joint_torque": 12}
    sizes |= {"foot_force": 4, "linear_acceleration": 3, "trunk_position": 3}
    values = {name: torch.randn(size, generator=generator) for name, size in sizes.items()}
    return RobotState(time=123.456789, sequence=7, **values)


def test_a_state_arrives_bit_for_bit(generator: torch.Generator) -> None:
    state = random_state(generator)
    kind, body = unseal(pack_state(state, 3))
    found, commanders = unpack_state(body)
    assert kind == STATE and commanders == 3
    for entry in fields(RobotState):
        sent, got = getattr(state, entry.name), getattr(found, entry.name)
        assert torch.equal(sent, got) if isinstance(sent, torch.Tensor) else sent == got, entry.name
    unknown, _ = unpack_state(unseal(pack_state(replace(state, trunk_position=None), 0))[1])
    assert unknown.trunk_position is None and torch.equal(unknown.joint_torque, state.joint_torque)


def test_a_command_arrives_bit_for_bit(generator: torch.Generator) -> None:
    command = JointCommand(*torch.randn(5, 12, generator=generator))
    kind, body = unseal(pack_command(command, session=2**63 + 1, sequence=5))
    found, session = unpack_command(body)
    assert kind == COMMAND and session == 2**63 + 1
    for entry in fields(JointCommand):
        assert torch.equal(getattr(command, entry.name), getattr(found, entry.name)), entry.name


def test_damaged_packets_are_refused(generator: torch.Generator) -> None:
    packet = pack_state(random_state(generator), 1)
    for index in range(0, len(packet), 7):
        damaged = packet[:index] + bytes([packet[index] ^ 4]) + packet[index + 1 :]
        with pytest.raises(PacketError, match="wrong checksum"):
            unseal(damaged)
    with pytest.raises(PacketError, match="wrong checksum"):
        unseal(b"short")
    with pytest.raises(PacketError, match="made by another version"):
        unpack_state(unseal(seal(STATE, b"\0" * 20))[1])
    with pytest.raises(PacketError, match="made by another version"):
        unpack_command(unseal(seal(GREETING, b""))[1])


def test_commanders_are_forgotten() -> None:
    commanders = Commanders(memory=0.5)
    for session, now in ((1, 0.0), (2, 0.3), (1, 0.4)):
        commanders.heard(session, now)
    assert [commanders.count(now) for now in (0.4, 0.85, 1.0)] == [2, 1, 0]


def test_who_has_fallen_silent_does_not_take_itself_for_alone() -> None:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(contextlib.closing(RobotServer(SimulatedRobot())))
        stop = threading.Event()
        thread = threading.Thread(target=in_real_time, args=(server,), kwargs={"stopped": stop.is_set})
        thread.start()
        stack.callback(thread.join)
        stack.callback(stop.set)
        driving, silent = (
            stack.enter_context(contextlib.closing(LoopbackTransport(server.port, patience=60.0))) for _ in range(2)
        )
        silent.send(JointCommand.damped(0.0))

        def heard() -> int:
            """How many programs command, as the robot tells; one of them goes on."""
            driving.send(JointCommand.damped(0.0))
            silent.read()
            driving.read()
            return driving._commanders

        assert until(lambda: heard() == 2)
        assert until(lambda: heard() == 1 and silent._commanders == 1 and driving.other_commanders() == ())
        assert silent.other_commanders() == ("1 other program",)


def test_a_missing_robot_is_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        with pytest.raises(ConnectionError, match=rf"no robot answers on 127.0.0.1, port {port}, within 0 s"):
            LoopbackTransport(port, patience=0.2)
