from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agility_rl.collectors import EvolutionStrategy


def strategy(dimensions: int = 2, population: int = 20, seed: int = 0, **options: Any) -> EvolutionStrategy:
    generator = torch.Generator().manual_seed(seed)
    return EvolutionStrategy(
        [0.0] * dimensions, [1.0] * dimensions, population=population, generator=generator, **options
    )


def search(es: EvolutionStrategy, target: Tensor, generations: int) -> float:
    for _ in range(generations):
        x = es.ask()
        es.tell(x, -(x - target).square().sum(-1))
    return (es.mean - target).abs().max().item()


def test_weights_are_those_of_the_paper_at_half_survival() -> None:
    es = strategy(population=300)
    rank = np.arange(1, 151)
    expected = np.log(301 / 2) - np.log(rank)
    np.testing.assert_allclose(es.weights.numpy(), expected / expected.sum(), rtol=1e-12)
    assert bool((es.weights > 0).all())
    assert len(strategy(population=10, survival_rate=0.9).weights) == 9
    assert bool((strategy(population=10, survival_rate=1.0).weights > 0).all())


def test_one_generation_by_hand() -> None:
    es = strategy(population=4)
    x = torch.tensor([[0.0, 0.5], [0.9, 0.1], [0.3, 0.7], [0.2, 0.2]])
    es.tell(x, torch.tensor([2.0, 5.0, 1.0, 3.0]))  # second, then fourth survive
    w1, w2 = math.log(2.5), math.log(2.5) - math.log(2)
    w1, w2 = w1 / (w1 + w2), w2 / (w1 + w2)
    mean = [w1 * 0.9 + w2 * 0.2, w1 * 0.1 + w2 * 0.2]
    variance = [w1 * (0.9 - mean[0]) ** 2 + w2 * (0.2 - mean[0]) ** 2]
    variance += [w1 * (0.1 - mean[1]) ** 2 + w2 * (0.2 - mean[1]) ** 2]
    assert es.mean.tolist() == pytest.approx(mean)
    assert es.covariance.diagonal().tolist() == pytest.approx(variance)
    assert es.covariance[0, 1].item() == 0.0
    assert es.generation == 1


def test_full_covariance_and_old_centre_against_numpy() -> None:
    es = strategy(3, 10, covariance="full", centre="old", learning_rate=0.25)
    old_mean, old = es.mean.numpy().copy(), es.covariance.numpy().copy()
    x, scores = es.ask(), torch.randn(10)
    es.tell(x, scores)
    best = x.numpy()[np.argsort(-scores.numpy())[:5]]
    w = np.log(5.5) - np.log(np.arange(1, 6))
    w /= w.sum()
    new = sum(wi * np.outer(row - old_mean, row - old_mean) for wi, row in zip(w, best, strict=True))
    np.testing.assert_allclose(es.covariance.numpy(), 0.75 * old + 0.25 * new, rtol=1e-10)
    np.testing.assert_allclose(es.mean.numpy(), 0.75 * old_mean + 0.25 * w @ best, rtol=1e-10)


def test_the_first_generation_is_uniform_in_its_range() -> None:
    es = strategy(2, 4000)
    x = es.ask()
    assert x.shape == (4000, 2)
    assert 0.0 <= x.min() < 0.01
    assert 0.99 < x.max() <= 1.0
    torch.testing.assert_close(x.mean(0), es.mean, atol=0.02, rtol=0)
    torch.testing.assert_close(x.std(0), es.std, atol=0.02, rtol=0)


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_samples_have_the_distribution(covariance: Any) -> None:
    es = strategy(2, 20, covariance=covariance)
    search(es, torch.tensor([0.3, 0.6]), 1)
    sample = es.sample(20000, torch.Generator().manual_seed(1))
    np.testing.assert_allclose(np.cov(sample.numpy().T), es.covariance.numpy(), atol=0.03 * es.covariance.max().item())
    torch.testing.assert_close(sample.mean(0), es.mean, atol=0.01, rtol=0)


def test_it_finds_a_target_and_settles() -> None:
    es = strategy(6, 100)
    target = torch.linspace(0.1, 0.9, 6)
    assert search(es, target, 40) < 0.01
    assert es.std.max() < 0.01


def test_a_target_outside_the_first_range() -> None:
    target = torch.tensor([2.5, -1.0, 0.5])
    assert search(strategy(3, 100, centre="old"), target, 60) < 0.02


def test_bounds_hold_and_the_best_may_lie_on_them() -> None:
    es = strategy(2, 60, lower=[0.0, -math.inf], upper=[1.2, math.inf], centre="old")
    for _ in range(30):
        x = es.ask()
        assert x[:, 0].min() >= 0.0
        assert x[:, 0].max() <= 1.2
        es.tell(x, -(x - torch.tensor([3.0, 3.0])).square().sum(-1))
    assert es.mean[0].item() == pytest.approx(1.2, abs=0.02)
    assert es.mean[1].item() == pytest.approx(3.0, abs=0.1)


def test_only_ranks_count() -> None:
    one, other = strategy(), strategy()
    x, scores = one.ask(), torch.randn(20)
    one.tell(x, scores)
    other.tell(x, torch.exp(3 * scores) - 7.0)
    assert torch.equal(one.mean, other.mean)
    assert torch.equal(one.covariance, other.covariance)


def test_permuting_the_individuals_changes_nothing() -> None:
    one, other = strategy(), strategy()
    x, scores, order = one.ask(), torch.randn(20), torch.randperm(20)
    one.tell(x, scores)
    other.tell(x[order], scores[order, None])
    assert torch.equal(one.mean, other.mean)


