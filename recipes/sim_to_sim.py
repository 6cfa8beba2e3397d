"""Does a controller move the same in another simulator, and how near does it come to the limits of the deployment?

The artifact runs as on the robot (``agility_rl.deploy``: its own history and estimates, no truth of the simulator) on
one robot in plain MuJoCo, once with the physics step of the training and once with that of the robot's motors. Time is
simulated, so that the machine's speed does not matter. The safety checks look, but do not stop: what they would have
stopped is listed, and the figures are of whole episodes.

In:  a run or artifact folder of a BBC.
Out: tables on the screen, and with ``--output FILE.json`` in a file.

    python recipes/sim_to_sim.py pretrained/bbc [--episodes 10 --seconds 10 --steps 0.005 0.001]

Every episode has one behaviour and one command drawn from Table S2, the same for all physics steps, and starts
standing. The first second is left out of everything but falls and limits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from evaluate import COLUMNS, LEAP, name_gaits
from judgement import make_table, to_json
from rich.console import Console
from rollouts import Recording, join, recorded_step
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS, JUMP, sample_commands, skill_index
from agility_rl.deploy import Artifact, BehaviourCommand, DeployedBBC, JointCommand, SafetyLimits
from agility_rl.deploy.behaviour import torch_network
from agility_rl.deploy.safety import Safety, pd_torque
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.go2 import constants
from agility_rl.training import cli, run_folder

STAND_SECONDS = 1.0
"""Time for which the robot stands before it is told to move [s]."""
FALL_FORCE = 1.0
"""Force on trunk or hips that is a fall [N], as in training (method notes, section 4.2)."""
_TRUNK_AND_HIPS = (constants.TRUNK_GROUP, *constants.HIP_GROUPS)
Figures = dict[str, Any]
LIMITS = ("tilt", "beyond stops", "commanded torque", "joint speed")


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder."""
    behaviours: tuple[str, ...] = BEHAVIOURS
    """Which ones."""
    episodes: int = 10
    """Episodes of each behaviour with each physics step."""
    seconds: float = 10.0
    """Length of an episode."""
    settle: float = 1.0
    """Left out of the measurement at the start of an episode [s]."""
    steps: tuple[float, ...] = (constants.SIM_DT, 0.001)
    """Physics steps [s]: that of the training, and that of the robot's motors (supplement S3)."""
    friction_loss: float | None = None
    """Dry friction of the joints [N m]; as in training by default."""
    seed: int = 0
    """Of the commands."""
    output: Path | None = None
    """File for the figures, ending in .json."""


@dataclass(frozen=True)
class Episode:
    """What one robot did, and how near it came to where the deployment gives up."""

    recording: Recording
    largest: dict[str, float]
    """Largest tilt [rad], excess past joint stops [rad], commanded torque and joint speed as shares of the limits."""
    stopped: tuple[float, str] | None
    """When a check would first have stopped the robot [s], and why."""


def measure(state: Any, command: JointCommand, bbc: DeployedBBC, safety: Safety) -> dict[str, float]:
    """The quantities that the safety checks look at, in one control step."""
    limits = safety.limits
    upright = rotations.rotate(state.quaternion, torch.tensor([0.0, 0.0, 1.0]))[2].clamp(-1.0, 1.0)
    position = state.joint_position
    beyond = torch.maximum(torch.tensor(limits.joint_lower) - position, position - torch.tensor(limits.joint_upper))
    torque = pd_torque(command, state).abs() / torch.tensor(bbc.manifest["limits"]["joint_torque"])
    speed = state.joint_velocity.abs() / torch.tensor(limits.joint_speed)
    values = (torch.acos(upright), beyond.max().clamp(min=0.0), torque.max(), speed.max())
    return {name: float(value) for name, value in zip(LIMITS, values, strict=True)}


def run_episode(robot: SimulatedRobot, bbc: DeployedBBC, told: BehaviourCommand, seconds: float) -> Episode:
    """Stand, then move as told."""
    limits = SafetyLimits.from_manifest(bbc.manifest)
    safety = Safety(limits, bbc.joint_names, bbc.manifest["limits"]["joint_torque"])
    bbc.reset()
    robot.reset("standing")
    robot.command(JointCommand(bbc.default_pose, bbc.stiffness, bbc.damping))
    robot.advance(STAND_SECONDS)
    rows: list[tuple[Tensor, ...]] = []
    largest = dict.fromkeys(LIMITS, 0.0)
    stopped: tuple[float, str] | None = None
    fell = False
    for step in range(round(seconds / bbc.period)):
        state = robot.state(now=step * bbc.period)
        bbc.observe(state)
        command = JointCommand(bbc.target(bbc.act(told)), bbc.stiffness, bbc.damping)
        fault = safety.check_state(state, state.time) or safety.check_command(command, state)
        if fault is not None and stopped is None:
            stopped = state.time, str(fault)
        found = measure(state, command, bbc, safety)
        largest = {name: max(largest[name], found[name]) for name in LIMITS}
        robot.command(command)
        robot.advance(bbc.period)
        after = robot.state(now=0.0)
        velocity = torch.from_numpy(robot.data.qvel[:3].astype("float32"))
        assert after.trunk_position is not None
        place = after.trunk_position, after.quaternion, velocity, after.angular_velocity
        rows.append((*place, after.joint_position, after.foot_force))
        pressed = [robot.data.sensordata[3 * group : 3 * group + 3] for group in _TRUNK_AND_HIPS]
        fell = fell or any(math.hypot(*force) > FALL_FORCE for force in pressed)
    steps = recorded_step(*(torch.stack(column) for column in zip(*rows, strict=True)))
    return Episode(Recording(*[values[None] for values in steps] + [torch.tensor([fell])]), largest, stopped)


