"""What a robot would measure in a simulation: noise and latency included, trunk velocity left out."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2 import constants, features
from agility_rl.simulation import Simulator


class RobotSensors:
    """Read ``N`` simulated robots as their own sensors would.

    A reading is ``[N, 33]``: the 29 numbers of :data:`agility_rl.go2.features.MEASUREMENT_LAYOUT`, then four contact
    flags of the feet (now or one step earlier, as policies are trained). It is to be taken once a control step. Noise
    is uniform and drawn anew for every reading; latency holds readings back by whole control steps.

    Source: half-widths of the noise: released code (method notes, section 3.2); no formula.

    Args:
        num_robots: N.
        noise: factor on the half-widths of :data:`agility_rl.go2.features.MEASUREMENT_LAYOUT`, or half-widths by entry
            name, in the entry's unit.
        latency: control steps by which measurements are late.
        generator: source of the noise.

    Raises:
        ValueError: if there is noise without a generator, the latency is negative, or an entry is unknown.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> simulator = make_simulator(num_simulations=2, num_threads=1)
        >>> sensors = RobotSensors(2, noise={"joint_position": 0.01}, generator=torch.Generator().manual_seed(0))
        >>> reading = sensors.reset(simulator, torch.ones(2, dtype=torch.bool))
        >>> reading.shape
        torch.Size([2, 33])
        >>> bool((reading[:, 5:17] - simulator.joint_position).abs().amax() <= 0.01)
        True
    """

    def __init__(
        self,
        num_robots: int,
        *,
        noise: float | Mapping[str, float] = 0.0,
        latency: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        if latency < 0:
            raise ValueError(f"latency must be a number of control steps from 0, got {latency}")
        self.half_width = _half_width(noise)
        if bool(self.half_width.any()) and generator is None:
            raise ValueError("noise needs a generator, so that a run can be repeated")
        self.latency = latency
        self.generator = generator
        self._queue = torch.zeros(latency + 1, num_robots, features.NUM_MEASUREMENT + len(constants.LEGS))
        self._touched = torch.zeros(num_robots, len(constants.LEGS), dtype=torch.bool)
        self._reading = self._queue[0]

    def read(self, simulator: Simulator) -> Tensor:
        """Take the reading of a new control step."""
        touched = _touching(simulator)
        self._queue = torch.cat((self._queue[1:], _present(simulator, touched | self._touched)[None]))
        self._touched = touched
        self._reading = self._noisy(self._queue[0])
        return self._reading

    def reset(self, simulator: Simulator, mask: Tensor) -> Tensor:
        """Forget what robots of a bool mask ``[N]`` measured before; the others keep their latest reading."""
        row = mask[:, None]
        touched = _touching(simulator)
        self._touched = torch.where(row, touched, self._touched)
        self._queue = torch.where(row, _present(simulator, touched), self._queue)  # all ages alike
        self._reading = torch.where(row, self._noisy(self._queue[0]), self._reading)
        return self._reading

    def _noisy(self, reading: Tensor) -> Tensor:
        if self.generator is None:
            return reading
        return reading + self.half_width * (2.0 * torch.rand(reading.shape, generator=self.generator) - 1.0)


def _present(simulator: Simulator, touched: Tensor) -> Tensor:
    roll, pitch, _ = rotations.to_euler(simulator.root_quaternion)
    measured = features.measurement(
        torch.stack((roll, pitch), -1),
        simulator.root_angular_velocity,
        simulator.joint_position,
        simulator.joint_velocity,
    )
    return torch.cat((measured, touched.to(measured.dtype)), -1)


def _touching(simulator: Simulator) -> Tensor:
    return simulator.contact_force[:, list(constants.FOOT_GROUPS)] > features.FOOT_CONTACT_FORCE


def _half_width(noise: float | Mapping[str, float]) -> Tensor:
    layout = features.MEASUREMENT_LAYOUT
    if isinstance(noise, Mapping):
        names = [entry.name for entry in layout]
        if unknown := set(noise) - set(names):
            raise ValueError(f"no measurement is called {', '.join(sorted(unknown))}; expected {', '.join(names)}")
        layout = tuple(entry._replace(noise=noise.get(entry.name, 0.0)) for entry in layout)
        noise = 1.0
    return torch.cat((noise * features.noise_scale(layout), torch.zeros(len(constants.LEGS))))
