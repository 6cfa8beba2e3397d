"""How a training runs from its folder to its end: checkpoints, log, display, Ctrl-C, time limit.

Started by ``torchrun --nproc-per-node 2 recipes/...``, every process has the robots of ``--env.num-robots`` for itself;
all of them train one policy, and the first one writes.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

from torch import Tensor, nn
from torchrl.envs import EnvBase

from agility_rl.deploy.artifact import MANIFEST_FILE, Artifact, ArtifactError
from agility_rl.record import MCAPLogger
from agility_rl.simulation import simulator_device
from agility_rl.training import cli, distributed, run_folder
from agility_rl.training.checkpoint import RunCheckpoint
from agility_rl.training.display import Display


class RunConfig(Protocol):
    """Options that every training has."""

    @property
    def simulator(self) -> Literal["batch", "warp"]: ...
    @property
    def device(self) -> str: ...
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

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike: networks, optimisers, curriculum."""
        ...

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself: robots, memories, random numbers."""
        ...


C = TypeVar("C", bound=RunConfig)
P = TypeVar("P", bound=Parts)
R = TypeVar("R")
KEPT = ("iterations", "max_minutes")
"""Options that may change when a training is resumed."""


def own_options(cfg: R, kept: Sequence[str] = KEPT) -> R:
    """Those with which a run that is resumed began; only some may change, such as how long it goes on."""
    run: Path | None = cfg.resume  # type: ignore[attr-defined]
    if run is None:
        return cfg
    changed = {name: getattr(cfg, name) for name in ("resume", *kept)}
    own: R = replace(run_folder.read_config(run, type(cfg)), **changed)  # type: ignore[type-var]
    if distributed.rank() == 0:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in kept)
        unheeded = ", ".join(cli.unheeded(cfg, own))
        print(
            f"{run} goes on with the options that it began with, but for {flags}"
            + (f"; not heeded: {unheeded}" if unheeded else "")
        )
    return own


def folder_of(cfg: RunConfig) -> Path:
    """Where a run writes."""
    return cfg.resume or cfg.runs / cfg.name


def policy_to_start_from(path: Path, kind: str, hidden: tuple[int, ...]) -> Artifact:
    """What ``--init-from`` names, if its layers are as wide as those that this run builds.

    Raises:
        ArtifactError: if they are not, or it is no such artifact.
    """
    start = Artifact.load(path, kind=kind)
    own = start.manifest.get("network", {}).get("hidden", list(hidden))
    if own != list(hidden):
        sizes = " ".join(str(size) for size in own)
        raise ArtifactError(
            f"{start.folder}: its hidden layers are {own}, this run builds {list(hidden)}; give --ppo.hidden {sizes}"
        )
    return start


def check_began_with(run: Path | None, kind: str, digest: str, path: Path) -> None:
    """Refuse to resume a run on another frozen policy than it began with.

    Args:
        run: that is resumed, or ``None``.
        kind: under which its manifest names the policy's weights.
        digest: of the weights that lie at ``path`` now.

    Raises:
        ArtifactError: if they are others.
    """
    if run is not None and (run / "policy" / MANIFEST_FILE).is_file():
        began = json.loads((run / "policy" / MANIFEST_FILE).read_text(encoding="utf-8")).get(kind)
        if began is None:
            raise ArtifactError(
                f"{run} does not say which policy it began with ({kind}); begin another one: --init-from"
            )
        if began != digest:
            raise ArtifactError(
                f"{run} began with another policy ({kind} {began[:12]}) than {path} holds now ({digest[:12]}); put it "
                "back, or begin another run with --init-from"
            )


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


def finite(total: Tensor, what: str, iteration: int) -> Tensor:
    """A loss, if it is a number.

    Raises:
        ValueError: if it is none; the weights are then still those of the step before.
    """
    if not bool(total.isfinite()):
        raise ValueError(
            f"the loss of {what} is {total.item()} in iteration {iteration + 1}; nothing was saved since the last "
            "checkpoint: look for NaN in teacher and images, or begin anew by --init-from, with a lower learning rate"
        )
    return total


class SavedRun:
    """Checkpoints of a run: one of all that is alike and of the first process, one more of each other process.

    With as many processes as wrote it, a run goes on bit for bit; robots and memories of further ones begin anew.
    """

    def __init__(self, folder: Path, parts: Parts, progress: dict[str, float]) -> None:
        self.progress, self._rank = progress, distributed.rank()
        self._alike = {"progress", *parts.alike}
        first = self._rank == 0
        self._main = RunCheckpoint(folder, progress=progress, **parts.alike, **(parts.own if first else {}))
        self._own = None if first else RunCheckpoint(folder / f"process-{self._rank}", **parts.own)

    def save(self) -> None:
        """Write what belongs to this process; the first one's file comes last."""
        step = int(self.progress["iteration"])
        self.progress["processes"] = distributed.size()
        if self._own is not None:
            self._own.save(step)
        distributed.wait()
        if self._own is None:
            self._main.save(step)

    def exists(self) -> bool:
        """Whether the first process has saved anything yet."""
        return bool(self._main.steps())

    def load(self) -> None:
        """Restore the newest checkpoint."""
        step = self._main.load(components=None if self._own is None else self._alike)
        if self._own is not None and self._rank < self.progress.get("processes", 1):
            self._own.load(step)


