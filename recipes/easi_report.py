"""What a search found and how far to trust it: error, result file, convergence figure, identifiability table."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from torch import Tensor

from agility_rl.collectors import EvolutionStrategy, ParameterSpace
from agility_rl.record.plots import Curves, save_figure
from agility_rl.training.run_folder import to_json, write_json

TRIES, UNLUCKY = 60, 0.1
"""Searches in which one parameter has no effect, and the share of its spreads there that a parameter must stay below:
above it the log does not show it."""
FULL_LIMIT, SURVIVOR_LIMIT = 0.8, 0.4
"""Correlations that are worth a warning: of a full covariance, and of the survivors of a diagonal one, whose parents
are independent, so that every generation shows only what selection adds."""
EDGE = 0.02
"""A bounded search that ends this close to the end of its range, in shares of it, probably wanted to leave it."""


@dataclass(frozen=True)
class Identifiability:
    """How well a log determines parameters.

    Attributes:
        spread: ``[D]``, standard deviation of the final distribution in shares of the first one's.
        chance: median of what is left of it for a parameter that has no effect; survivors of a finite population
            drift together.
        correlation: ``[D, D]``, of the final distribution, or mean of the survivors' with a diagonal one.
        warnings: a line for everything that should not be trusted.
    """

    spread: Tensor
    chance: float
    correlation: Tensor
    warnings: tuple[str, ...]


def survivor_correlation(search: EvolutionStrategy, individuals: Tensor, scores: Tensor) -> Tensor:
    """Weighted correlation ``[D, D]`` of the individuals that survive a generation; 0 where one does not vary."""
    scores = torch.where(scores.isfinite(), scores.double(), -math.inf)
    best = individuals[scores.argsort(descending=True, stable=True)[: len(search.weights)]]
    weights = search.weights[:, None]
    deviation = best - (weights * best).sum(0)
    covariance = (weights * deviation).mT @ deviation
    scale = covariance.diagonal().sqrt()
    correlation = covariance / (scale[:, None] * scale).clamp_min(1e-300)
    return correlation.fill_diagonal_(1.0)


def identify(search: EvolutionStrategy, space: ParameterSpace, survivors: Tensor) -> Identifiability:
    """Compare the final distribution with the first one, and with what chance would have made of it.

    Selection by chance narrows a distribution too, so that a narrow one alone proves nothing.

    Args:
        search: after its last generation.
        space: names of the parameters.
        survivors: ``[D, D]``, mean of :func:`survivor_correlation` over the generations.
    """
    first = (search.high - search.low) / math.sqrt(12.0)
    spread, by_chance = search.std / first, spreads_by_chance(search)
    chance, unlucky = float(by_chance.median()), float(by_chance.quantile(UNLUCKY))
    names, full = space.names, search.form == "full"
    correlation = search.correlation if full else survivors
    # Correlations of few survivors are large by themselves; several generations average that out.
    samples = len(search.weights) * (1 if full else max(1, search.generation))
    limit = max(FULL_LIMIT if full else SURVIVOR_LIMIT, 3.0 / math.sqrt(samples))
    warnings = [
        f"{name}: the log hardly shows it ({float(spread[i]):.2f} of the first spread; chance leaves {chance:.2f}, and "
        f"less than {unlucky:.2f} in one of ten searches)"
        for i, name in enumerate(names)
        if spread[i] > unlucky
    ]
    for i in range(len(names)):
        for j in range(i):
            if (r := float(correlation[i, j])) and abs(r) > limit:
                rule = "product" if r < 0 else "ratio"
                warnings.append(
                    f"{names[j]} and {names[i]}: the log cannot tell them apart (correlation {r:+.2f}); trust their "
                    f"{rule} more than either"
                )
        bounded = bool(search.lower[i] == search.low[i] and search.upper[i] == search.high[i])
        place = (search.estimate[i] - search.low[i]) / (search.high[i] - search.low[i])
        if bounded and not EDGE <= place <= 1.0 - EDGE:
            warnings.append(
                f"{names[i]}: ends at the edge of its range; widen --search.span or give --search.no-bounded"
            )
    return Identifiability(spread, chance, correlation, tuple(warnings))


def spreads_by_chance(search: EvolutionStrategy) -> Tensor:
    """What as many generations leave of a parameter that has no effect, ``[TRIES]`` in shares of the first spread.

    Each parameter in turn has none, while the search finds a place for the others: with a full covariance their
    narrowing narrows the blind one too. A single parameter is judged by dice.
    """
    generator, width, found = torch.Generator().manual_seed(0), search.high - search.low, []
    for number in range(TRIES):
        other, seen = search.anew(generator), torch.ones(len(width), dtype=torch.float64)
        seen[blind := number % len(width)] = 0.0
        for _ in range(search.generation):
            individuals = other.ask()
            missed = (seen * ((individuals - search.low) / width - 0.4).square()).sum(-1)
            other.tell(individuals, -missed - 1e-9 * torch.rand(len(missed), generator=generator))
        found.append(math.sqrt(12.0) * other.std[blind] / width[blind])
    return torch.stack(found)


def physical(search: EvolutionStrategy, space: ParameterSpace) -> tuple[Tensor, Tensor]:
    """Centre and spread of the present distribution in physical units, ``[D]`` each.

    The centre of a logarithmic parameter is its median; the spread is half the width of one deviation to either side.
    """
    ends = [space.denormalize(search.estimate + sign * search.std) for sign in (-1.0, 1.0)]
    return space.denormalize(search.estimate), (ends[1] - ends[0]) / 2


def relative_error(value: Tensor, truth: Tensor, space: ParameterSpace) -> Tensor:
    """|x - x*| / x*, ``[D]``; in shares of the first range where the nominal or the true value is 0.

    Source: method notes, section 6.5.
    """
    scale = torch.where((space.nominal == 0.0) | (truth == 0.0), space.high - space.low, truth.abs())
    return (value - truth).abs() / scale


def load_truth(path: Path, space: ParameterSpace) -> tuple[Tensor, dict[str, Any]]:
    """True values ``[D]`` in a file of ``record_log.py``, and how its log was recorded.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, or lacks a parameter.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        known, recording = record["parameters"], dict(record["recording"])
        values = {name: float(entry["value"]) for name, entry in known.items()}
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged or no truth of record_log.py: {error}") from error
    if missing := [name for name in space.names if name not in values]:
        raise ValueError(f"{path} does not know {missing[0]}; it has {', '.join(values)}")
    return torch.tensor([values[name] for name in space.names], dtype=torch.float64), recording


