from __future__ import annotations

import torch
from tensordict import TensorDict

from agility_rl.modules import StateEstimator


def test_sizes_of_section_s6() -> None:
    shapes = [tuple(p.shape) for p in StateEstimator(45).parameters() if p.ndim == 2]
    assert shapes == [(128, 45), (64, 128), (4, 64)]


def test_nested_keys_and_gradients() -> None:
    net = StateEstimator(3, 2, in_keys=[("o", "p")], out_key=("o", "e"))
    td = net(TensorDict({"o": {"p": torch.randn(8, 3)}}, batch_size=[8]))
    assert td["o", "e"].shape == (8, 2)
    td["o", "e"].sum().backward()
    assert all(p.grad is not None for p in net.parameters())
