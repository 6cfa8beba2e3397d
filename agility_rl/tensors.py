"""Constants of the package as tensors, made once for each device."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


@functools.cache
def constant(values: tuple[Any, ...], device: torch.device, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tuple of numbers, nested or not, as a tensor.

    Made once and shared, so that nothing is copied to a GPU while robots step: **never change it in place**.

    Example:
        >>> constant((1.0, 2.0), torch.device("cpu"))
        tensor([1., 2.])
    """
    with torch.inference_mode(False):  # a tensor of inference could not be used in training later
        return torch.tensor(values, dtype=dtype, device=device)
