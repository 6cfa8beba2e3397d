"""What each part of stage 1 is good for: trainings that lack one of them, evaluated alike, in one table.

In:  the clips that ``bbc_pretrain.py`` takes.
Out: runs ``ablation_VARIANT_SEED`` in ``--runs``, each trained and evaluated, and ``ablations.json`` and
     ``ablations.md`` there, of these and of those before. What is finished is not done again, what was interrupted is
     resumed: stop it whenever you like, and start it again with further variants or seeds.

    python recipes/ablations.py --variants none no_information task_only --seeds 0 1 --motion.labelled DIR \
        --motion.unlabelled DIR

A training of the preset ``cpu`` takes some 35 minutes on two free cores.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import bbc_presets
import torch
from bbc_config import Config as TrainingConfig
from rich.console import Console
from rollouts import MotionConfig

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.training import cli, metrics, run_folder
from agility_rl.training.checkpoint import RunCheckpoint

VARIANTS: dict[str, tuple[str, ...]] = {
    "none": (),
    "labels_3_percent": ("--motion.label-share", "0.03"),
    "labels_1_percent": ("--motion.label-share", "0.01"),
    "no_labels": (
        *("--motion.label-share", "0", "--imitation.no-conditional", "--imitation.labelled-share", "0"),
        *("--imitation.warm-up", "0", "--imitation.cloning", "0", "--env.rhythm-weight", "0", "--trials.start", "None"),
    ),
    "no_information": ("--imitation.information", "0"),
    "prior_raw": ("--imitation.prior-temperature", "None"),
    "no_mirror": ("--motion.no-mirror",),
    "no_rhythm": ("--env.rhythm-weight", "0"),
    "task_only": (
        *("--imitation.imitation-reward", "0", "--imitation.skill-reward", "0", "--imitation.shift-reward", "0"),
        *("--imitation.cloning", "0", "--env.rhythm-weight", "0"),
    ),
}
"""What each variant adds to the command. ``none`` lacks nothing; ``prior_raw`` draws skills from the learned prior as
it is, which the preset makes almost even; ``no_labels`` looks at no clip's name, and ``task_only`` pays for commands
and regularity alone and does without the preset's changes of the imitation, both from a random start."""


@dataclass(frozen=True)
class Config:
    variants: tuple[str, ...] = tuple(VARIANTS)
    """Which trainings, by name."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of each."""
    preset: str = "cpu"
    """Preset of ``bbc_pretrain.py``."""
    iterations: int | None = None
    """Iterations of each; those of the preset when not given."""
    runs: Path = Path("runs")
    """Folder of the runs and of the table."""
    episodes: int = 100
    """Episodes of each behaviour in an evaluation."""
    seconds: float = 20.0
    """Length of an episode."""
    switches: int = 10
    """Trials of each of the 20 ordered switches."""
    motion: MotionConfig = field(default_factory=MotionConfig)


def command(recipe: str, *arguments: str) -> None:
    """Run a recipe from beside this one; its output is ours, and so is Ctrl-C: it ends as it does by itself.

    Raises:
        ValueError: if it failed.
    """
    with subprocess.Popen([sys.executable, str(Path(__file__).with_name(f"{recipe}.py")), *arguments]) as process:
        while process.returncode is None:
            with contextlib.suppress(KeyboardInterrupt):  # the recipe has heard it too, and saves
                process.wait()
    if process.returncode:
        raise ValueError(f"recipes/{recipe}.py ended with {process.returncode}; what it said stands above")


def motion_options(config: MotionConfig) -> list[str]:
    """The clips, as options of either recipe."""
    given = {"--motion.labelled": config.labelled, "--motion.unlabelled": config.unlabelled}
    return [text for option, path in given.items() if path is not None for text in (option, str(path))]


def options_of(variant: str, preset: str) -> list[str]:
    """What a variant adds to the command."""
    changes = bbc_presets.PRESETS[preset].changes if variant == "task_only" else ()
    kept = [str(part) for change in changes if not change[1].startswith("imitation.") for part in change]
    return [*VARIANTS[variant], *(["--changes", *kept] if changes else [])]


