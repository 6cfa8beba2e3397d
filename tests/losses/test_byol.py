from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate

from agility_rl.losses import BYOLLoss
from agility_rl.losses.functional import cosine_regression
from agility_rl.modules import BYOL


def network() -> BYOL:
    return BYOL(TensorDictModule(nn.Linear(3, 4), in_keys=["x"], out_keys=["depth_feature"]), 4, hidden=8)


def views(number: int = 6) -> TensorDict:
    return TensorDict({f"view_{i}": TensorDict({"x": torch.randn(number, 3)}, [number]) for i in (1, 2)}, [number])


def cosine(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    a, b = a.detach().double().numpy(), b.detach().double().numpy()
    return (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)


def test_value_against_numpy() -> None:
    net, td = network(), views()
    loss = BYOLLoss(net)
    SoftUpdate(loss, eps=0.99)
    one, two = (net(td[f"view_{i}"].clone()) for i in (1, 2))
    expected = (2 - 2 * cosine(one["prediction"], two["projection"])).mean()
    expected += (2 - 2 * cosine(two["prediction"], one["projection"])).mean()
    out = loss(td)
    assert out["loss_byol"].item() == pytest.approx(expected, rel=1e-5)
    assert out["similarity"].item() == pytest.approx(1 - expected / 4, rel=1e-5)


def test_limits_and_invariances() -> None:
    q = torch.randn(5, 7, dtype=torch.float64, requires_grad=True)
    z = torch.randn(5, 7, dtype=torch.float64)
    assert cosine_regression(q, 3.0 * q).abs().max() < 1e-9
    torch.testing.assert_close(cosine_regression(q, -q), torch.full((5,), 4.0, dtype=torch.float64))
    torch.testing.assert_close(cosine_regression(q, z), cosine_regression(0.1 * q, 9.0 * z))
    assert torch.autograd.gradcheck(lambda x: cosine_regression(x, z), q)


def test_the_views_may_change_places() -> None:
    loss, td = BYOLLoss(network()), views()
    SoftUpdate(loss, eps=0.99)
    swapped = TensorDict({"view_1": td["view_2"], "view_2": td["view_1"]}, [6])
    torch.testing.assert_close(loss(td)["loss_byol"], loss(swapped)["loss_byol"])


def test_the_target_gets_no_gradient_and_moves_by_the_average() -> None:
    net = network()
    loss = BYOLLoss(net)
    average = SoftUpdate(loss, eps=0.99)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    target = {key: value.clone() for key, value in loss.target_network_params.flatten_keys().items()}
    loss(views())["loss_byol"].backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in net[0].parameters())
    assert all(value.grad is None for value in loss.target_network_params.flatten_keys().values())
    assert {id(p) for p in loss.parameters()} == {id(p) for p in net.parameters()}
    optimizer.step()
    after = loss.target_network_params.flatten_keys()
    weights = [key for key in target if key.endswith("weight")]
    assert all(torch.equal(after[key], target[key]) for key in weights)
    average.step()
    online = loss.network_params.flatten_keys()
    for key in weights:
        torch.testing.assert_close(
            loss.target_network_params.flatten_keys()[key], 0.99 * target[key] + 0.01 * online[key]
        )


def test_training_pulls_views_together_without_collapsing_them() -> None:
    net = network()
    loss = BYOLLoss(net)
    average, optimizer = SoftUpdate(loss, eps=0.9), torch.optim.Adam(loss.parameters(), lr=3e-3)
    images = torch.randn(64, 3)
    td = TensorDict({f"view_{i}": {"x": images + 0.1 * torch.randn(64, 3)} for i in (1, 2)}, [64])
    first = loss(td)["similarity"]
    for _ in range(60):
        optimizer.zero_grad()
        out = loss(td)
        out["loss_byol"].backward()
        optimizer.step()
        average.step()
    assert out["similarity"] > 0.75 > 0.65 > first
    assert out["spread"] > 0.04  # 0 is one point for all images


def test_a_point_for_all_images_has_no_spread() -> None:
    net = network()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.zero_()
        net[1].module.layers[3].bias.fill_(1.0)
    loss = BYOLLoss(net)
    SoftUpdate(loss, eps=0.99)
    assert loss(views())["spread"].item() == pytest.approx(0.0, abs=1e-6)


def test_keys_reduction_and_the_input() -> None:
    loss, td = BYOLLoss(network(), reduction="none"), views()
    SoftUpdate(loss, eps=0.99)
    assert loss(td)["loss_byol"].shape == (6,)
    assert set(loss.out_keys) == set(loss(td).keys())
    assert loss.in_keys == [("view_1", "x"), ("view_2", "x")]
    keys = set(td.keys(True, True))
    loss.set_keys(view_1=("pair", "a"), view_2=("pair", "b"))
    nested = TensorDict({"pair": {"a": td["view_1"], "b": td["view_2"]}}, [6])
    assert loss.in_keys == [("pair", "a", "x"), ("pair", "b", "x")]
    assert loss(nested)["loss_byol"].shape == (6,)
    assert set(td.keys(True, True)) == keys


def test_no_warning_with_an_average() -> None:
    loss = BYOLLoss(network())
    SoftUpdate(loss, eps=0.99)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss(views())
