from __future__ import annotations

import pytest
import torch

from agility_rl.modules import SkillPrior


def test_it_starts_uniform_and_follows_equation_s1() -> None:
    prior = SkillPrior(3, decay=0.9)
    batch = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    expected = torch.full((3,), 1 / 3)
    torch.testing.assert_close(prior.probabilities, expected)
    for _ in range(2):
        prior.update(batch)
        expected = 0.9 * expected + 0.1 * torch.tensor([0.5, 0.5, 0.0])
    torch.testing.assert_close(prior.probabilities, expected)
    assert prior.probabilities.sum().item() == pytest.approx(1.0)


def test_an_average_may_be_passed() -> None:
    one, other = SkillPrior(2, decay=0.5), SkillPrior(2, decay=0.5)
    batch = torch.tensor([[0.2, 0.8], [0.4, 0.6]])
    one.update(batch)
    other.update(batch.mean(0))
    torch.testing.assert_close(one.probabilities, other.probabilities)


def test_the_temperature_flattens_as_in_the_released_code() -> None:
    prior = SkillPrior(5, temperature=0.25)
    prior.load_state_dict({"probabilities": torch.tensor([0.1, 0.2, 0.3, 0.3, 0.1])})
    expected = torch.tensor([0.126, 0.188, 0.280, 0.280, 0.126])  # method notes, section 3.5
    torch.testing.assert_close(prior.sampling_probabilities, expected, atol=6e-4, rtol=0)


def test_samples_follow_the_distribution_and_the_generator(generator: torch.Generator) -> None:
    prior = SkillPrior(2)
    prior.load_state_dict({"probabilities": torch.tensor([0.8, 0.2])})
    draws = prior.sample((100, 200), generator)
    assert draws.shape == (100, 200)
    assert draws.dtype == torch.int64
    assert draws.float().mean().item() == pytest.approx(0.2, abs=0.01)
    assert torch.equal(draws, prior.sample((100, 200), torch.Generator().manual_seed(0)))
    assert prior.sample((), generator).shape == ()


def test_errors() -> None:
    with pytest.raises(ValueError, match="it is beta"):
        SkillPrior(decay=1.001)
    with pytest.raises(ValueError, match="temperature"):
        SkillPrior(temperature=0.0)
    with pytest.raises(ValueError, match="num_skills"):
        SkillPrior(0)
    with pytest.raises(ValueError, match=r"\[\*B, 5\], got \[3\]"):
        SkillPrior().update(torch.ones(3))
