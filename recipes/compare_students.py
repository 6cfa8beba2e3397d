"""Students with and without BYOL, of several seeds: success under each disturbance of their camera.

In:  run folders of ``tsc_student.py`` (each says itself whether it was trained with BYOL) and that of their teacher.
Out: tables on the screen, ``OUTPUT/student_comparison.json``, ``OUTPUT/figures/success_under_disturbance.png`` and
     ``OUTPUT/cells.json``: every student's successes under each disturbance, written as soon as they are known. What
     stands there is not done again: stop it whenever you like, and start it again, with further students too.

    python recipes/compare_students.py runs/with_0 runs/with_1 runs/without_0 runs/without_1 --teacher runs/my_teacher

All of them meet courses of one seed, which no training used; the first of every robot are the same. A success rate of
several runs is their mean with a Student-t interval over the runs; of one run it has a Wilson interval.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from course_judgement import summarise
from deciders import Decider, load_decider
from disturbances import Disturbance, chosen
from evaluate_course import Config as CourseConfig
from evaluate_course import simulate
from judgement import make_table, show, to_json
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress
from tsc_setup import course_of

from agility_rl.record.plots import new_figure, save_figure
from agility_rl.training import cli, metrics, run_folder

CELLS_FILE = "cells.json"
SETTINGS = ("strength", "episodes", "robots", "episode_length", "seed")
"""Options that all cells of a file share, beside the course."""
GROUPS = {True: "with BYOL", False: "without BYOL"}
OF_TEACHER, HALVED = 0.9, 0.5
"""Targets of stage 4: share of the teacher's success, and of the loss of success under disturbance."""


@dataclass(frozen=True)
class Config:
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run or artifact folders of students."""
    teacher: Path | None = None
    """Run or artifact folder of the teacher that they learned from."""
    bbc: Path | None = None
    """Folder of the Basic Behaviour Controller; that of the training by default."""
    course: str = "full"
    """Preset course or course file."""
    disturbance: tuple[str, ...] = ("all",)
    """None, rectangles, noise, blur, dropout, late_1, late_2, pitch; ``all`` for each of them."""
    strength: int = 1
    """How many times images are disturbed."""
    episodes: int = 300
    """Of each student under each disturbance."""
    robots: int = 100
    """Most robots simulated at once."""
    episode_length: float = 40.0
    """Seconds until an episode counts as failed."""
    seed: int = 1000
    """Of courses and start places."""
    num_threads: int | None = None
    """Threads of the simulator."""
    output: Path = Path("runs/student_comparison")
    """Folder of the results."""


def measured_before(file: Path, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cells of earlier calls with the same ``--output``: by weights and disturbance ``successes`` and ``obstacles``.

    Raises:
        ValueError: if they are damaged, or were measured on another course or with other options.
    """
    found = run_folder.read_json(file)
    if found is None:
        return {}
    if other := [name for name, value in settings.items() if found["settings"].get(name) != value]:
        raise ValueError(f"{file} was measured with other {', '.join(other)}; choose another --output, or remove it")
    return found["cells"]


def rate(successes: Sequence[int], episodes: int) -> metrics.Interval:
    """Success of one run, or the mean of several."""
    if len(successes) == 1:
        return metrics.wilson_interval(successes[0], episodes)
    return metrics.mean_interval(torch.tensor(successes) / episodes)


