"""Where do the encoders of students look? Grad-CAM as in Fig. S2, and the share of attention that is on the obstacle.

Source: Fu et al. 2025, supplement S8, Fig. S2; Grad-CAM: :mod:`agility_rl.modules.grad_cam`. The share is ours: the
pixels of the obstacle ahead are known, because the simulation can look again without it.

In:  run folders of ``tsc_student.py``, with BYOL and without; the first one walks, all of them look at the same images.
Out: tables on the screen, ``OUTPUT/attention.json``, ``OUTPUT/figures/attention.png``.

    python recipes/attention.py runs/with_0 runs/without_0 --images 256
    python recipes/attention.py runs/with_0 runs/without_0 --objective behaviour --strength 3
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from attention_scenes import Scenes, collect_scenes, network, objective
from deciders import load_decider
from disturbances import chosen
from judgement import make_table, show, to_json
from matplotlib.figure import Figure
from rich.console import Console
from torch import Tensor
from tsc_setup import course_of

from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.grad_cam import grad_cam
from agility_rl.record.plots import new_figure, save_figure
from agility_rl.training import cli, metrics, run_folder

DISTURBED = ("none", "rectangles", "noise", "blur", "dropout")
"""Columns: those of Fig. S2, and pixels that drop out."""
BATCH = 64
Objective = Literal["feature", "obstacle", "behaviour"]


@dataclass(frozen=True)
class Config:
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run or artifact folders of students; the first one walks."""
    bbc: Path | None = None
    """Folder of the Basic Behaviour Controller; that of the training by default."""
    course: str = "full"
    """Preset course or course file."""
    objective: Objective = "feature"
    """What the attention is for: the encoder's features, the obstacle recognised, or the behaviour chosen."""
    obstacle: str = "bar_jump"
    """Obstacle that the figure shows (Fig. S2: the bar jump)."""
    images: int = 256
    """Images that count."""
    least: float = 0.02
    """Share of its pixels that the obstacle must have."""
    every: int = 4
    """Decisions between two images of a robot."""
    robots: int = 32
    """Simulated together."""
    strength: int = 1
    """How many times images are disturbed."""
    seed: int = 2000
    """Of courses and disturbances."""
    num_threads: int | None = None
    """Threads of the simulator."""
    output: Path | None = None
    """Folder of the results; by default the first run."""


def maps(student: RecurrentStudent, scenes: Scenes, index: int, images: Tensor, name: Objective) -> Tensor:
    """Attention of one student on (disturbed) images, ``[M, 58, 87]``."""
    found = []
    for rows in torch.arange(len(images)).split(BATCH):
        wanted = objective(name, student, scenes.contexts[index][rows], scenes.kind[rows])
        found.append(grad_cam(student.depth_encoder, images[rows], wanted))
    return torch.cat(found)


def share_on(cam: Tensor, mask: Tensor) -> Tensor:
    """Share of each map ``[M, H, W]`` that lies on the pixels of a mask, ``[M]``; NaN where there is no attention."""
    cam = cam.flatten(1)
    return (cam * mask.flatten(1)).sum(-1) / cam.sum(-1)


def similarity(cam: Tensor, other: Tensor) -> Tensor:
    """Cosine between maps ``[M, H, W]``, ``[M]``; NaN where one has no attention."""
    cam, other = cam.flatten(1), other.flatten(1)
    return (cam * other).sum(-1) / (torch.linalg.vector_norm(cam, dim=-1) * torch.linalg.vector_norm(other, dim=-1))


def interval(values: Tensor) -> metrics.Interval | None:
    """Mean and bootstrap interval of what is a number."""
    values = values[values.isfinite()]
    return metrics.bootstrap_interval(values, torch.Generator().manual_seed(0)) if len(values) else None


def picture(rows: Sequence[tuple[str, Tensor, Tensor | None]], columns: Sequence[str], mask: Tensor) -> Figure:
    """Fig. S2: each row a label, images ``[C, 58, 87]`` and maps of attention over them, or none."""
    figure = new_figure(2.4 * len(columns), 1.75 * len(rows))
    for row, (label, images, cams) in enumerate(rows):
        for column, name in enumerate(columns):
            axes = figure.add_subplot(len(rows), len(columns), row * len(columns) + column + 1)
            axes.imshow(images[column].numpy(), cmap="gray", vmin=-0.5, vmax=0.5)
            if cams is not None:
                axes.imshow(cams[column].numpy(), cmap="jet", alpha=0.5, vmin=0.0, vmax=1.0)
            axes.contour(mask.numpy(), levels=[0.5], colors="white", linewidths=0.6)
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                axes.set_title(name, fontsize=9)
            if column == 0:
                axes.set_ylabel(label, fontsize=8)
    return figure


