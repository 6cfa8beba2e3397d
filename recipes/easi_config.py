"""Options and presets of the search for the simulator that explains a robot log.

``paper`` holds Table S3 to the number, and the values of EASI's release (method notes, section 6) where it is silent:
individuals roll out the policy. ``cpu`` is ours, for two cores: individuals replay windows of the log, and the critic
sees by how much they miss it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from agility_rl.collectors import GAINS
from agility_rl.training import run_folder


@dataclass(frozen=True)
class SearchConfig:
    parameters: tuple[str, ...] = GAINS
    """What is searched: the six gains (supplement S2), or any names that ``Parameter.named`` knows."""
    span: float = 3.0
    """First range [1/span, span] x nominal (method notes, section 6.3)."""
    scale: Literal["log", "linear"] = "log"
    """``linear`` as in EASI's release; ``log`` gives a third and three times the nominal value equal room (ours)."""
    bounded: bool = False
    """Clip individuals to the first range, as in EASI's sim-to-sim runs; physical limits hold in any case."""
    survival_rate: float = 0.5
    """Table S3."""
    covariance: Literal["diagonal", "full"] = "diagonal"
    """``diagonal`` as in EASI's release; ``full`` follows, and shows, parameters that make up for each other."""
    centre: Literal["new", "old"] = "new"
    """Mean about which the spread is taken; ``new`` as in EASI's release, ``old`` reaches far outside the range."""
    min_std: float | None = 0.0
    """Least standard deviation in shares of the first range; 0 as in EASI's release. When None, 0.005 of [1/3, 3] x
    nominal for an exact log and 0.02 for a noisy one."""
    averaged: float = 0.0
    """Share of the generations whose means the result averages; 0 as in EASI's release."""
    response: float | None = None
    """Share of the generations in whose windows the critic looks for the next mean, by linear responses; needs
    ``--collection replay`` (ours). When None, the mean of the survivors, as in EASI's release."""


@dataclass(frozen=True)
class CriticConfig:
    updates: int = 10
    """Updates in a generation, K (Table S3)."""
    optimizer: Literal["rmsprop", "adam"] = "rmsprop"
    """``rmsprop``: Table S3; ``adam`` with momenta 0.5 and 0.9, as is usual with a gradient penalty."""
    learning_rate: float = 3e-4
    """Table S3."""
    hidden: tuple[int, ...] = (128, 128)
    """EASI's release (method notes, section 6.2)."""
    weight_clip: float | None = 0.01
    """EASI's release (method notes, section 6.2)."""
    gradient_penalty: float | None = None
    """Instead of, or beside, clipped weights (ours)."""
    difference: bool = False
    """Show the critic s' - s instead of s' (ours)."""
    matched: bool = False
    """Show the critic |s' - s'_R|, by how much s' misses what the robot did after the same s and a, and let it begin as
    a distance; needs ``--collection replay`` (ours)."""
    clip: float = 10.0
    """Bound of the critic's normalised inputs; a small one silences windows whose estimated start is far off (ours)."""
    batch_per_robot: int = 16
    """Transitions of every simulation in an update, and as many of the log in all (method notes, section 6.2)."""


@dataclass(frozen=True)
class Config:
    name: str = "easi"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    log: Path | None = None
    """Robot log: .mcap, .csv or .npz."""
    policy: Path | None = None
    """Run or artifact folder of the BBC that made the log; the open-loop trot of ``record_log.py`` without one."""
    behaviours: tuple[str, ...] = ("pace", "trot")
    """What the BBC was told to do, as in ``record_log.py``."""
    command_seconds: float = 1.0
    """Time between two commands, as in ``record_log.py``."""
    truth: Path | None = None
    """``NAME.truth.json`` of a recorded log: print how far the search is from it. The search itself never sees it."""
    generations: int = 50
    """EASI's release (method notes, section 6.3)."""
    num_robots: int = 300
    """Individuals of a generation (Table S3)."""
    trajectory_length: int = 500
    """Control steps of an individual (Table S3); of ``replay`` all windows together."""
    collection: Literal["policy", "replay"] = "policy"
    """``policy``: individuals roll out the policy (Algorithm S2); ``replay``: windows of the log (ours)."""
    window: int | None = None
    """Control steps of a replayed window; when not given, 1 for an exact log and 8 for a noisy one."""
    skip: int | None = None
    """First steps of a window that do not count; when not given, 0 for an exact log and 2 for a noisy one."""
    noise: float = 0.0
    """Measurement noise that the robot is known to have, as in ``record_log.py``."""
    latency: int = 0
    """Its known latency in control steps."""
    friction_loss: float | None = None
    """Dry friction of the joints [N m]; as the policy was trained when not given."""
    num_threads: int | None = None
    """Threads of the simulator; they do not change the result."""
    max_minutes: float | None = None
    """Stop and save after this time."""
    checkpoint_every: int = 5
    """Generations."""
    resume: Path | None = None
    """Run folder to go on with."""
    search: SearchConfig = field(default_factory=SearchConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)


