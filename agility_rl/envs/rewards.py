"""Reward terms of locomotion: functions of a :class:`LocomotionState`, each ``-> [N]``, without weight or time step.

Sources: supplement S4 for the regularisation terms; the task terms are missing there and come from the released code
(method notes, section 4.4). The environment multiplies each term by its weight and the control step, logs it by name,
and clips the sum at zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import constants
from agility_rl.tensors import constant

RewardFunction = Callable[[LocomotionState], Tensor]

TRACKING_WIDTH = 0.25
"""Denominator of the tracking exponentials [(m/s)^2, (rad/s)^2] (released code)."""
COLLISION_FORCE = 0.1
"""Contact force that counts as a collision [N] (released code)."""


class RewardTerm(NamedTuple):
    """A reward function and its weight."""

    weight: float
    function: RewardFunction


SLOW = 0.1
"""Below this commanded speed a miss counts as at it [m/s]."""


LATERAL_WIDTH = 0.3
"""Miss of the sideways speed at which :func:`lateral_progress` pays nothing [m/s]: the trot's largest command."""


def linear_velocity(state: LocomotionState) -> Tensor:
    """``exp(-|v*_xy - v_xy|^2 / 0.25)``, base frame."""
    error = (state.command[:, :2] - state.linear_velocity[:, :2]).square().sum(-1)
    return torch.exp(-error / TRACKING_WIDTH)


def yaw_rate(state: LocomotionState) -> Tensor:
    """``exp(-(w* - w_z)^2 / 0.25)``."""
    return torch.exp(-(state.command[:, 2] - state.angular_velocity[:, 2]).square() / TRACKING_WIDTH)


def velocity_progress(state: LocomotionState) -> Tensor:
    """``max(1 - |v - v*| / max(v*, 0.1 m/s), -1)``, v the mean speed in the commanded direction, v* the commanded one.

    Ours: it pays nothing for standing and has a slope there, where the exponential of :func:`linear_velocity` has
    almost none, and it is as steep for a slow walk as for a canter. What goes sideways is the exponential's part.
    The mean of the last half second counts: within a stride the speed of a walking dog changes by a third, and
    who is paid for a constant one shuffles. Where none is commanded any direction is the commanded one.
    """
    wanted, shown = state.command[:, :2], state.mean_velocity[:, :2]
    speed = wanted.norm(dim=-1)
    along = torch.where(speed > 0.0, (wanted * shown).sum(-1) / speed.clamp(min=1e-6), shown.norm(dim=-1))
    return (1.0 - (along - speed).abs() / speed.clamp(min=SLOW)).clamp(min=-1.0)


def turn_progress(state: LocomotionState) -> Tensor:
    """``max(1 - |w - w*| / 1 rad/s, -1)``, w the mean turn rate of the last half second.

    Ours: the exponential of :func:`yaw_rate` has no slope where a robot goes straight and should turn by 1 rad/s, and
    the trunk of a galloping dog yaws within its stride.
    """
    return (1.0 - (state.mean_yaw_rate - state.command[:, 2]).abs()).clamp(min=-1.0)


def lateral_progress(state: LocomotionState) -> Tensor:
    """``max(1 - |v_y - v_y*| / 0.3 m/s, -1)``, v_y the mean sideways speed of the last half second, base frame.

    Ours: :func:`velocity_progress` does not see what goes sideways, and who drifts in a turn by 0.15 m/s still earns
    0.91 of :func:`linear_velocity`. A gate that is 0.6 m wide is then missed.
    """
    miss = (state.mean_velocity[:, 1] - state.command[:, 1]).abs()
    return (1.0 - miss / LATERAL_WIDTH).clamp(min=-1.0)


def rhythm(state: LocomotionState) -> Tensor:
    """How much of the feet's fore-aft motion has the stride frequency and the phases of the behaviour's clips.

    Ours: :class:`agility_rl.envs.rhythm.Rhythm`, in environments that have a pattern.
    """
    return state.rhythm


def low_feet(state: LocomotionState) -> Tensor:
    """By how much the feet that come to a box are lower than its top, of all together [m].

    Ours: whether a robot gets onto a box is settled half a second before it falls, when its feet come to the edge.
    """
    return state.low_feet


def jump_height_window(state: LocomotionState) -> Tensor:
    """10 while jumping and within 5 cm of the commanded height (released code)."""
    near = (state.command[:, 3] - state.root_height[:, 0]).abs() < 0.05
    return 10.0 * (near & state.jumping)


