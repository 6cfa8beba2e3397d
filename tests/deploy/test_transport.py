"""States and commands, and the fake bus."""

from __future__ import annotations

import torch

from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.transport import FakeBus, JointCommand, RobotState, Transport
from agility_rl.go2 import constants


def test_the_fake_bus_gives_what_was_put_there() -> None:
    clock = ManualClock()
    bus = FakeBus(clock)
    transport: Transport = bus
    clock.time, bus.age = 3.0, 0.5
    state = transport.read()
    assert state is not None and state.time == 2.5
    bus.state = None
    assert transport.read() is None


def test_joints_follow_only_what_drives_them() -> None:
    bus = FakeBus(ManualClock())
    target = torch.tensor(constants.DEFAULT_POSE) + 0.1
    bus.send(JointCommand.damped(3.0))
    assert torch.equal(bus.read().joint_position, torch.tensor(constants.DEFAULT_POSE))
    bus.send(JointCommand(target, torch.full((12,), 40.0), torch.ones(12)))
    assert torch.equal(bus.read().joint_position, target) and len(bus.sent) == 2


def test_damping_has_no_target() -> None:
    command = JointCommand.damped(3.0)
    assert not command.stiffness.any() and not command.torque.any() and not command.velocity.any()
    assert command.damping.tolist() == [3.0] * 12


def test_a_standing_robot_carries_its_weight() -> None:
    state = RobotState.standing(4.0)
    assert state.time == 4.0
    assert torch.isclose(state.foot_force.sum(), torch.tensor(9.81 * constants.TOTAL_MASS))
