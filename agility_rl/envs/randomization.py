"""Draws of physical parameters, one function call per reset.

Source: method notes, section 4.5 (released code): friction 0.6 to 2.0, trunk mass 0 to 1.5 kg, centre of mass +-0.1 m,
gain multipliers 0.8 to 1.2 per joint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from agility_rl.go2 import constants


@dataclass(frozen=True)
class Randomization:
    """Closed intervals from which parameters are drawn uniformly; an interval of one value switches a draw off.

    What is drawn replaces what the simulator was made with: its ground's friction, and gains and trunk other than the
    robot's own.
    """

    friction: tuple[float, float] = (0.6, 2.0)
    trunk_mass: tuple[float, float] = (0.0, 1.5)
    """Added mass [kg]."""
    trunk_com: tuple[float, float] = (-0.1, 0.1)
    """Offset of the centre of mass on each axis [m]."""
    gain: tuple[float, float] = (0.8, 1.2)
    """Multipliers of the robot's own stiffness and damping (:mod:`agility_rl.go2.constants`), per joint."""
    action_delay: tuple[float, float] = (0.0, 0.0)
    """Seconds between a target and its arrival at the motors."""
    draw: Callable[[int, torch.Generator], dict[str, Tensor]] | None = None
    """Further fields for ``Simulator.set_parameters`` of a number of robots, in place of those above: an identified
    simulator (stage 2)."""


NOMINAL = Randomization((1.0, 1.0), (0.0, 0.0), (0.0, 0.0), (1.0, 1.0), (0.0, 0.0))


def uniform(shape: tuple[int, ...], interval: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Uniform draw of a closed interval.

    Raises:
        ValueError: if the interval is reversed.
    """
    low, high = interval
    if low > high:
        raise ValueError(f"an interval must be (low, high) with low <= high, got ({low}, {high})")
    return low + (high - low) * torch.rand(shape, generator=generator, device=generator.device)


def sample_parameters(
    num_robots: int, ranges: Randomization, generator: torch.Generator
) -> tuple[dict[str, Tensor], Tensor]:
    """Draw simulator parameters and the privileged observation that describes them.

    Returns:
        ``(fields, privileged)``: fields for ``Simulator.set_parameters`` and float32 ``[N, 29]``, laid out as
        :data:`agility_rl.go2.features.PRIVILEGED_LAYOUT`.

    Example:
        >>> fields, privileged = sample_parameters(2, NOMINAL, torch.Generator())
        >>> privileged[0, :5].tolist(), fields["stiffness"][0, 0].item()
        ([0.0, 0.0, 0.0, 0.0, 1.0], 40.0)
    """
    friction = uniform((num_robots, 1), ranges.friction, generator)
    mass = uniform((num_robots, 1), ranges.trunk_mass, generator)
    com = uniform((num_robots, 3), ranges.trunk_com, generator)
    fields = {
        "ground_friction": friction,
        "trunk_mass_offset": mass,
        "trunk_com_offset": com,
        "stiffness": uniform((num_robots, 12), ranges.gain, generator) * constants.STIFFNESS,
        "damping": uniform((num_robots, 12), ranges.gain, generator) * constants.DAMPING,
        "action_delay": uniform((num_robots, 1), ranges.action_delay, generator),
    }
    if not torch.count_nonzero(fields["action_delay"]):
        del fields["action_delay"]
    if ranges.draw is not None:
        fields |= ranges.draw(num_robots, generator)
    return fields, described(fields)


DESCRIBED = ("trunk_mass_offset", "trunk_com_offset", "ground_friction", "stiffness", "damping")
"""Parameters that the privileged observation holds, in its order."""


def described(parameters: Mapping[str, Tensor]) -> Tensor:
    """The privileged observation ``[N, 29]`` of these parameters, gains as deviations from the nominal ones [1].

    Source: layout and units: :data:`agility_rl.go2.features.PRIVILEGED_LAYOUT`.

    Args:
        parameters: those of :data:`DESCRIBED`, ``[N, size]``, as ``Simulator.parameter`` gives them.

    Example:
        >>> fields, privileged = sample_parameters(2, Randomization(), torch.Generator().manual_seed(0))
        >>> bool((described(fields) == privileged).all())
        True
    """
    *known, stiffness, damping = (parameters[name] for name in DESCRIBED)
    return torch.cat((*known, stiffness / constants.STIFFNESS - 1.0, damping / constants.DAMPING - 1.0), -1)
