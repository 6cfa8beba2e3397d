from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from agility_rl.losses import TransitionDiscriminatorLoss
from agility_rl.modules import FeatureNormalizer, TransitionDiscriminator

S, A = 3, 2


def network(**options: object) -> TransitionDiscriminator:
    return TransitionDiscriminator(S, A, (8, 6), **options)


def group(*shape: int, shift: float = 0.0) -> TensorDict:
    entries = {"measurement": torch.randn(*shape, S), "action": torch.randn(*shape, A)}
    return TensorDict({**entries, "next": {"measurement": torch.randn(*shape, S) + shift}}, shape)


def batch(expert: int = 4, policy: int = 6) -> TensorDict:
    return TensorDict({"expert": group(expert), "policy": group(policy)})


def total(losses: TensorDict) -> Tensor:
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


def numpy_forward(net: TransitionDiscriminator, td: TensorDict) -> tuple[np.ndarray, np.ndarray]:
    """Logit and squared norm of its gradient at the normalised inputs, by hand."""
    w1, b1, w2, b2, w3, b3 = (p.detach().double().numpy() for p in net.parameters())
    x = torch.cat((td["measurement"], td["action"], td["next", "measurement"]), -1).double().numpy()
    if net.normalizer is not None:
        x = (x - net.normalizer.mean.numpy()) / net.normalizer.std.numpy()
    h1 = np.maximum(x @ w1.T + b1, 0)
    h2 = np.maximum(h1 @ w2.T + b2, 0)
    gradient = ((w3 * (h2 > 0)) @ w2 * (h1 > 0)) @ w1
    return (h2 @ w3.T + b3)[:, 0], (gradient**2).sum(-1)


@pytest.mark.parametrize("normalized", [False, True])
def test_values_against_numpy(normalized: bool) -> None:
    normalizer = FeatureNormalizer(torch.zeros(8), torch.linspace(0.5, 2.0, 8)) if normalized else None
    net, td = network(normalizer=normalizer), batch()
    losses = TransitionDiscriminatorLoss(net, gradient_penalty=5.0)(td)
    (expert, expert_penalty), (policy, policy_penalty) = (numpy_forward(net, td[name]) for name in ("expert", "policy"))
    assert losses["loss_discriminator"].item() == pytest.approx(0.5 * (policy.mean() - expert.mean()), rel=1e-4)
    penalty = 2.5 * (expert_penalty.mean() + policy_penalty.mean())
    assert losses["loss_gradient_penalty"].item() == pytest.approx(penalty, rel=1e-4)
    assert losses["logit_expert"].item() == pytest.approx(expert.mean(), rel=1e-4)
    assert losses["logit_policy"].item() == pytest.approx(policy.mean(), rel=1e-4)
    assert losses["distance"].item() == pytest.approx(expert.mean() - policy.mean(), rel=1e-4)


def test_equal_groups_have_no_distance() -> None:
    same = group(5)
    losses = TransitionDiscriminatorLoss(network())(TensorDict({"expert": same, "policy": same.clone()}))
    assert losses["loss_discriminator"].item() == losses["distance"].item() == 0.0


def test_clipping_bounds_every_weight_and_leaves_the_statistics() -> None:
    normalizer = FeatureNormalizer(torch.full((8,), 3.0), torch.full((8,), 2.0))
    net = network(normalizer=normalizer)
    loss = TransitionDiscriminatorLoss(net)
    before = [p.detach().clone() for p in net.parameters()]
    loss.clip_weights()
    for old, new in zip(before, net.parameters(), strict=True):
        torch.testing.assert_close(new.detach(), old.clamp(-0.01, 0.01), rtol=0, atol=0)
        assert new.requires_grad
    assert normalizer.mean.tolist() == [3.0] * 8
    assert normalizer.std.tolist() == [2.0] * 8
    loss.weight_clip = 0.001  # schedulable
    loss.clip_weights()
    assert max(p.abs().max().item() for p in net.parameters()) <= 0.0010001


def test_without_a_clip_the_weights_stay() -> None:
    net = network()
    before = [p.detach().clone() for p in net.parameters()]
    TransitionDiscriminatorLoss(net, weight_clip=None, gradient_penalty=1.0).clip_weights()
    assert all(torch.equal(old, new) for old, new in zip(before, net.parameters(), strict=True))


