"""Measure how well a controller jumps onto boxes: robots trot, and some way before one they are told to jump.

In:  a run folder of ``bbc_pretrain.py`` or ``bbc_distill.py``, or its ``policy/`` folder.
Out: tables on the screen: who gets onto a box and over it, by its height, and by where and how fast the jump begins.

    python recipes/box_trials.py runs/my_controller
    python recipes/box_trials.py pretrained/bbc_leaping --heights 0.1 0.2 0.3 --speeds 1.8

Got onto it has whose trunk comes past its middle, over it who comes half a metre beyond its far side, in both cases
without a fall by the rules of a course (trunk, hip or thigh touch something). Nobody steers: robots go where they go.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.table import Table
from rollouts import load_controller, make_env
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import rotations
from agility_rl.behaviours import JUMP, skill_index
from agility_rl.envs.encounters import BOX, REACH
from agility_rl.envs.obstacles import BOX_HALF
from agility_rl.envs.terminations import LOCOMOTION_TERMINATIONS, thigh_contact
from agility_rl.training import cli

TROT_SPEED = (0.8, 1.2)
"""Of the approach [m/s]; drawn, so that jumps begin anywhere in a stride."""
NEVER = 1e-12
"""Share of encounters of an environment that has the pieces for them, but puts none there by itself."""


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder of a controller."""
    heights: tuple[float, ...] = (0.10, 0.15, 0.20, 0.25, 0.30)
    """Of boxes [m]."""
    distances: tuple[float, ...] = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4)
    """From the trunk's middle to the near side, where a jump begins [m]."""
    speeds: tuple[float, ...] = (1.2, 1.5, 1.8)
    """Of the jump [m/s]."""
    jump_height: float = 0.55
    """Commanded to the jump [m]."""
    repeats: int = 5
    """Robots of each height, distance and speed."""
    trot: float = 0.7
    """Seconds of the approach, from a stand."""
    seconds: float = 3.5
    """From the beginning of the jump on."""
    turned: float = 0.1
    """How far a box is turned at most [rad]."""
    seed: int = 0
    """Of starts and commands."""
    num_threads: int | None = None
    """Of the simulator; all by default."""


@dataclass(frozen=True)
class Trials:
    """What became of ``N`` robots.

    Attributes:
        case: ``[N, 3]``, height [m], distance [m] and speed [m/s].
        onto, over: bool ``[N]``.
        fell: bool ``[N]``, before they were over it.
        farthest: ``[N]``, place of the trunk along the way, from the near side on [m].
    """

    case: Tensor
    onto: Tensor
    over: Tensor
    fell: Tensor
    farthest: Tensor


def hold_trials(config: Config) -> Trials:
    """Let robots trot, put a box before each, and tell them to jump.

    Raises:
        ValueError: if there is nothing to try.
    """
    if config.repeats < 1 or not (config.heights and config.distances and config.speeds):
        raise ValueError("expected --repeats of at least 1, and --heights, --distances and --speeds")
    controller = load_controller(config.run)
    grid = list(itertools.product(config.heights, config.distances, config.speeds)) * config.repeats
    case, n = torch.tensor(grid), len(grid)
    height, distance, speed = case.unbind(-1)
    generator = torch.Generator().manual_seed(config.seed)
    env = make_env(
        n,
        controller,
        None,
        num_threads=config.num_threads,
        encounters=NEVER,
        terminations=(*LOCOMOTION_TERMINATIONS, thigh_contact),
    )
    assert env.encounters is not None
    policy = controller.bbc.deployable_policy()
    fast, turned = torch.rand(2, n, generator=generator)
    trot = torch.zeros(n, 5)
    trot[:, 0], trot[:, 4] = TROT_SPEED[0] + (TROT_SPEED[1] - TROT_SPEED[0]) * fast, 0.3
    jump = torch.zeros(n, 5)
    jump[:, 0], jump[:, 3] = speed, config.jump_height
    env.set_commands(torch.full((n,), skill_index("trot")), trot)
    td = env.reset()
    fell, onto, over = (torch.zeros(n, dtype=torch.bool) for _ in range(3))
    farthest = torch.full((n,), -torch.inf)
    start = round(config.trot / env.dt)
    for step in range(start + round(config.seconds / env.dt)):
        if step == start:
            ahead = env.encounters
            _, _, heading = rotations.to_euler(env.simulator.root_quaternion)
            way = torch.stack((heading.cos(), heading.sin()), -1)
            middle = env.simulator.root_position[:, :2] + (distance + BOX_HALF[0])[:, None] * way
            ahead.kind, ahead.lift = torch.full((n,), BOX), height
            ahead.position, ahead.yaw = middle, heading + config.turned * (2.0 * turned - 1.0)
            ahead.show(torch.ones(n, dtype=torch.bool), env.simulator)
            env.set_commands(torch.full((n,), JUMP), jump)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = env.step(policy(td))["next"]
        fell = fell | (td["terminated"][:, 0] & ~over)
        if step >= start:
            along = ((env.simulator.root_position[:, :2] - middle) * way).sum(-1)
            farthest = torch.where(fell, farthest, torch.maximum(farthest, along + BOX_HALF[0]))
            onto = onto | (~fell & (along > 0.0))
            over = over | (~fell & (along > REACH[BOX]))
    env.close()
    return Trials(case, onto, over, fell, farthest)


def table(title: str, columns: Sequence[float], rows: Sequence[float], cells: Sequence[Sequence[str]]) -> Table:
    """A table of texts."""
    drawn = Table(title, *(f"{column:g}" for column in columns))
    for row, texts in zip(rows, cells, strict=True):
        drawn.add_row(f"{row:g}", *texts)
    return drawn


def show(config: Config, trials: Trials, console: Console) -> None:
    """Print who got where."""
    height, distance, speed = trials.case.unbind(-1)

    def of(result: Tensor, *where: Tensor) -> str:
        rows = torch.stack(where).all(0)
        return f"{int(result[rows].sum())} of {int(rows.sum())}"

    overall = Table("height, m", "onto it", "over it", "fell", "place reached, m")
    for h in config.heights:
        at = (height - h).abs() < 1e-6
        median = trials.farthest[at].median().item()
        overall.add_row(f"{h:g}", of(trials.onto, at), of(trials.over, at), of(trials.fell, at), f"{median:.2f}")
    console.print(overall)
    cells = [
        [of(trials.onto, (height - h).abs() < 1e-6, (distance - d).abs() < 1e-6) for d in config.distances]
        for h in config.heights
    ]
    console.print(table("onto it: height, m; distance, m", config.distances, config.heights, cells))
    highest = (height - max(config.heights)).abs() < 1e-6
    cells = [
        [of(trials.onto, highest, (speed - v).abs() < 1e-6, (distance - d).abs() < 1e-6) for d in config.distances]
        for v in config.speeds
    ]
    console.print(table("the highest: speed, m/s; distance, m", config.distances, config.speeds, cells))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    config = cli.from_arguments(Config, arguments, doc=__doc__)
    with cli.one_line_errors():
        show(config, hold_trials(config), cli.console(140))


if __name__ == "__main__":
    main()
