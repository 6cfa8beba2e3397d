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

import json
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from bbc_presets import CPU
from rich.console import Console
from rollouts import MotionConfig

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.training import cli, metrics
from agility_rl.training.checkpoint import RunCheckpoint

WITHOUT_IMITATION = [change for change in CPU.changes if not change[1].startswith("imitation.")]
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
        *("--changes", *(str(part) for change in WITHOUT_IMITATION for part in change)),
    ),
}
"""What each variant adds to the command. ``none`` lacks nothing; ``prior_raw`` draws skills from the learned prior as
it is, which the preset makes almost even; ``no_labels`` looks at no clip's name, and ``task_only`` pays for commands
and regularity alone, both from a random start."""


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
    """Run a recipe from beside this one; its output is ours.

    Raises:
        ValueError: if it failed.
    """
    done = subprocess.run([sys.executable, str(Path(__file__).with_name(f"{recipe}.py")), *arguments], check=False)
    if done.returncode:
        raise ValueError(f"recipes/{recipe}.py ended with {done.returncode}; what it said stands above")


def motion_options(config: MotionConfig) -> list[str]:
    """The clips, as options of either recipe."""
    given = {"--motion.labelled": config.labelled, "--motion.unlabelled": config.unlabelled}
    return [text for option, path in given.items() if path is not None for text in (option, str(path))]


def train(variant: str, seed: int, config: Config) -> Path:
    """An evaluated run, made, resumed or found."""
    run = config.runs / f"ablation_{variant}_{seed}"
    if (run / "evaluation.json").is_file():
        return run
    arguments = ["--max-minutes", "None"]  # alike are iterations, however busy the machine is
    arguments += ["--iterations", str(config.iterations)] if config.iterations is not None else []
    if (run / cli.CONFIG_FILE).is_file():
        arguments += ["--resume", str(run)]
    else:
        arguments += ["--name", run.name, "--runs", str(config.runs), "--seed", str(seed)]
        arguments += [*motion_options(config.motion), *VARIANTS[variant]]
    command("bbc_pretrain", config.preset, *arguments)
    wanted = (
        config.iterations or json.loads((run / cli.CONFIG_FILE).read_text(encoding="utf-8"))["config"]["iterations"]
    )
    if (done := RunCheckpoint(run / "checkpoints").steps()[-1]) < wanted:
        raise ValueError(f"{run} ended after {done} of {wanted} iterations; start this again to go on")
    judged = {"--episodes": config.episodes, "--seconds": config.seconds, "--switches": config.switches}
    options = [text for option, value in judged.items() for text in (option, str(value))]
    command("evaluate", str(run), *motion_options(config.motion), *options)
    return run


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
    file = config.runs / "ablations.json"
    rows: dict[str, list[dict[str, Any]]] = {}
    if file.is_file():
        rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    for seed in config.seeds:
        for variant in config.variants:
            found = summary(train(variant, seed, config))
            others = [row for row in rows.get(variant, []) if row["run"] != found["run"]]
            rows[variant] = sorted([*others, found], key=lambda row: row["run"])
            cli.write_json(file, {"format": "agility_rl.ablations", "rows": rows})
            (config.runs / "ablations.md").write_text(table(rows), encoding="utf-8")
    console.print(table(rows), highlight=False)
    return rows


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__), cli.console(140))
