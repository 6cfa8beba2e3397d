"""Figures of a Basic Behaviour Controller that no table shows: its footfalls beside the dogs', how it changes from one
behaviour to the next, what the shift ε does to each behaviour, and how the skill prior came about.

In:  a run folder of ``bbc_pretrain.py`` or an artifact folder; motion as for ``evaluate.py``.
Out: ``footfalls.png``, ``transitions.png``, ``shift.png`` and, of a run with its log, ``prior.png`` in ``--output``
     (``RUN/figures`` by default).

    python recipes/gait_figures.py pretrained/bbc --motion.labelled DIR --motion.unlabelled DIR --output figures

Dog and robot are judged by one rule (``gait_analysis.stance``: a foot that stands goes forward over the ground at less
than half of the trunk's speed); the robot is told the speed of the clip beside it, as far as Table S2 lets it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from evaluate import evaluate_prior
from matplotlib.figure import Figure
from rich.console import Console
from rollouts import Controller, Motion, MotionConfig, Recording, load_controller, load_motion, make_env, record
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS, command_bounds
from agility_rl.go2.constants import CONTROL_DT as DT
from agility_rl.motion import MotionClip
from agility_rl.motion.gait_analysis import clip_stance, measure_clip, measure_windows, stance, stance_share
from agility_rl.record import read_scalars
from agility_rl.record.plots import draw_footfalls, new_figure, save_figure
from agility_rl.training import cli

SHOWN = 2.0
"""Seconds of a footfall diagram."""
WALK, PACE, TROT, CANTER, JUMP = range(NUM_BEHAVIOURS)
TOUR = (WALK, TROT, CANTER, JUMP, PACE, CANTER, WALK)
"""Behaviours of the transitions' figure, one after the other."""
SHIFTS = torch.linspace(-1.0, 1.0, 9)
SHIFTED = ("stride frequency [Hz]", "speed [m/s]", "trunk height [m]", "duty factor")
MEASURED = 4.0
"""Seconds over which the effect of a shift is measured."""


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder."""
    settle: float = 3.0
    """Seconds from a start or a change of the shift to what is measured."""
    stay: float = 3.0
    """Seconds in each behaviour of the transitions."""
    robots: int = 16
    """Robots for each behaviour and shift."""
    seed: int = 0
    """Seed of start states."""
    output: Path | None = None
    """Folder of the figures; ``figures`` in the run by default."""
    motion: MotionConfig = field(default_factory=MotionConfig)


def command(skill: Tensor, speed: Tensor | None = None) -> Tensor:
    """``[N, 5]``: straight ahead, in the middle of each range of Table S2, or at speeds ``[N]`` as far as it allows."""
    low, high = (bounds[skill] for bounds in command_bounds())
    told = 0.5 * (low + high)
    if speed is not None:
        told[:, 0] = speed.clamp(low[:, 0], high[:, 0])
    return told


def examples(clips: list[MotionClip]) -> list[MotionClip]:
    """The longest clip of every behaviour."""
    return [max((clip for clip in clips if clip.label == name), key=lambda clip: clip.duration) for name in BEHAVIOURS]


def footfalls(controller: Controller, motion: Motion, reference: TensorDictBase, config: Config) -> Figure:
    """Every behaviour's footfalls, of a dog, or a synthetic gait, on the left and of the robot on the right."""
    clips = examples(motion.labelled)
    speeds = torch.stack([measure_clip(clip).speed for clip in clips])
    skill = torch.arange(NUM_BEHAVIOURS)
    told = command(skill, speeds)
    shown, steps = round(SHOWN / DT), round((config.settle + SHOWN) / DT)
    recording = drive(controller, reference, config, [(steps, skill, told)])
    stands = stance(recording.feet, recording.velocity, recording.yaw_rate, DT)
    figure = new_figure(11.0, 7.5)
    kind = "synthetic" if motion.synthetic else "dog"
    for row, clip in enumerate(clips):
        robot = recording.velocity[row, -shown:, 0].mean()
        panels = (
            (
                f"{kind}, {clip.name}, {speeds[row]:.2f} m/s",
                clip_stance(clip)[: round(SHOWN / clip.dt)],
                clip.dt,
            ),
            (f"robot, told {BEHAVIOURS[row]} at {told[row, 0]:.2f} m/s: {robot:.2f} m/s", stands[row, -shown:], DT),
        )
        for column, (title, contact, dt) in enumerate(panels):
            axes = figure.add_subplot(NUM_BEHAVIOURS, 2, 2 * row + column + 1)
            draw_footfalls(axes, contact, dt)
            axes.set_xlim(0.0, SHOWN)
            axes.set_title(title, fontsize=9)
    for axes in figure.axes[-2:]:
        axes.set_xlabel("time [s]")
    return figure