def attend(config: Config, console: Console) -> dict[str, Any]:
    """Collect images, compute all maps, write and return what they say."""
    if not config.runs or config.images < 1 or config.robots < 1 or config.every < 1:
        raise ValueError("expected the folders of one student or more, --images, --robots and --every of at least 1")
    if config.obstacle not in OBSTACLES:
        raise ValueError(f"--obstacle: unknown {config.obstacle!r}; expected one of {', '.join(OBSTACLES)}")
    disturbances, course = chosen(DISTURBED, config.strength), course_of(config.course)
    deciders = [load_decider(path, config.bbc, kind="student") for path in config.runs]
    if len({(one.manifest["bbc"], one.decision_steps, one.fastest_canter) for one in deciders}) > 1:
        raise ValueError("the students must belong to the same BBC, decide at the same rate and canter as fast")
    scenes = collect_scenes(
        course,
        deciders,
        wanted=config.images,
        robots=config.robots,
        every=config.every,
        least=config.least,
        seed=config.seed,
        num_threads=config.num_threads,
    )
    generator = torch.Generator().manual_seed(config.seed)
    images = {name: one.images(generator)(scenes.images) for name, one in disturbances.items()}
    labels = ["with BYOL" if one.manifest["byol"] else "without BYOL" for one in deciders]
    cams = [
        {name: maps(network(decider), scenes, index, seen, config.objective) for name, seen in images.items()}
        for index, decider in enumerate(deciders)
    ]
    area = scenes.mask.flatten(1).float().mean(-1)
    groups: dict[str, Any] = {}
    for label in sorted(set(labels)):
        own = [cam for cam, one in zip(cams, labels, strict=True) if one == label]
        share = {name: torch.stack([share_on(cam[name], scenes.mask) for cam in own]) for name in images}
        same = {name: torch.stack([similarity(cam["none"], cam[name]) for cam in own]) for name in images}
        groups[label] = {
            "share": {name: interval(value.nanmean(0)) for name, value in share.items()},
            "share_over_area": {name: interval((value / area).nanmean(0)) for name, value in share.items()},
            "similarity_to_undisturbed": {name: interval(value.nanmean(0)) for name, value in same.items()},
            "without_attention": {name: int(value.isnan().sum()) for name, value in share.items()},
        }
    counts = torch.bincount(scenes.kind, minlength=len(OBSTACLES)).tolist()
    result = {
        "format": "agility_rl.attention",
        "format_version": 1,
        "runs": [{"run": str(path), "label": label} for path, label in zip(config.runs, labels, strict=True)],
        "weights": [decider.weights for decider in deciders],
        "settings": config,
        "versions": run_folder.versions(),
        "images": {name: count for name, count in zip(OBSTACLES, counts, strict=True) if count},
        "area_of_the_obstacle": interval(area),
        "groups": groups,
    }
    output = config.output or config.runs[0]
    output.mkdir(parents=True, exist_ok=True)
    run_folder.write_json(output / "attention.json", to_json(result))
    candidates = (scenes.kind == list(OBSTACLES).index(config.obstacle)).nonzero()[:, 0]
    if len(candidates):
        example = int(candidates[area[candidates].argsort()[len(candidates) // 2]])  # of median size
        shown = torch.stack([seen[example] for seen in images.values()])
        rows: list[tuple[str, Tensor, Tensor | None]] = [("depth", shown, None)]
        for label in sorted(set(labels)):
            cam = cams[labels.index(label)]
            rows.append((label, shown, torch.stack([cam[name][example] for name in images])))
        columns = ["original", *(one.label for name, one in disturbances.items() if name != "none")]
        save_figure(picture(rows, columns, scenes.mask[example]), output / "figures" / "attention.png")
    else:
        console.print(f"no figure: none of the images shows {config.obstacle}", highlight=False)
    print_attention(result, {name: one.label for name, one in disturbances.items()}, console)
    console.print(f"{output / 'attention.json'} and figures written", highlight=False)
    return result


def print_attention(result: Mapping[str, Any], disturbances: Mapping[str, str], console: Console) -> None:
    """Print the tables."""
    area = result["area_of_the_obstacle"].estimate
    console.print(f"{sum(result['images'].values())} images; the obstacle has {area:.3f} of an image", highlight=False)
    titles = {
        "share": "share of attention on the obstacle's pixels, 95 % intervals over images",
        "share_over_area": "that share over the obstacle's share of the image (1: looks nowhere in particular)",
        "similarity_to_undisturbed": "cosine between attention on disturbed and on original images",
    }
    for key, title in titles.items():
        table = make_table(title, "", *disturbances.values())
        for label, group in result["groups"].items():
            table.add_row(label, *(show(group[key][name]) for name in disturbances))
        console.print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    config = cli.from_arguments(Config, arguments, doc=__doc__)
    with cli.one_line_errors():
        attend(config, cli.console(160))


if __name__ == "__main__":
    main()
