"""The latent variables and task commands that a robot is asked to follow, redrawn every six seconds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from agility_rl import behaviours
from agility_rl.tensors import worthwhile


class CommandSampler:
    """Skill c, shift epsilon and task command of ``N`` robots, with their redraw clocks.

    The skill is drawn from given probabilities (the learned prior), the shift uniformly from [-1, 1], the command from
    the range of the skill.

    Source: supplement S2 (redraw every six seconds), Algorithm S1 line 3, Table S2.

    Args:
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        period: control steps between two redraws; ``None`` never redraws by itself.

    Attributes:
        skill: int64 ``[N]``.
        shift: ``[N, 1]``.
        command: ``[N, 5]`` in the order of :data:`agility_rl.behaviours.COMMANDS`.
        probabilities: ``[5]``, assign to change the skill distribution.

    Example:
        >>> sampler = CommandSampler(3, torch.Generator(), period=300)
        >>> sampler.resample(torch.ones(3, dtype=torch.bool))
        >>> sampler.vector().shape
        torch.Size([3, 11])
    """

    def __init__(self, num_robots: int, generator: torch.Generator, period: int | None) -> None:
        self.generator, device = generator, generator.device
        self.period, number = period, behaviours.NUM_BEHAVIOURS
        self.skill = torch.zeros(num_robots, dtype=torch.int64, device=device)
        self.shift = torch.zeros(num_robots, 1, device=device)
        self.command = torch.zeros(num_robots, len(behaviours.COMMANDS), device=device)
        self.age = torch.zeros(num_robots, dtype=torch.int64, device=device)
        self.probabilities = torch.full((number,), 1.0 / number, device=device)

    @property
    def jumping(self) -> Tensor:
        """Bool ``[N]``: the commanded skill is jump."""
        return self.skill == behaviours.JUMP

    def resample(self, mask: Tensor) -> None:
        """Redraw the rows of a bool mask ``[N]`` and restart their clocks."""
        if not worthwhile(mask):
            return
        # Drawn for every robot, so that a GPU need not be asked for how many it is.
        skill = torch.multinomial(self.probabilities, len(mask), replacement=True, generator=self.generator)
        command = behaviours.sample_commands(skill, self.generator)
        shift = 2.0 * torch.rand(len(mask), 1, generator=self.generator, device=skill.device) - 1.0
        self.assign(mask, skill, command, shift)

    def assign(self, mask: Tensor, skill: Tensor, command: Tensor, shift: Tensor) -> None:
        """Set the rows of a bool mask ``[N]`` to theirs of given values ``[N]``, ``[N, 5]`` and ``[N, 1]``."""
        # New tensors, because observations of earlier steps may still refer to the old ones.
        self.skill = torch.where(mask, skill, self.skill)
        self.command = torch.where(mask[:, None], command, self.command)
        self.shift = torch.where(mask[:, None], shift, self.shift)
        self.age = self.age.masked_fill(mask, 0)

    def advance(self, held: Tensor | None = None) -> None:
        """Let one control step pass and redraw what has become too old, but not the rows of a bool mask ``[N]``."""
        self.age = self.age + 1
        if self.period is not None:
            old = self.age >= self.period
            self.resample(old if held is None else old & ~held)

    def vector(self) -> Tensor:
        """Command observation ``[N, 11]``: five commands, shift, one-hot skill (:data:`agility_rl.keys.COMMAND`)."""
        return behaviours.command_vector(self.skill, self.command, self.shift)

    def state_dict(self) -> dict[str, Any]:
        """Everything but the generator."""
        return {name: getattr(self, name).clone() for name in ("skill", "shift", "command", "age", "probabilities")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, value in state.items():
            setattr(self, name, value.clone())
