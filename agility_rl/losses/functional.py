"""Formulas of the losses and of the rewards they train, as pure functions of tensors.

Every criterion returns one term per sample; the reduction belongs to the caller. Logits go in, never probabilities.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

Criterion = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""``(expert logit, policy logit) -> (expert term, policy term)``, each of the shape of its logit."""


def missed(estimate: Tensor, target: Tensor, key: object) -> Tensor:
    """Target minus estimate, of one shape; the target gets no gradient.

    Source: ours.

    Args:
        estimate: ``[*B, ...]``.
        target: the same shape and unit.
        key: what the target is called, for the message.

    Returns:
        The shape of both.

    Raises:
        ValueError: if the shapes differ: they might be broadcast to one that compares every sample with every other.

    Example:
        >>> missed(torch.zeros(2, 1), torch.ones(2), "shift")
        Traceback (most recent call last):
        ValueError: expected 'shift' of shape [2, 1], as it is estimated, got [2]
    """
    if estimate.shape != target.shape:
        raise ValueError(
            f"expected {key!r} of shape {list(estimate.shape)}, as it is estimated, got {list(target.shape)}"
        )
    return target.detach() - estimate


def least_squares(expert_logit: Tensor, policy_logit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Least-squares criterion of a discriminator: dogs towards +1, policy towards -1.

    .. math:: \tfrac12 (D(o_E) - 1)^2, \qquad \tfrac12 (D(o_\pi) + 1)^2

    Source: first term of Eq. (10); released code (method notes, section 3.4).

    Example:
        >>> least_squares(torch.tensor([1.0]), torch.tensor([1.0]))
        (tensor([0.]), tensor([2.]))
    """
    return 0.5 * (expert_logit - 1.0).square(), 0.5 * (policy_logit + 1.0).square()


def logistic(expert_logit: Tensor, policy_logit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Binary cross-entropy of a discriminator, on logits.

    .. math:: -\tfrac12 \log \sigma(D(o_E)), \qquad -\tfrac12 \log(1 - \sigma(D(o_\pi)))

    Source: alternative of the released code (method notes, section 3.4); Ess-InfoGAIL uses it.

    Example:
        >>> expert, policy = logistic(torch.tensor([0.0]), torch.tensor([-100.0]))
        >>> round(expert.item(), 4), round(policy.item(), 4)
        (0.3466, 0.0)
    """
    return 0.5 * functional.softplus(-expert_logit), 0.5 * functional.softplus(policy_logit)


def wasserstein(expert_logit: Tensor, policy_logit: Tensor) -> tuple[Tensor, Tensor]:
    r"""Wasserstein criterion of a critic; needs a gradient penalty or weight clipping beside it.

    .. math:: -\tfrac12 D(o_E), \qquad \tfrac12 D(o_\pi)

    Source: alternative of the released code (method notes, section 3.4); Eq. (13) of EASI has the same form.

    Example:
        >>> wasserstein(torch.tensor([3.0]), torch.tensor([1.0]))
        (tensor([-1.5000]), tensor([0.5000]))
    """
    return -0.5 * expert_logit, 0.5 * policy_logit


CRITERIA: dict[str, Criterion] = {
    "least_squares": least_squares,
    "logistic": logistic,
    "wasserstein": wasserstein,
}
"""Criteria by name."""


def gradient_penalty(logit: Tensor, inputs: Tensor | Sequence[Tensor], *, create_graph: bool = True) -> Tensor:
    r"""Squared norm of the discriminator's gradient at its inputs, one per sample.

    .. math:: \|\nabla_o D(o)\|^2

    Zero-centred and on expert samples only, as in adversarial motion priors: it flattens D around the data.

    Source: L_gp of Eq. (10); released code (method notes, section 3.4); Peng et al. 2021, arXiv:2104.02180.

    Args:
        logit: ``[*B, 1]``, computed from ``inputs`` sample by sample.
        inputs: tensors that require a gradient, ``[*B, ...]``; all trailing dimensions count as features.
        create_graph: whether the penalty is to be differentiated itself.

    Returns:
        ``[*B]``.

    Raises:
        ValueError: if no input requires a gradient.

    Example:
        >>> x = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
        >>> gradient_penalty((x.square().sum(-1, keepdim=True)), x)
        tensor([ 20., 100.], grad_fn=<SumBackward1>)
    """
    tensors = [inputs] if isinstance(inputs, Tensor) else list(inputs)
    if not tensors or not all(x.requires_grad for x in tensors):
        raise ValueError(
            "gradient_penalty needs inputs that require a gradient, got "
            f"requires_grad={[x.requires_grad for x in tensors]}; call x.detach().requires_grad_() before the network"
        )
    # the logits of a batch depend on their own row only, so that one backward of the sum gives every row's gradient
    gradients = torch.autograd.grad(logit.sum(), tensors, create_graph=create_graph)
    batch_dims = logit.ndim - 1
    norms = [gradient.square().flatten(batch_dims).sum(-1) for gradient in gradients]
    return norms[0] if len(norms) == 1 else torch.stack(norms).sum(0)


def imitation_reward(logit: Tensor) -> Tensor:
    r"""Reward of looking like a dog, in [0, 1], for a least-squares discriminator.

    .. math:: r^I = \max\left(0, 1 - \tfrac14 (D(o) - 1)^2\right)

    Source: r^I of Eq. (11), Eq. (2); released code (method notes, section 3.6).

    Example:
        >>> imitation_reward(torch.tensor([1.0, 0.0, -1.0, 5.0]))
        tensor([1.0000, 0.7500, 0.0000, 0.0000])
    """
    return (1.0 - 0.25 * (logit - 1.0).square()).clamp_min(0.0)


def skill_reward(skill_logits: Tensor, skill: Tensor) -> Tensor:
    r"""Reward of showing the commanded skill, at most 0.

    .. math:: r^{SS} = \log Q^c(c | o)

    Source: r^SS of Eq. (11); method notes, section 3.6. Differs from the released code, which applies softmax twice.

    Args:
        skill_logits: ``[*B, K]``.
        skill: int64 ``[*B]``.

    Returns:
        ``[*B, 1]``.

    Example:
        >>> skill_reward(torch.zeros(1, 2), torch.tensor([1]))
        tensor([[-0.6931]])
    """
    return skill_logits.log_softmax(-1).gather(-1, skill.unsqueeze(-1))


def shift_reward(estimate: Tensor, shift: Tensor) -> Tensor:
    r"""Reward of showing the commanded shift, at most 0.

    .. math:: r^{US} = -|Q^\epsilon(o) - \epsilon|

    Source: r^US of Eq. (11); released code (method notes, section 3.6).

    Args:
        estimate: ``[*B, S]``.
        shift: ``[*B, S]``.

    Returns:
        ``[*B, 1]``, the mean over S.

    Example:
        >>> shift_reward(torch.tensor([[0.5]]), torch.tensor([[-0.5]]))
        tensor([[-1.]])
    """
    return -missed(estimate, shift, "shift").abs().mean(-1, keepdim=True)


def conditional_entropy(skill_logits: Tensor) -> Tensor:
    r"""Entropy of the predicted skill given each sample [nat].

    .. math:: H(y | o) = -\sum_k p_k(o) \log p_k(o)

    Source: L_RIM of Eq. (10); released code (method notes, section 3.4); Krause et al. 2010 (regularized
    information maximization).

    Args:
        skill_logits: ``[*B, K]``.

    Returns:
        ``[*B]``.

    Example:
        >>> conditional_entropy(torch.zeros(1, 4))
        tensor([1.3863])
    """
    log_probability = skill_logits.log_softmax(-1)
    return -(log_probability.exp() * log_probability).sum(-1)


def marginal_entropy(skill_logits: Tensor) -> Tensor:
    r"""Entropy of the predicted skill averaged over all samples [nat]; large when all skills occur.

    .. math:: H(y) = -\sum_k \bar p_k \log \bar p_k, \qquad \bar p = \tfrac1N \sum_j p(o_j)

    Source: Ess-InfoGAIL's balance term (method notes, section 3.4, ancestors); the paper's release leaves it out.

    Args:
        skill_logits: ``[*B, K]``.

    Returns:
        ``[]``.

    Example:
        >>> round(marginal_entropy(torch.tensor([[100.0, 0.0], [0.0, 100.0]])).item(), 4)
        0.6931
    """
    log_probability = skill_logits.log_softmax(-1).flatten(0, -2)  # [N, K]
    # mean in the log domain: a skill that never occurs has probability 0 in float32, and 0 * log 0 is nan
    log_mean = log_probability.logsumexp(0) - math.log(log_probability.shape[0])
    return -(log_mean.exp() * log_mean).sum()


def gaussian_kl(loc: Tensor, scale: Tensor, other_loc: Tensor, other_scale: Tensor) -> Tensor:
    r"""Kullback-Leibler divergence of two diagonal Gaussians [nat], never negative.

    .. math:: \mathrm{KL}(p \| q) = \sum_i \log\frac{\sigma_q}{\sigma_p}
              + \frac{\sigma_p^2 + (\mu_p - \mu_q)^2}{2 \sigma_q^2} - \frac12

    For an adaptive learning rate, p is the policy that collected the data and q the present one.

    Source: target 0.01 of the released code (method notes, section 3.7) refers to this value.

    Args:
        loc: ``[*B, A]``, mean of p.
        scale: ``[*B, A]``, standard deviation of p.
        other_loc: ``[*B, A]``, mean of q.
        other_scale: ``[*B, A]``, standard deviation of q.

    Returns:
        ``[*B]``.

    Example:
        >>> one = torch.ones(1, 2)
        >>> gaussian_kl(0 * one, one, one, one)
        tensor([1.])
    """
    ratio = scale / other_scale
    distance = (loc - other_loc) / other_scale
    return (0.5 * (ratio.square() + distance.square() - 1.0) - ratio.log()).sum(-1)


def clipped_surrogate(log_ratio: Tensor, advantage: Tensor, clip_epsilon: float) -> Tensor:
    r"""Clipped surrogate objective of proximal policy optimisation, as a loss.

    .. math:: -\min\left(\rho A, \; \mathrm{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A\right)

    No gradient is left once the ratio is outside the clip on the side that the advantage favours.

    Source: Schulman et al. 2017, arXiv:1707.06347, Eq. (7).

    Args:
        log_ratio: ``[*B]``, log-probability of the action now minus that at collection.
        advantage: ``[*B]``.
        clip_epsilon: half width of the interval in which the ratio is free.

    Returns:
        ``[*B]``.

    Example:
        >>> clipped_surrogate(torch.tensor([2.0, 2.0]).log(), torch.tensor([1.0, -1.0]), 0.2)
        tensor([-1.2000,  2.0000])
    """
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1.0 - clip_epsilon, 1.0 + clip_epsilon)
    return -torch.minimum(ratio * advantage, clipped * advantage)


