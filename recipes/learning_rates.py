"""How learning rates of stage 4 fall."""

from __future__ import annotations

import math

import torch

WARM_UP = 400
"""Steps in which :func:`half_cosine` rises: an optimiser begins anew, on weights that may be good already."""


def annealed(first: float, last: float, iteration: int, length: int) -> float:
    """Falls linearly from the first to the last value, and stays there."""
    return first + (last - first) * min(iteration / length, 1.0)


def half_cosine(first: float, share: float, step: int) -> float:
    """Falls from the first value to 0 as the share of what is to be done goes from 0 to 1, after :data:`WARM_UP`."""
    return 0.5 * first * (1.0 + math.cos(math.pi * share)) * min(1.0, (step + 1) / WARM_UP)


def set_learning_rate(optimizer: torch.optim.Optimizer, value: float) -> None:
    """Of all parameters."""
    for group in optimizer.param_groups:
        group["lr"] = value
