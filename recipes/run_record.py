"""What ``deploy.py`` writes of a run, for eyes and as a robot log."""

from __future__ import annotations

import torch

from agility_rl import rotations
from agility_rl.behaviours import COMMANDS
from agility_rl.collectors.log_formats import AXES
from agility_rl.deploy import DeployedBBC, DeployedStudent
from agility_rl.deploy.controller import StepRecord
from agility_rl.go2 import constants, features
from agility_rl.record import EpisodeRecorder


class Recorder:
    """Writes every control step: for eyes, and in the form of a robot log.

    Rows into which no transition of the behaviour controller leads have ``start`` 1: standing up, damping, and steps
    that came too early or too late after the one before.
    """

    def __init__(self, episode: EpisodeRecorder, bbc: DeployedBBC, task: DeployedStudent | None = None) -> None:
        self.episode, self.bbc, self.task = episode, bbc, task
        self._begun: float | None = None

    def __call__(self, step: StepRecord) -> None:
        """Write one control step, once the robot has spoken."""
        state = step.state
        if state is None:
            return
        self._begun = step.time if self._begun is None else self._begun
        action = step.action
        if action is None:
            driven = step.command.stiffness > 0
            action = torch.where(driven, (step.command.position - self.bbc.default_pose) / self.bbc.action_scale, 0.0)
        height = float(step.estimate[0]) if step.estimate is not None else 0.0
        position = torch.tensor([0.0, 0.0, height]) if state.trunk_position is None else state.trunk_position
        roll, pitch, _ = rotations.to_euler(state.quaternion)
        command = torch.zeros(len(COMMANDS)) if step.behaviour is None else step.behaviour.command
        self.episode.record(
            position,
            state.quaternion,
            state.joint_position,
            joint_velocity=state.joint_velocity,
            joint_torque=state.joint_torque,
            foot_contact=state.foot_force > features.FOOT_CONTACT_FORCE,
            signals={
                "roll_pitch": {"roll": float(roll), "pitch": float(pitch)},
                "angular_velocity": dict(zip(AXES, state.angular_velocity.tolist(), strict=True)),
                "linear_acceleration": dict(zip(AXES, state.linear_acceleration.tolist(), strict=True)),
                "action": dict(zip(constants.JOINT_NAMES, action.tolist(), strict=True)),
                "start": {"value": float(not step.continues)},
                "command": dict(zip(COMMANDS, command.tolist(), strict=True)),
                "controller": {
                    "mode": str(step.mode),
                    "behaviour": "" if step.behaviour is None else step.behaviour.name,
                    "estimated_height": height,
                },
                "foot_force": dict(zip(constants.LEGS, state.foot_force.tolist(), strict=True)),
                "timing": {
                    "time": step.time - self._begun,
                    "state_age": step.time - state.time,
                    "lateness": step.lateness,
                    "duration": step.duration,
                },
                **({} if self.task is None else {"perceived": perceived(self.task)}),
            },
        )


def perceived(task: DeployedStudent) -> dict[str, float]:
    """What a student makes of what it sees."""
    here, later = task.heading.tolist()
    return {"heading": here, "next_heading": later, "obstacle": float(task.obstacle)}