def run(
    recipe: str,
    cfg: C,
    build: Callable[[C], P],
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
        build: makes what it is made of.
        begin: called once in a new run, before the first iteration.
        iterate: from the number of finished iterations to the metrics of the next.
        save_policy: writes the artifact into a run folder.
        headline: metrics of a plain line.

    Returns:
        The run folder.

    Raises:
        ValueError: if it would never be saved.
    """
    if cfg.checkpoint_every < 1:
        raise ValueError(f"--checkpoint-every: expected at least 1, got {cfg.checkpoint_every}")
    with distributed.processes(cuda=simulator_device(cfg.simulator, cfg.device).type == "cuda"):
        return _run(recipe, cfg, build(cfg), begin, iterate, save_policy, headline)


def _run(
    recipe: str,
    cfg: C,
    parts: P,
    begin: Callable[[P, C], None],
    iterate: Callable[[P, C, int], dict[str, float]],
    save_policy: Callable[[P, C, Path], None],
    headline: tuple[str, ...],
) -> Path:
    resumed, first = cfg.resume is not None, distributed.rank() == 0
    folder = folder_of(cfg)
    if first:
        run_folder.start_run(cfg, folder, resume=resumed, recipe=recipe, processes=distributed.size())
    distributed.wait()
    progress: dict[str, float] = {"iteration": 0, "minutes": 0.0}
    saved = SavedRun(folder / "checkpoints", parts, progress)
    if resumed and saved.exists():
        saved.load()
    elif resumed and (folder / "policy" / MANIFEST_FILE).is_file():
        raise FileNotFoundError(
            f"{folder} has a policy and no checkpoint: it would begin anew and replace the policy; begin another run "
            "with --init-from"
        )
    else:  # a new run, or one that was killed before its first checkpoint: it begins anew, with the same numbers
        if resumed and first:
            print(f"{folder} has no checkpoint yet: it begins anew, with the same numbers")
        try:
            begin(parts, cfg)
        except BaseException:  # nothing is learned yet, and the name stays free
            if first and not resumed:
                run_folder.abandon_run(folder)
            raise
        distributed.share(part for part in parts.alike.values() if isinstance(part, nn.Module))
    logger = MCAPLogger(folder.name, folder.parent, resume=resumed) if first else None
    if logger is not None and not resumed:
        logger.log_hparams(run_folder.to_json(cfg))
    start, late = time.monotonic() - 60.0 * progress["minutes"], False

    def save() -> None:
        if logger is not None:
            logger.flush()  # first: what a checkpoint goes on from is in the log, whenever the run is killed
        saved.save()
        if first:
            save_policy(parts, cfg, folder)

    with contextlib.ExitStack() as stack:
        display = stack.enter_context(Display(recipe, cfg.iterations, headline=headline)) if first else None
        interrupted = stack.enter_context(cli.interruptible())
        while progress["iteration"] < cfg.iterations and not distributed.anyone(interrupted()):
            metrics = distributed.average_metrics(iterate(parts, cfg, int(progress["iteration"])))
            progress["iteration"] += 1
            progress["minutes"] = metrics["time/minutes"] = (time.monotonic() - start) / 60.0
            if logger is not None and display is not None:
                logger.log_metrics(metrics, step=int(progress["iteration"]))
                display.update(int(progress["iteration"]), metrics)
            if progress["iteration"] == 1 or progress["iteration"] % cfg.checkpoint_every == 0:
                save()  # after the first one too: what comes once before a training is part of it, and may take long
            late = distributed.anyone(cfg.max_minutes is not None and progress["minutes"] >= cfg.max_minutes)
            if late:
                break
    save()
    if logger is not None:
        logger.close()
        reason = ", by --max-minutes" if late else ""
        short = f" after {progress['iteration']:.0f} of {cfg.iterations} iterations{reason}"
        print(f"saved {folder}" + (short if progress["iteration"] < cfg.iterations else ""))
    parts.env.close()
    return folder
