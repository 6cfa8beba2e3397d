"""Measure a Basic Behaviour Controller: does the robot do what it is told, and does it move like the dog?

In:  a run folder of ``bbc_pretrain.py`` or an artifact folder; motion by ``--motion.labelled DIR --motion.unlabelled
     DIR``, else the folders that the run was trained on, else synthetic gaits.
Out: tables on the screen, ``RUN/evaluation.json``, ``RUN/figures/*.png``; an earlier evaluation is replaced.

    python recipes/evaluate.py runs/my_run [--episodes 100 --seconds 20 --motion.labelled DIR]

Every episode has one behaviour and one command drawn from Table S2, starts from a frame of recorded motion of that
behaviour, and is driven by the deterministic deployable policy (what the robot measures, never the simulator's truth).
What it showed is named by the gait classifier, which knows nothing of our networks; dogs are measured by the same code.
An episode with a fall counts as not recognised. The first second is left out of everything but falls.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from identified import load_simulator
from judgement import draw_episode, nmi_interval, print_evaluation, targets, to_json
from rich.console import Console
from rollouts import Controller, Motion, MotionConfig, Recording, join, load_controller, load_motion, make_env, record
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, JUMP, NUM_BEHAVIOURS, sample_commands
from agility_rl.envs.randomization import Randomization
from agility_rl.go2.constants import CONTROL_DT as DT
from agility_rl.motion import MotionClip
from agility_rl.motion.gait_analysis import (
    GAIT_LABELS,
    STAND,
    GaitMeasurement,
    classify_episodes,
    classify_index,
    clip_stance_share,
    measure_clip,
    measure_windows,
    stance_share,
)
from agility_rl.record.plots import behaviour_matrix, save_figure
from agility_rl.training import cli, metrics, run_folder

COLUMNS = (*GAIT_LABELS, "fall")
FALL = COLUMNS.index("fall")
WINDOW = 3.0
"""Length of the stretches that a gait is named in [s]."""
LEAP = round(0.9 / DT)
"""A leap fits into so many steps; the typical peak is the median of the highest trunks of such stretches."""
TOLERANCE, PHASE_TOLERANCE = 0.25, 0.05
"""Allowed distance from the dog's clips: a quarter, but for phases (shares of a stride, often near 0) at least 0.05."""

TURNING = 0.2
"""Slower commanded turns [rad/s] say nothing about how well a robot turns."""


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder."""
    episodes: int = 100
    """Episodes of each behaviour."""
    seconds: float = 20.0
    """Length of an episode."""
    settle: float = 1.0
    """Left out of the measurement at the start of an episode [s]."""
    switches: int = 10
    """Trials of each of the 20 ordered switches between behaviours; 0 leaves them out."""
    switch_seconds: float = 4.0
    """Time in the first and in the second behaviour."""
    robots: int = 500
    """Most robots simulated at once."""
    simulator: Path | None = None
    """Another simulator than the nominal one: ``result.json`` of ``easi.py``, or a log's ``NAME.truth.json``."""
    randomize: bool = False
    """Draw friction, masses and gains as in training instead of the nominal robot."""
    noise: float = 0.0
    """Factor on the observation noise (training: 1)."""
    seed: int = 0
    """Seed of commands and start states."""
    num_threads: int | None = None
    """Threads of the simulator."""
    output: Path | None = None
    """Folder of the results; the run by default."""
    motion: MotionConfig = field(default_factory=MotionConfig)


def simulate(
    controller: Controller, config: Config, reference: Any, schedule: list[tuple[int, Tensor, Tensor]]
) -> Recording:
    """Record all robots of a schedule, at most ``config.robots`` at once."""
    parts: list[Recording] = []
    simulator = load_simulator(config.simulator) if config.simulator else None
    for rows in torch.arange(len(schedule[0][1])).split(config.robots):
        randomization = Randomization() if config.randomize else None
        options = {"num_threads": config.num_threads, "observation_noise": config.noise, "randomization": randomization}
        env = make_env(len(rows), controller, reference, simulator, seed=config.seed + len(parts), **options)
        parts.append(record(controller.bbc, env, [(steps, skill[rows], c[rows]) for steps, skill, c in schedule]))
        env.close()
    return join(parts)


def gait_figures(m: GaitMeasurement, duty: Tensor) -> dict[str, Tensor]:
    """The figures that a robot and a dog are compared by."""
    return {
        "phase FL-FR": m.phase_left_right_front,
        "phase lateral": m.phase_lateral,
        "phase diagonal": m.phase_diagonal,
        "duty factor": duty,
        "stride frequency": m.stride_frequency,
    }


