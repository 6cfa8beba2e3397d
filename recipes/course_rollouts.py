"""What an evaluation on a course runs: a teacher or a script decides, robots walk, whole episodes are recorded."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rollouts import Controller, load_controller
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tsc_config import Config as TeacherConfig

from agility_rl import behaviours, keys
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.envs import AgilityEnv
from agility_rl.envs.decisions import NUM_PARAMETERS
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.rewards import COLLISION_FORCE
from agility_rl.go2 import constants, features
from agility_rl.modules import Teacher

Decide = Callable[[TensorDictBase], TensorDictBase]
"""Observations of a course to decisions under ``action``."""
STEERING = 2.0
"""Turn rate that a script commands for each radian of heading error [1/s]."""
COLLIDING = (*constants.THIGH_GROUPS, *constants.CALF_GROUPS)
TIME, WALKED_AROUND = "time", "walked around"
"""Why an episode has no success, beside the environment's failures."""


@dataclass(frozen=True)
class Decider:
    """What decides, how often, and the Basic Behaviour Controller that it tells."""

    decide: Decide
    decision_steps: int
    controller: Controller
    name: str
    run: Path | None
    weights: str | None
    course: str
    """Course that it was trained on."""
    behaviours: tuple[str, ...]
    """Behaviours that it may choose."""


@dataclass(frozen=True)
class Episode:
    """One whole episode of one robot.

    Attributes:
        start: ``[3]``, where the trunk was before the first step [m].
        steps: ``[T]`` control steps: ``position`` [T, 3] after the step [m], ``behaviour`` and ``obstacle`` (type)
            int64 [T], ``touching`` bool [T, 8], thighs and calves.
        passed, bypassed, failed: int64 ``[7]``, how often each type of obstacle was.
        cause: why it was no success; empty for a success.
        layout: the course as it was drawn, for :class:`CourseLayout`, one row.
    """

    start: Tensor
    steps: TensorDict
    passed: Tensor
    bypassed: Tensor
    failed: Tensor
    cause: str
    layout: dict[str, Any]

    @property
    def success(self) -> bool:
        """All way-points were reached, and no obstacle was walked around."""
        return not self.cause

    @property
    def path(self) -> Tensor:
        """Trunk from above, ``[T + 1, 2]`` [m]."""
        return torch.cat((self.start[None], self.steps["position"]))[:, :2]

    def collisions(self) -> Tensor:
        """Bool ``[T]``: a thigh or calf begins to touch something; ``[T, 8]`` tells which."""
        touching = self.steps["touching"]
        before = torch.cat((torch.zeros_like(touching[:1]), touching[:-1]))
        return touching & ~before


