"""How a training runs from its folder to its end: checkpoints, log, display, Ctrl-C, time limit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from torchrl.envs import EnvBase

from agility_rl.record import MCAPLogger
from agility_rl.training import cli
from agility_rl.training.checkpoint import RunCheckpoint
from agility_rl.training.display import Display


class RunConfig(Protocol):
    """Options that every training has."""

    @property
    def name(self) -> str: ...
    @property
    def runs(self) -> Path: ...
    @property
    def iterations(self) -> int: ...
    @property
    def max_minutes(self) -> float | None: ...
    @property
    def checkpoint_every(self) -> int: ...
    @property
    def resume(self) -> Path | None: ...


class Parts(Protocol):
    """What a training is made of."""

    @property
    def env(self) -> EnvBase: ...

    def checkpoint(self, folder: Path, progress: dict[str, float]) -> RunCheckpoint:
        """All that a bit-exact continuation needs."""
        ...


C = TypeVar("C", bound=RunConfig)
P = TypeVar("P", bound=Parts)


def own_options(cfg: C) -> C:
    """Those with which a run that is resumed began; only how long it goes on may change."""
    if cfg.resume is None:
        return cfg
    kept = {"resume": cfg.resume, "iterations": cfg.iterations, "max_minutes": cfg.max_minutes}
    return replace(cli.read_config(cfg.resume, type(cfg)), **kept)  # type: ignore[type-var]


class Laps:
    """Seconds of the parts of an iteration, as metrics ``time/NAME``.

    Attributes:
        metrics: of the laps so far.
    """

    def __init__(self) -> None:
        self.metrics: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, name: str) -> None:
        """A part ends here, and the next begins."""
        now = time.perf_counter()
        self.metrics[f"time/{name}"], self._last = now - self._last, now


def run(
    recipe: str,
    cfg: C,
    parts: P,
    *,
    begin: Callable[[P, C], None],
    iterate: Callable[[P, C, int], dict[str, float]],
    save_policy: Callable[[P, C, Path], None],
    headline: tuple[str, ...],
) -> Path:
    """Train until the iterations, the time or the user end it, save everything, and close the environment.

    Args:
        recipe: its name.
        cfg: its options.
        parts: what it is made of.
        begin: called once in a new run, before the first iteration.
        iterate: from the number of finished iterations to the metrics of the next.
        save_policy: writes the artifact into a run folder.
        headline: metrics of a plain line.

    Returns:
        The run folder.
    """
    resumed = cfg.resume is not None
    folder = cli.start_run(cfg, cfg.resume or cfg.runs / cfg.name, resume=resumed, recipe=recipe)
    progress: dict[str, float] = {"iteration": 0, "minutes": 0.0}
    saved = parts.checkpoint(folder / "checkpoints", progress)
    if resumed:
        saved.load()
    else:
        begin(parts, cfg)
    logger = MCAPLogger(folder.name, folder.parent, resume=resumed)
    start = time.monotonic() - 60.0 * progress["minutes"]

    def save() -> None:
        saved.save(int(progress["iteration"]))
        save_policy(parts, cfg, folder)

    with Display(recipe, cfg.iterations, headline=headline) as display, cli.interruptible() as interrupted:
        while progress["iteration"] < cfg.iterations and not interrupted():
            metrics = iterate(parts, cfg, int(progress["iteration"]))
            progress["iteration"] += 1
            progress["minutes"] = metrics["time/minutes"] = (time.monotonic() - start) / 60.0
            logger.log_metrics(metrics, step=int(progress["iteration"]))
            display.update(int(progress["iteration"]), metrics)
            if progress["iteration"] % cfg.checkpoint_every == 0:
                save()
            if cfg.max_minutes is not None and progress["minutes"] >= cfg.max_minutes:
                break
    save()
    logger.close()
    parts.env.close()
    print(f"saved {folder}")
    return folder
