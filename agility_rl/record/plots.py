"""Figures of runs and gaits, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from agility_rl.go2.constants import LEGS

Curves = Mapping[str, tuple[Tensor, Tensor]]
"""Metric name to (steps ``[n]``, values ``[n]``), as :func:`agility_rl.record.read_scalars` returns."""


def learning_curves(
    runs: Mapping[str, Curves], names: Sequence[str], *, smoothing: float = 0.0, columns: int = 3
) -> Figure:
    """One panel a metric, one line a run.

    .. math:: y_i = \\alpha y_{i-1} + (1 - \\alpha) x_i

    Source: no paper formula; exponential smoothing.

    Args:
        runs: label to curves.
        names: metrics to draw, in order; a run without one leaves its line out.
        smoothing: alpha in 0..1; the raw curve stays visible behind.
        columns: panels in a row.

    Raises:
        ValueError: if no run has any of the metrics.

    Example:
        >>> curve = {"loss": (torch.arange(3), torch.tensor([3.0, 2.0, 1.0]))}
        >>> len(learning_curves({"a": curve, "b": curve}, ["loss"]).axes[0].lines)
        2
    """
    known = {name for curves in runs.values() for name in curves}
    if not known & set(names):
        raise ValueError(f"no run has any of {', '.join(names)}; they have {', '.join(sorted(known)) or 'nothing'}")
    columns = max(1, min(columns, len(names)))
    rows = -(-len(names) // columns)
    figure = new_figure(4.2 * columns, 2.8 * rows)
    for index, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, index + 1)
        for number, (label, curves) in enumerate(runs.items()):
            if name not in curves:
                continue
            steps, values = curves[name][0].numpy(), curves[name][1].numpy()
            colour = f"C{number}"
            if smoothing > 0.0:
                axes.plot(steps, values, color=colour, alpha=0.25, linewidth=0.8)
                values = _smooth(values, smoothing)
            dot = "." if len(steps) == 1 else None  # a line of one point is invisible
            axes.plot(steps, values, color=colour, label=label, linewidth=1.4, marker=dot)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("iteration", fontsize=8)
        axes.grid(alpha=0.3)
        if len(runs) > 1 and index == 0:
            axes.legend(fontsize=8)
    return figure


def footfall_diagram(contact: Tensor, dt: float, *, title: str = "") -> Figure:
    """Hildebrand diagram: a bar for each stance of each foot.

    Source: Hildebrand 1965, "Symmetrical gaits of horses".

    Args:
        contact: bool ``[T, 4]``, feet in the order of :data:`agility_rl.go2.constants.LEGS`.
        dt: time between two rows [s].
        title: text above.

    Raises:
        ValueError: if the contacts have another shape.

    Example:
        >>> len(footfall_diagram(torch.tensor([[1, 0, 0, 1], [0, 1, 1, 0]]).bool(), dt=0.02).axes[0].patches)
        4
    """
    figure = new_figure(8.0, 2.2)
    axes = figure.add_subplot()
    draw_footfalls(axes, contact, dt)
    axes.set_xlabel("time [s]")
    axes.set_title(title, fontsize=10)
    return figure


def draw_footfalls(axes: Axes, contact: Tensor, dt: float) -> None:
    """The bars of :func:`footfall_diagram` on axes of a figure that holds more.

    Example:
        >>> axes = new_figure(4.0, 2.0).add_subplot()
        >>> draw_footfalls(axes, torch.ones(50, 4).bool(), dt=0.02)
        >>> len(axes.patches), float(axes.get_xlim()[1])
        (4, 1.0)
    """
    if contact.ndim != 2 or contact.shape[1] != len(LEGS):
        raise ValueError(f"expected contacts [T, {len(LEGS)}], got {list(contact.shape)}")
    edge = torch.zeros(1, dtype=torch.int8)
    for foot, leg in enumerate(LEGS):
        change = torch.diff(torch.cat((edge, contact[:, foot].bool().to(torch.int8).cpu(), edge)))
        starts, ends = (change == 1).nonzero().flatten(), (change == -1).nonzero().flatten()
        bars = [(start * dt, (end - start) * dt) for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]
        for start, length in bars:
            axes.barh(foot, length, left=start, height=0.6, color=f"C{foot}", label=leg)
    axes.set_yticks(range(len(LEGS)), LEGS)
    axes.invert_yaxis()
    axes.set_xlim(0.0, contact.shape[0] * dt)


def behaviour_matrix(counts: Tensor, names: Sequence[str], columns: Sequence[str] | None = None) -> Figure:
    """Commanded behaviours against shown ones, each row in shares.

    Args:
        counts: ``[C, K]``, rows commanded.
        names: C row labels.
        columns: K column labels; the row labels by default.

    Raises:
        ValueError: if the labels do not fit the counts.

    Example:
        >>> behaviour_matrix(torch.eye(2), ["walk", "trot"]).axes[0].get_xlabel()
        'shown'
    """
    columns = list(names) if columns is None else list(columns)
    if counts.shape != (len(names), len(columns)):
        raise ValueError(f"expected counts [{len(names)}, {len(columns)}] for the labels, got {list(counts.shape)}")
    shares = (counts.double() / counts.sum(1, keepdim=True).clamp(min=1)).cpu().numpy()
    figure = new_figure(1.8 + 0.8 * len(columns), 1.4 + 0.6 * len(names))
    axes = figure.add_subplot()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for row, column in np.ndindex(*shares.shape):
        share = shares[row, column]
        axes.text(column, row, f"{share:.2f}", ha="center", va="center", color="white" if share > 0.6 else "black")
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(names)), list(names))
    axes.set_xlabel("shown")
    axes.set_ylabel("commanded")
    return figure


def tracking_plot(
    commanded: Mapping[str, Tensor], measured: Mapping[str, Tensor], dt: float, *, peaks: Sequence[str] = ()
) -> Figure:
    """Commanded and measured signals over time, one panel a signal, with the root mean square error.

    Args:
        commanded: signal name (with its unit) to ``[T]``.
        measured: the same names to ``[T]``.
        dt: time between two values [s].
        peaks: signals whose peaks are commanded, such as a jump's height; their error is not that of every instant.

    Raises:
        KeyError: if a commanded signal was not measured.

    Example:
        >>> zero = torch.zeros(5)
        >>> tracking_plot({"velocity [m/s]": zero}, {"velocity [m/s]": zero + 1}, dt=0.02).axes[0].get_title()
        'velocity [m/s], RMS error 1.000'
    """
    if missing := [name for name in commanded if name not in measured]:
        raise KeyError(f"{missing} were commanded, not measured; measured are {list(measured)}")
    figure = new_figure(8.0, 2.0 * len(commanded))
    for index, (name, wanted) in enumerate(commanded.items()):
        axes = figure.add_subplot(len(commanded), 1, index + 1)
        time = torch.arange(wanted.numel()) * dt
        axes.plot(time, wanted.cpu(), "k--", linewidth=1.0, label="commanded")
        axes.plot(time, measured[name].cpu(), linewidth=1.2, label="measured")
        error = (measured[name] - wanted).double().square().mean().sqrt().item()
        axes.set_title(f"{name}, " + ("peaks commanded" if name in peaks else f"RMS error {error:.3f}"), fontsize=9)
        axes.grid(alpha=0.3)
        if index == 0:
            axes.legend(fontsize=8)
    figure.axes[-1].set_xlabel("time [s]")
    return figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure (PNG, PDF or SVG by the ending), making its folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_figure(footfall_diagram(torch.ones(9, 4), dt=0.02), f"{folder}/figures/trot.png").is_file()
        True
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    return path


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size [inches], without pyplot: it keeps every figure of a long run, and wants a display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _smooth(values: np.ndarray, smoothing: float) -> np.ndarray:
    smooth, average = np.empty_like(values, dtype=float), float("nan")
    for index, value in enumerate(values):
        if not np.isnan(value):
            average = value if np.isnan(average) else smoothing * average + (1.0 - smoothing) * value
        smooth[index] = average if not np.isnan(value) else value
    return smooth
