"""Metrics against numbers from tables and by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from agility_rl.training.metrics import (
    bootstrap_interval,
    mean_interval,
    normalized_mutual_information,
    reward_term_means,
    t_quantile,
    wilson_interval,
)


def test_reward_terms() -> None:
    terms = {"imitation": torch.tensor([[[1.0]], [[2.0]]]), "slip": torch.tensor([[[-0.5]], [[0.0]]])}
    expected = {"reward/imitation": 1.5, "reward/slip": -0.25, "reward/total": 1.25}
    assert reward_term_means(TensorDict({"next": {"reward_terms": terms}}, [2, 1])) == expected
    assert reward_term_means(TensorDict({"reward_terms": terms}, [2, 1])) == expected
    nested = TensorDict({"next": {"env": {"terms": terms}}}, [2, 1])
    assert reward_term_means(nested, ("env", "terms"), "task")["task/slip"] == -0.25
    with pytest.raises(KeyError, match="no reward terms"):
        reward_term_means(TensorDict({"reward": torch.zeros(2)}, [2]))


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605)],
)
def test_wilson_against_published_values(successes: int, trials: int, low: float, high: float) -> None:
    """Newcombe 1998, table I, gives the last two rows."""
    interval = wilson_interval(successes, trials)
    assert interval.estimate == successes / trials
    assert interval.low == pytest.approx(low, abs=6e-5) and interval.high == pytest.approx(high, abs=6e-5)


def test_student_quantiles_against_the_table() -> None:
    table = {1: 12.7062, 2: 4.3027, 3: 3.1824, 4: 2.7764, 9: 2.2622, 30: 2.0423, 120: 1.9799, 1000: 1.9623}
    for freedom, value in table.items():
        assert t_quantile(0.975, freedom) == pytest.approx(value, abs=6e-5)
    assert t_quantile(0.5, 7) == pytest.approx(0.0, abs=1e-9)
    assert t_quantile(0.995, 4) == pytest.approx(4.6041, abs=6e-5)


def test_mean_interval_covers_as_promised(generator: torch.Generator) -> None:
    hits = 0
    for _ in range(400):
        interval = mean_interval(torch.randn(5, generator=generator) + 3.0, 0.9)
        hits += interval.low <= 3.0 <= interval.high
    assert 0.86 < hits / 400 < 0.94
    assert mean_interval(torch.tensor([2.0])) == (2.0, -math.inf, math.inf)


def test_bootstrap_agrees_with_the_normal_interval(generator: torch.Generator) -> None:
    values = torch.randn(400, generator=generator)
    interval, normal = bootstrap_interval(values, generator), mean_interval(values)
    assert interval.low == pytest.approx(normal.low, abs=0.015) and interval.high == pytest.approx(
        normal.high, abs=0.015
    )


def test_mutual_information_by_hand() -> None:
    counts = torch.tensor([[3.0, 1.0], [1.0, 3.0]])
    information = math.log(2) - (-(0.75 * math.log(0.75) + 0.25 * math.log(0.25)))
    assert normalized_mutual_information(counts) == pytest.approx(information / math.log(2), abs=1e-12)
    permuted = torch.eye(5)[[3, 1, 4, 0, 2]]
    assert normalized_mutual_information(permuted) == 1.0
    collapsed = torch.zeros(5, 5)
    collapsed[:, 2] = 10
    assert normalized_mutual_information(collapsed) == 0.0
    assert normalized_mutual_information(torch.tensor([[4]])) == 1.0


def test_errors() -> None:
    with pytest.raises(ValueError, match="got 3 of 2"):
        wilson_interval(3, 2)
    for empty in (lambda: mean_interval(torch.zeros(0)), lambda: bootstrap_interval(torch.zeros(0), torch.Generator())):
        with pytest.raises(ValueError, match="at least one value"):
            empty()
    with pytest.raises(ValueError, match="freedom"):
        t_quantile(0.9, 0)
    with pytest.raises(ValueError, match="matrix of counts"):
        normalized_mutual_information(torch.zeros(2, 2))
