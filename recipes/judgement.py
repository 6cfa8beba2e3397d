"""What an evaluation means: its figures against the targets of stage 1, as tables on the screen and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from rollouts import Recording
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, JUMP
from agility_rl.go2.constants import CONTROL_DT
from agility_rl.record.plots import footfall_diagram, save_figure, tracking_plot
from agility_rl.training import metrics, run_folder

SPEED_LIMIT = {"walk": 0.2, "pace": 0.2, "trot": 0.2, "canter": 0.35, "jump": 0.35}
PRIOR_LIMIT = 0.15
"""Total variation distance that counts as close."""


def targets(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every target of stage 1 and what was measured: ``passed`` judges the estimate, ``certain`` its whole interval."""
    rows: list[dict[str, Any]] = []

    def judge(name: str, value: metrics.Interval | None, target: str, low: float, high: float) -> None:
        passed, *ends = (False,) * 3 if value is None else (low <= number <= high for number in value)
        rows.append({"name": name, "value": value, "target": target, "passed": passed, "certain": passed and all(ends)})

    def add(name: str, value: metrics.Interval | None, sign: str, limit: float) -> None:
        judge(name, value, f"{sign} {limit:g}", *((limit, math.inf) if sign == ">=" else (-math.inf, limit)))

    gait = dict.fromkeys(key for entry in found["behaviours"].values() for key in entry["gait"])
    for name, entry in found["behaviours"].items():
        add(f"{name}: recognised", entry["recognised"], ">=", 0.9)
        add(f"{name}: speed error, m/s", entry["errors"].get("speed"), "<=", SPEED_LIMIT[name])
        for key in gait if not entry["gait"] else ():
            judge(f"{name}: {key}", None, "a dog's, and it always fell", math.nan, math.nan)
        for key, compared in entry["gait"].items():
            target = "{:.2f} to {:.2f} (dog) within 25 %".format(*compared["dog"])
            judge(f"{name}: {key}", compared["robot"], target, *compared["allowed"])
    add("jump: trunk peak error, m", found["behaviours"]["jump"]["errors"].get("height"), "<=", 0.05)
    add("NMI of commanded and shown", found["nmi"], ">=", 0.85)
    add("falls", found["falls"], "<=", 0.02)
    if found["switches"]:
        add("switches without a fall", found["switches"]["all_without_fall"], ">=", 0.95)
    if found["prior"]:
        add(
            "prior to unlabelled shares (total variation)",
            metrics.Interval(float(found["prior"]["total_variation"]), math.nan, math.nan),
            "<=",
            PRIOR_LIMIT,
        )
    return rows


def nmi_interval(counts: Tensor, generator: torch.Generator, resamples: int = 500) -> metrics.Interval:
    """NMI of commanded and shown with a bootstrap interval: episodes drawn anew within each commanded behaviour."""
    size = int(counts.sum(1)[0])
    drawn = torch.multinomial(counts.float(), size * resamples, replacement=True, generator=generator)
    tables = torch.nn.functional.one_hot(drawn.unflatten(1, (resamples, size)), counts.shape[1]).sum(2)
    values = torch.tensor([metrics.normalized_mutual_information(table) for table in tables.unbind(1)])
    low, high = values.quantile(torch.tensor([0.025, 0.975])).tolist()
    return metrics.Interval(metrics.normalized_mutual_information(counts), low, high)


def draw_episode(
    recording: Recording, skill: int, robot: int, command: Tensor, label: str, start: int, figures: Path
) -> None:
    """Footfall diagram and tracking plot of one episode."""
    name = BEHAVIOURS[skill]
    title = f"commanded {name} at {command[0]:.2f} m/s, shown {label}"
    pressed = recording.pressed[robot, start : start + round(3.0 / CONTROL_DT)]
    save_figure(footfall_diagram(pressed, CONTROL_DT, title=title), figures / f"footfall_{name}.png")
    signals = {
        "forward velocity [m/s]": (0, recording.velocity[robot, :, 0]),
        "yaw rate [rad/s]": (2, recording.yaw_rate[robot]),
        "trunk height [m]": (3 if skill == JUMP else 4, recording.height[robot]),
    }
    wanted = {key: command[column].expand_as(values) for key, (column, values) in signals.items()}
    measured, peaks = {key: values for key, (_, values) in signals.items()}, ["trunk height [m]"] * (skill == JUMP)
    plot = tracking_plot(wanted, measured, CONTROL_DT, peaks=peaks)
    save_figure(plot, figures / f"tracking_{name}.png")


