"""What do the small parts cost that run in every control step or iteration, on one core, beside their budgets?

The budgets are ours or those of the issue that asked for the part. Times are of the process, so that other work on the
machine counts little, and each is the median of its repetitions.

    python benchmarks/small_parts.py
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from agility_rl.deploy.depth import DepthPreprocessor
from agility_rl.motion import MotionDataset, synthesize_gait
from agility_rl.motion import gait_analysis as gait
from agility_rl.record import MCAPLogger

SAMPLES = 1228
"""States of motion in one minibatch of the imitation's update."""
METRICS = 60
"""Numbers that an iteration logs, about."""


@dataclass(frozen=True)
class Part:
    """One part: what it is, what it may cost [ms] and what runs it once."""

    name: str
    budget: float
    run: Callable[[], object]


def camera_image(generator: np.random.Generator) -> np.ndarray:
    """Floor and wall as a D435i gives them: 2 % of single pixels and 1 % of blocks are not seen."""
    down = (np.arange(480) - 240.0)[:, None] / 424.0
    depth = np.broadcast_to(np.where(down > 0.0, np.minimum(0.4 / np.maximum(down, 1e-9), 3.0), 3.0), (480, 848))
    counts = np.rint(1000.0 * depth * generator.normal(1.0, 0.005, depth.shape)).astype(np.uint16)
    counts[np.kron(generator.random((60, 106)) < 0.01, np.ones((8, 8), dtype=bool))] = 0
    counts[generator.random(depth.shape) < 0.02] = 0
    return counts


def parts(folder: str) -> list[Part]:
    """Every part, ready to run."""
    preprocess, image = DepthPreprocessor(), camera_image(np.random.default_rng(0))
    logger = MCAPLogger("run", folder)
    metrics = {f"group/metric_{index}": float(index) for index in range(METRICS)}

    def log() -> None:
        logger.log_metrics(metrics, 0)
        logger.flush()

    clips = [synthesize_gait(name, duration=8.0) for name in ("walk", "pace", "trot", "canter")]
    dataset, generator = MotionDataset(clips, clips), torch.Generator().manual_seed(0)
    return [
        Part("camera image to network's input", 4.0, lambda: preprocess(image)),
        Part(f"log {METRICS} numbers and flush", 20.0, log),
        Part(f"sample {SAMPLES} unlabelled motions", 50.0, lambda: dataset.sample_unlabelled(SAMPLES, generator)),
        Part("gaits of 500 episodes of 20 s", 10_000.0, gaits),
    ]


def gaits() -> object:
    """Windows and gaits of 500 episodes in which the feet trot at 2 Hz."""
    t = 0.02 * torch.arange(1000)
    cycle = 2.0 * t[:, None] - torch.tensor([0.0, 0.5, 0.5, 0.0])
    x = 0.1 * torch.cos(2.0 * torch.pi * cycle)
    feet = torch.stack((x, torch.zeros_like(x), torch.full_like(x, -0.29)), -1)
    velocity = torch.tensor([1.2, 0.0, 0.0]).expand(len(t), 3)
    stretch = (feet, cycle % 1.0 < 0.4, torch.full_like(t, 0.31), velocity, torch.zeros_like(t))
    return gait.classify_episodes(gait.measure_windows(*(part.expand(500, *part.shape) for part in stretch)))


def main() -> None:
    """Time every part and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=2.0, help="how long each part is repeated")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for part in parts(folder):
            part.run()
            times: list[float] = []
            while not times or sum(times) < options.seconds:
                start = time.process_time()
                part.run()
                times.append(time.process_time() - start)
            print(f"{part.name:36} {1e3 * statistics.median(times):9.2f} ms of {part.budget:8.0f} ms")


if __name__ == "__main__":
    main()
