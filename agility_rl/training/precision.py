"""Which number format the hidden layers compute in while a policy is updated."""

from __future__ import annotations

from typing import Literal

import torch

Precision = Literal["auto", "float32", "bfloat16"]
BFLOAT16_UNITS = ("avx512_bf16", "amx_bf16", "bf16")
"""Names by which PyTorch reports instructions that multiply in bfloat16; without them bfloat16 is emulated."""


def hidden_precision(
    name: Precision, device: torch.device | str = "cpu", capabilities: dict[str, bool] | None = None
) -> torch.dtype:
    """The number format of a name; ``auto`` is bfloat16 where a CPU or GPU has instructions for it, else float32.

    Source: ours; without such instructions bfloat16 is emulated, and slower than float32.

    Args:
        name: one of :data:`Precision`.
        device: where the layers are.
        capabilities: what the CPU can do, by default what :func:`torch.cpu.get_capabilities` says.

    Raises:
        ValueError: if it is none of the three.

    Example:
        >>> hidden_precision("auto", capabilities={"avx512_bf16": True}), hidden_precision("auto", capabilities={})
        (torch.bfloat16, torch.float32)
    """
    if name == "auto":
        if torch.device(device).type == "cuda":
            multiplies = torch.cuda.is_bf16_supported(including_emulation=False)
        else:
            found = torch.cpu.get_capabilities() if capabilities is None else capabilities
            multiplies = any(found.get(unit) for unit in BFLOAT16_UNITS)
        name = "bfloat16" if multiplies else "float32"
    if name not in ("float32", "bfloat16"):
        raise ValueError(f"precision: expected auto, float32 or bfloat16, got {name!r}")
    return torch.float32 if name == "float32" else torch.bfloat16
