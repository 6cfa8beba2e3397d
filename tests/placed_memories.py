"""Memories that know their place, of which nothing speaks but what a test lets speak."""

from __future__ import annotations

import math

import torch

from agility_rl.go2.camera import LATENCY
from agility_rl.modules.placed_memory import PlacedMemory

POINTS = torch.tensor([-1.5, -0.5, 0.5, 1.5])[:, None] * torch.tensor([1.0, 0.0]).expand(7, 1, 2)


FIRST, STRAIGHT, BACK = (2.0, 3.0, 0.0), (6.0, 3.0, 0.0), (6.0, 5.0, math.pi)
"""Three obstacles in the arena: the second is 4 m ahead of the first, the third 2 m beside it, facing the other way."""


def silent(
    *routes: tuple[tuple[float, float, float], ...], stock: tuple[int, ...] = ()
) -> tuple[PlacedMemory, dict[str, torch.Tensor]]:
    """A memory whose head and glance say what their biases say, and views of those by name; nothing counts."""
    memory = PlacedMemory(32, 45, 8, 7, 0.05, POINTS.clone(), routes or (((0.0, 0.0, 0.0),),), stock=stock)
    with torch.no_grad():
        for layer in (memory.head[0], memory.glance.linear[0]):
            layer.weight.zero_()
            layer.bias.zero_()
    head = memory.head[0].bias.detach().split((*memory.known, 3, 1))
    biases = dict(zip(("latent", "obstacle", "progress", "alike", "weight"), head, strict=True))
    biases["correction"], biases["scale"] = memory.glance.correction[-1].bias.detach().split((4, 3))
    biases["alike"].fill_(100.0)
    biases["weight"].fill_(-100.0)
    return memory, biases


def still(memory: PlacedMemory, pose: list[float], at: int | None = None) -> tuple[torch.Tensor, ...]:
    """Inputs of a step in which nothing moves: a pose in the arena, and a way-point that is certain."""
    belief = torch.zeros(memory.parts[3])
    if at is not None:
        belief = belief - 30.0
        belief[at] = 0.0
    before = torch.cat((torch.tensor(pose) - memory.starts[0], torch.zeros(3), belief - memory.prior))
    seen = (
        torch.zeros(1, 32),
        torch.zeros(1, 45),
        torch.zeros(1, 4),
        torch.zeros(1, 58, 87),
        torch.full((1, 1), LATENCY),
    )
    return *seen, torch.cat((torch.zeros(8), before, torch.zeros(sum(memory.parts[4:]))))[None]


ON_THE_WAY = [1.8, 3.7, 0.0, 1.0]
"""Beside the second way-point of the first obstacle: which one is next, the place does not say."""
