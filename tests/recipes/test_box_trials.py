"""Trials on boxes: who is counted where, and that a controller is driven up to them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.training import cli

Module = Callable[[str], ModuleType]


def test_counts_by_hand(module: Module, capsys: pytest.CaptureFixture[str]) -> None:
    trials = module("box_trials")
    config = trials.Config(Path("run"), heights=(0.1, 0.3), distances=(0.8,), speeds=(1.5,), repeats=3)
    case = torch.tensor([[0.1, 0.8, 1.5], [0.3, 0.8, 1.5]] * 3)
    onto = torch.tensor([True, False, True, True, True, False])
    over, fell = onto & torch.tensor([True, False, False, False, True, False]), ~onto
    found = trials.Trials(case, onto, over, fell, torch.tensor([2.1, 0.0, 1.0, 1.2, 3.0, 0.4]))
    trials.show(config, found, cli.console(120))
    printed = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "of" in line]
    assert rows == [
        ["0.1", "3 of 3", "2 of 3", "0 of 3", "2.10"],
        ["0.3", "1 of 3", "0 of 3", "2 of 3", "0.40"],
        ["0.1", "3 of 3"],
        ["0.3", "1 of 3"],
        ["1.5", "1 of 3"],
    ]


def test_an_untrained_controller_gets_nowhere(untrained: Path, module: Module) -> None:
    trials = module("box_trials")
    config = trials.Config(untrained, heights=(0.3,), distances=(0.8,), speeds=(1.5,), repeats=2, trot=0.1, seconds=0.4)
    found = trials.hold_trials(config)
    torch.testing.assert_close(found.case, torch.tensor([[0.3, 0.8, 1.5]] * 2))
    assert not bool((found.onto | found.over).any())
    assert bool((found.farthest < 0.0).all())
