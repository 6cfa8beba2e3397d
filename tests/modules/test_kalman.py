from __future__ import annotations

import math

import torch

from agility_rl.modules.kalman import FREEDOM, corrected, credible, doubted

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


def test_a_surprise_counts_less_unless_little_was_known() -> None:
    """0.35 m aside, said as surely as the place is known (0.02 m): a twentieth counts."""
    said, sure = HERE + torch.tensor([0.0, 0.35, 0.0, 0.0]), torch.full((3,), 0.02**2)
    surprise = 0.35**2 / (2.0 * 0.02**2)
    unsure = doubted(HERE, sure, said, sure)
    torch.testing.assert_close(unsure, sure * (1.0 + surprise / FREEDOM))
    place, _ = corrected(HERE, sure, said, unsure)
    expected = 0.35 / (2.0 + surprise / FREEDOM) * credible(said, HERE)[0]
    torch.testing.assert_close(place[1], expected, rtol=1e-4, atol=0.0)
    lost = torch.full((3,), 0.35**2)
    torch.testing.assert_close(doubted(HERE, lost, said, sure), sure * (1.0 + 1.0 / FREEDOM), rtol=1e-2, atol=0.0)


def test_what_goes_on_being_said_is_believed_in_the_end() -> None:
    """Variances that grow by (0.03 m)^2 a second, 25 decisions a second: 0.35 m are made up for within 4 s."""
    said, sure = HERE + torch.tensor([0.0, 0.35, 0.0, 0.0]), torch.full((3,), 0.02**2)
    place, variance, seconds = HERE, sure, 0.0
    while place[1] < 0.3:
        variance = variance + 0.04 * 0.03**2
        place, variance = corrected(place, variance, said, doubted(place, variance, said, sure))
        seconds += 0.04
    assert 0.5 < seconds < 4.0


def test_no_gradient_passes_through_the_surprise() -> None:
    unsure = torch.full((3,), 0.01, requires_grad=True)
    said = (HERE + 0.2).requires_grad_()
    doubted(HERE, torch.full((3,), 0.02), said, unsure).sum().backward()
    assert said.grad is None and unsure.grad is not None
    factor = 1.0 + 2.0 * 0.2**2 / 0.03 / FREEDOM
    torch.testing.assert_close(unsure.grad, torch.full((3,), factor))
