"""Numbers that describe a batch or an evaluation, with the uncertainty that belongs to them."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor


class Interval(NamedTuple):
    """An estimate with its confidence interval."""

    estimate: float
    low: float
    high: float


def reward_term_means(
    batch: TensorDictBase, key: str | tuple[str, ...] = "reward_terms", prefix: str = "reward"
) -> dict[str, float]:
    """Mean of every reward term of a collected batch, as ``PREFIX/NAME``, and of their sum as ``PREFIX/total``.

    .. math:: \\bar r_k = \\frac{1}{N T} \\sum_{n,t} r_{k,n,t}

    Args:
        batch: collected TensorDict; the terms are looked up below ``("next", key)``, then below ``key``.
        key: nested entry with one tensor a term.
        prefix: group of the metrics' names.

    Raises:
        KeyError: if there are no reward terms in the batch.

    Example:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"next": {"reward_terms": {"speed": torch.tensor([[1.0], [3.0]])}}}, [2])
        >>> reward_term_means(batch)
        {'reward/speed': 2.0, 'reward/total': 2.0}
    """
    path = (key,) if isinstance(key, str) else tuple(key)
    terms = batch.get(("next", *path), None)
    if terms is None:
        terms = batch.get(path, None)
    if terms is None:
        raise KeyError(
            f"no reward terms below {('next', *path)} or {path}; the batch has {sorted(map(str, batch.keys()))}"
        )
    names = sorted(terms.keys())
    # One transfer for all terms: a batch on a GPU would otherwise be waited for once a term.
    means = torch.stack([terms.get(name).float().mean() for name in names]).tolist()
    result = {f"{prefix}/{name}": value for name, value in zip(names, means, strict=True)}
    return result | {f"{prefix}/total": math.fsum(means)}


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> Interval:
    """Share of successes and its Wilson score interval, which stays honest at 0, at 1 and for few trials.

    .. math:: \\frac{1}{1 + z^2 / n} \\left( \\hat p + \\frac{z^2}{2n}
        \\pm z \\sqrt{\\frac{\\hat p (1 - \\hat p)}{n} + \\frac{z^2}{4 n^2}} \\right)

    Source: Wilson 1927, "Probable inference, the law of succession, and statistical inference".

    Raises:
        ValueError: if there are no trials, or more successes than trials.

    Example:
        >>> [round(x, 3) for x in wilson_interval(8, 10)]
        [0.8, 0.49, 0.943]
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"expected 0 <= successes <= trials and trials >= 1, got {successes} of {trials}")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    share = successes / trials
    centre = share + z * z / (2 * trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return Interval(share, max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale))


def mean_interval(values: Tensor, confidence: float = 0.95) -> Interval:
    """Mean of independent values (seeds, episodes) and its Student-t interval.

    .. math:: \\bar x \\pm t_{n-1} \\, s / \\sqrt n

    Source: Student 1908. With one value the interval is infinite.

    Args:
        values: any shape, at least one number.
        confidence: probability that the interval covers the true mean.

    Raises:
        ValueError: if there are no values.

    Example:
        >>> [round(x, 3) for x in mean_interval(torch.tensor([1.0, 2.0, 3.0]))]
        [2.0, -0.484, 4.484]
    """
    values = values.detach().flatten().double().cpu()
    count = values.numel()
    if count == 0:
        raise ValueError("expected at least one value, got none")
    mean = values.mean().item()
    if count == 1:
        return Interval(mean, -math.inf, math.inf)
    half = t_quantile(0.5 + confidence / 2, count - 1) * values.std().item() / math.sqrt(count)
    return Interval(mean, mean - half, mean + half)


