"""Tensors on any device: constants made once for each, and work that a GPU does rather than be asked about it."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


@functools.lru_cache(maxsize=1024)  # bounded, for weights that change from step to step come here too
def constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tuple of numbers, nested or not, as a tensor.

    Made once and shared, so that nothing is copied to a GPU while robots step: **never change it in place**.

    Example:
        >>> constant((1.0, 2.0), torch.device("cpu"))
        tensor([1., 2.])
    """
    with torch.inference_mode(False):  # a tensor of inference could not be used in training later
        return torch.tensor(values, dtype=dtype, device=device)


def worthwhile(mask: Tensor) -> bool:
    """Whether to work for the rows of a bool mask: on a CPU if there is any, on a GPU always.

    A GPU's answer takes until all is done that it was told before; meanwhile it could have been told what to do next.

    Example:
        >>> worthwhile(torch.zeros(3, dtype=torch.bool)), worthwhile(torch.tensor([False, True]))
        (False, True)
    """
    return mask.device.type != "cpu" or bool(mask.any())


def rows_of(mask: Tensor) -> Tensor:
    """Rows to work on for a bool mask ``[M]``, int64 ``[K]``: on a CPU those that are set, on a GPU all.

    For the same reason as :func:`worthwhile`: how many are set is known only when all is done. Who works on them looks
    at the mask again.

    Example:
        >>> rows_of(torch.tensor([False, True, True]))
        tensor([1, 2])
    """
    if mask.device.type == "cpu":
        return mask.nonzero()[:, 0]
    return torch.arange(len(mask), device=mask.device)
