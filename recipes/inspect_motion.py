"""Look at motion: what a clip or a folder of clips holds, on the Go2, in a table and in footfall diagrams.

In:  motion files of any supported format, or folders of them; nothing shows the five synthetic gaits.
Out: a table on the screen, OUTPUT/CLIP.png footfall diagrams, and with --convert DIR the clips as .npz at 50 Hz.

    python recipes/inspect_motion.py PATH [PATH ...] [--output DIR] [--convert DIR]

A clip that cannot be read gets a line of its own that says why; the others are shown all the same, and the exit status
is 1. Gaits are named from foot phases, speed and trunk height, window by window, never from file names.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.table import Table
from unique_names import unique_names

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.motion import MotionClip, MotionError, load_clip
from agility_rl.motion.clip import save
from agility_rl.motion.edit import foot_slip
from agility_rl.motion.formats import motion_files
from agility_rl.motion.gait_analysis import (
    GAIT_LABELS,
    GaitMeasurement,
    classify_episodes,
    classify_index,
    measure_clip,
)
from agility_rl.motion.gaits import synthesize_gait
from agility_rl.record.plots import footfall_diagram, save_figure
from agility_rl.training import cli


@dataclass(frozen=True)
class Config:
    """Look at motion clips on the Go2: a table, and footfall diagrams."""

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Motion files or folders of them; none shows the five synthetic gaits."""
    output: Path = field(default=Path("figures/motion"))
    """Folder of the footfall diagrams."""
    figures: bool = True
    """Draw footfall diagrams."""
    figure_seconds: float = 6.0
    """Longest stretch in a footfall diagram [s]; the most typical one of the clip is drawn."""
    window: float = 3.0
    """Length of the windows that gaits are named in [s]."""
    grounding: float = 1.0
    """Window in which the floor is found [s]; 0 leaves heights as stored."""
    convert: Path | None = None
    """Folder to write the clips to as .npz at 50 Hz; existing files are not overwritten."""
    notes: bool = False
    """Print everything that the readers found."""


@dataclass(frozen=True)
class Inspection:
    """A clip and what was measured on it."""

    path: str
    clip: MotionClip
    gait: str
    figures: GaitMeasurement
    windows: Counter[str]
    typical: int  # first frame of the first window that shows the clip's gait


def find_files(paths: tuple[Path, ...]) -> list[tuple[Path, str]]:
    """All motion files in files and folders, in natural order, each with a short name: its path from the one given.

    Raises:
        MotionError: if a path does not exist or a folder holds no motion.
    """
    found: list[tuple[Path, str]] = []
    for path in paths:
        if not path.exists():
            raise MotionError(f"{path}: expected a motion file or a folder of them, found nothing; check the path")
        if path.is_file():
            found.append((path, path.name))
            continue
        found += [(file, file.relative_to(path.parent).as_posix()) for file in motion_files(path)]
    return found