def bootstrap_interval(
    values: Tensor, generator: torch.Generator, *, confidence: float = 0.95, resamples: int = 2000
) -> Interval:
    """Mean and its percentile bootstrap interval, for values that are far from normal (returns, distances).

    Source: Efron 1979, "Bootstrap methods: another look at the jackknife".

    Args:
        values: any shape, at least one number.
        generator: source of the resampling.
        confidence: probability that the interval covers the true mean.
        resamples: number of resampled means.

    Example:
        >>> interval = bootstrap_interval(torch.arange(100.0), torch.Generator().manual_seed(0))
        >>> 43 < interval.low < interval.estimate == 49.5 < interval.high < 56
        True
    """
    values = values.detach().flatten().double().cpu()
    if values.numel() == 0:
        raise ValueError("expected at least one value, got none")
    index = torch.randint(values.numel(), (resamples, values.numel()), generator=generator)
    means = values[index].mean(-1)
    low, high = torch.quantile(means, torch.tensor([0.5 - confidence / 2, 0.5 + confidence / 2], dtype=torch.float64))
    return Interval(values.mean().item(), low.item(), high.item())


def t_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t distribution, by bisection of its integrated density.

    .. math:: F(t) = \\tfrac12 + \\frac{\\Gamma(\\frac{\\nu+1}{2})}{\\sqrt{\\pi}\\,\\Gamma(\\frac\\nu2)}
        \\int_0^{\\arctan(t/\\sqrt\\nu)} \\cos^{\\nu-1}\\theta \\, d\\theta

    Source: Abramowitz & Stegun, section 26.7, with t = sqrt(nu) tan(theta).

    Raises:
        ValueError: if the probability is not between 0.5 and 1, or there is less than one degree of freedom.

    Example:
        >>> round(t_quantile(0.975, 1), 3), round(t_quantile(0.975, 10), 3)
        (12.706, 2.228)
    """
    if not 0.5 <= probability < 1.0 or freedom < 1:
        raise ValueError(f"expected 0.5 <= probability < 1 and freedom >= 1, got {probability} and {freedom}")
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(math.pi)
    unit = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)  # Simpson's rule needs an odd number of points
    weight = torch.full_like(unit, 2.0)
    weight[1::2], weight[0], weight[-1] = 4.0, 1.0, 1.0
    low, high = 0.0, math.pi / 2
    for _ in range(60):
        angle = (low + high) / 2
        integral = (weight * torch.cos(unit * angle) ** (freedom - 1)).sum().item() * angle / 6000.0
        low, high = (angle, high) if 0.5 + scale * integral < probability else (low, angle)
    return math.sqrt(freedom) * math.tan((low + high) / 2)


def normalized_mutual_information(counts: Tensor) -> float:
    """How much one partition tells about another (commanded against shown behaviours): 0 nothing, 1 everything.

    .. math:: \\mathrm{NMI} = \\frac{2 I(X; Y)}{H(X) + H(Y)}

    Source: Strehl & Ghosh 2002, with the arithmetic mean; the measure that Ess-InfoGAIL reports.

    Args:
        counts: ``[C, K]``, how often row label and column label came together.

    Raises:
        ValueError: if the counts are no matrix of non-negative numbers with at least one positive.

    Example:
        >>> normalized_mutual_information(torch.eye(5)), normalized_mutual_information(torch.ones(5, 5))
        (1.0, 0.0)
    """
    joint = _joint(counts)
    rows, columns = joint.sum(1), joint.sum(0)
    total = _entropy(rows) + _entropy(columns)
    if total == 0.0:
        return 1.0  # one label on each side: the partitions are the same
    information = _entropy(rows) + _entropy(columns) - _entropy(joint.flatten())
    return round(min(1.0, max(0.0, 2 * information / total)), 12)


def _joint(counts: Tensor) -> Tensor:
    counts = counts.detach().double().cpu()
    if counts.ndim != 2 or bool((counts < 0).any()) or counts.sum() <= 0:
        raise ValueError(f"expected a matrix of counts with a positive sum, got shape {list(counts.shape)}")
    return counts / counts.sum()


def _entropy(probabilities: Tensor) -> float:
    return torch.special.entr(probabilities).sum().item()
