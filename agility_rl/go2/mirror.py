"""The left-right mirror image of what a robot measures and of what it is told: y changes sign, legs change places.

A robot that is built symmetrically does in a mirror what its image does outside.

Source: elementary geometry; that dogs and robots are symmetric is an assumption of ours.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from agility_rl.behaviours import COMMANDS
from agility_rl.go2.features import Entry
from agility_rl.tensors import constant

POLAR = (1.0, -1.0, 1.0)
"""Signs of a position or velocity (x, y, z) in the mirror."""
AXIAL = (-1.0, 1.0, -1.0)
"""Signs of an angular velocity, or of roll, pitch and yaw."""
HINGES = (-1.0, 1.0, 1.0)
"""Signs of a leg's hip, thigh and calf."""
OTHER_SIDE = (1, 0, 3, 2)
"""The leg that a leg becomes."""

_SIGNS: dict[str, tuple[float, ...]] = {
    "roll_pitch": AXIAL[:2],
    "root_height": (1.0,),
    "angular_velocity": AXIAL,
    "linear_velocity": POLAR,
    "trunk_mass": (1.0,),
    "trunk_com": POLAR,
    "ground_friction": (1.0,),
}
_LEG_SIGNS: dict[str, tuple[float, ...]] = {
    "joint_position": HINGES,
    "joint_velocity": HINGES,
    "last_action": HINGES,
    "foot_position": POLAR,
    "foot_contact": (1.0,),
    "stiffness": (1.0, 1.0, 1.0),
    "damping": (1.0, 1.0, 1.0),
}
_COMMAND_SIGNS = tuple(-1.0 if name in ("velocity_y", "yaw_rate") else 1.0 for name in COMMANDS)


def mirror_joints(joints: Tensor) -> Tensor:
    """Joint angles, velocities or actions ``[*B, 12]`` in the mirror: legs exchanged, hips negated.

    Example:
        >>> mirror_joints(torch.arange(12.0))[:6]
        tensor([-3.,  4.,  5., -0.,  1.,  2.])
    """
    signs = constant(HINGES, joints.device, joints.dtype)
    return (joints.unflatten(-1, (4, 3))[..., list(OTHER_SIDE), :] * signs).flatten(-2)


def mirror_features(layout: tuple[Entry, ...], values: Tensor) -> Tensor:
    """A feature vector ``[*B, F]`` in the mirror.

    Args:
        layout: names of its parts, such as :data:`agility_rl.go2.features.PROPRIOCEPTION_LAYOUT`.
        values: the vector.

    Raises:
        ValueError: if the layout has an entry that nobody knows the image of, or another size than the vector.

    Example:
        >>> from agility_rl.go2.features import EXPLICIT_LAYOUT
        >>> mirror_features(EXPLICIT_LAYOUT, torch.tensor([0.3, 1.0, 0.2, 0.1]))
        tensor([ 0.3000,  1.0000, -0.2000,  0.1000])
    """
    source, signs = _image(layout)
    if values.shape[-1] != len(source):
        raise ValueError(f"expected vectors of {len(source)} numbers for this layout, got {values.shape[-1]}")
    return values[..., constant(source, values.device, torch.int64)] * constant(signs, values.device, values.dtype)


def mirror_commands(command: Tensor) -> Tensor:
    """Command vectors ``[*B, 5 or more]`` in the mirror: sideways velocity and turn rate change sign.

    Numbers beyond the five commands (the shift, the one-hot behaviour) stay as they are.

    Example:
        >>> mirror_commands(torch.tensor([1.0, 0.1, 0.5, 0.0, 0.3]))
        tensor([ 1.0000, -0.1000, -0.5000,  0.0000,  0.3000])
    """
    signs = _COMMAND_SIGNS + (1.0,) * (command.shape[-1] - len(_COMMAND_SIGNS))
    return command * constant(signs, command.device, command.dtype)


@functools.cache
def _image(layout: tuple[Entry, ...]) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """For every number of a layout's image the number that it comes from, and the sign that it takes."""
    source: list[int] = []
    signs: list[float] = []
    for entry in layout:
        start = len(source)
        if entry.name in _SIGNS:
            source += range(start, start + entry.size)
            signs += _SIGNS[entry.name]
        elif entry.name in _LEG_SIGNS:
            width = len(_LEG_SIGNS[entry.name])
            source += [start + leg * width + number for leg in OTHER_SIDE for number in range(width)]
            signs += _LEG_SIGNS[entry.name] * len(OTHER_SIDE)
        else:
            known = ", ".join((*_SIGNS, *_LEG_SIGNS))
            raise ValueError(f"the mirror image of {entry.name!r} is not known; expected entries among {known}")
        if len(signs) != start + entry.size:
            raise ValueError(f"expected {len(signs) - start} numbers of {entry.name!r}, the layout has {entry.size}")
    return tuple(source), tuple(signs)