def write_result(
    folder: Path,
    search: EvolutionStrategy,
    space: ParameterSpace,
    found: Identifiability,
    truth: Tensor | None,
    model: Mapping[str, Any],
) -> Path:
    """Write ``result.json``: values and multiples for people, search coordinates and model for the next stage."""
    centre, deviation = physical(search, space)
    error = None if truth is None else relative_error(centre, truth, space)
    parameters: dict[str, Any] = {}
    for i, entry in enumerate(space.parameters):
        mean, std = float(centre[i]), float(deviation[i])
        parameters[entry.name] = {
            "mean": mean,
            "std": std,
            "unit": entry.unit,
            "nominal": entry.nominal,
            "multiple": {"mean": mean / entry.nominal, "std": std / entry.nominal} if entry.nominal else None,
            "spread": float(found.spread[i]),
        }
        if truth is not None and error is not None:
            parameters[entry.name] |= {"truth": float(truth[i]), "error": float(error[i])}
    result = {
        "generations": search.generation,
        "parameters": parameters,
        "mean_error": None if error is None else float(error.mean()),
        "chance_spread": found.chance,
        "correlation": found.correlation.tolist(),
        "warnings": found.warnings,
        "model": model,
        # What a later stage draws simulators from: a Gaussian in these coordinates, mapped by these ranges.
        "search": {
            "mean": search.estimate.tolist(),
            "covariance": search.covariance.tolist(),
            "ranges": {p.name: {"low": p.low, "high": p.high, "scale": p.scale} for p in space.parameters},
        },
    }
    write_json(folder / "result.json", to_json(result))
    return folder / "result.json"


def print_result(
    console: Console, search: EvolutionStrategy, space: ParameterSpace, found: Identifiability, truth: Tensor | None
) -> None:
    """The identifiability table and its warnings."""
    centre, deviation = physical(search, space)
    title = f"after {search.generation} generations (chance alone leaves a spread of {found.chance:.2f})"
    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
    left = ("parameter", "unit", "correlates with")
    columns = ("parameter", "value", "unit", "x nominal", "spread", "correlates with")
    for column in columns + (("truth", "error") if truth is not None else ()):
        table.add_column(column, justify="left" if column in left else "right", no_wrap=column == "parameter")
    for i, entry in enumerate(space.parameters):
        others = found.correlation[i].abs().index_fill(0, torch.tensor([i]), -1.0)
        partner = int(others.argmax())
        row = [
            entry.name,
            f"{float(centre[i]):.4g} ± {float(deviation[i]):.2g}",
            entry.unit,
            f"{float(centre[i]) / entry.nominal:.3f}" if entry.nominal else "",
            f"{float(found.spread[i]):.3f}",
            f"{space.names[partner]} {float(found.correlation[i, partner]):+.2f}" if len(space) > 1 else "",
        ]
        if truth is not None:
            error = relative_error(centre, truth, space)[i]
            row += [f"{float(truth[i]):.4g}", f"{100 * float(error):.1f} %"]
        table.add_row(*row)
    console.print(table)
    if truth is not None:
        console.print(f"mean parameter error {100 * float(relative_error(centre, truth, space).mean()):.1f} %")
    for warning in found.warnings:
        console.print(f"warning: {warning}", markup=False)


def draw_convergence(path: Path, curves: Curves, space: ParameterSpace, truth: Tensor | None) -> Path:
    """One panel a parameter: centre and spread of every generation, the nominal value, and the true one if known."""
    columns = min(3, len(space))
    rows = -(-len(space) // columns)
    figure = Figure(figsize=(4.2 * columns, 2.8 * rows), layout="constrained")
    for index, entry in enumerate(space.parameters):
        axes = figure.add_subplot(rows, columns, index + 1)
        (steps, mean), (_, std) = (_values(curves, f"{kind}/{entry.name}") for kind in ("mean", "std"))
        axes.plot(steps, mean, color="C0", label="mean")
        axes.fill_between(steps, mean - std, mean + std, color="C0", alpha=0.25, label="one deviation")
        axes.axhline(entry.nominal, color="0.6", linestyle=":", label="nominal")
        if truth is not None:
            axes.axhline(float(truth[index]), color="k", linestyle="--", label="truth")
        axes.set_title(f"{entry.name} [{entry.unit}]", fontsize=9)
        axes.set_xlabel("generation", fontsize=8)
        axes.grid(alpha=0.3)
        if index == 0:
            axes.legend(fontsize=7)
    return save_figure(figure, path)


def _values(curves: Mapping[str, tuple[Tensor, Tensor]], name: str) -> tuple[Any, Any]:
    return curves[name][0].numpy(), curves[name][1].numpy()
