from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from agility_rl.losses import DiscriminatorLoss
from agility_rl.modules import Discriminator, FeatureNormalizer, Predictor

F, H = 3, 2


def network(**options: object) -> Discriminator:
    return Discriminator(F, H, (8, 6), **options)


def batch(expert: int = 4, policy: int = 6) -> TensorDict:
    return TensorDict(
        {
            "expert": TensorDict({"motion": torch.randn(expert, H, F)}, [expert]),
            "policy": TensorDict({"motion": torch.randn(policy, H, F)}, [policy]),
        }
    )


def total(losses: TensorDict) -> Tensor:
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


def numpy_forward(net: Discriminator, motion: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Logit and squared norm of its gradient at the normalised motion, by hand."""
    w1, b1, w2, b2, w3, b3 = (
        p.detach().double().numpy() for p in (*net.trunk.layers.parameters(), net.head.weight, net.head.bias)
    )
    x = motion.double().numpy()
    if net.trunk.normalizer is not None:
        x = (x - net.trunk.normalizer.mean.numpy()) / net.trunk.normalizer.std.numpy()
    x = x.reshape(len(x), -1)
    h1 = np.maximum(x @ w1.T + b1, 0)
    h2 = np.maximum(h1 @ w2.T + b2, 0)
    gradient = ((w3 * (h2 > 0)) @ w2 * (h1 > 0)) @ w1
    return (h2 @ w3.T + b3)[:, 0], (gradient**2).sum(-1)


@pytest.mark.parametrize("normalized", [False, True])
def test_values_against_numpy(normalized: bool) -> None:
    normalizer = FeatureNormalizer([0.1, 0.2, 0.3], [2.0, 0.5, 1.0]) if normalized else None
    net, td = network(normalizer=normalizer), batch()
    losses = DiscriminatorLoss(net, gradient_penalty=5.0, logit_regularization=0.05, weight_decay=1e-3)(td)
    expert, penalty = numpy_forward(net, td["expert", "motion"])
    policy, _ = numpy_forward(net, td["policy", "motion"])
    expected = 0.5 * ((expert - 1) ** 2).mean() + 0.5 * ((policy + 1) ** 2).mean()
    head = net.head.weight.square().sum().item()
    matrices = sum(p.square().sum().item() for p in net.parameters() if p.ndim == 2)
    assert losses["loss_discriminator"].item() == pytest.approx(expected, rel=1e-4)
    assert losses["loss_gradient_penalty"].item() == pytest.approx(5.0 * penalty.mean(), rel=1e-4)
    assert losses["loss_regularization"].item() == pytest.approx(0.05 * head + 1e-3 * matrices, rel=1e-4)
    assert losses["accuracy_expert"].item() == pytest.approx((expert > 0).mean())
    assert losses["accuracy_policy"].item() == pytest.approx((policy < 0).mean())
    assert losses["logit_expert"].item() == pytest.approx(expert.mean(), rel=1e-4)
    assert losses["logit_policy"].item() == pytest.approx(policy.mean(), rel=1e-4)


def test_the_penalty_does_not_depend_on_the_units_of_the_features() -> None:
    unit = torch.tensor([100.0, 0.01, 1.0])
    meter, other = network(normalizer=FeatureNormalizer(torch.zeros(F), torch.ones(F))), None
    other = network(normalizer=FeatureNormalizer(torch.zeros(F), unit))
    other.load_state_dict({**meter.state_dict(), "trunk.normalizer.std": unit})
    td = batch()
    scaled = TensorDict({name: TensorDict({"motion": td[name, "motion"] * unit}) for name in ("expert", "policy")})
    one, two = DiscriminatorLoss(meter)(td), DiscriminatorLoss(other)(scaled)
    torch.testing.assert_close(one["loss_gradient_penalty"], two["loss_gradient_penalty"])


def test_gradient_of_the_penalty_by_finite_differences() -> None:
    net = network().double()
    td = batch().apply(lambda x: x.double())
    loss = DiscriminatorLoss(net, gradient_penalty=1.0)
    loss(td)["loss_gradient_penalty"].backward()
    weight, step = net.trunk.layers[0].weight, 1e-6
    analytic = weight.grad[2, 1].item()
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            weight[2, 1] += sign * step
        values.append(loss(td)["loss_gradient_penalty"].item())
        with torch.no_grad():
            weight[2, 1] -= sign * step
    assert analytic == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("criterion", ["least_squares", "logistic", "wasserstein"])
def test_gradients_reach_the_discriminator_and_nothing_else(criterion: str) -> None:
    net, td = network(), batch()
    predictor = Predictor(trunk=net.trunk)
    total(DiscriminatorLoss(net, criterion=criterion)(td)).backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters())
    assert all(p.grad is None for p in (*predictor.skill_head.parameters(), *predictor.shift_head.parameters()))
    assert not td["expert", "motion"].requires_grad


def test_the_input_is_not_modified_and_in_keys_suffice() -> None:
    loss, td = DiscriminatorLoss(network()), batch()
    keys_before = set(td.keys(True, True))
    losses = loss(td)
    assert set(td.keys(True, True)) == keys_before
    assert set(losses.keys()) == set(loss.out_keys)
    alone = loss(td.select(*loss.in_keys))
    torch.testing.assert_close(total(alone), total(losses))


def test_call_without_tensordict() -> None:
    loss, td = DiscriminatorLoss(network()), batch()
    values = loss(expert_motion=td["expert", "motion"], policy_motion=td["policy", "motion"])
    torch.testing.assert_close(values[0], loss(td)["loss_discriminator"])


def test_nested_keys() -> None:
    net = network(
        num_skills=4, motion_key=("o", "m"), skill_key=("o", "c"), out_key=("d", "x"), normalized_key=("d", "n")
    )
    loss = DiscriminatorLoss(net)
    loss.set_keys(expert=("a", "dog"), policy=("a", "robot"), logit=("d", "x"), penalty_input=("d", "n"))
    group = TensorDict({"o": {"m": torch.randn(5, H, F), "c": torch.arange(5) % 4}}, [5])
    td = TensorDict({"a": TensorDict({"dog": group, "robot": group.clone()})})
    assert ("a", "dog", "o", "c") in loss.in_keys
    total(loss(td.select(*loss.in_keys))).backward()
    assert net.embedding.weight.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(nothing="x")


def test_coefficients_change_in_place() -> None:
    net, td = network(), batch()
    loss = DiscriminatorLoss(net, gradient_penalty=1.0)
    before = loss(td)["loss_gradient_penalty"]
    loss.gradient_penalty = 3.0
    torch.testing.assert_close(loss(td)["loss_gradient_penalty"], 3 * before)
    assert "gradient_penalty" in loss.state_dict()


def test_without_penalty() -> None:
    loss = DiscriminatorLoss(network(), gradient_penalty=None)
    assert "loss_gradient_penalty" not in loss(batch())
    assert "loss_gradient_penalty" not in loss.out_keys


def test_sum_and_masks() -> None:
    net, td = network(), batch()
    td["policy", "collector", "mask"] = torch.tensor([True, True, True, False, False, False])
    cut = batch()
    cut["expert"], cut["policy"] = td["expert"], td["policy"][:3].exclude("collector")
    for reduction in ("mean", "sum"):
        loss = DiscriminatorLoss(net, reduction=reduction)
        torch.testing.assert_close(loss(td)["loss_discriminator"], loss(cut)["loss_discriminator"])
    summed, mean = DiscriminatorLoss(net, reduction="sum")(cut), DiscriminatorLoss(net)(cut)
    torch.testing.assert_close(summed["loss_gradient_penalty"], 4 * mean["loss_gradient_penalty"])


def test_it_may_be_evaluated_without_gradients() -> None:
    loss, td = DiscriminatorLoss(network()), batch()
    with torch.no_grad():
        losses = loss(td)
    assert not any(value.requires_grad for value in losses.values())
    torch.testing.assert_close(total(losses), total(loss(td)).detach())


def test_a_foreign_discriminator_of_two_inputs() -> None:
    class Pair(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.head = nn.Linear(7, 1)

        def forward(self, state: Tensor, following: Tensor) -> Tensor:
            return self.head(torch.cat([state, following], -1))

    net = TensorDictModule(Pair(), in_keys=["state", "next"], out_keys=["d"])
    loss = DiscriminatorLoss(net, gradient_penalty=1.0)
    loss.set_keys(logit="d")
    td = TensorDict(
        {n: TensorDict({"state": torch.randn(5, 3), "next": torch.randn(5, 4)}) for n in ("expert", "policy")}
    )
    # the gradient of a linear discriminator is its weight, for every sample
    torch.testing.assert_close(loss(td)["loss_gradient_penalty"], net.module.head.weight.square().sum())


def test_it_separates_two_clouds() -> None:
    net = network()
    loss = DiscriminatorLoss(net, gradient_penalty=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    td = batch(64, 64)
    td["expert", "motion"] += 3.0
    for _ in range(60):
        optimizer.zero_grad()
        losses = loss(td)
        total(losses).backward()
        optimizer.step()
    assert losses["accuracy_expert"] > 0.95
    assert losses["accuracy_policy"] > 0.95
    torch.testing.assert_close(net(td["expert"].clone())["discriminator_logit"].mean(), loss(td)["logit_expert"])


def test_errors() -> None:
    with pytest.raises(ValueError, match="criterion must be one of"):
        DiscriminatorLoss(network(), criterion="hinge")
    headless = TensorDictModule(nn.Linear(3, 1), in_keys=["motion"], out_keys=["discriminator_logit"])
    with pytest.raises(ValueError, match="submodule called 'head'"):
        DiscriminatorLoss(headless)
    DiscriminatorLoss(headless, logit_regularization=0.0)
    with pytest.raises(ValueError, match="reduction"):
        DiscriminatorLoss(network(), reduction="none")
