"""Trials during a training: what the controller of the moment does, and which one the run shows in the end.

Between two checkpoints behaviours come and go (``docs/bbc_experiments.md``, Trials), and neither a reward nor a loss
tells. So from an iteration on the controller is measured every so often as ``evaluate.py`` does, with a seed that
nobody else uses, and ``policy/`` holds the best of those that were.

Out: ``RUN/trials/ITERATION/`` with ``policy/``, ``discriminator/``, ``evaluation.json`` and figures.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from bbc_config import Config
from evaluate import Config as Evaluation
from evaluate import evaluate
from rich.console import Console
from rollouts import MotionConfig

from agility_rl.deploy.artifact import Artifact
from agility_rl.training import distributed

FOLDER = "trials"
SEED = 1_000_003
"""Of commands and start states. What a controller was chosen by is no measurement of it: evaluate with other seeds."""


def due(cfg: Config, finished: int) -> bool:
    """Whether the controller is tried after so many iterations."""
    start = cfg.trials.start
    return start is not None and finished >= start and (finished - start) % cfg.trials.every == 0


def hold_trial(cfg: Config, run: Path, finished: int, save: Callable[[Path], None]) -> dict[str, float]:
    """Save the controller as it is, and measure it; of several processes, the first one does.

    Args:
        cfg: options of the training.
        run: its folder.
        finished: number of iterations so far.
        save: writes the controller's artifacts into a folder.

    Returns:
        How many targets it reached, as a metric; NaN in the other processes.
    """
    if distributed.rank() != 0:
        return {"trial/targets": math.nan}
    folder = run / FOLDER / f"{finished:06d}"
    save(folder)
    options = Evaluation(
        folder,
        episodes=cfg.trials.episodes,
        seconds=cfg.trials.seconds,
        switches=cfg.trials.switches,
        seed=SEED,
        num_threads=cfg.env.num_threads,
        simulator=cfg.env.simulator,
        motion=MotionConfig(cfg.motion.labelled, cfg.motion.unlabelled),
    )
    with torch.random.fork_rng(devices=[]):  # the training goes on with its own random numbers
        found = evaluate(options, Console(quiet=True))
    return {"trial/targets": float(rank(found)[0])}


def rank(found: Mapping[str, Any]) -> tuple[int, int]:
    """How good an evaluation is: targets reached; among equals, those that the whole interval reaches."""
    rows = found["targets"]
    return sum(row["passed"] for row in rows), sum(row["certain"] for row in rows)


def best_trial(run: Path) -> tuple[Path, dict[str, Any]] | None:
    """Folder and evaluation of the best trial of a run, the later one of two equals; nothing if there was none."""
    trials = []
    for file in sorted((run / FOLDER).glob("*/evaluation.json")):
        trials.append((file.parent, json.loads(file.read_text(encoding="utf-8"))))
    return max(reversed(trials), key=lambda trial: rank(trial[1]), default=None)


def show_best(run: Path) -> None:
    """Put the artifacts of the best trial where the run's own are; the manifest then says which it is."""
    if (best := best_trial(run)) is None:
        return
    folder, found = best
    chosen = {"iteration": int(folder.name), "targets": rank(found)[0], "of": len(found["targets"]), "seed": SEED}
    for name in ("policy", "discriminator"):
        artifact = Artifact.load(folder / name)
        Artifact.save(run / name, artifact.state, {**artifact.manifest, "trial": chosen})
