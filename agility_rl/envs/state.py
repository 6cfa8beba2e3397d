"""What the terms of an environment may look at after one control step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from agility_rl.go2 import kinematics


@dataclass
class LocomotionState:
    """Physical state, last actions and commands of ``N`` robots; every reward and termination is a function of it.

    Attributes:
        root_height: ``[N, 1]`` trunk height over the terrain [m].
        roll: ``[N]`` [rad].
        pitch: ``[N]`` [rad].
        yaw: ``[N]`` [rad].
        linear_velocity: ``[N, 3]`` [m/s], base frame.
        mean_velocity: ``[N, 3]`` [m/s], base frame, averaged over the last 0.5 s with exponential weights.
        mean_yaw_rate: ``[N]`` [rad/s], about the base's z axis, averaged likewise.
        angular_velocity: ``[N, 3]`` [rad/s], base frame.
        joint_position: ``[N, 12]`` [rad].
        joint_velocity: ``[N, 12]`` [rad/s].
        previous_joint_velocity: ``[N, 12]`` one control step earlier.
        torque: ``[N, 12]`` PD torque before the limits [N m], towards the targets that the motors have.
        previous_torque: ``[N, 12]``.
        action: ``[N, 12]``.
        previous_action: ``[N, 12]``.
        trunk_contact: ``[N]`` force on the trunk [N].
        hip_contact: ``[N, 4]`` [N].
        thigh_contact: ``[N, 4]`` [N].
        calf_contact: ``[N, 4]`` [N].
        foot_contact: ``[N, 4]`` [N].
        command: ``[N, 5]`` in the order of :data:`agility_rl.behaviours.COMMANDS`.
        jumping: bool ``[N]``, the skill is jump.
        peak_height: ``[N]`` highest trunk of the last 0.9 s [m].
        rhythm: ``[N]`` how much of the feet's motion follows the commanded pattern, times its emphasis (0 without).
        low_feet: ``[N]`` by how much feet that come to a box are lower than its top, all together [m] (0 without).
        unstable: bool ``[N]``, the engine reported divergence.
        dt: control step [s].
    """

    root_height: Tensor
    roll: Tensor
    pitch: Tensor
    yaw: Tensor
    linear_velocity: Tensor
    mean_velocity: Tensor
    mean_yaw_rate: Tensor
    angular_velocity: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    previous_joint_velocity: Tensor
    torque: Tensor
    previous_torque: Tensor
    action: Tensor
    previous_action: Tensor
    trunk_contact: Tensor
    hip_contact: Tensor
    thigh_contact: Tensor
    calf_contact: Tensor
    foot_contact: Tensor
    command: Tensor
    jumping: Tensor
    peak_height: Tensor
    rhythm: Tensor
    low_feet: Tensor
    unstable: Tensor
    dt: float

    @cached_property
    def feet(self) -> Tensor:
        """Centres of the feet ``[N, 4, 3]`` [m], base frame; computed once, whoever asks."""
        return kinematics.forward(self.joint_position)
