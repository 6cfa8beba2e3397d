"""Learning rates that fall, by hand."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest
import torch

Module = Callable[[str], ModuleType]


def test_learning_rates_fall(module: Module) -> None:
    rates = module("learning_rates")
    annealed = [rates.annealed(1e-3, 1e-5, n, 100) for n in (0, 50, 100, 500)]
    assert annealed == pytest.approx([1e-3, 5.05e-4, 1e-5, 1e-5])
    assert [rates.half_cosine(2.0, share, 1000) for share in (0.0, 0.5, 1.0)] == pytest.approx([2.0, 1.0, 0.0])
    assert rates.half_cosine(2.0, 0.0, 99) == pytest.approx(0.5), "it rises at first"
    optimizer = torch.optim.SGD([{"params": [torch.zeros(1)]}, {"params": [torch.zeros(2)]}], lr=1.0)
    rates.set_learning_rate(optimizer, 0.1)
    assert [group["lr"] for group in optimizer.param_groups] == [0.1, 0.1]
