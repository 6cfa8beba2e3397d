"""What travels between controller and robot, and the interface of whatever carries it; a fake bus for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from agility_rl.deploy.deadlines import Clock
from agility_rl.go2 import constants


@dataclass(frozen=True)
class RobotState:
    """What a robot last said about itself; joints and feet in the order of :mod:`agility_rl.go2.constants`.

    Attributes:
        time: when it arrived, on the controller's clock [s].
        quaternion: ``[4]``, (w, x, y, z), trunk to world.
        angular_velocity: ``[3]`` [rad/s], base frame.
        joint_position: ``[12]`` [rad].
        joint_velocity: ``[12]`` [rad/s].
        joint_torque: ``[12]`` [N m], as the motors estimate it.
        foot_force: ``[4]`` [N].
        linear_acceleration: ``[3]`` [m/s^2], base frame, gravity included.
        trunk_position: ``[3]`` [m], if something measures it: a simulator, or motion capture.
        sequence: number of the message, rising.
    """

    time: float
    quaternion: Tensor
    angular_velocity: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    joint_torque: Tensor
    foot_force: Tensor
    linear_acceleration: Tensor
    trunk_position: Tensor | None = None
    sequence: int = 0

    @classmethod
    def standing(cls, time: float = 0.0) -> RobotState:
        """A robot that stands still in the default pose.

        Example:
            >>> RobotState.standing().joint_position[:3]
            tensor([ 0.0000,  0.9000, -1.8000])
        """
        return cls(
            time=time,
            quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]),
            angular_velocity=torch.zeros(3),
            joint_position=torch.tensor(constants.DEFAULT_POSE),
            joint_velocity=torch.zeros(constants.NUM_JOINTS),
            joint_torque=torch.zeros(constants.NUM_JOINTS),
            foot_force=torch.full((len(constants.LEGS),), constants.GRAVITY * constants.TOTAL_MASS / 4),
            linear_acceleration=torch.tensor([0.0, 0.0, constants.GRAVITY]),
        )


@dataclass(frozen=True)
class JointCommand:
    """What every motor is to do: ``torque + stiffness (position - q) + damping (velocity - dq)``, each ``[12]``.

    The motors compute it themselves, at 1,000 Hz on the Go2 (supplement S3).

    Attributes:
        position: target [rad].
        stiffness: gain on the position [N m/rad].
        damping: gain on the velocity [N m s/rad].
        velocity: target [rad/s].
        torque: added as it is [N m].
    """

    position: Tensor
    stiffness: Tensor
    damping: Tensor
    velocity: Tensor = field(default_factory=lambda: torch.zeros(constants.NUM_JOINTS))
    torque: Tensor = field(default_factory=lambda: torch.zeros(constants.NUM_JOINTS))

    @classmethod
    def damped(cls, damping: float) -> JointCommand:
        """No target: the joints only resist motion; with 0 they are limp.

        Example:
            >>> command = JointCommand.damped(3.0)
            >>> command.stiffness.sum().item(), command.damping[0].item()
            (0.0, 3.0)
        """
        nothing = torch.zeros(constants.NUM_JOINTS)
        return cls(nothing, nothing, torch.full_like(nothing, damping))


class Transport(Protocol):
    """A way to one robot. It maps the robot's own order of joints to ours, and names what it gives.

    Attributes:
        joint_names: the joints of every state and command, in order, as the robot's side calls them.
    """

    joint_names: Sequence[str]

    def read(self) -> RobotState | None:
        """Newest state, never waiting; ``None`` if none has arrived yet."""

    def send(self, command: JointCommand) -> None:
        """Give the motors a command, which they keep until the next."""

    def other_commanders(self) -> Sequence[str]:
        """Who else has lately sent commands to this robot; empty if nobody."""

    def close(self) -> None:
        """Release what the transport holds."""


class FakeBus:
    """A transport without a robot, into which tests put states and faults.

    Args:
        clock: what tells the time of states.
        joint_names: what the robot calls its joints.

    Attributes:
        state: what :meth:`read` returns, its time set to the present minus :attr:`age`; ``None`` for no robot.
        age: how old every state is [s].
        others: what :meth:`other_commanders` returns.
        sent: every command, oldest first.
        follow: joints jump to each commanded position.

    Example:
        >>> from agility_rl.deploy.deadlines import ManualClock
        >>> bus = FakeBus(ManualClock())
        >>> bus.send(JointCommand.damped(3.0))
        >>> bus.read().time, len(bus.sent)
        (0.0, 1)
    """

    def __init__(self, clock: Clock, joint_names: Sequence[str] = constants.JOINT_NAMES) -> None:
        self.clock, self.joint_names = clock, joint_names
        self.state: RobotState | None = RobotState.standing()
        self.age = 0.0
        self.others: tuple[str, ...] = ()
        self.sent: list[JointCommand] = []
        self.follow = True

    def read(self) -> RobotState | None:
        """The state that the test put here."""
        return None if self.state is None else replace(self.state, time=self.clock.now() - self.age)

    def send(self, command: JointCommand) -> None:
        """Keep the command."""
        self.sent.append(command)
        if self.follow and self.state is not None and bool(command.stiffness.any()):
            self.state = replace(self.state, joint_position=command.position)

    def other_commanders(self) -> Sequence[str]:
        """What the test put here."""
        return self.others

    def close(self) -> None:
        """Nothing to release."""