def conclude(found: Mapping[str, Any], teacher: int | None, episodes: int) -> dict[str, Any]:
    """Success and its loss for every group and disturbance, and the targets.

    Args:
        found: by run, ``byol`` and ``successes`` by disturbance.
        teacher: successes of the teacher.
        episodes: behind every number of successes.
    """
    groups: dict[str, Any] = {}
    for byol, name in GROUPS.items():
        runs = [one["successes"] for one in found.values() if one["byol"] is byol]
        if not runs:
            continue
        disturbed = [key for key in runs[0] if key != "none"]
        group: dict[str, Any] = {"success": {key: rate([run[key] for run in runs], episodes) for key in runs[0]}}
        if "none" in runs[0]:
            loss = {key: torch.tensor([run["none"] - run[key] for run in runs]) / episodes for key in disturbed}
            group["loss"] = {key: metrics.mean_interval(value) for key, value in loss.items()}
            if loss:
                group["mean_loss"] = metrics.mean_interval(torch.stack(tuple(loss.values())).mean(0))
                passed = torch.tensor([[run[key] for key in disturbed] for run in runs]) / episodes
                group["mean_disturbed"] = metrics.mean_interval(passed.mean(1))
        groups[name] = group
    targets: list[dict[str, Any]] = []

    def add(name: str, value: float, target: str, passed: bool) -> None:
        targets.append({"name": name, "value": value, "target": target, "passed": passed})

    if teacher:
        for name, group in groups.items():
            if "none" in group["success"]:
                share = group["success"]["none"].estimate * episodes / teacher
                add(f"{name}: success / the teacher's", share, f">= {OF_TEACHER:g}", share >= OF_TEACHER)
    both = [groups[name] for name in GROUPS.values() if "mean_loss" in groups.get(name, {})]
    if len(both) == 2 and both[1]["mean_loss"].estimate > 0.0:  # else there is nothing to halve
        loss, limit = both[0]["mean_loss"].estimate, HALVED * both[1]["mean_loss"].estimate
        add("mean loss of success with BYOL", loss, f"<= {limit:.3f}, half of that without", loss <= limit)
        # Who passes less undisturbed has less to lose.
        disturbed, least = (group["mean_disturbed"].estimate for group in both)
        target = f">= {least:.3f}, that without"
        add("mean success under disturbance with BYOL", disturbed, target, disturbed >= least)
    return {"groups": groups, "targets": targets}


def print_comparison(result: Mapping[str, Any], disturbances: Mapping[str, Disturbance], console: Console) -> None:
    """Print the tables."""
    groups = result["groups"]
    columns = [column for name in groups for column in (name, "loss")]
    table = make_table(f"success on {result['course']}, 95 % intervals", "disturbance", *columns)
    for key, disturbance in disturbances.items():
        cells = []
        for group in groups.values():
            loss = group.get("loss", {}).get(key)
            cells += [show(group["success"][key]), "" if loss is None else f"{loss.estimate:+.3f}"]
        table.add_row(disturbance.label, *cells)
    console.print(table)
    table = make_table("successes of each run", "run", "", *(one.label for one in disturbances.values()))
    for name, run in result["runs"].items():
        kind = GROUPS[run["byol"]]
        table.add_row(name, kind, *(f"{run['successes'][key]}/{result['episodes']}" for key in disturbances))
    if result["teacher"] is not None:
        table.add_row(result["teacher"]["run"], "teacher", f"{result['teacher']['successes']}/{result['episodes']}")
    console.print(table)
    for row in result["targets"]:
        verdict = "[green]pass[/]" if row["passed"] else "[red]FAIL[/]"
        console.print(f"{row['name']}: {row['value']:.3f}, target {row['target']}: {verdict}", highlight=False)


def bars(groups: Mapping[str, Any], disturbances: Mapping[str, Disturbance]) -> Figure:
    """Success under each disturbance, one colour a group."""
    figure = new_figure(9.0, 3.6)
    axes, width = figure.add_subplot(), 0.8 / max(1, len(groups))
    for number, (name, group) in enumerate(groups.items()):
        values = [group["success"][key] for key in disturbances]
        estimates = torch.tensor([value.estimate for value in values])
        low = estimates - torch.tensor([max(0.0, value.low) for value in values])
        high = torch.tensor([min(1.0, value.high) for value in values]) - estimates
        places = torch.arange(len(values)) + (number - (len(groups) - 1) / 2) * width
        axes.bar(places.numpy(), estimates.numpy(), width, label=name)
        errors = torch.stack((low, high)).clamp(min=0.0).numpy()
        axes.errorbar(places.numpy(), estimates.numpy(), errors, fmt="none", color="black", linewidth=0.8)
    axes.set_xticks(range(len(disturbances)), [one.label for one in disturbances.values()], rotation=20, fontsize=8)
    axes.set_ylim(0.0, 1.0)
    axes.set_ylabel("success")
    axes.legend(fontsize=8)
    return figure


