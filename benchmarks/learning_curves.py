"""Do two ways to train stage 1 learn the same? Curves over the seeds of each, and what the last iterations reached.

    python benchmarks/learning_curves.py --group float32 runs/precision_float32_0 runs/precision_float32_1 \
        --group bfloat16 runs/precision_bfloat16_0 runs/precision_bfloat16_1 --output runs/precision.png

Shaded is the range of the seeds, the line is their mean; the table has the mean of the last iterations over the seeds,
and in brackets the lowest and highest seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.record import read_scalars
from agility_rl.record.plots import new_figure, save_figure

SHOWN: dict[str, tuple[Callable[..., Tensor], list[str]]] = {
    "reward of a step": (torch.sum, [f"reward/{name}" for name in ("imitation", "skill", "shift", "task")]),
    "skill recovered": (torch.mean, [f"recovery/{name}" for name in BEHAVIOURS]),
    "speed error [m/s]": (torch.sum, ["error/speed"]),
    "falls a minute": (torch.sum, ["falls_per_minute"]),
}
"""What is drawn, and the sum or mean of which metrics it is."""
LAST = 10
"""Iterations that the table averages."""


def curve(scalars: Mapping[str, tuple[Tensor, Tensor]], title: str) -> Tensor:
    """One entry an iteration."""
    together, names = SHOWN[title]
    return together(torch.stack([scalars[name][1] for name in names]), 0)


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--group", nargs="+", action="append", required=True, help="a name, and runs of several seeds")
    parser.add_argument("--output", type=Path, default=Path("runs/learning_curves.png"))
    options = parser.parse_args()
    for name, *runs in options.group:
        if not runs:
            parser.error(f"--group {name}: expected a name and at least one run after it")
    groups = {name: [read_scalars(run) for run in runs] for name, *runs in options.group}
    needed = {metric for _, names in SHOWN.values() for metric in names}
    for name, *runs in options.group:
        for run, scalars in zip(runs, groups[name], strict=True):
            if missing := needed - scalars.keys():
                parser.error(f"{run}: expected a run of bbc_pretrain.py, got one without {', '.join(sorted(missing))}")
    length = min(len(run["time/minutes"][1]) for runs in groups.values() for run in runs)
    print(f"{length} iterations")
    figure = new_figure(9.0, 4.8)
    for index, title in enumerate(SHOWN, 1):
        axes = figure.add_subplot(2, 2, index)
        for name, runs in groups.items():
            curves = torch.stack([curve(run, title)[:length] for run in runs])
            (line,) = axes.plot(curves.mean(0), label=name)
            axes.fill_between(range(length), curves.amin(0), curves.amax(0), color=line.get_color(), alpha=0.2, lw=0)
            last = curves[:, -LAST:].mean(-1)
            print(f"{title:20} {name:12} {last.mean():8.3f} ({last.min():.3f} to {last.max():.3f})")
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("iteration")
    figure.axes[0].legend(fontsize=8)
    for name, runs in groups.items():
        spent = torch.stack([run["time/policy"][1][:length].median() for run in runs])
        print(f"{'policy, s':20} {name:12} {spent.mean():8.3f} ({spent.min():.3f} to {spent.max():.3f})")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, options.output)
    print(f"drawn: {options.output}")


if __name__ == "__main__":
    main()
