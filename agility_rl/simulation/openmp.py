"""PyTorch's threads, when it is the physics' turn."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable

import torch  # noqa: F401 brings the OpenMP library whose function is looked up below

_SOFT = 1
"""``omp_pause_soft``: what threads hold stays as it is."""
_pause: Callable[[int], int] | None = (
    None if sys.platform == "win32" else getattr(ctypes.CDLL(None), "omp_pause_resource_all", None)
)


def rest() -> bool:
    """End PyTorch's OpenMP threads until the next operation starts them anew, so that physics has the cores.

    After an operation they spin for some milliseconds in case another follows, as long as a hundred robots need for a
    step: on two cores they held ``LocomotionEnv`` at 83 % of the bare engine's speed instead of 93 %. To end and start
    them takes less than 0.1 ms there.

    Source: ``omp_pause_resource_all`` of OpenMP 5.0, section 3.2.44.

    Returns:
        Whether the OpenMP library knows how; without it nothing happens.

    Example:
        >>> isinstance(rest(), bool)
        True
    """
    return _pause is not None and _pause(_SOFT) == 0
