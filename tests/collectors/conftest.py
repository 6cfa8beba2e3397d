"""Real simulators and simple policies over measurements."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.collectors import RobotLog, record_robot_log
from agility_rl.simulation import BatchSimulator


@pytest.fixture
def simulate() -> Iterator[Callable[..., BatchSimulator]]:
    """Make a simulator on one thread that is closed after the test."""
    made: list[BatchSimulator] = []

    def make(num_simulations: int = 2, **options: Any) -> BatchSimulator:
        options.setdefault("num_threads", 1)
        made.append(BatchSimulator(num_simulations, **options))
        return made[-1]

    yield make
    for simulator in made:
        simulator.close()


class Swing:
    """Joints swing at 2 Hz, each with its own phase, from the step on at which a robot was reset."""

    def __init__(self, size: float = 0.8) -> None:
        self.size, self.time = size, torch.zeros(0, 1)

    def __call__(self, measured: TensorDictBase) -> Tensor:
        if len(self.time) != len(measured):
            self.time = torch.zeros(len(measured), 1)
        self.time = torch.where(measured["is_init"], 0.0, self.time + 0.02)
        return self.size * torch.sin(4.0 * torch.pi * self.time + torch.linspace(0.0, 6.0, 12))


@pytest.fixture
def swing() -> type[Swing]:
    """Class of a policy that moves every joint and does not fall."""
    return Swing


@pytest.fixture
def log(simulate: Callable[..., BatchSimulator]) -> RobotLog:
    """A good log of 120 rows."""
    return record_robot_log(simulate(1), Swing(), 120, generator=torch.Generator().manual_seed(0))