def print_evaluation(found: Mapping[str, Any], console: Console) -> None:
    """Print the tables of an evaluation."""
    source = found["motion"]["source"]
    console.print(f"compared with {source}" + (", synthetic" if found["motion"]["synthetic"] else ""), highlight=False)
    matrix = make_table("shown by the robot, shares of episodes", "commanded", *found["matrix"]["columns"])
    for name, counts in zip(BEHAVIOURS, found["matrix"]["counts"].tolist(), strict=True):
        matrix.add_row(name, *(f"{count / sum(counts):.2f}" if count else "." for count in counts))
    console.print(matrix)
    table = make_table(
        "mean errors of an episode, without falls", "commanded", *found["episodes"]["quantities"], "falls"
    )
    for name, entry in found["behaviours"].items():
        errors = [show(entry["errors"].get(key)) for key in found["episodes"]["quantities"]]
        table.add_row(name, *errors, show(entry["falls"]))
    console.print(table)
    table = make_table("turn rates as shares of the commanded ones", "commanded", "to the left", "to the right")
    for name, entry in found["behaviours"].items():
        table.add_row(name, *(show(entry["turns"].get(side)) for side in ("left", "right")))
    console.print(table)
    if found["switches"]:
        trials = found["switches"]["trials"]
        table = make_table(
            f"switches without a fall, of {trials} (second behaviour recognised)", "from / to", *BEHAVIOURS
        )
        for first in BEHAVIOURS:
            keys = ["" if first == second else f"{first} to {second}" for second in BEHAVIOURS]
            safe, known = found["switches"]["without_fall"], found["switches"]["second_recognised"]
            table.add_row(first, *(f"{safe[key]} ({known[key]})" if key else "" for key in keys))
        console.print(table)
    if found["prior"]:
        table = make_table("skill prior", "", *BEHAVIOURS)
        for key in ("learned", "unlabelled_among_behaviours"):
            table.add_row(key.replace("_", " "), *(f"{share:.2f}" for share in found["prior"][key].values()))
        console.print(table)
        seconds = ", ".join(f"{name} {value:.0f} s" for name, value in found["prior"]["unlabelled_seconds"].items())
        console.print(f"unlabelled motion by the gait classifier: {seconds}", highlight=False)
    table = make_table("targets, with 95 % intervals", "what", "measured", "target", "")
    for row in found["targets"]:
        verdict = "[green]pass[/]" if row["passed"] else "[red]FAIL[/]"
        table.add_row(row["name"], show(row["value"]), row["target"], verdict)
    console.print(table)
    passed, certain = (sum(row[key] for row in found["targets"]) for key in ("passed", "certain"))
    whole = f"{certain} of them by the whole interval"
    console.print(f"{passed} of {len(found['targets'])} targets reached, {whole}", highlight=False)


def show(value: Any) -> str:
    """``0.93 (0.86 to 0.97)``, or a dash where nothing could be measured."""
    if value is None or value[0] is None or math.isnan(value[0]):
        return "-"
    known = len(value) == 3 and all(bound is not None and math.isfinite(bound) for bound in value[1:])
    return f"{value[0]:.3f}" + (f" ({value[1]:.3f} to {value[2]:.3f})" if known else "")


def to_json(value: Any) -> Any:
    """Dataclasses, tensors, intervals and the rest as JSON values; what is not finite becomes null."""
    if isinstance(value, metrics.Interval):
        return to_json(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, Tensor):
        return to_json(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return run_folder.to_json(value)


def make_table(title: str, *columns: str) -> Table:
    """An empty table; its first column is text, the others are numbers."""
    table = Table(title=title, title_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index == 0 else "right", no_wrap=True)
    return table
