"""Contenders take their turns in one run, so that their ratios do not depend on what else the machine does."""

from __future__ import annotations

import math
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


Phases = dict[str, list[dict[str, float]]]
"""Seconds of each phase of a loop's iterations, and of a whole ``iteration``."""


def phases_in_turns(
    loops: Mapping[str, Callable[[int], Mapping[str, float]]], phases: Sequence[str], numbers: range, warm_up: int
) -> Phases:
    """Run loops that tell the seconds of their phases, an iteration at a time; the first ``warm_up`` do not count."""
    found: Phases = {name: [] for name in loops}
    for index, number in enumerate(numbers):
        for name, loop in loops.items():
            start = time.perf_counter()
            spent = loop(number)
            total = time.perf_counter() - start
            if index >= warm_up:
                row = {phase: spent.get(phase, spent.get(f"time/{phase}", math.nan)) for phase in phases}
                found[name].append(row | {"iteration": total})
    return found


def print_phases(found: Phases, done: int) -> None:
    """Medians, ``done`` of something an iteration, and how many times as fast as the plain loop the recipe is."""
    heads = list(next(iter(found.values()))[0])
    print(f"{'median seconds':16}" + "".join(f"{head:>12}" for head in heads) + f"{'steps/s':>12}")
    for name, rows in found.items():
        middle = [statistics.median(row[head] for row in rows) for head in heads]
        print(f"{name:16}" + "".join(f"{value:12.3f}" for value in middle) + f"{done / middle[-1]:12.0f}")
    if {"recipe", "plain"} <= found.keys():
        plain, recipe = ([row["iteration"] for row in found[name]] for name in ("plain", "recipe"))
        print(f"speed of the recipe relative to the plain loop: {speed_up(plain, recipe):.3f}")


def circumstances(robots: int, threads: int) -> str:
    """What rates depend on."""
    return f"{robots} robots, {threads} threads, {torch.get_num_threads()} torch threads, load {os.getloadavg()[0]:.1f}"
