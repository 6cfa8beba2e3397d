from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.losses import HybridPPOLoss
from agility_rl.modules import Critic, HybridActor, selected_parameters

BOTH = pytest.mark.parametrize("continuous", ["all", "selected"])


def networks(shape: tuple[int, ...] = (3, 2), **options: Any) -> tuple[HybridActor, Critic]:
    actor = HybridActor(4, 3, shape, in_keys=["observation"], hidden=(8,), **options)
    return actor, Critic(4, in_keys=["observation"], hidden=(8,))


def collect(actor: HybridActor, *batch: int) -> TensorDict:
    with torch.no_grad():
        td = actor(TensorDict({"observation": torch.randn(*batch, 4)}, batch_size=batch))
    td["advantage"], td["value_target"] = torch.randn(*batch, 1), torch.randn(*batch, 1)
    return td


def move(actor: HybridActor, by: float = 0.2) -> None:
    """Change the policy, so that it is no longer the one that collected."""
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter += by * torch.randn(parameter.shape)
    actor.project_std()


def total(losses: TensorDict) -> Tensor:
    return torch.stack([value for name, value in losses.items() if name.startswith("loss_")]).sum()


@pytest.mark.parametrize(("continuous", "expected"), [("all", -0.180917), ("selected", -0.143220)])
def test_two_samples_by_hand(continuous: Any, expected: float) -> None:
    actor = HybridActor(1, 2, (2, 2), in_keys=["observation"], hidden=(1,))
    critic = Critic(1, in_keys=["observation"], hidden=(1,))
    for parameter in [*actor.network.trunk.parameters(), *actor.network.choice_head.parameters()]:
        torch.nn.init.zeros_(parameter)
    for parameter in [*actor.network.parameters_head.mean.parameters(), *critic.parameters()]:
        torch.nn.init.zeros_(parameter)
    # now: both choices have probability 1/2, every parameter is standard normal, the value is 0
    density = -math.log(2 * math.pi)  # of a block of two zeros
    td = TensorDict(
        {
            "observation": torch.zeros(2, 1),
            "action": {
                "behaviour": torch.tensor([0, 1]),
                "behaviour_log_prob": torch.tensor([0.25, 0.5]).log(),  # ratios 2 and 1
                "parameters": torch.zeros(2, 2, 2),
                # log-ratios of the blocks: (0.1, 0.05), chosen the first; (-0.4, -0.2), chosen the second
                "parameters_log_prob": density - torch.tensor([[0.1, 0.05], [-0.4, -0.2]]),
            },
            "advantage": torch.tensor([[1.0], [-1.0]]),
            "value_target": torch.tensor([[3.0], [1.0]]),
        },
        batch_size=[2],
    )
    losses = HybridPPOLoss(actor, critic, continuous=continuous, critic_coeff=0.5)(td)
    # -min(2, 1.2) and -min(-1, -1)
    assert losses["loss_discrete"].item() == pytest.approx((-1.2 + 1.0) / 2)
    # all: -e^0.15 = -1.161834 and, clipped from e^-0.6, 0.8; selected: -e^0.1 = -1.105171 and e^-0.2 = 0.818731
    assert losses["loss_continuous"].item() == pytest.approx(expected, abs=1e-6)
    assert losses["loss_critic"].item() == pytest.approx(0.5 * (9.0 + 1.0) / 2)
    # log 2 and, for each dimension, log(2 pi e) / 2 = 1.418939
    assert losses["loss_entropy"].item() == pytest.approx(-0.01 * (0.693147 + 1.418939), abs=1e-7)
    assert losses["clip_fraction_discrete"].item() == 0.5
    assert losses["clip_fraction_continuous"].item() == (0.5 if continuous == "all" else 0.0)
    assert losses["kl_discrete"].item() == pytest.approx((2 - 1 - math.log(2)) / 2, abs=1e-6)


