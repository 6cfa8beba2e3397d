"""Shared constants: one tensor for each device and type, and usable in training after inference."""

from __future__ import annotations

import torch

from agility_rl.tensors import constant


def test_a_constant_is_made_once_for_each_type() -> None:
    cpu = torch.device("cpu")
    one = constant((0.5, -1.0), cpu)
    assert one.tolist() == [0.5, -1.0] and one.dtype == torch.float32
    assert constant((0.5, -1.0), cpu) is one
    assert constant((0.5, -1.0), cpu, torch.float64).dtype == torch.float64
    assert constant(((1.0, 2.0), (3.0, 4.0)), cpu).shape == (2, 2)


def test_a_constant_of_inference_can_be_trained_with() -> None:
    with torch.inference_mode():
        made = constant((0.125, 8.0), torch.device("cpu"))
    weight = torch.ones(2, requires_grad=True)
    (weight * made).sum().backward()
    assert weight.grad is not None and weight.grad.tolist() == [0.125, 8.0]