def transitions(controller: Controller, reference: TensorDictBase, config: Config) -> Figure:
    """One robot's tour of the behaviours: commanded and measured speed, footfalls by contact forces."""
    steps = round(config.stay / DT)
    schedule = [(steps, skill := torch.tensor([index]), command(skill)) for index in TOUR]
    recording = drive(controller, reference, config, schedule)
    wanted = torch.cat([told[0, :1].expand(steps) for _, _, told in schedule])
    figure = new_figure(12.0, 4.2)
    top, bottom = figure.subplots(2, 1, sharex=True)
    time = torch.arange(len(wanted)) * DT
    top.plot(time, wanted, "k--", linewidth=1.0, label="commanded")
    top.plot(time, recording.velocity[0, :, 0], linewidth=1.2, label="measured")
    top.set_ylabel("speed [m/s]")
    top.legend(fontsize=8, loc="upper right")
    draw_footfalls(bottom, recording.pressed[0], DT)
    bottom.set_xlabel("time [s]")
    for place, index in enumerate(TOUR):
        middle = (place + 0.5) * config.stay
        top.text(middle, 0.03, BEHAVIOURS[index], ha="center", transform=top.get_xaxis_transform())
        for axes in (top, bottom):
            axes.axvline(place * config.stay, color="0.5", linewidth=0.8)
    if recording.fell[0]:
        top.set_title("it fell")
    return figure


def shift_effect(controller: Controller, reference: TensorDictBase, config: Config) -> Tensor:
    """``[5 behaviours, 9 shifts, robots, 4 figures]`` of 4 s each, NaN where a robot fell."""
    skill, number = torch.meshgrid(torch.arange(NUM_BEHAVIOURS), torch.arange(len(SHIFTS)), indexing="ij")
    rows = skill.flatten().repeat_interleave(config.robots)
    shift = SHIFTS[number.flatten().repeat_interleave(config.robots)][:, None]
    settle = round(config.settle / DT)
    recording = drive(controller, reference, config, [(settle + round(MEASURED / DT), rows, command(rows), shift)])
    feet, sole, height, velocity, yaw_rate = recording.stretch(torch.ones(len(rows), dtype=torch.bool), settle)
    gait = measure_windows(feet, sole, height, velocity, yaw_rate, DT, MEASURED)
    duty = stance_share(feet, velocity, yaw_rate, DT)
    figures = torch.stack((gait.stride_frequency[:, 0], velocity[..., 0].mean(1), height.mean(1), duty), -1)
    figures = figures.masked_fill(recording.fell[:, None], torch.nan)
    return figures.unflatten(0, (NUM_BEHAVIOURS, len(SHIFTS), config.robots))


def shifts(effect: Tensor) -> Figure:
    """What the shift changes: mean and standard deviation over the robots that did not fall."""
    mean = effect.nanmean(2)
    spread = (effect - mean[:, :, None]).square().nanmean(2).sqrt()
    figure = new_figure(12.0, 3.2)
    for column, title in enumerate(SHIFTED):
        axes = figure.add_subplot(1, len(SHIFTED), column + 1)
        for behaviour, name in enumerate(BEHAVIOURS):
            middle, width = mean[behaviour, :, column], spread[behaviour, :, column]
            axes.plot(SHIFTS, middle, label=name)
            axes.fill_between(SHIFTS, middle - width, middle + width, alpha=0.15)
        axes.set_title(title, fontsize=9)
        axes.set_xlabel("shift ε", fontsize=8)
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return figure


def prior(run: Path, motion: Motion) -> Figure:
    """The skill prior over the training, and the shares of the unlabelled motion by the gait classifier (dashed)."""
    scalars = read_scalars(run)
    figure = new_figure(7.0, 3.2)
    axes = figure.add_subplot()
    shares: dict[str, float] = {}
    if motion.unlabelled:
        learned = [float(scalars[f"prior/{name}"][1][-1]) for name in BEHAVIOURS]
        shares = evaluate_prior(learned, motion.unlabelled)["unlabelled_among_behaviours"]
    for index, name in enumerate(BEHAVIOURS):
        axes.plot(*scalars[f"prior/{name}"], color=f"C{index}", label=name)
        if name in shares:
            axes.axhline(shares[name], color=f"C{index}", linestyle="--", linewidth=0.8)
    axes.set_xlabel("iteration")
    axes.set_ylabel("probability")
    axes.legend(fontsize=8, loc="center right")
    return figure


def drive(controller: Controller, reference: TensorDictBase, config: Config, schedule: list[tuple]) -> Recording:
    """Record the robots of a schedule."""
    env = make_env(len(schedule[0][1]), controller, reference, seed=config.seed)
    recording = record(controller.bbc, env, schedule)
    env.close()
    return recording


def main(config: Config, console: Console) -> list[Path]:
    """Draw everything; returns the paths."""
    if config.settle < 0 or config.stay < DT or config.robots < 1:
        raise ValueError("expected --settle of at least 0, --stay of at least 0.02 s and --robots of at least 1")
    controller = load_controller(config.run)
    motion = load_motion(config.motion, controller.trained, config.seed)
    console.print(f"motion: {motion.source}", markup=False)
    reference = motion.start_states(config.seed)
    figures = {
        "footfalls": footfalls(controller, motion, reference, config),
        "transitions": transitions(controller, reference, config),
        "shift": shifts(shift_effect(controller, reference, config)),
    }
    if (controller.run / "metrics.mcap").is_file():
        figures["prior"] = prior(controller.run, motion)
    folder = config.output or controller.run / "figures"
    paths = [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items()]
    for path in paths:
        console.print(str(path), highlight=False)
    return paths


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__), cli.console(140))
