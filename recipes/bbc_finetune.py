"""Stage 2b: fine-tune a Basic Behaviour Controller in the identified simulator, and say what it gained.

Source: Fu et al. 2025, supplement S2 (fine-tuning after EASI); the learning is that of ``bbc_pretrain.py``.

In:  a trained BBC (``--init-from RUN``), the simulator that ``easi.py`` found (``--simulator RUN``), the clips; for
     simulator to simulator, the log's truth (``--target NAME.truth.json``), which only the comparison sees.
Out: ``runs/NAME/`` as ``bbc_pretrain.py`` writes it, and ``comparison.json``: the controller before and after.

    python recipes/bbc_finetune.py cpu --init-from runs/my_run --simulator runs/easi --target logs/target.truth.json \
        --motion.labelled DIR --motion.unlabelled DIR
    python recipes/bbc_finetune.py cpu --resume runs/finetune       # then compares; give --target and --episodes anew

Presets: ``smoke`` (seconds), ``cpu`` (about ten minutes on two cores), ``paper``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import bbc_config
import bbc_presets
from bbc_config import MotionConfig
from bbc_pretrain import train
from evaluate import Config as Evaluation
from evaluate import check, evaluate_behaviours
from judgement import to_json
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rollouts import MotionConfig as Clips
from rollouts import load_controller, load_motion

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.training import cli, metrics, run_folder


@dataclass(frozen=True)
class Config:
    name: str = "finetune"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of training and comparison."""
    init_from: Path | None = None
    """Run or artifact folder of the BBC."""
    simulator: Path | None = None
    """Run of ``easi.py``, or its ``result.json``."""
    target: Path | None = None
    """``NAME.truth.json`` of the log: compare there too."""
    resume: Path | None = None
    """Run folder to go on with."""
    iterations: int | None = None
    """Iterations of the training, instead of the preset's."""
    num_threads: int | None = None
    """Of the simulator; all by default. They do not change the result."""
    episodes: int = 50
    """Episodes of each behaviour in the comparison."""
    seconds: float = 20.0
    """Length of an episode."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    training: str = "polish"
    """Preset of ``bbc_pretrain.py`` whose other settings hold: ``smoke``, ``polish`` or ``paper``."""
    anchor: float = 2.0
    """How strongly the mean actions are held to those of the start: behaviours drift apart without it."""


PRESETS = {
    "smoke": Config(training="smoke", iterations=3, episodes=1, seconds=2.0),
    "cpu": Config(motion=bbc_presets.POLISH.motion),
    "paper": Config(training="paper", motion=bbc_presets.PAPER.motion),
}
ITERATIONS = {"smoke": 3, "polish": 120, "paper": 10_000}
"""The paper states no number of its own for the fine-tuning (method notes, section 11)."""
LEARNING_RATE, DESIRED_KL = 1e-4, 0.006
"""Small steps: a good policy has more to lose than to find."""


def training(cfg: Config) -> bbc_config.Config:
    """Settings of the training: those of the preset, for a policy that can already walk."""
    if cfg.training not in ITERATIONS:
        raise ValueError(f"--training must be one of {', '.join(ITERATIONS)}, got {cfg.training!r}")
    base, hidden = bbc_presets.PRESETS[cfg.training], bbc_presets.PRESETS[cfg.training].ppo.hidden
    if cfg.init_from is not None:
        hidden = tuple(load_controller(cfg.init_from).artifact.manifest["network"]["hidden"])
    return replace(
        base,
        name=cfg.name,
        runs=cfg.runs,
        seed=cfg.seed,
        init_from=cfg.init_from,
        resume=cfg.resume,
        iterations=cfg.iterations or ITERATIONS[cfg.training],
        max_minutes=None,
        motion=cfg.motion,
        env=replace(
            base.env,
            simulator=cfg.simulator,
            num_threads=cfg.num_threads,
            action_delay_from=0,  # what a pre-training learns at first without
            progress_weight=base.env.progress_left,  # no fading: it walks already
            progress_left=base.env.progress_left,
        ),
        ppo=replace(
            base.ppo,
            critic_warm_up=min(20, (cfg.iterations or ITERATIONS[cfg.training]) // 2),
            learning_rate=min(base.ppo.learning_rate, LEARNING_RATE),
            max_learning_rate=min(base.ppo.max_learning_rate, 5.0 * LEARNING_RATE),
            desired_kl=None if base.ppo.desired_kl is None else min(base.ppo.desired_kl, DESIRED_KL),
            hidden=hidden,
        ),
        imitation=replace(base.imitation, cloning=0, information_ramp=(0, 1), anchor=cfg.anchor),
    )


def evaluation(cfg: Config, path: Path, simulator: Path) -> Evaluation:
    """How a controller is measured in a simulator."""
    return Evaluation(
        path,
        episodes=cfg.episodes,
        seconds=cfg.seconds,
        seed=cfg.seed,
        num_threads=cfg.num_threads,
        simulator=simulator,
        switches=0,
    )


def compare(cfg: Config, run: Path, console: Console) -> dict[str, Any]:
    """Measure the controllers before and after in the identified simulator, and in the target if it is known."""
    assert cfg.init_from is not None and cfg.simulator is not None
    places = {"identified": cfg.simulator} | ({"target": cfg.target} if cfg.target else {})
    motion = load_motion(Clips(cfg.motion.labelled, cfg.motion.unlabelled), {}, cfg.seed)
    states = motion.start_states(cfg.seed)
    result: dict[str, Any] = {}
    for place, simulator in places.items():
        for stage, path in (("before", cfg.init_from), ("after", run)):
            controller = load_controller(path)
            options = evaluation(cfg, path, simulator)
            figures = run / "figures" / f"{place}_{stage}"
            found = evaluate_behaviours(controller, options, motion, states, figures)
            result.setdefault(place, {})[stage] = found
        console.print(table(f"in the {place} simulator", result[place]))
    return result


def table(title: str, found: dict[str, Any]) -> Table:
    """What changed, by behaviour."""
    rows = Table("commanded", "measured", title=title, box=SIMPLE_HEAD, pad_edge=False)
    for stage in found:
        rows.add_column(f"{stage} (95 %)", justify="right")

    def show(interval: metrics.Interval | None) -> str:
        return "-" if interval is None else f"{interval.estimate:.3f} ({interval.low:.3f} to {interval.high:.3f})"

    for name in BEHAVIOURS:
        entries = [stage["behaviours"][name] for stage in found.values()]
        for key in ("recognised", "falls"):
            rows.add_row(name, key, *(show(entry[key]) for entry in entries))
        for key, unit in (("speed", "m/s"), ("yaw rate", "rad/s")):
            rows.add_row(name, f"{key} error, {unit}", *(show(entry["errors"].get(key)) for entry in entries))
    return rows


def main(cfg: Config, console: Console | None = None) -> Path:
    """Fine-tune, then compare; returns the run folder."""
    console = console or cli.console(120)
    if cfg.resume is not None:
        own, asked = run_folder.read_config(cfg.resume, bbc_config.Config), cfg
        cfg = replace(cfg, init_from=own.init_from, simulator=own.env.simulator, motion=own.motion, seed=own.seed)
        cfg = replace(cfg, iterations=cfg.iterations or own.iterations, anchor=own.imitation.anchor)
        if own.init_from is None or own.env.simulator is None:
            raise ValueError(f"{cfg.resume} is no run of bbc_finetune.py: resume it with its own recipe")
        if unheeded := cli.unheeded(asked, cfg):
            print(f"{cfg.resume} goes on with the options that it began with; not heeded: {', '.join(unheeded)}")
    if cfg.init_from is None or cfg.simulator is None:
        raise ValueError("give --init-from RUN, the BBC to fine-tune, and --simulator RUN, what easi.py found")
    if cfg.iterations is not None and cfg.iterations < 1:
        raise ValueError(f"--iterations: expected at least 1, got {cfg.iterations}")
    if cfg.target is not None and not cfg.target.is_file():
        raise FileNotFoundError(f"--target {cfg.target}: no such file; record_log.py writes NAME.truth.json")
    check(evaluation(cfg, cfg.init_from, cfg.simulator))
    run = train(training(cfg))
    run_folder.write_json(run / "comparison.json", to_json(compare(cfg, run, console)))
    console.print(f"saved {run / 'comparison.json'}", markup=False)
    return run


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_presets(PRESETS, default="cpu", doc=__doc__))