def test_who_has_no_finite_score_does_not_survive() -> None:
    es = strategy(population=6)
    x = torch.rand(6, 2)
    scores = torch.tensor([math.nan, -math.inf, 1.0, math.inf, math.nan, math.nan])
    es.tell(x, scores)
    torch.testing.assert_close(es.mean, x[2].double())
    with pytest.raises(ValueError, match="no score of generation 1 is finite"):
        es.tell(x, torch.full((6,), math.nan))


def test_correlation_of_what_the_score_cannot_tell_apart() -> None:
    es = strategy(3, 300, covariance="full", min_std=1e-3)
    for _ in range(6):
        x = es.ask()
        es.tell(x, -(x[:, 0] + x[:, 1] - 1.0).square() - (x[:, 2] - 0.5).square())
    assert es.correlation[0, 1] < -0.9
    assert es.correlation.diagonal().tolist() == [1.0] * 3
    assert es.correlation[0, 2].abs() < 0.5


def test_the_estimate_averages_the_last_means() -> None:
    es, plain = strategy(averaged=0.5, covariance="full"), strategy(covariance="full")
    assert es.estimate.tolist() == [0.5, 0.5]
    means = []
    for _ in range(5):
        for one in (es, plain):
            x = one.ask()
            one.tell(x, -(x - 0.3).square().sum(-1))
        means.append(es.mean.numpy())
    assert torch.equal(es.mean, plain.mean), "averaging does not change the search"
    np.testing.assert_allclose(es.estimate.numpy(), np.mean(means[-2:], 0))  # round(2.5) is 2
    assert torch.equal(plain.estimate, plain.mean)
    other = strategy(averaged=0.5, seed=7, covariance="full")
    other.load_state_dict(es.state_dict())
    assert torch.equal(other.estimate, es.estimate) and torch.equal(other.ask(), es.ask())


def test_a_state_of_an_earlier_version_is_refused_in_one_line() -> None:
    es = strategy()
    state = es.state_dict()
    state["mean"] = state.pop("means")
    with pytest.raises(ValueError, match="saved by an earlier version"):
        es.load_state_dict(state)


def test_averaging_is_nearer_when_scores_are_noisy() -> None:
    generator, misses = torch.Generator().manual_seed(3), {0.0: 0.0, 0.5: 0.0}
    for seed in range(8):
        es = strategy(3, 40, seed=seed, min_std=0.1)
        for _ in range(30):
            x, best = es.ask(), 0.4 + 0.2 * torch.randn(3, generator=generator)
            es.tell(x, -(x - best).square().sum(-1))
        for share in misses:
            es.averaged = share
            misses[share] += (es.estimate - 0.4).norm().item()
    assert misses[0.5] < 0.7 * misses[0.0]


def test_a_known_mean_replaces_that_of_the_survivors() -> None:
    one, other = strategy(), strategy()
    x, scores = one.ask(), torch.randn(20)
    one.tell(x, scores)
    other.tell(x, scores, torch.tensor([0.1, 0.9]))
    assert other.mean.tolist() == pytest.approx([0.1, 0.9])
    assert torch.equal(one.covariance, other.covariance)
    bounded = strategy(lower=[0.0, 0.0], upper=[1.0, 1.0])
    bounded.tell(x, scores, torch.tensor([-3.0, 0.9]))
    assert bounded.mean.tolist() == pytest.approx([0.0, 0.9])


def test_least_deviation() -> None:
    es = strategy(2, 20, min_std=0.05, covariance="full")
    search(es, torch.tensor([0.5, 0.5]), 30)
    assert es.std.min().item() >= 0.05 - 1e-12


def test_the_search_resumes_bit_for_bit() -> None:
    target = torch.tensor([0.2, 0.9])
    whole, first = strategy(seed=3), strategy(seed=3)
    search(whole, target, 7)
    search(first, target, 4)
    second = strategy(seed=99)
    second.load_state_dict(first.state_dict())
    search(first, target, 1)  # what is saved does not follow the original
    search(second, target, 3)
    assert torch.equal(whole.mean, second.mean)
    assert torch.equal(whole.covariance, second.covariance)
    assert torch.equal(whole.ask(), second.ask())
    assert second.generation == 7


def test_a_search_anew_is_the_one_that_was_begun() -> None:
    target = torch.tensor([0.2, 0.9])
    done = strategy(seed=3)
    search(done, target, 7)
    state = done.state_dict()
    other = done.anew(torch.Generator().manual_seed(3))
    search(other, target, 7)
    assert torch.equal(other.mean, done.mean) and torch.equal(other.covariance, done.covariance)
    assert torch.equal(done.state_dict()["means"], state["means"]), "the first one is left alone"


def test_errors() -> None:
    with pytest.raises(ValueError, match="lower <= low < high <= upper"):
        strategy(2, lower=[0.5, 0.0])
    with pytest.raises(ValueError, match="high must be a vector"):
        EvolutionStrategy([0.0], [1.0, 2.0], generator=torch.Generator())
    with pytest.raises(ValueError, match="survivors"):
        strategy(population=2, survival_rate=0.5)
    with pytest.raises(ValueError, match="'diagonal' or 'full'"):
        strategy(covariance="dense")
    with pytest.raises(ValueError, match="learning_rate"):
        strategy(learning_rate=0.0)
    with pytest.raises(ValueError, match=r"expected individuals \[20, 2\]"):
        strategy().tell(torch.zeros(19, 2), torch.zeros(19))
    with pytest.raises(ValueError, match="must be finite"):
        strategy().tell(torch.full((20, 2), math.nan), torch.zeros(20))
    with pytest.raises(ValueError, match="has 2 parameters, expected 3"):
        strategy(3).load_state_dict(strategy(2).state_dict())