def jump_height_peak(state: LocomotionState, width: float = 0.01) -> Tensor:
    """``exp(-(h* - h_max)^2 / width)`` with the highest trunk of the last 0.9 s.

    Our alternative to the window: it has a slope everywhere and does not pay for staying high. A beginner misses by
    0.2 m, where a width of 0.04 m^2 has five times the slope of 0.01.
    """
    miss = state.command[:, 3] - state.peak_height
    return torch.exp(-miss.square() / width) * state.jumping


def locomotion_height(state: LocomotionState) -> Tensor:
    """``exp(-10 (h* - h)^2 / 0.25)`` while not jumping (released code)."""
    miss = state.command[:, 4] - state.root_height[:, 0]
    return torch.exp(-10.0 * miss.square() / 0.25) * ~state.jumping


def torque(state: LocomotionState) -> Tensor:
    """Sum of squared PD torques before the limits [(N m)^2] (S4)."""
    return state.torque.square().sum(-1)


def torque_change(state: LocomotionState) -> Tensor:
    """Sum of squared torque changes from one control step to the next [(N m)^2] (S4)."""
    return (state.torque - state.previous_torque).square().sum(-1)


def joint_acceleration(state: LocomotionState) -> Tensor:
    """Sum of squared joint accelerations by finite differences [(rad/s^2)^2] (S4)."""
    return ((state.joint_velocity - state.previous_joint_velocity) / state.dt).square().sum(-1)


def joint_position_limit(state: LocomotionState) -> Tensor:
    """Sum of excursions beyond 0.9 of the joint range [rad] (S4; factor: released code)."""
    device = state.joint_position.device
    lower, upper = (constant(limits, device) for limits in constants.soft_joint_limits())
    return ((lower - state.joint_position).clamp(min=0) + (state.joint_position - upper).clamp(min=0)).sum(-1)


def joint_velocity_limit(state: LocomotionState) -> Tensor:
    """Sum of joint speeds beyond the limit, each at most 1 [rad/s] (S4)."""
    limit = constant(constants.VELOCITY_LIMIT, state.joint_velocity.device)
    return (state.joint_velocity.abs() - limit).clamp(0.0, 1.0).sum(-1)


def torque_limit(state: LocomotionState) -> Tensor:
    """Sum of PD torques beyond the limit [N m] (S4)."""
    limit = constant(constants.TORQUE_LIMIT, state.torque.device)
    return (state.torque.abs() - limit).clamp(min=0).sum(-1)


def collision(state: LocomotionState) -> Tensor:
    """Number of thighs and calves in contact (weight: S4; that they are counted: released code)."""
    return (torch.cat((state.thigh_contact, state.calf_contact), -1) > COLLISION_FORCE).sum(-1).float()


def action_smoothness(state: LocomotionState) -> Tensor:
    """Sum of squared action changes (S4)."""
    return (state.action - state.previous_action).square().sum(-1)


def hip_deviation(state: LocomotionState) -> Tensor:
    """Sum of squared hip angles from the default pose [rad^2] (released code)."""
    return _from_default(state)[:, ::3].square().sum(-1)


def pose_deviation(state: LocomotionState) -> Tensor:
    """Sum of squared joint angles from the default pose [rad^2] (released code)."""
    return _from_default(state).square().sum(-1)


def _from_default(state: LocomotionState) -> Tensor:
    return state.joint_position - constant(constants.DEFAULT_POSE, state.joint_position.device)


LOCOMOTION_REWARDS: Mapping[str, RewardTerm] = {
    "linear_velocity": RewardTerm(2.0, linear_velocity),
    "yaw_rate": RewardTerm(1.5, yaw_rate),
    "jump_height": RewardTerm(0.2, jump_height_window),
    "locomotion_height": RewardTerm(0.1, locomotion_height),
    "torque": RewardTerm(-1e-5, torque),
    "torque_change": RewardTerm(-1e-7, torque_change),
    "joint_acceleration": RewardTerm(-2.5e-7, joint_acceleration),
    "joint_position_limit": RewardTerm(-0.1, joint_position_limit),
    "joint_velocity_limit": RewardTerm(-0.1, joint_velocity_limit),
    "torque_limit": RewardTerm(-0.03, torque_limit),
    "collision": RewardTerm(-10.0, collision),
    "action_smoothness": RewardTerm(-0.1, action_smoothness),
    "hip_deviation": RewardTerm(-0.5, hip_deviation),
    "pose_deviation": RewardTerm(-0.1, pose_deviation),
}
"""Weights of supplement S4 where it has them, else of the released code. The weight of ``joint_velocity_limit`` is
unreadable in S4 and taken from the released code."""