def load_teacher(path: Path, bbc: Path | None, allowed: Sequence[str] | None) -> Decider:
    """The deterministic deployable teacher of a run or artifact folder, with the controller that it was trained on.

    Args:
        path: run or artifact folder.
        bbc: folder of the controller; that of the training by default.
        allowed: behaviours that it may choose; those of the training by default.

    Raises:
        FileNotFoundError: if something is missing.
        ArtifactError: if it is damaged, no teacher, or was trained on another controller.
        ValueError: if a behaviour is unknown.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected the folder of a run or an artifact, found none; check the path")
    run = path.parent if path.name == "policy" else path
    artifact = Artifact.load(path / "policy" if (path / "policy").is_dir() else path)
    manifest = artifact.manifest
    if manifest["kind"] != "teacher" or "network" not in manifest:
        raise ArtifactError(
            f"{artifact.folder}: expected a teacher of tsc_teacher.py, got an artifact of kind {manifest['kind']!r}; "
            "a BBC decides nothing: give it as --bbc, with a teacher or with --script BEHAVIOUR:SPEED"
        )
    artifact.check_layout(keys.PROPRIOCEPTION, features.PROPRIOCEPTION_LAYOUT)
    network = dict(manifest["network"])
    if network["num_obstacles"] != len(OBSTACLES):
        raise ArtifactError(
            f"{artifact.folder}: knows {network['num_obstacles']} types of obstacles, expected {len(OBSTACLES)}"
        )
    known = range(behaviours.NUM_BEHAVIOURS) if network["allowed"] is None else network["allowed"]
    if allowed is not None:
        network["allowed"] = sorted(behaviours.skill_index(name) for name in allowed)
        if not allowed or not set(network["allowed"]) <= set(known):
            names = ", ".join(behaviours.BEHAVIOURS[index] for index in known)
            raise ValueError(f"--behaviours: expected some of those that it was trained with, {names}; got {allowed}")
    teacher = Teacher(**network)
    mask = teacher.actor.network.mask.clone()
    try:
        teacher.load_state_dict(artifact.state)
    except RuntimeError as error:
        raise ArtifactError(f"{artifact.folder}: the weights are not those of the network it names: {error}") from error
    teacher.actor.network.mask.copy_(mask)
    controller = load_controller(bbc or trained_bbc(run))
    digest = controller.artifact.manifest["weights"]["sha256"]
    if manifest.get("bbc") != digest:
        raise ArtifactError(
            f"{controller.artifact.folder} holds the BBC {digest[:12]}, but {artifact.folder} was trained on "
            f"{str(manifest.get('bbc'))[:12]}; give that one as --bbc"
        )
    return Decider(
        teacher.deployable_policy(),
        round(manifest["control_period"] / constants.CONTROL_DT),
        controller,
        run.name,
        run,
        manifest["weights"]["sha256"],
        manifest.get("course", "full"),
        tuple(behaviours.BEHAVIOURS[index] for index in network["allowed"] or known),
    )


def trained_bbc(run: Path) -> Path:
    """Where a run's configuration says its controller was, else where the pretrained one is."""
    file = run / "config.json"
    if not file.is_file():
        return TeacherConfig().bbc
    try:
        return Path(json.loads(file.read_text(encoding="utf-8"))["config"]["bbc"])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is damaged or no run's configuration: {error}; give the BBC as --bbc") from error


def load_script(script: str, bbc: Path | None) -> Decider:
    """One behaviour at one speed, turned towards the way-point; everything else in the middle of its range.

    Args:
        script: ``BEHAVIOUR:SPEED``, speed in m/s.
        bbc: folder of the controller; the pretrained one by default.

    Raises:
        ValueError: if it is no such text, or the behaviour has no such speed.
    """
    name, _, number = script.partition(":")
    try:
        skill, speed = behaviours.skill_index(name), float(number)
    except ValueError as error:
        raise ValueError(f"--script: expected BEHAVIOUR:SPEED such as trot:1.2, got {script!r} ({error})") from None
    low, high = behaviours.command_bounds()
    slowest, fastest = low[skill, 0].item(), high[skill, 0].item()
    if not slowest - 1e-6 <= speed <= fastest + 1e-6:
        raise ValueError(f"--script: {name} goes at {slowest:g} to {fastest:g} m/s (Table S2), got {number} m/s")
    turn = behaviours.COMMANDS.index("yaw_rate")

    def decide(td: TensorDictBase) -> TensorDictBase:
        n = len(td)
        parameters = torch.zeros(n, behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS)
        parameters[:, skill, 0] = 2.0 * (speed - slowest) / (fastest - slowest) - 1.0
        parameters[:, skill, turn] = STEERING * td[keys.HEADING_ERROR][:, 0] / high[skill, turn]  # clipped by the env
        decision = {keys.BEHAVIOUR: torch.full((n,), skill), keys.PARAMETERS: parameters}
        return td.set(keys.ACTION, TensorDict(decision, td.batch_size))

    label = f"script_{name}_{speed:g}"
    return Decider(decide, 1, load_controller(bbc or TeacherConfig().bbc), label, None, None, "full", (name,))


