from __future__ import annotations

import pytest
import torch
from torch import nn

from agility_rl.modules.mlp import ConcatenatedMLP, OutputLinear, mlp


def test_layers_alternate_and_the_output_stays_linear() -> None:
    net = mlp(3, (8, 4), 2, activation=nn.ReLU)
    assert [type(layer) for layer in net] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, OutputLinear]
    assert all(bool((layer.bias == 0).all()) for layer in net if isinstance(layer, nn.Linear))


def test_without_output_the_last_layer_is_activated() -> None:
    assert isinstance(mlp(3, (8,))[-1], nn.ELU)


@pytest.mark.parametrize(("size_in", "hidden"), [(0, (4,)), (3, (0,)), (3, ())])
def test_impossible_sizes_are_refused(size_in: int, hidden: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="positive layer sizes"):
        mlp(size_in, hidden)


@pytest.mark.parametrize("batch", [(), (5,), (5, 7)])
def test_inputs_are_concatenated_in_the_order_of_the_keys(batch: tuple[int, ...]) -> None:
    net = ConcatenatedMLP(["a", ("nested", "history")], 2 + 3 * 4, (6,), 1, sequence_keys=[("nested", "history")])
    a, history = torch.randn(*batch, 2), torch.randn(*batch, 3, 4)
    expected = net.layers(torch.cat([a, history.reshape(*batch, 12)], -1))
    torch.testing.assert_close(net(a, history), expected)


def test_a_wrong_size_names_the_inputs() -> None:
    with pytest.raises(ValueError, match=r"in_features=4.*got 5 \(a: 5\)"):
        ConcatenatedMLP(["a"], 4, (6,), 1)(torch.zeros(2, 5))


def test_only_the_output_is_computed_in_float32_inside_autocast() -> None:
    net = mlp(64, (64,), 8)
    x = torch.randn(16, 64)
    with torch.autocast("cpu", torch.bfloat16):
        hidden, said = net[:-1](x), net(x)
    assert (hidden.dtype, said.dtype) == (torch.bfloat16, torch.float32)
    torch.testing.assert_close(said, nn.functional.linear(hidden.float(), net[-1].weight, net[-1].bias))
    torch.testing.assert_close(said, net(x), rtol=0.05, atol=0.02)
    said.sum().backward()
    assert net[0].weight.grad.dtype is torch.float32  # type: ignore[union-attr]