def numpy_losses(now: TensorDict, value: Tensor, td: TensorDict, continuous: str) -> dict[str, float]:
    """The loss in numpy and float64, sample by sample."""
    logits, loc, scale = (now[name].detach().numpy().astype(np.float64) for name in ("logits", "loc", "scale"))
    choice, parameters = td["action", "behaviour"].numpy(), td["action", "parameters"].numpy()
    old_discrete = td["action", "behaviour_log_prob"].numpy()
    old_continuous = td["action", "parameters_log_prob"].numpy()
    advantage = td["advantage"].numpy()
    terms: dict[str, list[float]] = {name: [] for name in ("discrete", "continuous", "entropy", "critic")}
    for i, k in enumerate(choice):
        probability = np.exp(logits[i]) / np.exp(logits[i]).sum()
        blocks = range(len(probability)) if continuous == "all" else [k]
        ratio = {"discrete": probability[k] / np.exp(old_discrete[i]), "continuous": 1.0}
        entropies = []
        for block in blocks:
            for mean, deviation, x in zip(loc[i, block], scale[i, block], parameters[i, block]):
                ratio["continuous"] *= np.exp(-0.5 * ((x - mean) / deviation) ** 2) / deviation / np.sqrt(2 * np.pi)
                entropies.append(0.5 * np.log(2 * np.pi * np.e * deviation**2))
            ratio["continuous"] /= np.exp(old_continuous[i, block])
        for head, r in ratio.items():
            terms[head].append(-min(r * advantage[i, 0], np.clip(r, 0.7, 1.3) * advantage[i, 0]))
        terms["entropy"].append(0.02 * (probability * np.log(probability)).sum() - 0.05 * np.mean(entropies))
        terms["critic"].append(2.0 * (value[i, 0].item() - td["value_target"][i, 0].item()) ** 2)
    return {f"loss_{name}": float(np.mean(values)) for name, values in terms.items()}


@BOTH
def test_the_formula_in_numpy(continuous: Any) -> None:
    actor, critic = networks()
    td = collect(actor, 32)
    move(actor)
    loss = HybridPPOLoss(
        actor,
        critic,
        continuous=continuous,
        clip_epsilon=0.3,
        critic_coeff=2.0,
        discrete_entropy_coeff=0.02,
        continuous_entropy_coeff=0.05,
    )
    losses = loss(td)
    expected = numpy_losses(actor[0](td.clone()), critic(td.clone())["state_value"], td, continuous)
    assert {name for name in loss.out_keys if name.startswith("loss_")} == set(expected)
    for name, value in expected.items():
        assert losses[name].item() == pytest.approx(value, rel=1e-4, abs=1e-6), name
    assert 0.0 < losses["clip_fraction_continuous"].item() < 1.0
    assert set(losses.keys()) == set(loss.out_keys)
    assert all(not losses[name].requires_grad for name in loss.out_keys if not name.startswith("loss_"))


@BOTH
@pytest.mark.parametrize("batch", [(6,), (3, 4)])
def test_on_its_own_policy_every_ratio_is_one(continuous: Any, batch: tuple[int, ...]) -> None:
    actor, critic = networks()
    td = collect(actor, *batch)
    loss = HybridPPOLoss(actor, critic, continuous=continuous)
    losses = loss(td)
    for head in ("discrete", "continuous"):
        torch.testing.assert_close(losses[f"loss_{head}"], -td["advantage"].mean())
        assert losses[f"clip_fraction_{head}"].item() == 0.0
        assert losses[f"kl_{head}"].item() == pytest.approx(0.0, abs=1e-6)
        assert loss.divergence(td)[head].item() == pytest.approx(0.0, abs=1e-6)


@BOTH
@pytest.mark.parametrize(("shift", "advantage", "free"), [(-1, 1, False), (1, 1, True), (-1, -1, True), (1, -1, False)])
def test_beyond_the_clip_no_gradient_pushes_further(
    continuous: Any, shift: float, advantage: float, free: bool
) -> None:
    """An old log-probability lower by one makes the ratio e: a good action's is then high enough."""
    actor, critic = networks()
    td = collect(actor, 8)
    td["advantage"] = torch.full((8, 1), float(advantage))
    td["action", "behaviour_log_prob"] += shift
    td["action", "parameters_log_prob"] += shift
    losses = HybridPPOLoss(actor, critic, continuous=continuous)(td)
    for head in ("discrete", "continuous"):
        gradient = torch.autograd.grad(
            losses[f"loss_{head}"], list(actor.parameters()), allow_unused=True, retain_graph=True
        )
        assert any(g is not None and bool(g.abs().max() > 0) for g in gradient) is free
        assert losses[f"clip_fraction_{head}"].item() == 1.0


