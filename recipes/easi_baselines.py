"""EASI against CMA-ES, ``mujoco.sysid`` and uniform domain randomisation: same logs, windows and simulated steps.

Every target is a simulator with six gains drawn log-uniformly from [1/3, 3] x nominal; its log is recorded, every
method searches it, and the table compares their errors with the truth. Conditions:

    clean     what the sensors say is exact and in time
    noisy     measurement noise of the released code, and measurements one control step late; both known
    outside   as clean, but every gain of the target lies outside the first search range, [1/1.5, 1.5] x nominal
    outside_noisy   noisy and outside

Source: range of the targets and error |x - x*| / x*: method notes, sections 6.3 and 6.5; log of 4,000 steps:
supplement S2; the comparison is ours.

In:  nothing, or the controller that makes the logs (``--easi.policy RUN``); an open-loop trot without one.
Out: ``runs/NAME/`` with ``CONDITION/target_NN.json`` (one file a target), the logs beside them, ``table.md`` and
     ``table.json``.

    python recipes/easi_baselines.py cpu --targets 10
    python recipes/easi_baselines.py cpu --resume runs/easi_baselines --targets 20     # ten more

Presets: ``smoke`` (seconds), ``cpu`` and ``paper`` (those of ``easi.py``). A finished method of a finished target is
never run again: stop at any time and go on with ``--resume``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import easi_config
import record_log
import torch
from easi_methods import METHODS, Problem, identify
from easi_report import load_truth, relative_error
from easi_table import markdown, print_table, summarize
from log_policy import make_actor
from rich.console import Console
from training_run import own_options

from agility_rl.collectors import GAINS, ParameterSpace, RobotLog, cut_windows
from agility_rl.collectors.parameters import Parameter
from agility_rl.training import cli, run_folder
from agility_rl.training.seeding import Seeds

TARGET_SPAN = 3.0
"""Targets have gains in [1/3, 3] x nominal (method notes, section 6.3)."""
OUTSIDE_SPAN = 1.5
"""First range of the search, [1/1.5, 1.5] x nominal, that targets of the condition ``outside`` avoid (ours)."""


@dataclass(frozen=True)
class Condition:
    noise: float = 0.0
    """Factor on the half-widths of the measurement noise."""
    latency: int = 0
    """Control steps by which measurements are late."""
    span: float = TARGET_SPAN
    """First range of the search, [1/span, span] x nominal."""


KEPT = ("targets", "conditions", "methods")
"""Options that may change when a comparison is resumed."""
CONDITIONS = {
    "clean": Condition(),
    "noisy": Condition(noise=1.0, latency=1),
    "outside": Condition(span=OUTSIDE_SPAN),
    "outside_noisy": Condition(noise=1.0, latency=1, span=OUTSIDE_SPAN),
}


@dataclass(frozen=True)
class Config:
    name: str = "easi_baselines"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of targets, noise and searches."""
    targets: int = 10
    """Targets of every condition."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """What the logs and the first range are like, by name."""
    methods: tuple[str, ...] = tuple(METHODS)
    """What is compared, by name."""
    steps: int = 4000
    """Rows of a log: 80 s (supplement S2)."""
    window: int | None = None
    """Control steps that the baselines predict from one start state; as EASI's when not given."""
    skip: int | None = None
    """First steps of a window that do not count for the baselines; as EASI's when not given."""
    population: int = 30
    """Individuals of CMA-ES; each predicts as many windows as the budget of EASI's generation allows."""
    resume: Path | None = None
    """Run folder to go on with; only ``--targets``, ``--conditions`` and ``--methods`` may change."""
    easi: easi_config.Config = field(default_factory=lambda: easi_config.CPU)
    """Options of the search, also policy and budget; log, noise, latency, seed and span come from the target."""


PRESETS = {
    "smoke": Config(name="smoke_baselines", targets=1, steps=200, population=8, easi=easi_config.SMOKE),
    "cpu": Config(),
    "paper": Config(easi=easi_config.PAPER),
}


def check(cfg: Config) -> None:
    """Refuse options that make no comparison.

    Raises:
        ValueError: naming the option.
    """
    for option, chosen, known in (("conditions", cfg.conditions, CONDITIONS), ("methods", cfg.methods, METHODS)):
        if not chosen or (unknown := sorted(set(chosen) - set(known))):
            raise ValueError(f"expected --{option} from {', '.join(known)}, got {', '.join(unknown) or 'none'}")
    if cfg.targets < 1 or cfg.population < 4:
        raise ValueError(f"expected --targets from 1 and --population from 4, got {cfg.targets} and {cfg.population}")
    if set(cfg.easi.search.parameters) != set(GAINS):
        raise ValueError(f"the comparison is about the gains; leave --easi.search.parameters at {', '.join(GAINS)}")
    own = {"log": cfg.easi.log, "truth": cfg.easi.truth, "resume": cfg.easi.resume}
    for name, value in own.items():
        if value is not None:
            raise ValueError(f"leave --easi.{name} out: the comparison records its own logs")


def draw_target(seed: int, index: int, condition: Condition) -> dict[str, float]:
    """Multiples of the nominal gains, the same in every condition up to the gap that ``outside`` leaves."""
    draw = 2.0 * torch.rand(len(GAINS), generator=Seeds(seed).generator(f"target {index}"), dtype=torch.float64) - 1.0
    # From [1/3, 3] as it is, or with [1/span, span] cut out; the smallest step beyond keeps it strictly outside.
    inner = 0.0 if condition.span == TARGET_SPAN else math.log(condition.span)
    exponent = draw.sign() * (inner + draw.abs() * (math.log(TARGET_SPAN) - inner))
    return dict(zip(GAINS, exponent.exp().tolist(), strict=True))