def record_episodes(
    env: AgilityEnv,
    decider: Decider,
    quota: Tensor,
    progress: Callable[[], object] = lambda: None,
) -> list[Episode]:
    """The first ``quota`` ``[N]`` episodes of every robot, whole ones.

    How many count is settled before anything runs: to stop at a number of finished episodes would count more of those
    that end early. The environment takes a decision at every control step, so that paths and times have 20 ms; a
    decision is held here for as long as the teacher was trained to.
    """
    if env.decision_steps != 1:
        raise ValueError(f"expected an environment that decides at every control step, got {env.decision_steps}")
    n, left = env.num_robots, quota.clone()
    rows, age = torch.arange(n), torch.zeros(n, dtype=torch.int64)
    outcomes = {name: torch.zeros(n, len(OBSTACLES), dtype=torch.int64) for name in ("passed", "bypassed", "failed")}
    episodes: list[Episode] = []
    td = env.reset()
    start = env.simulator.root_position.clone()
    held = TensorDict({}, [n])
    tape = TensorDict({}, [n, env.max_steps])
    while bool((left > 0).any()):
        kind = td[keys.OBSTACLE].argmax(-1)
        fresh = age % decider.decision_steps == 0
        if bool(fresh.any()):
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                decision = decider.decide(td)[keys.ACTION].select(keys.BEHAVIOUR, keys.PARAMETERS)
            held = decision.clone() if held.is_empty() else torch.where(fresh, decision, held)
        td = env.step(td.set(keys.ACTION, held))["next"]
        step = {
            "position": env.simulator.root_position.clone(),
            "behaviour": held[keys.BEHAVIOUR],
            "obstacle": kind,
            "touching": env.simulator.contact_force[:, list(COLLIDING)] > COLLISION_FORCE,
        }
        if tape.is_empty():
            shape = (n, env.max_steps)
            tape = TensorDict({name: value.new_zeros(*shape, *value.shape[1:]) for name, value in step.items()}, shape)
        tape[rows, age] = TensorDict(step, [n])
        age = age + 1
        for name, total in outcomes.items():
            total += td[keys.OUTCOME, name]
        done = td["done"][:, 0]
        if not bool(done.any()):
            continue
        layout = env.arena.layout.state_dict()
        for robot in (done & (left > 0)).nonzero()[:, 0].tolist():
            counts = {name: total[robot].clone() for name, total in outcomes.items()}
            taken = tape[robot, : age[robot]].clone()
            drawn = {key: x[robot : robot + 1].clone() if isinstance(x, Tensor) else x for key, x in layout.items()}
            episodes.append(Episode(start[robot].clone(), taken, **counts, cause=cause_of(td[robot]), layout=drawn))
            progress()
        left = left - (done & (left > 0)).long()
        for total in outcomes.values():
            total[done] = 0
        age = age.masked_fill(done, 0)
        td = env.maybe_reset(td)
        start = torch.where(done[:, None], env.simulator.root_position, start)
    return episodes


def cause_of(end: TensorDictBase) -> str:
    """Why the episode of one robot ended here without success, the first reason that holds; empty for a success."""
    if end[keys.OUTCOME, "success"].item():
        return ""
    if end[keys.OUTCOME, "finished"].item():
        return WALKED_AROUND
    failures = [name for name, holds in end[keys.TERMINATIONS].items() if holds.item()]
    return failures[0] if failures else TIME


def shares(episodes: int, robots: int) -> Tensor:
    """Episodes of each robot ``[N]``, as evenly as it goes, for at most ``robots`` robots."""
    n = min(episodes, robots)
    return torch.full((n,), episodes // n) + (torch.arange(n) < episodes % n)


def way_points(layout: CourseLayout) -> Tensor:
    """All way-points of the first row's route in the world, ``[G, 2]`` [m]."""
    slots = layout.course.slots
    route = layout.route[0, : layout.length[0]].tolist()
    goals = []
    for index in route:
        local = torch.tensor(slots[index].goals)
        yaw = layout.yaw[0, index].item()
        turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
        goals.append(layout.position[0, index] + local @ turn.T)
    return torch.cat(goals)