def summarise(episodes: Sequence[Episode], skill: Tensor, command: Tensor, settle: float) -> dict[str, Figures]:
    """Figures of every behaviour by name; speed and frequency are means of the episodes without a fall."""
    recording = join([episode.recording for episode in episodes])
    start = round(settle / constants.CONTROL_DT)
    shown, gait = name_gaits(recording, start)
    velocity = recording.velocity[:, start:, 0].mean(1)
    height = recording.height[:, start:]
    peak = height.unfold(1, LEAP, LEAP).amax(-1).median(-1).values
    errors = {
        "speed error": velocity - command[:, 0],
        "yaw rate error": recording.yaw_rate[:, start:].mean(1) - command[:, 2],
        "height error": torch.where(skill == JUMP, peak - command[:, 3], height.mean(1) - command[:, 4]),
    }
    found: dict[str, Figures] = {}
    for index in skill.unique().tolist():
        rows = skill == index
        walked = rows & ~recording.fell
        of_it = [episodes[row] for row in rows.nonzero()[:, 0].tolist()]
        found[BEHAVIOURS[index]] = {
            "recognised": int((shown[rows] == index).sum()),
            "falls": int(recording.fell[rows].sum()),
            **{name: float(value[walked].abs().mean()) for name, value in errors.items()},
            "stride frequency": float(gait["stride frequency"][walked].nanmean()) if gait else math.nan,
            "stopped": [episode.stopped for episode in of_it if episode.stopped is not None],
            **{name: max(episode.largest[name] for episode in of_it) for name in LIMITS},
            "shown": [COLUMNS[label] for label in shown[rows].tolist()],
        }
    return found


def print_tables(found: dict[float, dict[str, Figures]], cfg: Config, console: Console) -> None:
    """Side by side: one row a behaviour and physics step."""
    shares = {
        "recognised": f"{{}}/{cfg.episodes}",
        "falls": f"{{}}/{cfg.episodes}",
        "speed error": "{:.3f} m/s",
        "yaw rate error": "{:.3f} rad/s",
        "height error": "{:.3f} m",
        "stride frequency": "{:.2f} Hz",
    }
    limits = {
        "tilt": "{:.2f} rad",
        "beyond stops": "{:.3f} rad",
        "commanded torque": "{:.2f} x limit",
        "joint speed": "{:.2f} x limit",
    }
    motion = make_table("motion (means of the episodes without a fall)", "behaviour", "physics step", *shares)
    nearness = make_table("largest values, at 50 Hz", "behaviour", "physics step", *limits, "stopped by a check")
    for name in next(iter(found.values())):
        for dt, rows in found.items():
            row, label = rows[name], f"{1e3 * dt:g} ms"
            motion.add_row(name, label, *(text.format(row[key]) for key, text in shares.items()))
            stopped = f"{len(row['stopped'])}/{cfg.episodes}"
            nearness.add_row(name, label, *(text.format(row[key]) for key, text in limits.items()), stopped)
    console.print(motion)
    console.print(nearness)
    for dt, rows in found.items():
        for name, row in rows.items():
            for moment, reason in row["stopped"]:
                console.print(f"{name}, {1e3 * dt:g} ms: after {moment:.2f} s, {reason}", highlight=False)


def main(cfg: Config, console: Console | None = None) -> dict[float, dict[str, Figures]]:
    """Run everything, print, and return the figures by physics step and behaviour."""
    if not cfg.behaviours or not cfg.steps or cfg.episodes < 1 or cfg.settle < 0 or cfg.seconds < cfg.settle + 1.0:
        raise ValueError(
            "expected one of --behaviours, --steps and --episodes, and --seconds at least 1 s longer than --settle >= 0"
        )
    if cfg.output is not None and cfg.output.suffix != ".json":
        raise ValueError(f"expected --output to end in .json, got {cfg.output}")
    console, begin = console or cli.console(140), time.monotonic()
    artifact = Artifact.load(cfg.run, kind="bbc")
    friction = artifact.manifest.get("simulation", {}).get("friction_loss", 0.0)
    friction = friction if cfg.friction_loss is None else cfg.friction_loss
    skill = torch.tensor([skill_index(name) for name in cfg.behaviours]).repeat_interleave(cfg.episodes)
    command = sample_commands(skill, torch.Generator().manual_seed(cfg.seed))
    found: dict[float, dict[str, Figures]] = {}
    bbc = DeployedBBC(torch_network(artifact), artifact)
    for dt in cfg.steps:
        robot = SimulatedRobot(sim_dt=dt, command_timeout=None, friction_loss=friction)
        told = [BehaviourCommand(index, wanted) for index, wanted in zip(skill.tolist(), command, strict=True)]
        episodes = [run_episode(robot, bbc, order, cfg.seconds) for order in told]
        found[dt] = summarise(episodes, skill, command, cfg.settle)
    print_tables(found, cfg, console)
    console.print(f"{len(cfg.steps) * len(skill)} episodes in {time.monotonic() - begin:.0f} s", highlight=False)
    if cfg.output is not None:
        by_name = {f"{1e3 * dt:g} ms": rows for dt, rows in found.items()}
        settings = {
            "settings": cfg,
            "weights": artifact.manifest["weights"]["sha256"],
            "versions": run_folder.versions(),
        }
        cfg.output.parent.mkdir(parents=True, exist_ok=True)
        run_folder.write_json(cfg.output, to_json({**settings, "physics steps": by_name}))
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__))