@BOTH
def test_gradients_reach_the_blocks_that_count(continuous: Any) -> None:
    actor, critic = networks()
    td = collect(actor, 16)
    td["action", "behaviour"] = torch.ones(16, dtype=torch.int64)
    losses = HybridPPOLoss(actor, critic, continuous=continuous)(td)
    (losses["loss_continuous"] + losses["loss_entropy"]).backward()
    head = actor.network.parameters_head
    bias = head.mean[0].bias.grad.reshape(3, 2).abs().amin(-1) > 0
    deviation = head.std.grad.reshape(3, 2).abs().amin(-1) > 0
    counted = [True] * 3 if continuous == "all" else [False, True, False]
    assert bias.tolist() == deviation.tolist() == counted


def test_each_part_trains_its_own_network() -> None:
    actor, critic = networks()
    td = collect(actor, 16)
    loss = HybridPPOLoss(actor, critic, discrete_entropy_coeff=0.0, continuous_entropy_coeff=0.0)
    heads = {
        "loss_discrete": actor.network.choice_head,
        "loss_continuous": actor.network.parameters_head,
        "loss_critic": critic,
    }
    # an advantage that still hangs on the critic must not lead the surrogate there
    td["advantage"] = td["advantage"] - critic(td.clone())["state_value"]
    for part in heads:
        actor.zero_grad()
        critic.zero_grad()
        loss(td)[part].backward()
        for other, head in heads.items():
            reached = any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in head.parameters())
            assert reached is (part == other), (part, other)


def test_entropy_coefficients_can_be_changed_in_place() -> None:
    actor, critic = networks(initial_std=0.5)
    td = collect(actor, 4)
    loss = HybridPPOLoss(actor, critic, discrete_entropy_coeff=0.0)
    expected = 0.5 * math.log(2 * math.pi * math.e * 0.25)
    losses = loss(td)
    assert losses["entropy_continuous"].item() == pytest.approx(expected, rel=1e-5)
    assert losses["loss_entropy"].item() == pytest.approx(-0.01 * expected, rel=1e-5)
    loss.continuous_entropy_coeff = 0.0
    loss.discrete_entropy_coeff = 1.0
    losses = loss(td)
    assert losses["loss_entropy"].item() == pytest.approx(-losses["entropy_discrete"].item())


@BOTH
def test_the_exact_divergence(continuous: Any) -> None:
    actor, critic = networks()
    td = collect(actor, 20_000)
    old = td.select("logits", "loc", "scale").clone()
    move(actor, 0.05)
    loss = HybridPPOLoss(actor, critic, continuous=continuous)
    divergence = loss.divergence(td)
    new = actor[0](td.select("observation"))
    p, q = old["logits"].log_softmax(-1), new["logits"].log_softmax(-1)
    assert divergence["discrete"].item() == pytest.approx((p.exp() * (p - q)).sum(-1).mean().item(), rel=1e-4)
    variance = (old["scale"] / new["scale"]).square()
    kl = 0.5 * (variance + ((old["loc"] - new["loc"]) / new["scale"]).square() - 1 - variance.log()).sum(-1)
    if continuous == "selected":
        kl = selected_parameters(td["action", "behaviour"], kl.unsqueeze(-1)).squeeze(-1)
    else:
        kl = kl.sum(-1)
    assert divergence["continuous"].item() == pytest.approx(kl.mean().item(), rel=1e-4)
    assert torch.equal(td["loc"], old["loc"])
    # and the estimate from the ratios agrees
    losses = loss(td)
    for head in ("discrete", "continuous"):
        assert losses[f"kl_{head}"].item() == pytest.approx(divergence[head].item(), rel=0.1)


@BOTH
def test_means_beyond_their_bounds_are_held_back(continuous: Any) -> None:
    actor, critic = networks()
    weight, bias = actor.network.parameters_head.mean.parameters()
    with torch.no_grad():
        weight.zero_()
        bias.copy_(torch.tensor([0.5, 3.0, -1.5, -0.9, 1.0, 2.0]))
    td = collect(actor, 5)
    td["action", "behaviour"] = torch.tensor([0, 0, 1, 2, 2])
    plain = HybridPPOLoss(actor, critic, continuous=continuous)
    loss = HybridPPOLoss(actor, critic, continuous=continuous, bounds_coeff=0.1)
    assert "loss_bounds" not in plain(td) and "loss_bounds" not in plain.out_keys
    found = loss(td)
    blocks = torch.tensor([2.0**2, 0.5**2, 1.0**2])  # of the three choices
    expected = blocks.sum() if continuous == "all" else blocks[td["action", "behaviour"]].mean()
    torch.testing.assert_close(found["loss_bounds"], 0.1 * expected)
    assert set(loss.out_keys) == set(found.keys())
    own = [value for value in loss.actor_params.flatten_keys().values() if torch.equal(value, bias)]
    (gradient,) = torch.autograd.grad(found["loss_bounds"], own)
    assert (gradient != 0.0).tolist() == [False, True, True, False, False, True]
    assert (gradient[[1, 5]] > 0.0).all() and gradient[2] < 0.0  # back towards the bounds
    loss.bounds_coeff = 0.2
    torch.testing.assert_close(loss(td)["loss_bounds"], 2.0 * found["loss_bounds"])