def name_gaits(recording: Recording, start: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Index into COLUMNS of every robot ``[N]``, and its gait figures (NaN after a fall)."""
    upright = ~recording.fell
    shown, figures = torch.full((len(upright),), FALL), {}
    if upright.any():
        feet, sole, height, velocity, yaw_rate = recording.stretch(upright, start)
        shown[upright], typical = classify_episodes(measure_windows(feet, sole, height, velocity, yaw_rate, DT, WINDOW))
        for name, values in gait_figures(typical, stance_share(feet, velocity, yaw_rate, DT)).items():
            figures[name] = torch.full((len(upright),), math.nan).masked_scatter(upright, values)
    return shown, figures


def dog_figures(clips: list[MotionClip], name: str) -> dict[str, list[float]]:
    """The same figures of each clip of a behaviour, but of clips that show another gait only if there are no others."""
    rows, agreeing = [], []
    for clip in (clip for clip in clips if clip.label == name):
        winner, m = classify_episodes(measure_clip(clip, WINDOW))
        rows.append(gait_figures(m, clip_stance_share(clip)))
        agreeing += rows[-1:] if GAIT_LABELS[int(winner)] == name else []
    return {key: [row[key].item() for row in agreeing or rows] for key in rows[0]}


def compare(robot: metrics.Interval, dog: list[float], slack: float) -> dict[str, Any]:
    """Whether the robot's mean is within a quarter (or ``slack``) of the interval that the dog's clips span."""
    low, high = min(dog), max(dog)
    allowed = [low - max(TOLERANCE * low, slack), high + max(TOLERANCE * high, slack)]
    ratio = robot.estimate * len(dog) / sum(dog) if sum(dog) > 0 else math.nan
    within = allowed[0] <= robot.estimate <= allowed[1]
    return {"robot": robot, "dog": [low, high], "allowed": allowed, "ratio_to_mean": ratio, "within": within}


def evaluate_behaviours(
    controller: Controller, config: Config, motion: Motion, reference: Any, figures: Path
) -> dict[str, Any]:
    """All episodes of all behaviours in one batch."""
    generator = torch.Generator().manual_seed(config.seed)
    skill = torch.arange(NUM_BEHAVIOURS).repeat_interleave(config.episodes)
    command = sample_commands(skill, generator)
    recording = simulate(controller, config, reference, [(round(config.seconds / DT), skill, command)])
    start, jump, upright = round(config.settle / DT), skill == JUMP, ~recording.fell
    shown, gait = name_gaits(recording, start)
    height = recording.height[:, start:]
    peak = height.unfold(1, LEAP, LEAP).amax(-1).median(-1).values
    wanted = torch.stack((*command[:, :3].unbind(-1), torch.where(jump, command[:, 3], command[:, 4])), -1)
    velocity = recording.velocity[:, start:].mean(1)
    got = (
        velocity[:, 0],
        velocity[:, 1],
        recording.yaw_rate[:, start:].mean(1),
        torch.where(jump, peak, height.mean(1)),
    )
    names = ("speed", "lateral speed", "yaw rate", "height")
    result: dict[str, Any] = {}
    for index, name in enumerate(BEHAVIOURS):
        rows = skill == index
        walked = rows & upright
        # Standing is right where the command is to stand: the dead-band of walk makes a few commands of no velocity.
        right = rows & ((shown == index) | ((shown == STAND) & (command[:, :3] == 0).all(-1)))
        entry: dict[str, Any] = {"episodes": config.episodes, "errors": {}, "turns": {}, "gait": {}}
        entry["shown"] = dict(zip(COLUMNS, shown[rows].bincount(minlength=len(COLUMNS)).tolist(), strict=True))
        entry["recognised"] = metrics.wilson_interval(int(right.sum()), config.episodes)
        entry["falls"] = metrics.wilson_interval(int((rows & ~upright).sum()), config.episodes)
        if walked.any():
            for column, key in enumerate(names):
                entry["errors"][key] = metrics.mean_interval((got[column] - wanted[:, column])[walked].abs())
            for side, turn in (("left", wanted[:, 2]), ("right", -wanted[:, 2])):
                if (turned := walked & (turn > TURNING)).any():
                    entry["turns"][side] = metrics.mean_interval((got[2] / wanted[:, 2])[turned])
            for key, dog in dog_figures(motion.labelled, name).items():
                slack = PHASE_TOLERANCE if key.startswith("phase") else 0.0
                entry["gait"][key] = compare(metrics.mean_interval(gait[key][walked]), dog, slack)
            for key, contact in (("force", recording.pressed), ("height", recording.sole)):
                entry[f"duty factor by {key}"] = metrics.mean_interval(contact[walked, start:].float().mean((1, 2)))
        result[name] = entry
        typical = int(torch.cat([x.nonzero()[:, 0] for x in (right, walked, rows)])[0])
        draw_episode(recording, index, typical, command[typical], COLUMNS[shown[typical]], start, figures)
    counts = torch.stack([shown[skill == index].bincount(minlength=len(COLUMNS)) for index in range(NUM_BEHAVIOURS)])
    save_figure(behaviour_matrix(counts, BEHAVIOURS, COLUMNS), figures / "behaviour_matrix.png")
    return {
        "behaviours": result,
        "matrix": {"rows": BEHAVIOURS, "columns": COLUMNS, "counts": counts},
        "nmi": nmi_interval(counts, generator),
        "falls": metrics.wilson_interval(int(recording.fell.sum()), len(skill)),
        "episodes": {
            "skill": skill,
            "shown": shown,
            "quantities": names,
            "commanded": wanted,
            "measured": torch.stack(got, -1),
        },
    }


def evaluate_switches(controller: Controller, config: Config, reference: Any) -> dict[str, Any]:
    """Every ordered switch from one behaviour to another: falls, and whether the second behaviour is recognised."""
    pairs = torch.tensor([(a, b) for a in range(NUM_BEHAVIOURS) for b in range(NUM_BEHAVIOURS) if a != b])
    first, second = pairs.repeat_interleave(config.switches, 0).unbind(-1)
    generator, steps = torch.Generator().manual_seed(config.seed + 1), round(config.switch_seconds / DT)
    schedule = [(steps, skill, sample_commands(skill, generator)) for skill in (first, second)]
    recording = simulate(controller, config, reference, schedule)
    shown, _ = name_gaits(recording, steps + min(round(config.settle / DT), steps // 2))
    safe = (~recording.fell).unflatten(0, (len(pairs), config.switches)).sum(1).tolist()
    known = (shown == second).unflatten(0, (len(pairs), config.switches)).sum(1).tolist()
    labels = [f"{BEHAVIOURS[a]} to {BEHAVIOURS[b]}" for a, b in pairs.tolist()]
    total = len(pairs) * config.switches
    return {
        "trials": config.switches,
        "without_fall": dict(zip(labels, safe, strict=True)),
        "second_recognised": dict(zip(labels, known, strict=True)),
        "all_without_fall": metrics.wilson_interval(sum(safe), total),
        "all_second_recognised": metrics.wilson_interval(sum(known), total),
    }


def evaluate_prior(prior: list[float], clips: list[MotionClip]) -> dict[str, Any]:
    """The learned prior beside the shares of time of the unlabelled motion, as the gait classifier names it."""
    seconds = torch.zeros(len(GAIT_LABELS), dtype=torch.float64)
    for clip in clips:
        labels = classify_index(measure_clip(clip, WINDOW)).flatten()
        seconds += labels.bincount(minlength=len(GAIT_LABELS)) * clip.duration / len(labels)
    shares = seconds[:NUM_BEHAVIOURS] / seconds[:NUM_BEHAVIOURS].sum().clamp(min=1e-9)
    distance = 0.5 * (torch.tensor(prior, dtype=torch.float64) - shares).abs().sum()
    return {
        "learned": dict(zip(BEHAVIOURS, prior, strict=True)),
        "unlabelled_among_behaviours": dict(zip(BEHAVIOURS, shares.tolist(), strict=True)),
        "unlabelled_seconds": dict(zip(GAIT_LABELS, seconds.tolist(), strict=True)),
        "total_variation": distance,
    }


def check(config: Config) -> None:
    """Refuse an evaluation that cannot be.

    Raises:
        ValueError: naming the options.
    """
    if config.episodes < 1 or config.robots < 1 or config.switches < 0:
        raise ValueError("expected --episodes and --robots of at least 1 and --switches of at least 0")
    if config.settle < 0 or config.seconds < config.settle + 1.0 or (config.switches and config.switch_seconds < 1.0):
        raise ValueError(
            "expected --seconds at least 1 s longer than --settle >= 0, and --switch-seconds of at least 1"
        )
    if config.simulator is not None and config.randomize:
        raise ValueError("--randomize: a simulator of --simulator has its own parameters; give one of the two")


def evaluate(config: Config, console: Console) -> dict[str, Any]:
    """The whole evaluation; writes it and returns it."""
    check(config)
    begin = time.monotonic()
    controller = load_controller(config.run)
    motion = load_motion(config.motion, controller.trained, config.seed)
    reference = motion.start_states(config.seed)
    output = config.output or controller.run
    prior = controller.artifact.manifest.get("prior")
    found = evaluate_behaviours(controller, config, motion, reference, output / "figures")
    found["switches"] = evaluate_switches(controller, config, reference) if config.switches else None
    found["prior"] = evaluate_prior(prior, motion.unlabelled) if prior and motion.unlabelled else None
    result = {
        "format": "agility_rl.evaluation",
        "format_version": 1,
        "run": config.run.name,
        "weights": controller.artifact.manifest["weights"]["sha256"],
        "motion": {"source": motion.source, "synthetic": motion.synthetic},
        "settings": config,
        "versions": run_folder.versions(),
        **found,
        "targets": targets(found),
        "seconds": time.monotonic() - begin,
    }
    run_folder.write_json(output / "evaluation.json", to_json(result))
    print_evaluation(result, console)
    console.print(f"{output / 'evaluation.json'} and figures written after {result['seconds']:.0f} s", highlight=False)
    return result


if __name__ == "__main__":
    with cli.one_line_errors():
        evaluate(cli.from_arguments(Config, doc=__doc__), cli.console(140))
