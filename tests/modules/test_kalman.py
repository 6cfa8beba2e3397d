from __future__ import annotations

import math

import torch

from agility_rl.modules.kalman import corrected, credible

HERE = torch.tensor([2.0, 0.0, 0.0, 1.0])


def test_what_is_surely_said_is_believed_and_what_is_not_changes_nothing() -> None:
    said = torch.tensor([2.1, -0.05, math.sin(0.1), math.cos(0.1)])
    variance = torch.tensor([0.04, 0.01, 0.02])
    place, left = corrected(HERE, variance, said, torch.full((3,), 1e-9))
    torch.testing.assert_close(place, said, atol=1e-4, rtol=0.0)
    assert (left < 1e-3 * variance).all()
    place, left = corrected(HERE, variance, said, torch.full((3,), 1e9))
    torch.testing.assert_close(place, HERE)
    torch.testing.assert_close(left, variance)


def test_two_measurements_are_as_one_of_their_weighted_mean() -> None:
    """Inverse variances add, and means are weighted by them: 0.04 m off by 0.01 m^2, then 0.1 m by 0.02 m^2."""
    before = torch.full((3,), 0.05)
    place, variance = HERE, before
    for off, unsure in ((0.04, 0.01), (0.1, 0.02)):
        place, variance = corrected(
            place, variance, HERE + torch.tensor([off, 0.0, 0.0, 0.0]), torch.full((3,), unsure)
        )
    weights = torch.tensor([1 / 0.05, 1 / 0.01, 1 / 0.02])
    expected = (weights * torch.tensor([0.0, 0.04, 0.1])).sum() / weights.sum()
    torch.testing.assert_close(place[0] - 2.0, expected, atol=1e-4, rtol=0.0)
    torch.testing.assert_close(variance[0], 1.0 / weights.sum(), rtol=1e-3, atol=0.0)


def test_half_of_a_right_angle_is_still_a_unit_vector() -> None:
    """As sure as what is said: half-way between ahead and to the left, where sine and cosine are sqrt(1/2)."""
    said, variance = torch.tensor([2.0, 0.0, 1.0, 0.0]), torch.full((3,), 0.02)
    place, _ = corrected(HERE, variance, said, variance)
    torch.testing.assert_close(place, torch.tensor([2.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]))


def test_what_is_said_of_a_place_far_away_hardly_counts() -> None:
    distances = torch.tensor([0.0, 0.5, 1.0, 2.0])
    said = HERE + distances[:, None] * torch.tensor([0.6, 0.8, 0.0, 0.0])
    torch.testing.assert_close(credible(said, HERE)[:, 0], 1.0 / (1.0 + distances**4))
    assert not credible(said.requires_grad_(), HERE).requires_grad
