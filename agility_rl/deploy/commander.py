"""What the Basic Behaviour Controller is told to do, and who says so: an operator, or a policy above it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from agility_rl import behaviours
from agility_rl.deploy.transport import RobotState


@dataclass(frozen=True)
class BehaviourCommand:
    """A behaviour and how to do it.

    Attributes:
        skill: index into :data:`agility_rl.behaviours.BEHAVIOURS`.
        command: ``[5]`` in the order and units of :data:`agility_rl.behaviours.COMMANDS`.
        shift: latent shift in [-1, 1].

    Example:
        >>> command = BehaviourCommand.of("jump", velocity_x=1.0, height=0.5)
        >>> command.name, command.vector().shape
        ('jump', torch.Size([11]))
    """

    skill: int
    command: Tensor
    shift: float = 0.0

    @classmethod
    def of(
        cls,
        behaviour: str,
        *,
        velocity_x: float | None = None,
        velocity_y: float = 0.0,
        yaw_rate: float = 0.0,
        height: float | None = None,
        shift: float = 0.0,
    ) -> BehaviourCommand:
        """Command of a named behaviour, every number kept in the range that it was trained on.

        Source: Table S2 (ranges), released code (dead-bands).

        Args:
            behaviour: one of :data:`agility_rl.behaviours.BEHAVIOURS`.
            velocity_x: forward [m/s]; the middle of the range if not given.
            velocity_y: to the left [m/s].
            yaw_rate: to the left [rad/s].
            height: trunk height of a gait, or highest trunk of a jump [m]; the middle of the range if not given.
            shift: latent shift.

        Raises:
            ValueError: if there is no such behaviour, or a number is not finite.

        Example:
            >>> BehaviourCommand.of("trot", velocity_x=9.0).command
            tensor([1.5000, 0.0000, 0.0000, 0.0000, 0.2950])
        """
        skill = behaviours.skill_index(behaviour)
        low, high = (bound[skill] for bound in behaviours.command_bounds())
        command = (low + high) / 2
        wanted = (velocity_x, velocity_y, yaw_rate, height, height)
        for index, value in enumerate(wanted):
            if value is not None:
                command[index] = value
        if not bool(command.isfinite().all()):
            raise ValueError(f"expected finite commands for {behaviour}, got {command.tolist()}")
        command = torch.minimum(torch.maximum(command, low), high)
        dead = command.abs() < torch.tensor(behaviours.DEAD_BAND)
        return cls(skill, command.masked_fill(dead, 0.0), min(max(shift, -1.0), 1.0))

    @property
    def name(self) -> str:
        """The behaviour's name."""
        return behaviours.BEHAVIOURS[self.skill]

    @property
    def jumping(self) -> bool:
        """Whether the behaviour is the jump."""
        return self.skill == behaviours.JUMP

    def vector(self) -> Tensor:
        """``[11]`` as networks read it (:data:`agility_rl.keys.COMMAND`)."""
        return behaviours.command_vector(torch.tensor(self.skill), self.command, torch.tensor([self.shift]))


@dataclass(frozen=True)
class Perception:
    """What a commander may look at in a control step.

    Attributes:
        time: the controller's clock [s].
        state: what the robot said.
        proprioception: ``[45]`` as the networks read it (:data:`agility_rl.keys.PROPRIOCEPTION`).
        estimate: ``[4]``, what the behaviour controller estimated one step earlier (:data:`agility_rl.keys.ESTIMATE`).
    """

    time: float
    state: RobotState
    proprioception: Tensor
    estimate: Tensor


class Commander(Protocol):
    """Who tells the behaviour controller what to do, once in every control step.

    A task policy is one: it keeps its own memory (a recurrent state, the last depth image), forgets it in
    :meth:`reset`, and reports the age of its images by :meth:`sources`. A person is another, and a person who corrects
    a policy is a third, which asks both.
    """

    def reset(self) -> None:
        """Forget the past: the robot is about to start."""

    def decide(self, perception: Perception) -> BehaviourCommand:
        """What to do from now on."""

    def sources(self) -> Mapping[str, float]:
        """When each thing it depends on was last heard, on the controller's clock [s]: ``operator``, ``depth``."""


class Operator:
    """A person: the latest command that came in, and when the person's device was last heard.

    Whatever reads the device (a terminal, a gamepad, a browser) calls :meth:`command` on a change and :meth:`heard`
    at least a few times a second, also while nothing changes; a silent device stops the robot.

    Args:
        command: what to do until the first input.
        now: the present, on the controller's clock [s].

    Example:
        >>> operator = Operator(BehaviourCommand.of("walk"), now=0.0)
        >>> operator.command(BehaviourCommand.of("trot"), now=1.5)
        >>> operator.sources()
        {'operator': 1.5}
    """

    def __init__(self, command: BehaviourCommand, now: float) -> None:
        self._command, self._heard = command, now

    def command(self, command: BehaviourCommand, now: float) -> None:
        """Take a new command."""
        self._command, self._heard = command, now

    def heard(self, now: float) -> None:
        """The device is still there."""
        self._heard = now

    def reset(self) -> None:
        """An operator's wish outlasts a restart."""

    def decide(self, perception: Perception) -> BehaviourCommand:
        """The latest command."""
        return self._command

    def sources(self) -> Mapping[str, float]:
        """When the device was last heard [s]."""
        return {"operator": self._heard}