def test_the_penalty_bounds_the_slope_where_only_the_simulator_goes() -> None:
    """D = w x has the loss ½ w (E x_pi - E x_E) + ½ gp (w² + w²): its minimum is at w = (E x_E - E x_pi) / (4 gp)."""
    linear = nn.Linear(1, 1, bias=False)
    net = TensorDictModule(linear, in_keys=["x"], out_keys=["transition_logit"])
    loss = TransitionDiscriminatorLoss(net, weight_clip=None, gradient_penalty=0.5)
    td = TensorDict(
        {"expert": TensorDict({"x": torch.full((4, 1), 3.0)}), "policy": TensorDict({"x": torch.ones(5, 1)})}
    )
    optimizer = torch.optim.SGD(loss.parameters(), 0.2)
    for _ in range(100):
        optimizer.zero_grad()
        total(loss(td)).backward()
        optimizer.step()
    assert linear.weight.item() == pytest.approx(2.0 / (4 * 0.5), rel=1e-4)


def test_gradients_reach_the_discriminator_and_nothing_else() -> None:
    net, td = network(), batch()
    total(TransitionDiscriminatorLoss(net, gradient_penalty=1.0)(td)).backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters())
    assert net.head.bias.grad.item() == pytest.approx(0.0, abs=1e-7)  # a constant added to D changes nothing
    assert not td["expert", "measurement"].requires_grad


def test_the_input_is_not_modified_and_in_keys_suffice() -> None:
    loss, td = TransitionDiscriminatorLoss(network(), gradient_penalty=1.0), batch()
    before = set(td.keys(True, True))
    losses = loss(td)
    assert set(td.keys(True, True)) == before
    assert set(losses.keys()) == set(loss.out_keys)
    torch.testing.assert_close(total(loss(td.select(*loss.in_keys))), total(losses))
    assert "loss_gradient_penalty" not in TransitionDiscriminatorLoss(network())(td)


def test_masked_transitions_do_not_count() -> None:
    net = network()
    rollout = group(2, 3)
    rollout["collector", "mask"] = torch.tensor([[True, True, False], [True, False, False]])
    cut = TensorDict({"expert": group(4), "policy": rollout.reshape(-1)[[0, 1, 3]].exclude("collector")})
    whole = TensorDict({"expert": cut["expert"], "policy": rollout})
    for reduction in ("mean", "sum"):
        loss = TransitionDiscriminatorLoss(net, gradient_penalty=1.0, reduction=reduction)
        masked, alone = loss(whole), loss(cut)
        for name in loss.out_keys:
            torch.testing.assert_close(masked[name], alone[name])
    mask = rollout["collector", "mask"]
    spoilt = rollout.exclude("collector").masked_fill(~mask, torch.nan).set("collector", rollout["collector"])
    total(loss(TensorDict({"expert": cut["expert"], "policy": spoilt}))).backward()
    assert all(weight.grad.isfinite().all() for weight in net.parameters() if weight.grad is not None)


def test_nested_keys() -> None:
    loss = TransitionDiscriminatorLoss(network(out_key=("d", "x"), normalized_key=("d", "n")), gradient_penalty=1.0)
    loss.set_keys(expert=("a", "robot"), policy=("a", "simulation"), logit=("d", "x"), penalty_input=("d", "n"))
    td = TensorDict({"a": TensorDict({"robot": group(4), "simulation": group(5)})})
    assert ("a", "robot", "next", "measurement") in loss.in_keys
    total(loss(td.select(*loss.in_keys))).backward()
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(nothing="x")


def test_it_may_be_evaluated_without_gradients() -> None:
    loss, td = TransitionDiscriminatorLoss(network(), gradient_penalty=1.0), batch()
    with torch.no_grad():
        losses = loss(td)
    assert not any(value.requires_grad for value in losses.values())
    torch.testing.assert_close(total(losses), total(loss(td)).detach())


def test_clipped_critic_separates_two_clouds() -> None:
    net = network()
    loss = TransitionDiscriminatorLoss(net)
    optimizer = torch.optim.RMSprop(loss.parameters(), 3e-4)
    td = TensorDict({"expert": group(64, shift=2.0), "policy": group(64)})
    for _ in range(60):
        loss.clip_weights()
        optimizer.zero_grad()
        losses = loss(td)
        total(losses).backward()
        optimizer.step()
    assert losses["distance"] > 0
    expert, policy = (net(td[name].clone())["transition_logit"] for name in ("expert", "policy"))
    assert (expert > policy.median()).float().mean() > 0.9


def test_errors() -> None:
    with pytest.raises(ValueError, match="bound on its slope"):
        TransitionDiscriminatorLoss(network(), weight_clip=None)
    with pytest.raises(ValueError, match="must be positive, got 0"):
        TransitionDiscriminatorLoss(network(), weight_clip=0.0)
    with pytest.raises(ValueError, match="reduction"):
        TransitionDiscriminatorLoss(network(), reduction="none")
