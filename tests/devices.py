"""How to tell without a GPU that code would run on one: nothing is made on the CPU by default."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

REPOSITORY = Path(__file__).parents[1]
OURS = (REPOSITORY / "agility_rl", REPOSITORY / "recipes")
OF_THE_CPU = ("batch.py", "depth_camera.py", "terrain.py")
"""What belongs to the CPU's engine, or is made before there is a simulator."""
OF_THE_HOST = ("distributed.py", "tsc_curriculum.py", "course_metrics.py", "tsc_script.py")
"""What the host counts, or reads from options and moves itself."""
MAKERS: set[Callable[..., Any]] = {
    *(torch.tensor, torch.as_tensor, torch.zeros, torch.ones, torch.full, torch.empty, torch.eye),
    *(torch.arange, torch.linspace, torch.rand, torch.randn, torch.randint, torch.randperm),
}


class NamesDevices(TorchFunctionMode):
    """Gathers the lines of ours that make a tensor, other than a single number, and do not say where.

    Attributes:
        silent: ``FILE:LINE: CODE``.
    """

    def __init__(self) -> None:
        super().__init__()
        self.silent: set[str] = set()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if func in MAKERS and (kwargs or {}).get("device") is None and result.ndim:
            caller = traceback.extract_stack(limit=2)[0]
            path = Path(caller.filename)
            if any(folder in path.parents for folder in OURS) and path.name not in OF_THE_CPU + OF_THE_HOST:
                self.silent.add(f"{path.relative_to(REPOSITORY)}:{caller.lineno}: {caller.line}")
        return result
