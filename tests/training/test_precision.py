"""The number format of hidden layers, and what stays in float32."""

from __future__ import annotations

import pytest
import torch

from agility_rl.training.precision import hidden_precision


def test_auto_takes_bfloat16_only_where_the_cpu_multiplies_in_it() -> None:
    assert hidden_precision("auto", capabilities={"avx512_bf16": True}) is torch.bfloat16
    assert hidden_precision("auto", capabilities={"avx512_bf16": False, "avx512_f": True}) is torch.float32
    assert hidden_precision("auto") is hidden_precision("auto", "cpu", torch.cpu.get_capabilities())


def test_who_names_a_format_gets_it() -> None:
    assert hidden_precision("float32", capabilities={"avx512_bf16": True}) is torch.float32
    assert hidden_precision("bfloat16", capabilities={}) is torch.bfloat16


def test_another_name_is_refused() -> None:
    with pytest.raises(ValueError, match="expected auto, float32 or bfloat16, got 'half'"):
        hidden_precision("half")  # type: ignore[arg-type]
