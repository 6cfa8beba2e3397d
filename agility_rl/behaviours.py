"""The five behaviours of the dog and the commands each of them accepts.

Source: Fu et al. 2025, Table S2 (ranges) and section S2 (redraw period); dead-bands from the released code
(method notes, section 4.3).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agility_rl.tensors import constant

BEHAVIOURS: tuple[str, ...] = ("walk", "pace", "trot", "canter", "jump")
"""Behaviour names; the position in this tuple is the skill index everywhere in the package."""

NUM_BEHAVIOURS = len(BEHAVIOURS)
JUMP = BEHAVIOURS.index("jump")

COMMANDS: tuple[str, ...] = ("velocity_x", "velocity_y", "yaw_rate", "jump_height", "locomotion_height")
"""Entries of a command vector: m/s, m/s, rad/s, m, m."""

RESAMPLE_PERIOD = 6.0
"""Seconds between two draws of latent variables and commands (section S2)."""

DEAD_BAND = (0.1, 0.05, 0.05, 0.0, 0.0)
"""Smaller commands become zero: m/s, m/s, rad/s (released code)."""


@dataclass(frozen=True)
class CommandRange:
    """Closed interval of every command of one behaviour; ``None`` means that the command is unused and zero."""

    velocity_x: tuple[float, float]
    velocity_y: tuple[float, float]
    yaw_rate: tuple[float, float]
    jump_height: tuple[float, float] | None
    locomotion_height: tuple[float, float] | None


COMMAND_RANGES: dict[str, CommandRange] = {
    "walk": CommandRange((0.0, 0.6), (-0.15, 0.15), (-1.0, 1.0), None, (0.25, 0.34)),
    "pace": CommandRange((0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), None, (0.25, 0.34)),
    "trot": CommandRange((0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), None, (0.25, 0.34)),
    "canter": CommandRange((0.8, 2.0), (-0.5, 0.5), (-0.5, 0.5), None, (0.25, 0.34)),
    "jump": CommandRange((0.8, 1.8), (-0.3, 0.3), (-0.5, 0.5), (0.45, 0.55), None),
}
"""Command ranges of the quadrupedal agility challenge (Table S2)."""

FASTEST_CANTER = COMMAND_RANGES["canter"].velocity_x[1]
"""Fastest canter that is commanded [m/s] (Table S2), where nobody asks for a faster one."""
TOP_SPEED = 5.0
"""Nobody may ask for more [m/s]: no Go2 is as fast (manufacturer's data)."""


def skill_index(name: str) -> int:
    """Index of a behaviour.

    Raises:
        ValueError: if ``name`` is none of the five behaviours.

    Example:
        >>> skill_index("trot")
        2
    """
    try:
        return BEHAVIOURS.index(name)
    except ValueError:
        raise ValueError(f"{name!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)}") from None


@functools.cache
def _bounds(fastest_canter: float) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Lower and upper ends of :data:`COMMAND_RANGES`, but for the canter's forward speed."""
    slowest = COMMAND_RANGES["canter"].velocity_x[0]
    if not slowest < fastest_canter <= TOP_SPEED:
        raise ValueError(
            f"fastest canter: expected more than {slowest:g} and at most {TOP_SPEED:g} m/s, got {fastest_canter}"
        )
    ranges = COMMAND_RANGES | {"canter": replace(COMMAND_RANGES["canter"], velocity_x=(slowest, fastest_canter))}
    return tuple(
        tuple(tuple((getattr(row, command) or (0.0, 0.0))[end] for command in COMMANDS) for row in ranges.values())
        for end in (0, 1)
    )


def command_bounds(device: torch.device | str = "cpu", fastest_canter: float = FASTEST_CANTER) -> tuple[Tensor, Tensor]:
    """Lower and upper bound of every command, each ``[5 behaviours, 5 commands]``; unused commands are 0.

    They are shared (:func:`agility_rl.tensors.constant`): never change them in place.

    Source: Table S2; a faster canter is ours.

    Args:
        device: where they are.
        fastest_canter: upper bound of the canter's forward speed [m/s].

    Raises:
        ValueError: if there is no such canter.

    Example:
        >>> low, high = command_bounds()
        >>> round(high[skill_index("canter"), 0].item(), 3)
        2.0
    """
    low, high = _bounds(fastest_canter)
    return constant(low, torch.device(device)), constant(high, torch.device(device))


def sample_commands(skill: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Draw a command vector uniformly from the range of each given skill, then apply the dead-bands.

    Source: Table S2; dead-bands: released code.

    Args:
        skill: int64 ``[*B]``, index into :data:`BEHAVIOURS`.
        generator: source of randomness.

    Returns:
        float32 ``[*B, 5]`` in the order and units of :data:`COMMANDS`.

    Example:
        >>> sample_commands(torch.tensor([4]))[0, 3] >= 0.45
        tensor(True)
    """
    low, high = command_bounds(skill.device)
    uniform = torch.rand((*skill.shape, len(COMMANDS)), generator=generator, device=skill.device)
    command = low[skill] + (high - low)[skill] * uniform
    return command.masked_fill(command.abs() < constant(DEAD_BAND, skill.device), 0.0)


def commands_from_parameters(
    skill: Tensor, parameters: Tensor, bounds: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """Map parameters in [-1, 1] to the command range of each given skill.

    Source: the Task-Specific Controller's action, method notes, section 5.1; ranges: Table S2.

    Args:
        skill: int64 ``[*B]``, index into :data:`BEHAVIOURS`.
        parameters: ``[*B, 6]``, the five commands in the order of :data:`COMMANDS` and the shift; clipped.
        bounds: of all commands (:func:`command_bounds`); Table S2's by default.

    Returns:
        Commands ``[*B, 5]`` in the units of :data:`COMMANDS`, unused ones zero, and the shift ``[*B, 1]`` as it is.

    Example:
        >>> command, shift = commands_from_parameters(torch.tensor([2]), torch.zeros(1, 6))
        >>> [round(number, 3) for number in command[0].tolist()]  # the middle of a trot
        [1.0, 0.0, 0.0, 0.0, 0.295]
    """
    low, high = command_bounds(skill.device) if bounds is None else bounds
    parameters = parameters.clamp(-1.0, 1.0)
    command = low[skill] + (high - low)[skill] * (parameters[..., : len(COMMANDS)] + 1.0) / 2.0
    return command, parameters[..., len(COMMANDS) :]


def command_vector(skill: Tensor, command: Tensor, shift: Tensor) -> Tensor:
    """Command observation as networks read it: five commands, shift, one-hot skill.

    Source: method notes, section 3.2.

    Args:
        skill: int64 ``[*B]``, index into :data:`BEHAVIOURS`.
        command: ``[*B, 5]`` in the order and units of :data:`COMMANDS`.
        shift: ``[*B, 1]`` in [-1, 1].

    Returns:
        ``[*B, 11]`` (:data:`agility_rl.keys.COMMAND`).

    Example:
        >>> command_vector(torch.tensor([1]), torch.zeros(1, 5), torch.ones(1, 1))[0].tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return torch.cat((command, shift, torch.nn.functional.one_hot(skill, NUM_BEHAVIOURS).to(command.dtype)), -1)