def compare(config: Config, console: Console) -> dict[str, Any]:
    """Simulate everything; writes the result and returns it."""
    if not config.runs or config.episodes < 1 or config.robots < 1:
        raise ValueError("expected the folders of one student or more, --episodes and --robots of at least 1")
    begin, disturbances = time.monotonic(), chosen(config.disturbance, config.strength)
    course = course_of(config.course)
    students = [load_decider(path, config.bbc, kind="student") for path in config.runs]
    teacher = None if config.teacher is None else load_decider(config.teacher, config.bbc, kind="teacher")
    names = [str(path) for path in config.runs]
    if len({student.weights for student in students}) < len(names):
        raise ValueError("every student counts once: two folders hold the same weights")
    if teacher is not None:
        for name, student in zip(names, students, strict=True):
            if student.manifest["teacher"] != teacher.weights:
                raise ValueError(f"{name} did not learn from the teacher of {config.teacher}; give the one it names")
    file = config.output / CELLS_FILE
    settings = to_json({"course": course, **{name: getattr(config, name) for name in SETTINGS}})
    cells = measured_before(file, settings)
    if cells:  # by other rules of the package, perhaps
        console.print(f"{file}: what stands there is not measured again; remove it for that", highlight=False)
    options = CourseConfig(
        episodes=config.episodes,
        robots=config.robots,
        episode_length=config.episode_length,
        seed=config.seed,
        num_threads=config.num_threads,
    )
    config.output.mkdir(parents=True, exist_ok=True)

    with Progress(console=console, transient=True) as bar:

        def cell(decider: Decider, key: str, disturbance: Disturbance) -> dict[str, Any]:
            done = cells.setdefault(str(decider.weights), {})
            if key not in done:
                task = bar.add_task(f"{decider.name}, {disturbance.label}", total=config.episodes)
                episodes = simulate(course, decider, options, lambda: bar.advance(task), disturbance)
                bar.remove_task(task)
                successes = sum(episode.success for episode in episodes)
                done[key] = to_json({"successes": successes, "obstacles": summarise(course, episodes)["obstacles"]})
                run_folder.write_json(
                    file, {"format": "agility_rl.student_cells", "settings": settings, "cells": cells}
                )
            return done[key]

        def by_disturbance(decider: Decider) -> dict[str, dict[str, Any]]:
            row = {key: cell(decider, key, disturbance) for key, disturbance in disturbances.items()}
            return {name: {key: one[name] for key, one in row.items()} for name in ("successes", "obstacles")}

        beside = None if teacher is None else cell(teacher, "none", chosen(("none",))["none"])
        found = {
            name: {"byol": bool(student.manifest["byol"]), "weights": student.weights} | by_disturbance(student)
            for name, student in zip(names, students, strict=True)
        }
    result = {
        "format": "agility_rl.student_comparison",
        "format_version": 1,
        "course": config.course,
        "episodes": config.episodes,
        "settings": config,
        "versions": run_folder.versions(),
        "runs": found,
        "teacher": None if teacher is None or beside is None else {"run": teacher.name} | beside,
        **conclude(found, None if beside is None else beside["successes"], config.episodes),
        "seconds": time.monotonic() - begin,
    }
    run_folder.write_json(config.output / "student_comparison.json", to_json(result))
    figure = bars(result["groups"], disturbances)
    save_figure(figure, config.output / "figures" / "success_under_disturbance.png")
    print_comparison(result, disturbances, console)
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    config = cli.from_arguments(Config, arguments, doc=__doc__)
    with cli.one_line_errors():
        compare(config, cli.console(160))


if __name__ == "__main__":
    main()
