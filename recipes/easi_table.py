"""The table of ``easi_baselines.py``: mean and confidence interval over targets, for the screen and in Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from statistics import fmean, stdev
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.stats import t as student

CONFIDENCE = 0.95
DEVIATIONS = 2.0
"""A truth within so many of a method's own deviations counts as covered."""


@dataclass(frozen=True)
class Row:
    """One method under one condition, over its targets.

    Attributes:
        condition: name.
        method: name.
        targets: how many.
        error: mean over targets of the mean relative error of the parameters.
        interval: half-width of its 95 % confidence interval (Student's t); ``None`` for one target.
        parameters: mean relative error of every parameter.
        covered: share of truths within two of the method's own deviations; ``None`` if it states none.
        steps: mean of the control steps simulated.
        budget: control steps that were allowed.
        seconds: mean wall time.
        behind: by how much its error exceeds that of the first method, mean over the targets that both searched;
            ``None`` for the first one itself, or without such targets. Of two methods on the same targets this says
            more than their intervals, most of which comes from targets that are hard for both.
        behind_interval: half-width of its 95 % confidence interval.
    """

    condition: str
    method: str
    targets: int
    error: float
    interval: float | None
    parameters: dict[str, float]
    covered: float | None
    steps: float
    budget: float
    seconds: float
    behind: float | None
    behind_interval: float | None


def summarize(results: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> list[Row]:
    """A row for every condition and method that has a result, in the order of ``methods``."""
    first = methods[0]
    rows = []
    for condition in dict.fromkeys(result["condition"] for result in results):
        here = [result for result in results if result["condition"] == condition]
        for method in methods:
            known = [(result, result["methods"][method]) for result in here if method in result["methods"]]
            if not known:
                continue
            found = [entry for _, entry in known]
            errors = [entry["mean_error"] for entry in found]
            behind = [
                entry["mean_error"] - result["methods"][first]["mean_error"]
                for result, entry in known
                if method != first and first in result["methods"]
            ]
            rows.append(
                Row(
                    condition,
                    method,
                    len(found),
                    fmean(errors),
                    half_width(errors),
                    {name: fmean(entry["error"][name] for entry in found) for name in found[0]["error"]},
                    _covered(known),
                    fmean(entry["steps"] for entry in found),
                    fmean(result["budget"] for result, _ in known),
                    fmean(entry["seconds"] for entry in found),
                    fmean(behind) if behind else None,
                    half_width(behind),
                )
            )
    return rows


def half_width(values: Sequence[float]) -> float | None:
    r"""Half of the 95 % confidence interval of a mean, :math:`t_{0.975, n-1} s / \sqrt n`."""
    if len(values) < 2:
        return None
    quantile = float(student.ppf((1.0 + CONFIDENCE) / 2.0, len(values) - 1))
    return quantile * stdev(values) / math.sqrt(len(values))


def _covered(known: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> float | None:
    inside = [
        abs(entry["value"][name] - truth) <= DEVIATIONS * spread
        for result, entry in known
        for (name, truth), spread in zip(result["truth"].items(), entry["spread"], strict=True)
        if spread is not None
    ]
    return fmean(inside) if inside else None


def cells(row: Row) -> list[str]:
    """A row as text."""
    interval = "" if row.interval is None else f" ± {100 * row.interval:.1f}"
    behind = "" if row.behind is None else f"{100 * row.behind:+.1f}"
    behind += "" if row.behind_interval is None else f" ± {100 * row.behind_interval:.1f}"
    return [
        row.method,
        str(row.targets),
        f"{100 * row.error:.1f}{interval}",
        behind,
        *(f"{100 * error:.1f}" for error in row.parameters.values()),
        "" if row.covered is None else f"{100 * row.covered:.0f}",
        f"{row.steps / 1e6:.3g}",
        f"{row.seconds:.0f}",
    ]


def header(row: Row) -> list[str]:
    """Names of the columns of :func:`cells`."""
    names = [name.replace("_", " ").replace("stiffness", "P").replace("damping", "D") for name in row.parameters]
    return ["method", "targets", "mean error %", "behind the first", *names, "covered %", "million steps", "seconds"]


def markdown(rows: Sequence[Row]) -> str:
    """The tables, one for every condition, in Markdown."""
    lines = ["# Parameter errors in per cent of the truth", ""]
    for condition, group in groupby(rows, lambda row: row.condition):
        entries = list(group)
        columns = header(entries[0])
        lines += [f"## {condition} (budget {entries[0].budget / 1e6:.3g} million control steps)", ""]
        lines += [_line(columns), _line(["---", *["---:"] * (len(columns) - 1)])]
        lines += [*(_line(cells(row)) for row in entries), ""]
    lines += [
        f"Mean over targets ± half of its {CONFIDENCE:.0%} confidence interval; behind the first: by how much the "
        "error exceeds the first method's on the same targets; P and D are stiffness and damping; covered: truths "
        f"within {DEVIATIONS:g} of the method's own deviations.",
        "",
    ]
    return "\n".join(lines)


def _line(entries: Sequence[str]) -> str:
    return f"| {' | '.join(entries)} |"


def print_table(console: Console, rows: Sequence[Row]) -> None:
    """The tables on the screen."""
    for condition, group in groupby(rows, lambda row: row.condition):
        entries = list(group)
        title = f"{condition}: parameter errors in % (budget {entries[0].budget / 1e6:.3g} million control steps)"
        table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
        for column in header(entries[0]):
            table.add_column(column, justify="left" if column == "method" else "right", no_wrap=column == "method")
        for row in entries:
            table.add_row(*cells(row))
        console.print(table)
