"""What the Task-Specific Controller has decided, and what that commands the Basic Behaviour Controller to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from agility_rl import behaviours
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.randomization import uniform

NUM_PARAMETERS = len(behaviours.COMMANDS) + 1
COMMAND_NOISE = (0.8, 1.2)
"""Factors that every command of a decision is multiplied by in training (method notes, section 5.1)."""
_BUFFERS = ("behaviours", "parameters", "applied", "fresh")


class Decisions:
    """Behaviours and parameters of ``N`` robots, now and in the control steps before.

    Source: method notes, section 5.1.

    Args:
        num_robots: N.
        generator: source of the command noise; where it is, the tensors are.
        noise: lowest and highest factor on each command.
        fastest_canter: what the canter's forward speed ends at [m/s]; Table S2's, or a faster one (ours).

    Attributes:
        bounds: lower and upper ends of all commands.
        commands: what the Basic Behaviour Controller is told.
        behaviours: int64 ``[N, 3]``, chosen in this control step and the two before, newest first.
        parameters: ``[N, 2, 5, 6]``, the policy's numbers for all behaviours, of this control step and the one before.
        applied: ``[N, 2, 6]``, those of the chosen behaviour, clipped to [-1, 1].

    Example:
        >>> decisions = Decisions(1, torch.Generator(), noise=(1.0, 1.0))
        >>> decisions.decide(torch.tensor([4]), torch.ones(1, 5, 6))  # jump, everything at its most
        >>> [round(number, 2) for number in decisions.commands.command[0].tolist()]
        [1.8, 0.3, 0.5, 0.55, 0.0]
    """

    def __init__(
        self,
        num_robots: int,
        generator: torch.Generator,
        noise: tuple[float, float] = COMMAND_NOISE,
        fastest_canter: float = behaviours.FASTEST_CANTER,
    ) -> None:
        if not 0.0 <= noise[0] <= noise[1]:
            raise ValueError(f"command noise must be (low, high) with 0 <= low <= high, got {noise}")
        self.generator, self.noise, device = generator, noise, generator.device
        self.bounds = behaviours.command_bounds(device, fastest_canter)
        self.commands = CommandSampler(num_robots, generator, period=None)
        self.behaviours = torch.zeros(num_robots, 3, dtype=torch.int64, device=device)
        self.parameters = torch.zeros(num_robots, 2, behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS, device=device)
        self.applied = torch.zeros(num_robots, 2, NUM_PARAMETERS, device=device)
        self.fresh = torch.ones(num_robots, dtype=torch.bool, device=device)

    def begin(self, mask: Tensor) -> None:
        """Forget the past of the rows of a bool mask ``[N]``: their next decision changes nothing."""
        commands = self.commands
        commands.assign(mask, *(torch.zeros_like(was) for was in (commands.skill, commands.command, commands.shift)))
        self.fresh = self.fresh | mask

    def decide(self, behaviour: Tensor, parameters: Tensor) -> None:
        """Take a decision of every robot, int64 ``[N]`` and ``[N, 5, 6]``."""
        chosen = parameters.take_along_dim(behaviour[:, None, None], 1)[:, 0].clamp(-1.0, 1.0)
        command, shift = behaviours.commands_from_parameters(behaviour, chosen, self.bounds)
        if tuple(self.noise) != (1.0, 1.0):
            command = command * uniform(command.shape, self.noise, self.generator)
        self.commands.assign(torch.ones_like(self.fresh), behaviour, command, shift)
        news = {"behaviours": behaviour, "parameters": parameters, "applied": chosen}
        for name, new in news.items():
            memory = getattr(self, name)
            fresh = self.fresh.view(-1, *(1,) * (memory.ndim - 1))
            past = torch.where(fresh, new[:, None], memory[:, 1:])
            setattr(self, name, torch.cat((new[:, None], past), 1))
        self.fresh = torch.zeros_like(self.fresh)

    def advance(self) -> None:
        """Let one control step pass; the present becomes the past."""
        for name in ("behaviours", "parameters", "applied"):
            memory = getattr(self, name)
            setattr(self, name, torch.cat((memory[:, :1], memory[:, :-1]), 1))

    def state_dict(self) -> dict[str, Any]:
        """Everything but the generator."""
        memory = {name: getattr(self, name).clone() for name in _BUFFERS}
        return {**memory, "commands": self.commands.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name in _BUFFERS:
            setattr(self, name, state[name].clone())
        self.commands.load_state_dict(state["commands"])
