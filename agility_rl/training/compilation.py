"""Compile what a training calls often, or leave it as it is."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import torch

Call = TypeVar("Call", bound=Callable[..., Any])


def compiled(call: Call, enabled: bool) -> Call:
    """The same function or module, by ``torch.compile`` if enabled: faster after some ten seconds at the first call.

    Numbers differ by rounding; random ones are others, and as sure to come again. One policy after another that is
    built of the same parts is compiled once.

    Source: no formula; ``torch.compile``.

    Args:
        call: function or module.
        enabled: whether it is to be compiled, at its first call.

    Raises:
        ValueError: if it is, on a machine without a GPU and without a C++ compiler.

    Example:
        >>> compiled(torch.sin, False) is torch.sin
        True
    """
    if not enabled:
        return call
    name = os.environ.get("CXX", "clang++" if sys.platform == "darwin" else "g++")  # as torch looks for it
    if not torch.cuda.is_available() and shutil.which(name) is None:
        raise ValueError(
            f"compile: expected a C++ compiler, found no {name}; install one (Debian: g++), name another one by the "
            "environment variable CXX, or leave it out (--ppo.no-compile)"
        )
    return torch.compile(call)  # type: ignore[return-value]
