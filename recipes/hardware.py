"""What a training runs on: the physics engine, and the device of everything that is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch

from agility_rl.simulation import simulator_device


@dataclass(frozen=True)
class HardwareConfig:
    """Options of every training that say where it runs."""

    simulator: Literal["batch", "warp"] = "batch"
    """Physics engine: ``batch`` on CPU threads, or ``warp`` on an NVIDIA GPU (docs/gpu.md)."""
    device: str = "cuda"
    """Where ``warp`` is, and with it everything that is trained; ``cpu`` for tests."""
    max_contacts: int = 48
    """Contacts that ``warp`` has room for, on average of all robots."""


def training_device(cfg: HardwareConfig) -> torch.device:
    """Where robots, networks and experience are: the CPU for ``batch``, the given device for ``warp``.

    Raises:
        HardwareError: if ``warp`` is not installed or there is no such device, saying what is missing.
    """
    return simulator_device(cfg.simulator, cfg.device)


def simulator_options(cfg: HardwareConfig, num_threads: int | None) -> dict[str, Any]:
    """What an environment is told about its simulator: which one, where, and on how many threads of the CPU."""
    if cfg.simulator == "batch":
        return {"name": "batch", "num_threads": num_threads}
    return {"name": "warp", "device": training_device(cfg), "max_contacts": cfg.max_contacts}