def inspect(clip: MotionClip, path: str, window: float) -> Inspection:
    """Measure a clip window by window and name its gait by majority."""
    windows = measure_clip(clip, window)
    labels = classify_index(windows)
    winner, figures = classify_episodes(windows)
    first = int((labels == winner).nonzero()[0]) * (clip.num_frames // labels.numel())
    counts = Counter(GAIT_LABELS[index] for index in labels.tolist())
    return Inspection(path, clip, GAIT_LABELS[int(winner)], figures, counts, first)


def found(clip: MotionClip, pattern: str) -> str:
    """What the reader's notes say about something, or a dash."""
    matches = [match[1] for note in clip.notes if (match := re.search(pattern, note))]
    return matches[0] if matches else "-"


def table(rows: list[Inspection]) -> Table:
    """One line a clip."""
    result = Table(title="phases: 0 together, .5 alternating; contacts: soles lower than 25 mm", title_justify="left")
    for heading in ("clip", "format", "joints", "FK error"):
        result.add_column(heading, overflow="fold", min_width=6 if heading != "FK error" else 5)
    numbers = ("s", "m/s", "FL-FR", "lateral", "diagonal", "duty", "stride Hz", "trunk m", "peak m", "slip m/s")
    for heading in numbers:
        result.add_column(heading, justify="right")
    result.add_column("named", overflow="fold")
    result.add_column("gait", overflow="fold")
    for row in rows:
        clip, m = row.clip, row.figures
        agrees = clip.label is None or clip.label == row.gait
        others = ", ".join(f"{name} {count}" for name, count in row.windows.most_common() if name != row.gait)
        result.add_row(
            row.path,
            clip.source + (" (synthetic)" if clip.synthetic else ""),
            found(clip, r"joints ((?:FL|FR|RL|RR)(?:,(?:FL|FR|RL|RR)){3})"),
            found(clip, r"(?:kinematic|foot) error ([\d.]+ m+)"),
            f"{clip.duration:.1f}",
            f"{m.speed.item():.2f}",
            f"{m.phase_left_right_front.item():.2f}",
            f"{m.phase_lateral.item():.2f}",
            f"{m.phase_diagonal.item():.2f}",
            f"{m.duty.mean().item():.2f}",
            f"{m.stride_frequency.item():.1f}",
            f"{m.trunk_median.item():.2f}",
            f"{m.trunk_peak.item():.2f}",
            f"{foot_slip(clip).mean:.2f}",
            "-" if clip.label is None else clip.label,
            f"[{'green' if agrees else 'red'}]{row.gait}[/]" + (f" (also {others})" if others else ""),
        )
    return result


def draw(row: Inspection, name: str, config: Config) -> Path:
    """Footfall diagram of the stretch of a clip that shows its gait."""
    length = max(2, round(config.figure_seconds / row.clip.dt))
    start = max(0, min(row.typical, row.clip.num_frames - length))
    contact = row.clip.foot_contact[start : start + length]
    speed = row.figures.speed.item()
    title = f"{row.path}: {row.gait}, {speed:.2f} m/s, from {start * row.clip.dt:.1f} s"
    return save_figure(footfall_diagram(contact, row.clip.dt, title=title), config.output / f"{name}.png")


def write(rows: list[Inspection], names: list[str], folder: Path) -> None:
    """Store clips as .npz.

    Raises:
        MotionError: if one of the files exists; none is written then.
    """
    targets = [folder / f"{name}.npz" for name in names]
    for target in targets:
        if target.exists():
            raise MotionError(f"{target}: exists and is not overwritten; choose another --convert folder or remove it")
    for row, target in zip(rows, targets, strict=True):
        save(row.clip, target)


def main(config: Config, console: Console) -> int:
    """Inspect, print, draw; returns the exit status."""
    if config.window < 0.3 or config.figure_seconds <= 0 or config.grounding < 0:
        raise MotionError("expected --window of at least 0.3 s, --figure-seconds above 0 and --grounding of at least 0")
    rows: list[Inspection] = []
    broken: list[str] = []
    if config.paths:
        for path, name in find_files(config.paths):
            stem = re.split(r"[_\d.]", path.name)[0].lower()
            try:
                label = stem if stem in BEHAVIOURS else None
                clip = load_clip(path, label=label, grounding=config.grounding or None)
            except ValueError as error:
                broken.append(str(error))
                continue
            try:
                rows.append(inspect(clip, name, config.window))
            except ValueError as error:
                broken.append(f"{path}: {error}")
    else:
        console.print("No path given: these are the built-in synthetic gaits; no dog moved like this.")
        rows = [inspect(synthesize_gait(behaviour), behaviour, config.window) for behaviour in BEHAVIOURS]
    names = unique_names([row.path for row in rows])
    if rows:
        console.print(table(rows))
    if config.notes:
        for row in rows:
            console.print(f"{row.path}\n  " + "\n  ".join(row.clip.notes), markup=False, highlight=False)
    labelled = [row for row in rows if row.clip.label is not None]
    seconds = Counter[str]()
    for row in rows:
        for gait, count in row.windows.items():
            seconds[gait] += round(row.clip.duration * count / row.windows.total(), 1)  # type: ignore[assignment]
    shares = ", ".join(f"{gait} {value:.1f} s" for gait, value in seconds.most_common())
    console.print(f"{len(rows)} clips, {sum(row.clip.duration for row in rows):.1f} s: {shares or 'nothing'}")
    if labelled:
        agreeing = sum(row.clip.label == row.gait for row in labelled)
        console.print(f"the gait agrees with the name of {agreeing} of {len(labelled)} clips named after a behaviour")
    if config.convert is not None:
        write(rows, names, config.convert)
        console.print(f"{len(rows)} clips written to {config.convert}")
    if config.figures and rows:
        for row, name in zip(rows, names, strict=True):
            draw(row, name, config)
        console.print(f"footfall diagrams in {config.output}")
    for message in broken:
        console.print(f"[red]cannot read[/] {message}", soft_wrap=True, highlight=False)
    return 1 if broken else 0


if __name__ == "__main__":
    torch.set_num_threads(1)  # clips are small; threads would only wait for each other
    with cli.one_line_errors():
        sys.exit(main(cli.from_arguments(Config, doc=__doc__), cli.console(220)))