def record(cfg: Config, folder: Path, index: int, condition: Condition) -> Path:
    """The log of a target, recorded unless a run that was stopped has left it."""
    log = folder / f"target_{index:02d}.npz"
    if not log.with_suffix(".truth.json").is_file():
        log.unlink(missing_ok=True)  # the truth is written last
        record_log.main(
            record_log.Config(
                log=log,
                steps=cfg.steps,
                policy=cfg.easi.policy,
                behaviours=cfg.easi.behaviours,
                command_seconds=cfg.easi.command_seconds,
                truth=record_log.Truth(**draw_target(cfg.seed, index, condition)),
                noise=condition.noise,
                latency=condition.latency,
                friction_loss=cfg.easi.friction_loss,
                seed=Seeds(cfg.seed).integer(f"log {index}") % 2**31,
            )
        )
    return log


def make_problem(cfg: Config, log: Path, index: int, condition: Condition) -> Problem:
    """What every method gets: the log, the first range, the budget."""
    seed = Seeds(cfg.seed).integer(f"search {index}") % 2**31
    search = replace(cfg.easi.search, span=condition.span)
    easi = replace(cfg.easi, log=log, noise=condition.noise, latency=condition.latency, seed=seed, search=search)
    linear = {"scale": "linear"} if search.scale == "linear" else {}
    actor = make_actor(easi.policy, easi.behaviours, easi.command_seconds)
    window, skip = easi_config.replay_window(replace(easi, window=cfg.window, skip=cfg.skip))
    return Problem(
        space=ParameterSpace([Parameter.named(name, span=search.span, **linear) for name in search.parameters]),
        windows=cut_windows(RobotLog.load(log), window, skip=skip, noise=condition.noise, latency=condition.latency),
        easi=easi,
        friction_loss=actor.friction_loss if easi.friction_loss is None else easi.friction_loss,
        budget=easi.generations * easi.num_robots * easi.trajectory_length,
        population=cfg.population,
        seed=seed,
    )


def compare_on(cfg: Config, folder: Path, index: int, name: str, console: Console) -> dict[str, Any]:
    """Results of one target, of a finished file or of what is still missing in it."""
    file = folder / f"target_{index:02d}.json"
    result = run_folder.read_json(file) or {}
    missing = [method for method in cfg.methods if method not in result.get("methods", {})]
    if not missing:
        return result
    log = record(cfg, folder, index, CONDITIONS[name])
    problem = make_problem(cfg, log, index, CONDITIONS[name])
    truth, _ = load_truth(log.with_suffix(".truth.json"), problem.space)
    values = dict(zip(problem.space.names, truth.tolist(), strict=True))
    result = {"condition": name, "target": index, "budget": problem.budget, "truth": values, "methods": {}} | result
    for method in missing:
        outcome = identify(method, problem)
        error = relative_error(outcome.centre, truth, problem.space)
        result["methods"][method] = {
            "value": dict(zip(problem.space.names, outcome.centre.tolist(), strict=True)),
            "spread": [value if math.isfinite(value) else None for value in outcome.spread.tolist()],
            "error": dict(zip(problem.space.names, error.tolist(), strict=True)),
            "mean_error": float(error.mean()),
            "steps": outcome.steps,
            "seconds": outcome.seconds,
        }
        run_folder.write_json(file, result)
        console.print(
            f"{name}, target {index}, {method}: mean error {100 * float(error.mean()):.1f} %, {outcome.steps:,} "
            f"control steps, {outcome.seconds:.0f} s"
        )
    return result


def all_results(folder: Path) -> list[dict[str, Any]]:
    """Whatever there is in a run, of earlier calls with other conditions, targets or methods too."""
    files = [file for name in CONDITIONS for file in sorted((folder / name).glob("target_*.json"))]
    return [json.loads(file.read_text(encoding="utf-8")) for file in files if not file.name.endswith(".truth.json")]


def main(cfg: Config, console: Console | None = None) -> Path:
    """Compare on all targets, print and write the table; returns the run folder."""
    console = console or cli.console(160)
    cfg = own_options(cfg, KEPT)
    check(cfg)
    make_actor(cfg.easi.policy, cfg.easi.behaviours, cfg.easi.command_seconds)  # if it cannot be, the name stays free
    folder = run_folder.start_run(
        cfg, cfg.resume or cfg.runs / cfg.name, resume=cfg.resume is not None, recipe="easi_baselines"
    )
    with cli.interruptible() as interrupted:
        for index in range(cfg.targets):
            for name in cfg.conditions:
                if not interrupted():
                    (folder / name).mkdir(exist_ok=True)
                    compare_on(cfg, folder / name, index, name, console)
    results = all_results(folder)
    methods = dict.fromkeys([*cfg.methods, *(method for result in results for method in result["methods"])])
    summary = summarize(results, list(methods))
    run_folder.write_json(folder / "table.json", run_folder.to_json(summary))
    (folder / "table.md").write_text(markdown(summary), encoding="utf-8")
    print_table(console, summary)
    console.print(f"saved {folder}", markup=False)
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_presets(PRESETS, doc=__doc__, kept=KEPT))
