"""Let a controller that only goes straight ahead walk along curves, by geometry: it lives in a straight world that is
bent as a whole (``agility_rl/bending.py``), and neither its observations nor its feet leave that world.

It leans into the curve by seeing itself lean out of it. What it does so is rough, and a fast robot still falls, but its
steps are right: a teacher for ``bbc_distill.py``, after which PPO learns the balance. Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import COMMANDS
from agility_rl.bending import TIGHTEST, bend_points, straighten_points
from agility_rl.go2 import constants, features
from agility_rl.go2.kinematics import forward, inverse

SLOWEST = 0.25
"""Slower robots turn as if they walked this fast [m/s]."""
FARTHEST = 0.6
"""Most that a joint is moved by the bend [rad]: near a stretched leg inverse kinematics asks for anything."""
LEAN = 3.0
"""Roll error that the controller is shown in a curve, in units of the lean that balances the centrifugal force,
v |w| / g. It answers an error by a part of it only: with 3 a pace fell half as often as with 1 (11 and 21 of 32)."""
STEP = 0.01
"""Seconds of motion by which the speed of a bent joint is measured."""
SPEED, TURN = COMMANDS.index("velocity_x"), COMMANDS.index("yaw_rate")


def commanded_curvature(command: Tensor) -> Tensor:
    """Curvature ``[B]`` [1/m] of the path that a command vector asks for."""
    return (command[:, TURN] / command[:, SPEED].clamp(min=SLOWEST)).clamp(-TIGHTEST, TIGHTEST)


def move_joints(joints: Tensor, curvature: Tensor, bend: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Joints ``[B, 12]`` whose feet stand where ``bend`` puts those of the given ones."""
    feet = forward(joints)
    moved = inverse(bend(feet, curvature[:, None])) - inverse(feet)
    return joints + moved.nan_to_num().clamp(-FARTHEST, FARTHEST)


def straighten(observation: TensorDictBase) -> TensorDictBase:
    """What the controller would observe in its straight world, with no turn commanded."""
    observation = observation.copy()
    curvature = commanded_curvature(observation[keys.COMMAND])
    proprioception, command = observation[keys.PROPRIOCEPTION].clone(), observation[keys.COMMAND].clone()
    parts = {
        entry.name: proprioception[:, features.layout_slice(features.PROPRIOCEPTION_LAYOUT, entry.name)]
        for entry in features.PROPRIOCEPTION_LAYOUT
    }
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
    joints, speeds = parts["joint_position"] + pose, parts["joint_velocity"] / features.JOINT_VELOCITY_SCALE
    before, after = (move_joints(joints + sign * STEP * speeds, curvature, straighten_points) for sign in (-1.0, 1.0))
    parts["joint_position"][:] = move_joints(joints, curvature, straighten_points) - pose
    parts["joint_velocity"][:] = (after - before) / (2 * STEP) * features.JOINT_VELOCITY_SCALE
    target = move_joints(parts["last_action"] * scale + pose, curvature, straighten_points)
    parts["last_action"][:] = (target - pose) / scale
    turn = curvature * command[:, SPEED]
    parts["angular_velocity"][:, 2] -= turn * features.ANGULAR_VELOCITY_SCALE
    parts["roll_pitch"][:, 0] += LEAN * command[:, SPEED] * turn / constants.GRAVITY
    command[:, TURN] = 0.0
    observation[keys.PROPRIOCEPTION], observation[keys.COMMAND] = proprioception, command
    return observation


def steered(act: Callable[[TensorDictBase], Tensor]) -> Callable[[TensorDictBase], Tensor]:
    """Mean actions ``[B, 12]`` along the commanded curve, of a controller that acts in the straight world."""

    def bent(observation: TensorDictBase) -> Tensor:
        pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
        target = act(straighten(observation)) * scale + pose
        return (move_joints(target, commanded_curvature(observation[keys.COMMAND]), bend_points) - pose) / scale

    return bent
