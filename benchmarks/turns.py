"""Contenders take their turns in one run, so that their ratios do not depend on what else the machine does."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from agility_rl.go2 import constants

CPU = torch.device("cpu")


def seconds(work: Callable[[], object], device: torch.device = CPU) -> float:
    """Time of a piece of work, until the device has done it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def in_turns(contenders: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """What each contender says that its turns took; the first round warms up and does not count."""
    found: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(rounds + 1):
        for name, contender in contenders.items():
            took = contender()
            if turn:
                found[name].append(took)
    return found


def shifting_weight(steps: int, robots: int, seed: int = 0) -> Tensor:
    """Joint targets ``[steps, robots, 12]`` about the default pose: all contenders keep four feet on the ground."""
    offset = 0.05 * torch.randn(steps, robots, constants.NUM_JOINTS, generator=torch.Generator().manual_seed(seed))
    return torch.tensor(constants.DEFAULT_POSE) + offset


def through(step: Callable[[Tensor], object], targets: Tensor, device: torch.device = CPU) -> Callable[[], float]:
    """A contender that takes a control step to each of the targets."""

    def run() -> None:
        for target in targets:
            step(target)

    return lambda: seconds(run, device)


def speed_up(reference: Sequence[float], times: Sequence[float]) -> float:
    """How many times as fast as the reference, median over the rounds."""
    return statistics.median(one / other for one, other in zip(reference, times, strict=True))


def print_rates(found: Mapping[str, list[float]], done: int, unit: str) -> None:
    """Rates of contenders that do ``done`` of something in a turn, beside the first one's."""
    reference = next(iter(found.values()))
    for name, times in found.items():
        rate = done / statistics.median(times)
        print(f"{name:38} {rate:10.0f} {unit}/s {speed_up(reference, times):8.1%} of bare")


def circumstances(robots: int, threads: int) -> str:
    """What rates depend on."""
    return f"{robots} robots, {threads} threads, {torch.get_num_threads()} torch threads, load {os.getloadavg()[0]:.1f}"
