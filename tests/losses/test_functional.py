from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from agility_rl.losses import functional as F


def softplus(x: float) -> float:
    return math.log1p(math.exp(x))


@pytest.mark.parametrize(
    ("name", "expert", "policy"),
    [
        ("least_squares", 0.5 * (0.3 - 1) ** 2, 0.5 * (-0.7 + 1) ** 2),
        ("logistic", 0.5 * softplus(-0.3), 0.5 * softplus(-0.7)),
        ("wasserstein", -0.15, -0.35),
    ],
)
def test_criteria(name: str, expert: float, policy: float) -> None:
    terms = F.CRITERIA[name](torch.tensor([[0.3]]), torch.tensor([[-0.7], [-0.7]]))
    assert terms[0].shape == (1, 1)
    assert terms[1].shape == (2, 1)
    assert terms[0].item() == pytest.approx(expert)
    assert terms[1][1].item() == pytest.approx(policy)


def test_logistic_does_not_saturate() -> None:
    logit = torch.tensor([-500.0], requires_grad=True)
    F.logistic(logit, -logit)[0].sum().backward()
    assert logit.grad.item() == pytest.approx(-0.5)


@pytest.mark.parametrize("name", sorted(F.CRITERIA))
def test_gradcheck_of_criteria(name: str) -> None:
    logits = torch.randn(2, 4, 1, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: F.CRITERIA[name](x[0], x[1]), logits)


def test_gradient_penalty_of_a_cubic_and_its_own_gradient() -> None:
    x = torch.randn(4, 2, 3, dtype=torch.float64, requires_grad=True)
    scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    penalty = F.gradient_penalty(scale * x.pow(3).sum((-1, -2)).unsqueeze(-1), x)
    expected = (2.0 * 3 * x.detach().square()).square().sum((-1, -2))
    torch.testing.assert_close(penalty.detach(), expected)
    penalty.sum().backward()
    assert scale.grad.item() == pytest.approx(expected.sum().item())  # d(s^2 g)/ds = 2 s^2 g / s, with s = 2


def test_gradient_penalty_sums_over_several_inputs() -> None:
    x, y = torch.ones(3, 2, requires_grad=True), torch.ones(3, 1, requires_grad=True)
    penalty = F.gradient_penalty(3 * x.sum(-1, keepdim=True) + 4 * y, [x, y])
    assert penalty.tolist() == [34.0, 34.0, 34.0]
    with pytest.raises(ValueError, match="require a gradient"):
        F.gradient_penalty(x.sum(-1, keepdim=True), torch.ones(3, 2))


def test_rewards() -> None:
    assert F.imitation_reward(torch.tensor([1.0, -1.0, 3.0, 0.5])).tolist() == [1.0, 0.0, 0.0, 0.9375]
    logits = torch.tensor([[0.0, math.log(3.0)]])
    assert F.skill_reward(logits, torch.tensor([1])).item() == pytest.approx(math.log(0.75))
    assert F.skill_reward(logits.expand(4, 6, 2), torch.zeros(4, 6, dtype=torch.long)).shape == (4, 6, 1)
    reward = F.shift_reward(torch.tensor([[0.2, 0.0]]), torch.tensor([[-0.2, 0.2]]))
    assert reward.item() == pytest.approx(-0.3)


def test_entropies() -> None:
    logits = torch.tensor([[0.0, 0.0], [0.0, 200.0]])
    p = np.array([[0.5, 0.5], [0.0, 1.0]])
    np.testing.assert_allclose(F.conditional_entropy(logits).numpy(), [math.log(2), 0.0], atol=1e-6)
    mean = p.mean(0)
    assert F.marginal_entropy(logits).item() == pytest.approx(-(mean * np.log(mean)).sum(), rel=1e-6)
    certain = torch.tensor([[200.0, 0.0]] * 3, requires_grad=True)
    F.marginal_entropy(certain).backward()
    assert certain.grad.isfinite().all()


def test_mutual_information_is_never_negative() -> None:
    logits = 3 * torch.randn(50, 5)
    assert F.marginal_entropy(logits) >= F.conditional_entropy(logits).mean()


def test_gradcheck_of_entropies_and_rewards() -> None:
    logits = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(F.conditional_entropy, logits)
    assert torch.autograd.gradcheck(F.marginal_entropy, logits)
    assert torch.autograd.gradcheck(lambda x: F.skill_reward(x, torch.tensor([0, 1, 3])), logits)


def test_gaussian_kl_is_torchs() -> None:
    loc, other = torch.randn(2, 6, 3)
    scale, other_scale = torch.rand(2, 6, 3) + 0.1
    expected = kl_divergence(Independent(Normal(loc, scale), 1), Independent(Normal(other, other_scale), 1))
    torch.testing.assert_close(F.gaussian_kl(loc, scale, other, other_scale), expected)
    assert F.gaussian_kl(loc, scale, loc, scale).abs().max() < 1e-6


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected", "slope"),
    [
        (1.1, 2.0, -2.2, -2.0),  # inside: minus ratio times advantage
        (1.5, 2.0, -2.4, 0.0),  # good and already likelier: flat
        (0.5, 2.0, -1.0, -2.0),  # good and less likely: free to rise
        (0.5, -2.0, 1.6, 0.0),  # bad and already less likely: flat
        (1.5, -2.0, 3.0, 2.0),  # bad and likelier: free to fall
    ],
)
def test_clipped_surrogate(ratio: float, advantage: float, expected: float, slope: float) -> None:
    log_ratio = torch.tensor([math.log(ratio)], requires_grad=True)
    surrogate = F.clipped_surrogate(log_ratio, torch.tensor([advantage]), 0.2)
    assert surrogate.item() == pytest.approx(expected)
    surrogate.sum().backward()
    assert log_ratio.grad.item() == pytest.approx(slope * ratio)  # d loss / d log ratio


def test_divergence_estimate_is_unbiased_and_never_negative() -> None:
    p, q = Normal(0.0, 1.0), Normal(0.3, 1.2)
    sample = torch.randn(200_000, generator=torch.Generator().manual_seed(0))
    estimate = F.divergence_estimate(q.log_prob(sample) - p.log_prob(sample))
    assert estimate.min() >= 0.0
    assert estimate.mean().item() == pytest.approx(kl_divergence(p, q).item(), rel=0.02)


def test_linear_ramp() -> None:
    assert [F.linear_ramp(t, 200, 10_000) for t in (0, 200, 5_200, 10_200, 99_999)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert [F.linear_ramp(t, 5, 0, 0.1) for t in (4, 5)] == [0.0, 0.1]
    with pytest.raises(ValueError, match="length"):
        F.linear_ramp(0, 0, -1)
