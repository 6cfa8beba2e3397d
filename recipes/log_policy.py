"""What acts while a robot log is recorded, and again in the search that explains the log: it must be the same.

A trained controller follows a schedule of commands that repeats; without one, a synthetic trot is played without
feedback. Both depend only on the time since the robot's last reset, so that log and search go through the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from rollouts import load_controller
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.behaviours import command_bounds, command_vector, skill_index
from agility_rl.collectors import BehaviourPolicy
from agility_rl.collectors.rollout import MeasuredPolicy
from agility_rl.go2 import constants
from agility_rl.motion import synthesize_gait
from agility_rl.motion.tracking import joint_targets

SWINGS = ((0.2, 0.0), (-0.2, 0.0), (0.0, 0.6), (0.0, -0.6))
"""Pieces of the open-loop trot, lateral speed [m/s] and turn rate [rad/s]: straight ahead, hips would hardly move."""
SWING_SIZE = 0.5
"""Share of the gait's joint motion that is played; a full stride without feedback ends on the trunk."""
TURN = 0.5
"""Share of the fastest turn of a behaviour that is commanded, to the left and to the right."""
OPEN_LOOP = "open-loop trot"


@dataclass(frozen=True)
class Actor:
    """A policy over measurements, and what identifies it."""

    policy: MeasuredPolicy
    name: str
    """Checksum of the weights, or :data:`OPEN_LOOP`."""
    friction_loss: float
    """Dry friction of the joints for which it was made [N m]."""


class OpenLoop:
    """Play a table of actions ``[T, 12]`` from every robot's reset on, again and again."""

    def __init__(self, actions: Tensor) -> None:
        self.actions = actions
        self._step = torch.zeros(0, dtype=torch.int64)

    def __call__(self, measured: TensorDictBase) -> Tensor:
        """Actions ``[N, 12]``."""
        if len(self._step) != len(measured):
            self._step = torch.zeros(len(measured), dtype=torch.int64)
        self._step = torch.where(measured["is_init"][:, 0], 0, self._step + 1)
        return self.actions[self._step % len(self.actions)]


def make_actor(run: Path | None, behaviours: Sequence[str], command_seconds: float) -> Actor:
    """The controller of a run or artifact folder on its schedule, or the open-loop trot without one.

    Raises:
        ValueError: if a behaviour is unknown, there is none, a piece is shorter than a step, or the artifact is no BBC.
        FileNotFoundError: if there is no such folder.
    """
    steps = round(command_seconds / constants.CONTROL_DT)
    if steps < 1 or not behaviours:
        raise ValueError(f"expected --command-seconds of at least {constants.CONTROL_DT} and at least one --behaviours")
    if run is None:
        return Actor(OpenLoop(swing_actions(steps)), OPEN_LOOP, constants.FRICTION_LOSS)
    table = commands(behaviours)
    controller = load_controller(run)
    return Actor(
        BehaviourPolicy(controller.bbc.deployable_policy(), lambda step: table[step // steps % len(table)]),
        controller.artifact.manifest["weights"]["sha256"],
        controller.friction_loss,
    )


def commands(behaviours: Sequence[str]) -> Tensor:
    """Command vectors ``[2 B, 11]``: every behaviour in mid-range (Table S2), turning left, then right."""
    rows = []
    low, high = command_bounds()
    for skill in (skill_index(name) for name in behaviours):
        for turn in (TURN, -TURN):
            command = (low[skill] + high[skill]) / 2
            command[2] = turn * high[skill, 2]
            rows.append(command_vector(torch.tensor(skill), command, torch.zeros(1)))
    return torch.stack(rows)


def swing_actions(steps: int) -> Tensor:
    """Actions ``[4 steps, 12]`` of a trot on the spot: to the left, to the right, turning left, turning right."""
    pieces = []
    for lateral, turn in SWINGS:
        duration = (steps + 1) * constants.CONTROL_DT
        clip = synthesize_gait("trot", speed=0.0, lateral=lateral, yaw_rate=turn, duration=duration)
        pieces.append(joint_targets(clip)[:steps].float())
    target = torch.cat(pieces)
    middle = target.mean(0)
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
    return (middle + SWING_SIZE * (target - middle) - pose) / scale


def checksum(file: Path) -> str:
    """SHA-256 of a file, by which a resumed search knows its log again."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