def divergence_estimate(log_ratio: Tensor) -> Tensor:
    r"""Estimate of the divergence KL(p || q) [nat] from samples of p, never negative and without bias.

    .. math:: \rho - 1 - \log \rho, \qquad \rho = q(a) / p(a)

    It needs no more than log-probabilities; where the parameters of both policies are known, prefer the exact value.

    Source: third estimator of Schulman 2020, "Approximating KL divergence".

    Args:
        log_ratio: ``[*B]``, log q - log p of samples of p.

    Returns:
        ``[*B]``.

    Example:
        >>> divergence_estimate(torch.tensor([0.0, 1.0]))
        tensor([0.0000, 0.7183])
    """
    return log_ratio.expm1() - log_ratio


def linear_ramp(step: float, start: float, length: float, final: float = 1.0) -> float:
    r"""Coefficient that rises linearly from 0 to its final value, and stays there.

    .. math:: w(t) = w_{\mathrm{final}} \, \mathrm{clip}\left((t - t_0) / \ell, 0, 1\right)

    Source: RIM weight (start 200, length 10,000) and privileged coefficient (start 1,000, length 2,000): released
    code (method notes, sections 3.4 and 3.7).

    Args:
        step: present iteration.
        start: iteration until which the coefficient is 0.
        length: iterations of the rise; 0 switches at once.
        final: last value.

    Raises:
        ValueError: if ``length`` is negative.

    Example:
        >>> linear_ramp(700, start=200, length=1000, final=0.3)
        0.15
    """
    if length < 0:
        raise ValueError(f"length must not be negative, got {length}")
    if length == 0:
        return final if step >= start else 0.0
    return final * min(max((step - start) / length, 0.0), 1.0)


def cosine_regression(prediction: Tensor, target: Tensor) -> Tensor:
    r"""Squared distance of two vectors on the unit sphere.

    .. math:: \left\| \frac{q}{\|q\|} - \frac{z}{\|z\|} \right\|^2 = 2 - 2 \cos(q, z)

    Source: Grill et al. 2020, arXiv:2006.07733, Eq. (2); method notes, section 5.10.

    Args:
        prediction: ``[*B, P]``.
        target: ``[*B, P]``.

    Returns:
        ``[*B]``, 0 for one direction, 4 for opposite ones.

    Example:
        >>> cosine_regression(torch.tensor([[2.0, 0.0]]), torch.tensor([[0.0, 5.0]]))
        tensor([2.])
    """
    return 2.0 - 2.0 * functional.cosine_similarity(prediction, target, dim=-1)