PAPER = Config(search=SearchConfig(scale="linear", bounded=True))
CPU = Config(
    generations=25,
    num_robots=100,
    trajectory_length=150,
    collection="replay",
    search=SearchConfig(covariance="full", centre="old", min_std=None, averaged=0.3, response=0.75),
    critic=CriticConfig(
        optimizer="adam",
        learning_rate=1e-3,
        weight_clip=None,
        gradient_penalty=1.0,
        matched=True,
        clip=3.0,
        batch_per_robot=4,
    ),
)
SMOKE = replace(
    CPU,
    name="smoke",
    generations=3,
    num_robots=8,
    trajectory_length=20,
    checkpoint_every=1,
    critic=replace(CPU.critic, updates=2, hidden=(16, 16)),
)
PRESETS = {"smoke": SMOKE, "cpu": CPU, "paper": PAPER}

KEPT = ("generations", "max_minutes", "num_threads")
"""Options that may change when a search is resumed."""
REPLAY_WINDOWS = {"exact": (1, 0), "noisy": (8, 2)}
"""Steps and skipped steps of a replayed window. With exact start states the first step says most, and later ones only
add what the estimated trunk velocity gets wrong; a start state that was smoothed out of noise needs some steps to be
forgotten (measured: docs/easi.md)."""
MOST_AT_ONCE = 6
"""Most windows that every individual plays at the same time: beyond some hundreds of robots more only takes memory."""

LEAST_STD = {"exact": 0.005, "noisy": 0.02}
"""Least deviation of a search, in shares of [1/3, 3] x nominal: about what a result is off, so that the distribution
holds the truth (measured: docs/easi.md)."""


def least_std(cfg: Config) -> float:
    """Least standard deviation of the search, a given one before the usual one, which no first range changes."""
    if cfg.search.min_std is not None:
        return cfg.search.min_std
    search = cfg.search
    widest, width = (math.log(s) if search.scale == "log" else s - 1 / s for s in (SearchConfig.span, search.span))
    return LEAST_STD["noisy" if cfg.noise else "exact"] * widest / width


def replay_window(cfg: Config) -> tuple[int, int]:
    """Steps and skipped steps of a window, given ones before usual ones."""
    steps, skip = REPLAY_WINDOWS["noisy" if cfg.noise else "exact"]
    steps = steps if cfg.window is None else cfg.window
    return steps, min(skip, steps - 1) if cfg.skip is None else cfg.skip


def replayed_at_once(cfg: Config) -> int:
    """Windows that every individual plays at the same time, so that no robot idles; they do not change the result."""
    count = max(cfg.trajectory_length // replay_window(cfg)[0], 1)
    return max(number for number in range(1, MOST_AT_ONCE + 1) if count % number == 0)


def check(cfg: Config) -> Path:
    """Refuse options that make no search; returns the log's path.

    Raises:
        ValueError: naming the option.
    """
    if cfg.log is None:
        raise ValueError("give --log FILE, a robot log in .mcap, .csv or .npz; record_log.py makes one")
    for option, value in (("critic.matched", cfg.critic.matched), ("search.response", cfg.search.response)):
        if value and cfg.collection != "replay":
            raise ValueError(
                f"--{option} needs --collection replay: a roll-out of the policy has no matching transition"
            )
    counts = ("generations", "trajectory_length", "checkpoint_every", "critic.updates", "critic.batch_per_robot")
    if too_few := [name for name in counts if attrgetter(name)(cfg) < 1]:
        raise ValueError(f"expected --{too_few[0].replace('_', '-')} of at least 1, got {attrgetter(too_few[0])(cfg)}")
    if cfg.noise < 0.0 or cfg.latency < 0:
        raise ValueError(f"expected --noise and --latency from 0, got {cfg.noise} and {cfg.latency}")
    steps, _ = replay_window(cfg)
    if cfg.collection == "replay" and not 1 <= steps <= cfg.trajectory_length:
        raise ValueError(f"expected --window from 1 to --trajectory-length {cfg.trajectory_length}, got {steps}")
    return cfg.log


def check_inputs(run: Path, inputs: dict[str, Any]) -> None:
    """Refuse to go on with another log or policy than a run began with.

    Raises:
        ValueError: naming what changed.
    """
    began = json.loads((run / run_folder.CONFIG_FILE).read_text(encoding="utf-8")).get("inputs", {})
    for name, value in inputs.items():
        if began.get(name) != value:
            raise ValueError(f"{run} began with {name} {began.get(name)}, found {value}; resume with the same one")