def train(variant: str, seed: int, config: Config) -> Path:
    """An evaluated run, made, resumed or found.

    Raises:
        ValueError: if it was made with other options than those asked for, or stopped.
    """
    run = config.runs / f"ablation_{variant}_{seed}"
    options = ["--name", run.name, "--runs", str(config.runs), "--seed", str(seed)]
    options += [*motion_options(config.motion), *options_of(variant, config.preset)]
    asked = cli.from_presets(bbc_presets.PRESETS, [config.preset, *options])
    asked = replace(asked, iterations=config.iterations or asked.iterations)
    judged = {name: getattr(config, name) for name in ("episodes", "seconds", "switches")}
    begun, finished = (run / run_folder.CONFIG_FILE).is_file(), (run / "evaluation.json").is_file()
    if begun and (other := differences(run, asked, judged if finished else {})):
        raise ValueError(f"{run} was made with other {', '.join(other)}; choose another --runs, or remove it")
    if finished:
        return run
    limits = ["--iterations", str(asked.iterations), "--max-minutes", "None"]  # however busy the machine is
    command("bbc_pretrain", config.preset, *limits, *(["--resume", str(run)] if begun else options))
    if (done := RunCheckpoint(run / "checkpoints").steps()[-1]) < asked.iterations:
        raise ValueError(f"{run} ended after {done} of {asked.iterations} iterations; start this again to go on")
    judging = [text for name, value in judged.items() for text in (f"--{name}", str(value))]
    command("evaluate", str(run), *motion_options(config.motion), *judging)
    return run


def differences(run: Path, asked: TrainingConfig, judged: dict[str, Any]) -> list[str]:
    """Which options of a run's training are others than those asked for; of a finished run, of its evaluation too."""
    began = run_folder.read_config(run, TrainingConfig)
    free = {"name", "runs", "resume", "max_minutes", "iterations"}
    other = [name for name in vars(asked) if name not in free and getattr(began, name) != getattr(asked, name)]
    if judged:
        other += ["iterations"] if RunCheckpoint(run / "checkpoints").steps()[-1] != asked.iterations else []
        found = json.loads((run / "evaluation.json").read_text(encoding="utf-8"))["settings"]
        other += [name for name, value in judged.items() if found[name] != value]
    return other


def summary(run: Path) -> dict[str, Any]:
    """The figures of an evaluation that the table has."""
    found = json.loads((run / "evaluation.json").read_text(encoding="utf-8"))
    by_name = {target["name"]: target["value"] for target in found["targets"]}
    return {
        "run": run.name,
        "targets": sum(target["passed"] for target in found["targets"]),
        "of": len(found["targets"]),
        **{name: by_name[f"{name}: recognised"]["estimate"] for name in BEHAVIOURS},
        "nmi": found["nmi"]["estimate"],
        "falls": found["falls"]["estimate"],
        "like_a_dog": sum(t["passed"] for t in found["targets"] if "(dog)" in t["target"]),
    }


def table(rows: dict[str, list[dict[str, Any]]]) -> str:
    """Markdown: one line a variant, means over its seeds with 95 % intervals where there are several."""
    columns = ("targets", *BEHAVIOURS, "nmi", "falls", "like_a_dog")
    lines = [f"| without | seeds | {' | '.join(columns)} |".replace("_", " "), "|---" * (len(columns) + 2) + "|"]
    for variant, found in rows.items():
        cells = []
        for column in columns:
            mean, low, high = metrics.mean_interval(torch.tensor([float(row[column]) for row in found]))
            digits = 1 if column in ("targets", "like_a_dog") else 2
            cells.append(f"{mean:.{digits}f}" + (f" ± {0.5 * (high - low):.{digits}f}" if len(found) > 1 else ""))
        lines.append(f"| {variant.replace('_', ' ')} | {len(found)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(config: Config, console: Console) -> dict[str, list[dict[str, Any]]]:
    """Make everything that is missing; the table is written after every run."""
    unknown = [name for name in config.variants if name not in VARIANTS]
    if unknown or not config.seeds:
        raise ValueError(
            f"expected --seeds and --variants of {', '.join(VARIANTS)}; got {', '.join(unknown) or 'none'}"
        )
    if config.preset not in bbc_presets.PRESETS:
        raise ValueError(f"--preset: expected one of {', '.join(bbc_presets.PRESETS)}, got {config.preset!r}")
    file = config.runs / "ablations.json"
    rows: dict[str, list[dict[str, Any]]] = (run_folder.read_json(file) or {"rows": {}})["rows"]
    for seed in config.seeds:
        for variant in config.variants:
            found = summary(train(variant, seed, config))
            others = [row for row in rows.get(variant, []) if row["run"] != found["run"]]
            rows[variant] = sorted([*others, found], key=lambda row: row["run"])
            run_folder.write_json(file, {"format": "agility_rl.ablations", "rows": rows})
            (config.runs / "ablations.md").write_text(table(rows), encoding="utf-8")
    console.print(table(rows), highlight=False)
    return rows


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__), cli.console(140))
