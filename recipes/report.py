"""One HTML page of a run, with everything inside: targets, gaits, tracking, courses, learning curves, settings.

In:  a run folder of ``bbc_pretrain.py``, ``tsc_teacher.py`` or ``tsc_student.py``, best after ``evaluate.py`` or
     ``evaluate_course.py``, whose results and pictures the page shows; what was evaluated into ``RUN/course`` too.
Out: ``RUN/report.html``, a single file that needs no network; an earlier one is replaced.

    python recipes/report.py runs/my_run
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from course_report import course_results
from html_page import Markup, document, drawn, interval, note, picture, table
from judgement import show
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.record import read_scalars
from agility_rl.record.plots import Curves, learning_curves
from agility_rl.training import cli, run_folder
from agility_rl.training.checkpoint import publish

COURSE = "course"
"""Folder of a run in which another controller was evaluated on courses: ``evaluate_course.py --output RUN/course``."""
GROUPS = {
    "Rewards": "reward/",
    "Shares of the rewards": "share/",
    "Distance from the commands": "error/",
    "Style of each behaviour": "style/",
    "Behaviours recovered by the predictor": "recovery/",
    "Task terms": "task/",
    "Skill prior": "prior/",
}
SMOOTHING = 0.9
UNITS = {"speed": "m/s", "lateral speed": "m/s", "yaw rate": "rad/s", "height": "m"}


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""


def outdated(weights: str | None, evaluations: Mapping[str, Any]) -> list[str]:
    """Notes on evaluations, by recipe, of other weights than those that a run shows now."""
    text = "an earlier policy of this run was evaluated: run recipes/{}.py on it again"
    others = [recipe for recipe, found in evaluations.items() if found and found.get("weights", weights) != weights]
    return [note(text.format(recipe)) for recipe in others if weights]


def results(found: Mapping[str, Any], figures: Path) -> str:
    """What ``evaluate.py`` measured."""
    passed = sum(row["passed"] for row in found["targets"])
    motion = found["motion"]["source"]
    settings = found["settings"]
    text = (
        f"{settings['episodes']} episodes of {settings['seconds']:g} s of each behaviour, compared with {motion}. The "
        "gait classifier that names what the robot showed knows nothing of the networks. Intervals are of 95 %."
    )
    summary = f"<b>{passed} of {len(found['targets'])} targets reached.</b> {escape(text)}"
    parts = [f'<p class="headline">{summary}</p>']
    verdicts = {True: Markup('<span class="pass">pass</span>'), False: Markup('<span class="fail">fail</span>')}
    rows = [[r["name"], interval(r["value"]), r["target"], verdicts[r["passed"]]] for r in found["targets"]]
    parts += ["<h2>Targets</h2>", table(["what", "measured", "target", ""], rows)]
    parts += ["<h2>Commanded and shown</h2>", picture(figures / "behaviour_matrix.png", "shares of episodes")]
    fall = found["matrix"]["columns"].index("fall")
    caption = "one point an episode; on the dashed line it did as told, crosses fell"
    parts.append(drawn(tracking_scatter(found["episodes"], fall), caption))
    names = found["episodes"]["quantities"]
    errors = {name: entry["errors"] for name, entry in found["behaviours"].items()}
    rows = [[name, *(interval(entry.get(key)) for key in names)] for name, entry in errors.items()]
    heads = [f"{name}, {UNITS[name]}" for name in names]
    parts += ["<h3>Mean errors of an episode, without falls</h3>", table(["commanded", *heads], rows)]
    parts.append("<h2>Robot and dog</h2>")
    for name, entry in found["behaviours"].items():
        rows = [
            [
                key,
                interval(c["robot"]),
                "{:.3f} to {:.3f}".format(*c["dog"]),
                show([c["ratio_to_mean"]]),
                verdicts[c["within"]],
            ]
            for key, c in entry["gait"].items()
        ]
        parts.append(f"<h3>{escape(name)}</h3>")
        parts.append(
            table(["", "robot", "dog's clips", "ratio to their mean", "within 25 %"], rows)
            if rows
            else note("no episode without a fall")
        )
        parts.append(picture(figures / f"footfall_{name}.png", f"{name}: feet on the ground"))
        parts.append(picture(figures / f"tracking_{name}.png", f"{name}: one episode"))
    if found.get("switches"):
        safe, trials = found["switches"]["without_fall"], found["switches"]["trials"]
        rows = [[a, *("" if a == b else f"{safe[f'{a} to {b}']} of {trials}" for b in BEHAVIOURS)] for a in BEHAVIOURS]
        parts += ["<h2>Switches without a fall</h2>", table(["from / to", *BEHAVIOURS], rows)]
    if found.get("prior"):
        keys = ("learned", "unlabelled_among_behaviours")
        rows = [[key.replace("_", " "), *(f"{found['prior'][key][name]:.2f}" for name in BEHAVIOURS)] for key in keys]
        parts += ["<h2>Skill prior and unlabelled motion</h2>", table(["", *BEHAVIOURS], rows)]
    return "\n".join(parts)


def tracking_scatter(episodes: Mapping[str, Any], fall: int) -> Figure:
    """Commanded against measured, one point an episode, one panel a quantity; ``fall`` was shown by who fell."""
    skill, fell = torch.tensor(episodes["skill"]), torch.tensor(episodes["shown"]) == fall
    pairs = [torch.tensor([[or_nan(x) for x in row] for row in episodes[key]]) for key in ("commanded", "measured")]
    figure = Figure(figsize=(12.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for column, name in enumerate(episodes["quantities"]):
        axes = figure.add_subplot(1, len(episodes["quantities"]), column + 1)
        wanted, got = (pair[:, column] for pair in pairs)
        for index, behaviour in enumerate(BEHAVIOURS):
            for own, marker, size, label in ((~fell, "o", 7, behaviour), (fell, "x", 28, None)):
                chosen = own & (skill == index)
                points, colour = (wanted[chosen], got[chosen]), f"C{index}"
                axes.scatter(*points, s=size, alpha=0.6, label=label, marker=marker, color=colour)
        ends = [float(wanted.min()), float(wanted.max())]
        axes.plot(ends, ends, "k--", linewidth=1.0)
        axes.set_title(f"{name}, {UNITS[name]}", fontsize=10)
        axes.set_xlabel("commanded", fontsize=9)
        axes.grid(alpha=0.3)
        if column == 0:
            axes.set_ylabel("measured", fontsize=9)
            axes.legend(fontsize=8)
    return figure


def or_nan(value: float | None) -> float:
    """What JSON had to write as null."""
    return float("nan") if value is None else value


def curves(run: Path) -> str:
    """Learning curves of the run, group by group."""
    if not (run / "metrics.mcap").is_file():
        return note("no metrics.mcap in this folder: no learning curves")
    scalars: Curves = read_scalars(run)
    if not scalars:
        return note("metrics.mcap holds no scalars yet")
    groups = {title: [name for name in scalars if name.startswith(start)] for title, start in GROUPS.items()}
    grouped = {name for names in groups.values() for name in names}
    clock = [name for name in scalars if name.startswith("time/")]
    other = ("time/minutes", "time/images_per_second")  # the only ones that are no seconds of an iteration
    groups["Losses and the rest"] = [name for name in scalars if name not in (*grouped, *clock) or name in other]
    groups["Time [s]"] = [name for name in clock if name not in other]
    return "\n".join(
        drawn(learning_curves({run.name: scalars}, sorted(names), smoothing=SMOOTHING, columns=4), title)
        for title, names in groups.items()
        if names
    )


def page(run: Path) -> str:
    """The whole page.

    Raises:
        FileNotFoundError: if the folder is no run.
    """
    record, found = run_folder.read_json(run / run_folder.CONFIG_FILE), run_folder.read_json(run / "evaluation.json")
    courses = {folder: run_folder.read_json(folder / "course_evaluation.json") for folder in (run, run / COURSE)}
    manifest = run_folder.read_json(run / "policy" / "manifest.json") or {}
    if record is None and found is None and not any(courses.values()):
        files = f"{run_folder.CONFIG_FILE}, evaluation.json or course_evaluation.json"
        raise FileNotFoundError(f"{run}: expected a run folder with {files}; check the path")
    record = record or {}
    if (recipe := record.get("recipe", "")).startswith("easi"):
        raise ValueError(
            f"{run}: expected a run of a controller, got one of {recipe}.py; its own files say what it found"
        )
    parts = [f"<h1>{escape(run.resolve().name)}</h1>"]
    origin = [record.get("recipe"), record.get("started"), " ".join(record.get("command", []))]
    parts.append(note(" · ".join(str(entry) for entry in origin if entry)))
    parts += outdated(manifest.get("weights", {}).get("sha256"), {"evaluate": found, "evaluate_course": courses[run]})
    if found:
        parts.append(results(found, run / "figures"))
    if (run / "comparison.json").is_file():
        parts.append(note("the controller before and after fine-tuning: comparison.json, beside this page"))
    parts += [course_results(course, folder / "figures") for folder, course in courses.items() if course]
    if record and not found and not courses[run]:
        recipe = "evaluate" if record.get("recipe", "bbc_pretrain").startswith("bbc") else "evaluate_course"
        parts.append(note(f"not evaluated yet: run recipes/{recipe}.py on it"))
    strips = sorted((run / "figures").glob("perform_*.png"))
    if strips:
        parts += ["<h2>Pictures</h2>", *(picture(strip, strip.stem.replace("_", " ")) for strip in strips)]
    parts += ["<h2>Learning</h2>", curves(run)]
    parts.append("<h2>What it was made of</h2>")
    if data := manifest.get("data"):
        parts.append(f"<p>Motion: {escape(', '.join(data))}</p>")
    parts.append(table(["package", "version"], sorted(record.get("versions", {}).items())))
    for title, value in (("Configuration", record.get("config")), ("Manifest of the policy", manifest)):
        if value:
            text = escape(json.dumps(value, indent=2))
            parts.append(f"<details><summary>{title}</summary><pre>{text}</pre></details>")
    return document(run.resolve().name, parts)


def main(config: Config) -> Path:
    """Write the page in one step and return its path."""
    target = config.run / "report.html"
    text = page(config.run)
    staged = target.with_name(f".{target.name}.incoming")
    staged.write_text(text, encoding="utf-8")
    publish(staged, target)
    return target


if __name__ == "__main__":
    with cli.one_line_errors():
        print(main(cli.from_arguments(Config, doc=__doc__)).as_posix())
