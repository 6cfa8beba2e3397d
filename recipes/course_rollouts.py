"""What an evaluation on a course runs: somebody decides, robots walk, whole episodes are recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from deciders import Decider
from disturbances import DISTURBANCES, Disturbance
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.rewards import COLLISION_FORCE
from agility_rl.go2 import constants
from agility_rl.simulation import Simulator

COLLIDING = (*constants.THIGH_GROUPS, *constants.CALF_GROUPS)
TIME, WALKED_AROUND = "time", "walked around"
"""Why an episode has no success, beside the environment's failures."""


@dataclass(frozen=True)
class Episode:
    """One whole episode of one robot.

    Attributes:
        start: ``[3]``, where the trunk was before the first step [m].
        steps: ``[T]`` control steps: ``position`` [T, 3] after the step [m], ``pose`` [T, 16 + H], quaternion, joints
            and the course's hinges [rad], ``behaviour`` and ``obstacle`` (type) int64 [T], ``touching`` bool [T, 8],
            thighs and calves.
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


def pose_of(simulator: Simulator) -> Tensor:
    """Quaternion, joint angles and the hinges of the course [rad], ``[N, 16 + H]``."""
    return torch.cat((simulator.root_quaternion, simulator.joint_position, simulator.hinge_angle), -1)


def record_episodes(
    env: AgilityEnv,
    decider: Decider,
    quota: Tensor,
    progress: Callable[[], object] = lambda: None,
    disturbance: Disturbance = DISTURBANCES["none"],
    seed: int = 0,
) -> list[Episode]:
    """The first ``quota`` ``[N]`` episodes of every robot, whole ones.

    How many count is settled before anything runs: to stop at a number of finished episodes would count more of those
    that end early. The environment takes a decision at every control step, so that paths and times have 20 ms; a
    decision is held here for as long as the teacher or student was trained to. ``disturbance`` is what a student's
    camera suffers, and ``seed`` that of its noise.
    """
    if env.decision_steps != 1:
        raise ValueError(f"expected an environment that decides at every control step, got {env.decision_steps}")
    n, left = env.num_robots, quota.clone()
    rows, age = torch.arange(n), torch.zeros(n, dtype=torch.int64)
    outcomes = {name: torch.zeros(n, len(OBSTACLES), dtype=torch.int64) for name in ("passed", "bypassed", "failed")}
    episodes: list[Episode] = []
    td = env.reset()
    senses = decider.senses(env, disturbance, seed)
    if senses is not None:
        senses.begin(torch.ones(n, dtype=torch.bool))
    start = env.simulator.root_position.clone()
    held = TensorDict({}, [n])
    tape = TensorDict({}, [n, env.max_steps])
    while bool((left > 0).any()):
        kind = env.arena.types[env.arena.progress.obstacle].int().argmax(-1)
        fresh = age % decider.decision_steps == 0
        if bool(fresh.any()):
            seen = td[fresh] if senses is None else senses.observe(td[fresh], fresh)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                decided = decider.decide(seen)
            if senses is not None:
                senses.remember(decided, fresh)
            decision = decided[keys.ACTION].select(keys.BEHAVIOUR, keys.PARAMETERS)
            if held.is_empty():  # every robot decides in the first step
                held = decision.clone()
            held[fresh] = decision
        td = env.step(td.set(keys.ACTION, held.clone()))["next"]
        if senses is not None:
            senses.advance()
        step = {
            "position": env.simulator.root_position.clone(),
            "pose": pose_of(env.simulator),
            "behaviour": held[keys.BEHAVIOUR].clone(),
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
        if senses is not None:
            senses.begin(done)
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
