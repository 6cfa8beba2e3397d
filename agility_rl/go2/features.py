"""Numbers that describe the robot's motion to networks: the one place from which every part of the package gets them.

The expert (a clip), the policy (a simulation) and the robot pass through the same functions, so they cannot disagree.

Source: method notes, section 3.2 (layouts of the released code). The 12 placeholder zeros of the released
proprioception are left out, which makes 45 numbers of its 57.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.tensors import constant

ANGULAR_VELOCITY_SCALE = 0.25
LINEAR_VELOCITY_SCALE = 0.5
JOINT_VELOCITY_SCALE = 0.05
CONTACT_HEIGHT = 0.025
"""A sole lower than this touches the ground [m] (released code's rule for the dog, used for the robot alike)."""
HISTORY = 10
"""Frames of proprioception history, the present one included (released code)."""
FOOT_CONTACT_FORCE = 2.0
"""Force on a foot that counts as contact [N], now or one control step earlier (released code)."""
OBSERVATION_LIMIT = 100.0
"""Measured numbers are clipped to +- this (released code)."""
PEAK_WINDOW = 0.9
"""Seconds over which the highest trunk position counts for a jump (ours, as is what observes it)."""


class Entry(NamedTuple):
    """One named part of a feature vector: its size, unit before scaling, scale, and uniform noise half-width [unit]."""

    name: str
    size: int
    unit: str
    scale: float = 1.0
    noise: float = 0.0


PROPRIOCEPTION_LAYOUT: tuple[Entry, ...] = (
    Entry("roll_pitch", 2, "rad", 1.0, 0.01),
    Entry("angular_velocity", 3, "rad/s, base frame", ANGULAR_VELOCITY_SCALE, 0.2),
    Entry("joint_position", 12, "rad from the default pose", 1.0, 0.01),
    Entry("joint_velocity", 12, "rad/s", JOINT_VELOCITY_SCALE, 1.5),
    Entry("last_action", 12, "action units"),
    Entry("foot_contact", 4, "contact flag - 0.5"),
)
"""45 measured numbers; noise half-widths: released code, level 1."""

EXPLICIT_LAYOUT: tuple[Entry, ...] = (
    Entry("root_height", 1, "m over the terrain"),
    Entry("linear_velocity", 3, "m/s, base frame", LINEAR_VELOCITY_SCALE, 0.1),
)
"""What the robot cannot measure; the half-width is the released one. Nobody reads it with noise: the actor has an
estimate, and the critic the truth."""

MOTION_LAYOUT: tuple[Entry, ...] = (
    Entry("roll_pitch", 2, "rad"),
    Entry("root_height", 1, "m over the terrain"),
    Entry("linear_velocity", 3, "m/s, base frame", LINEAR_VELOCITY_SCALE),
    Entry("angular_velocity", 3, "rad/s, base frame", ANGULAR_VELOCITY_SCALE),
    Entry("joint_position", 12, "rad from the default pose"),
    Entry("joint_velocity", 12, "rad/s", JOINT_VELOCITY_SCALE),
    Entry("foot_position", 12, "m from the trunk, heading frame"),
    Entry("foot_contact", 4, "1 when the sole is lower than 25 mm"),
)
"""49 numbers of one discriminator frame."""

PRIVILEGED_LAYOUT: tuple[Entry, ...] = (
    Entry("trunk_mass", 1, "kg, added"),
    Entry("trunk_com", 3, "m, offset"),
    Entry("ground_friction", 1, "1"),
    Entry("stiffness", 12, "share above the nominal one"),
    Entry("damping", 12, "share above the nominal one"),
)
"""29 numbers of the simulation that no robot measures."""

MEASUREMENT_LAYOUT: tuple[Entry, ...] = (
    Entry("roll_pitch", 2, "rad", 1.0, 0.01),
    Entry("angular_velocity", 3, "rad/s, base frame", 1.0, 0.2),
    Entry("joint_position", 12, "rad", 1.0, 0.01),
    Entry("joint_velocity", 12, "rad/s", 1.0, 1.5),
)
"""29 numbers of a state as a robot log holds it, in SI units: no trunk velocity, no contact. Noise as above."""

CONTROLLER_LAYOUTS: dict[str, tuple[Entry, ...]] = {
    "proprioception": PROPRIOCEPTION_LAYOUT,
    "explicit": EXPLICIT_LAYOUT,
}
"""What a controller measures and what it estimates, as its artifact's manifest names them."""

NUM_PROPRIOCEPTION = sum(entry.size for entry in PROPRIOCEPTION_LAYOUT)
NUM_EXPLICIT = sum(entry.size for entry in EXPLICIT_LAYOUT)
NUM_MOTION = sum(entry.size for entry in MOTION_LAYOUT)
NUM_PRIVILEGED = sum(entry.size for entry in PRIVILEGED_LAYOUT)
NUM_MEASUREMENT = sum(entry.size for entry in MEASUREMENT_LAYOUT)


MOTION_OFFSETS = (0, 1)
"""Frames that a discriminator sees together, in control steps from the oldest: two consecutive ones (Table S1)."""


def check_motion_offsets(offsets: Sequence[int]) -> None:
    """Refuse offsets of discriminator frames that do not rise from zero.

    Raises:
        ValueError: if they do not.

    Example:
        >>> check_motion_offsets((0, 8, 16))
    """
    if not offsets or offsets[0] != 0 or any(later <= earlier for earlier, later in pairwise(offsets)):
        raise ValueError(f"expected offsets of motion frames that rise from 0, such as (0, 1), got {tuple(offsets)}")


def layout_slice(layout: tuple[Entry, ...], name: str) -> slice:
    """Where a named entry stands in a feature vector.

    Raises:
        KeyError: if the layout has no such entry.

    Example:
        >>> layout_slice(MOTION_LAYOUT, "root_height")
        slice(2, 3, None)
    """
    start = 0
    for entry in layout:
        if entry.name == name:
            return slice(start, start + entry.size)
        start += entry.size
    raise KeyError(f"no entry {name!r}; the layout has {', '.join(entry.name for entry in layout)}")


def noise_scale(layout: tuple[Entry, ...], device: torch.device | str = "cpu") -> Tensor:
    """Half-width of the uniform observation noise of every number, scaled like the number itself."""
    return torch.tensor([entry.noise * entry.scale for entry in layout for _ in range(entry.size)], device=device)


def proprioception(
    roll_pitch: Tensor,
    angular_velocity: Tensor,
    joint_position: Tensor,
    joint_velocity: Tensor,
    last_action: Tensor,
    foot_contact: Tensor,
) -> Tensor:
    """What the robot measures, scaled for the networks.

    Args:
        roll_pitch: ``[*B, 2]`` [rad].
        angular_velocity: ``[*B, 3]`` [rad/s], base frame.
        joint_position: ``[*B, 12]`` [rad].
        joint_velocity: ``[*B, 12]`` [rad/s].
        last_action: ``[*B, 12]``, action units.
        foot_contact: bool ``[*B, 4]``.

    Returns:
        ``[*B, 45]`` laid out as :data:`PROPRIOCEPTION_LAYOUT`.
    """
    default = constant(constants.DEFAULT_POSE, joint_position.device, joint_position.dtype)
    return torch.cat(
        (
            roll_pitch,
            angular_velocity * ANGULAR_VELOCITY_SCALE,
            joint_position - default,
            joint_velocity * JOINT_VELOCITY_SCALE,
            last_action,
            foot_contact.to(joint_position.dtype) - 0.5,
        ),
        -1,
    )


def measurement(roll_pitch: Tensor, angular_velocity: Tensor, joint_position: Tensor, joint_velocity: Tensor) -> Tensor:
    """State of system identification, from a log and from a simulation alike.

    Args:
        roll_pitch: ``[*B, 2]`` [rad].
        angular_velocity: ``[*B, 3]`` [rad/s], base frame.
        joint_position: ``[*B, 12]`` [rad].
        joint_velocity: ``[*B, 12]`` [rad/s].

    Returns:
        ``[*B, 29]`` laid out as :data:`MEASUREMENT_LAYOUT`.
    """
    return torch.cat((roll_pitch, angular_velocity, joint_position, joint_velocity), -1)


def explicit(root_height: Tensor, linear_velocity: Tensor) -> Tensor:
    """Trunk height ``[*B, 1]`` [m] and base-frame velocity ``[*B, 3]`` [m/s] as ``[*B, 4]``, scaled."""
    return torch.cat((root_height, linear_velocity * LINEAR_VELOCITY_SCALE), -1)


def in_heading_frame(roll: Tensor, pitch: Tensor, feet: Tensor) -> Tensor:
    """Feet ``[*B, 4, 3]`` [m] of the base frame, turned upright but not by the yaw."""
    angles = torch.stack((roll, pitch))[..., None]
    (cr, cp), (sr, sp) = angles.cos(), angles.sin()
    x, y, z = feet.unbind(-1)
    left, up = cr * y - sr * z, sr * y + cr * z
    return torch.stack((cp * x + sp * up, left, cp * up - sp * x), -1)


def motion_frame(
    root_height: Tensor,
    roll: Tensor,
    pitch: Tensor,
    linear_velocity: Tensor,
    angular_velocity: Tensor,
    joint_position: Tensor,
    joint_velocity: Tensor,
    feet: Tensor | None = None,
) -> Tensor:
    """One discriminator frame, for a clip and for a simulation alike.

    Foot contact is judged by the height of the sole, because a clip knows no forces.

    Args:
        root_height: ``[*B, 1]`` [m] over the terrain.
        roll: ``[*B]`` [rad].
        pitch: ``[*B]`` [rad].
        linear_velocity: ``[*B, 3]`` [m/s], base frame.
        angular_velocity: ``[*B, 3]`` [rad/s], base frame.
        joint_position: ``[*B, 12]`` [rad].
        joint_velocity: ``[*B, 12]`` [rad/s].
        feet: result of :func:`~agility_rl.go2.kinematics.forward` if the caller has it already.

    Returns:
        ``[*B, 49]`` laid out as :data:`MOTION_LAYOUT`.

    Example:
        >>> pose = torch.tensor(constants.DEFAULT_POSE)
        >>> zero = torch.zeros(())
        >>> motion_frame(torch.tensor([0.29]), zero, zero, torch.zeros(3), torch.zeros(3), pose, torch.zeros(12)).shape
        torch.Size([49])
    """
    feet = in_heading_frame(roll, pitch, kinematics.forward(joint_position) if feet is None else feet)
    contact = (root_height + feet[..., 2] - constants.FOOT_RADIUS) < CONTACT_HEIGHT
    default = constant(constants.DEFAULT_POSE, joint_position.device, joint_position.dtype)
    return torch.cat(
        (
            torch.stack((roll, pitch), -1),
            root_height,
            linear_velocity * LINEAR_VELOCITY_SCALE,
            angular_velocity * ANGULAR_VELOCITY_SCALE,
            joint_position - default,
            joint_velocity * JOINT_VELOCITY_SCALE,
            feet.flatten(-2),
            contact.to(joint_position.dtype),
        ),
        -1,
    )


def clip_frames(
    root_height: Tensor,
    root_quaternion: Tensor,
    root_linear_velocity: Tensor,
    root_angular_velocity: Tensor,
    joint_position: Tensor,
    joint_velocity: Tensor,
) -> Tensor:
    """Discriminator frames of a recorded motion, whose root velocities are in the world frame.

    Args:
        root_height: ``[*B]`` [m] over the ground.
        root_quaternion: ``[*B, 4]``.
        root_linear_velocity: ``[*B, 3]`` [m/s], world frame.
        root_angular_velocity: ``[*B, 3]`` [rad/s], world frame.
        joint_position: ``[*B, 12]`` [rad].
        joint_velocity: ``[*B, 12]`` [rad/s].

    Returns:
        ``[*B, 49]`` laid out as :data:`MOTION_LAYOUT`.
    """
    roll, pitch, _ = rotations.to_euler(root_quaternion)
    return motion_frame(
        root_height[..., None],
        roll,
        pitch,
        rotations.rotate_inverse(root_quaternion, root_linear_velocity),
        rotations.rotate_inverse(root_quaternion, root_angular_velocity),
        joint_position,
        joint_velocity,
    )


def in_stance(foot_velocity: Tensor, velocity: Tensor) -> Tensor:
    """Whether feet stand that go forward over the ground at ``foot_velocity`` [m/s]: slower than half of the trunk's.

    Example:
        >>> in_stance(torch.tensor([0.1, 2.5]), torch.tensor(1.0))
        tensor([ True, False])
    """
    return foot_velocity < 0.5 * velocity.clamp(min=0.2)
