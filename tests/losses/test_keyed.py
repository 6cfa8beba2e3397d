"""What losses share, on a discriminator whose slope is known."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from agility_rl.losses.keyed import KeyedLoss, penalized_logit


def linear() -> TensorDictModule:
    layer = nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[3.0, 4.0]]))
    return TensorDictModule(layer, in_keys=["x"], out_keys=["logit"])


def test_penalty_is_the_squared_slope_and_reaches_the_weights() -> None:
    network = linear()
    group = TensorDict({"x": torch.ones(5, 2)}, [5])
    logit, penalty = penalized_logit(network, group, "logit", "absent")
    torch.testing.assert_close(logit, torch.full((5, 1), 7.0))
    torch.testing.assert_close(penalty, torch.full((5,), 25.0))
    penalty.mean().backward()
    torch.testing.assert_close(network.module.weight.grad, torch.tensor([[6.0, 8.0]]))


def test_penalty_needs_no_graph_outside() -> None:
    with torch.no_grad():
        logit, penalty = penalized_logit(linear(), TensorDict({"x": torch.ones(2, 2)}, [2]), "logit", "absent")
    assert not logit.requires_grad and not penalty.requires_grad
    torch.testing.assert_close(penalty, torch.full((2,), 25.0))


def test_keys_can_be_replaced() -> None:
    class Loss(KeyedLoss):
        def __init__(self) -> None:
            super().__init__()
            self._in_keys = ["a"]

    loss = Loss()
    loss.in_keys = [("nested", "b")]
    assert loss.in_keys == [("nested", "b")]


def test_numbers_of_a_loss_are_where_its_networks_are() -> None:
    class Loss(KeyedLoss):
        def __init__(self, network: TensorDictModule) -> None:
            super().__init__()
            self.network = network
            self.register_coeff_buffer("bound", 0.2)

    layer = nn.Linear(2, 1, device="meta")  # a device that needs no hardware
    elsewhere = Loss(TensorDictModule(layer, in_keys=["x"], out_keys=["y"]))
    assert elsewhere.bound.device.type == "meta" and Loss(linear()).bound.item() == pytest.approx(0.2)