def test_nested_keys_and_set_keys() -> None:
    actor = HybridActor(
        4, 3, (3, 2), in_keys=[("o", "x")], hidden=(8,), choice_key=("a", "b", "which"), parameters_key="how"
    )
    critic = Critic(4, in_keys=[("o", "x")], hidden=(8,), out_key=("v", "now"))
    loss = HybridPPOLoss(actor, critic)
    loss.set_keys(
        discrete_action=("a", "b", "which"),
        continuous_action="how",
        discrete_log_prob=("a", "b", "which_log_prob"),
        continuous_log_prob="how_log_prob",
        advantage=("v", "advantage"),
        value_target=("v", "target"),
        value=("v", "now"),
    )
    with torch.no_grad():
        td = actor(TensorDict({"o": {"x": torch.randn(8, 4)}}, batch_size=[8]))
    td["v", "advantage"], td["v", "target"] = torch.randn(8, 1), torch.randn(8, 1)
    before = td.clone()
    losses = loss(td.select(*loss.in_keys))
    torch.testing.assert_close(losses["loss_discrete"], -td["v", "advantage"].mean())
    expected = (critic(td.clone())["v", "now"] - td["v", "target"]).square().mean()
    torch.testing.assert_close(losses["loss_critic"], expected)
    assert loss.divergence(td)["continuous"].item() == pytest.approx(0.0, abs=1e-6)
    loss(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert bool((td == before).all())
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(reward="r")


def test_it_works_without_a_tensordict() -> None:
    actor, critic = networks()
    loss = HybridPPOLoss(actor, critic)
    td = collect(actor, 8)
    entries = {key if isinstance(key, str) else "_".join(key): td[key] for key in loss.in_keys}
    values = dict(zip(loss.out_keys, loss(**entries), strict=True))
    losses = loss(td)
    for name in loss.out_keys:
        torch.testing.assert_close(values[name], losses[name])


def test_parameters_that_belong_to_no_choice() -> None:
    actor, critic = networks((5,))
    td = collect(actor, 8)
    losses = HybridPPOLoss(actor, critic)(td)
    torch.testing.assert_close(losses["loss_continuous"], -td["advantage"].mean())
    assert losses["entropy_continuous"].item() == pytest.approx(0.5 * math.log(2 * math.pi * math.e), rel=1e-5)
    with pytest.raises(ValueError, match="each choice's block"):
        HybridPPOLoss(actor, critic, continuous="selected")(td)


@BOTH
def test_reductions(continuous: Any) -> None:
    actor, critic = networks()
    td = collect(actor, 8)
    move(actor)
    none, mean, sums = (
        HybridPPOLoss(actor, critic, continuous=continuous, reduction=how)(td) for how in ("none", "mean", "sum")
    )
    for name in ("loss_discrete", "loss_continuous", "loss_critic", "loss_entropy"):
        assert none[name].shape == (8,)
        torch.testing.assert_close(none[name].mean(), mean[name])
        torch.testing.assert_close(none[name].sum(), sums[name])


def test_what_does_not_fit_is_refused() -> None:
    actor, critic = networks()
    with pytest.raises(ValueError, match="'all' or 'selected'"):
        HybridPPOLoss(actor, critic, continuous="some")  # type: ignore[arg-type]
    loss, td = HybridPPOLoss(actor, critic), collect(actor, 8)
    with pytest.raises(ValueError, match=r"'advantage' to be \[\*B, 1\], got \[8\]"):
        loss(td.clone().set("advantage", torch.zeros(8)))
    with pytest.raises(ValueError, match=r"log-probabilities \[8, 3\]"):
        loss(td.clone().set(("action", "parameters_log_prob"), torch.zeros(8)))
    with pytest.raises(KeyError, match="value_target"):
        loss(td.exclude("value_target"))
    with pytest.raises(KeyError, match="loc"):
        loss.divergence(td.exclude("loc"))
