"""The left-right mirror image of what environments write and of what policies answer, entry by entry.

Of a symmetric robot the image of experience is experience too: a good action's image is good in the state's image.

Source: elementary geometry; what it is used for elsewhere: Mittal et al. 2024, arXiv:2403.04359.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.envs.scandots import GRID_X, GRID_Y
from agility_rl.go2 import features
from agility_rl.go2.mirror import mirror_commands, mirror_features, mirror_joints
from agility_rl.tensors import constant


def _same(value: Tensor) -> Tensor:
    return value


def _scandots(value: Tensor) -> Tensor:
    return value.unflatten(-1, (len(GRID_Y), len(GRID_X))).flip(-2).flatten(-2)


def _image(value: Tensor) -> Tensor:
    return value.flip(-1)


def _place(value: Tensor) -> Tensor:
    return value * constant(_PLACE_SIGNS, value.device, value.dtype)


_PLACE_SIGNS = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0)
"""Of x, y of three points, and of sine and cosine of a yaw."""
_EXPLICIT = partial(mirror_features, features.EXPLICIT_LAYOUT)
_PROPRIOCEPTION = partial(mirror_features, features.PROPRIOCEPTION_LAYOUT)
_IMAGES: dict[NestedKey, Callable[[Tensor], Tensor]] = {
    keys.PROPRIOCEPTION: _PROPRIOCEPTION,
    keys.HISTORY: _PROPRIOCEPTION,
    keys.EXPLICIT: _EXPLICIT,
    keys.ESTIMATE: _EXPLICIT,
    keys.PRIVILEGED: partial(mirror_features, features.PRIVILEGED_LAYOUT),
    keys.MOTION: partial(mirror_features, features.MOTION_LAYOUT),
    keys.COMMAND: mirror_commands,
    keys.PEAK: _same,
    keys.SKILL: _same,
    keys.SHIFT: _same,
    keys.HEADING_ERROR: torch.neg,
    keys.PLACE: _place,
    keys.OBSTACLE: _same,
    keys.SCANDOTS: _scandots,
    keys.DEPTH: _image,
    keys.IMAGE_AGE: _same,
    keys.ACTION: mirror_joints,
    (keys.ACTION, keys.BEHAVIOUR): _same,
    (keys.ACTION, keys.PARAMETERS): mirror_commands,
}
"""Commands and parameters of decisions alike: the ranges of sideways velocity and turn rate are symmetric."""


def mirror(tensordict: TensorDictBase) -> TensorDict:
    """Observations and actions in the mirror.

    Args:
        tensordict: entries of :class:`~agility_rl.envs.LocomotionEnv` or :class:`~agility_rl.envs.AgilityEnv` that a
            policy reads, joint targets, decisions; any batch size.

    Returns:
        A TensorDict of the images of these entries.

    Raises:
        KeyError: if an entry has no image that is known here.

    Example:
        >>> seen = TensorDict({"heading_error": torch.tensor([[0.5, -0.2]]), "obstacle": torch.eye(7)[:1]}, [1])
        >>> mirror(seen)["heading_error"]
        tensor([[-0.5000,  0.2000]])
    """
    image = TensorDict({}, tensordict.batch_size, device=tensordict.device)
    for key in tensordict.keys(include_nested=True, leaves_only=True):
        if key not in _IMAGES:
            raise KeyError(f"the mirror image of {key!r} is not known; select among {', '.join(map(repr, _IMAGES))}")
        image[key] = _IMAGES[key](tensordict[key])
    return image
