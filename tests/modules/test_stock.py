from __future__ import annotations

import math

import pytest
import torch

from agility_rl.modules.stock import LEAST, NOTED, noted, remaining

ONE_OF_EACH = torch.ones(3)


def test_the_last_of_a_shuffled_course_is_known_before_it_is_seen() -> None:
    """Slots 0 and 1 hold types 2 and 0 for sure."""
    met = torch.zeros(3, 3)
    met[0, 2] = met[1, 0] = 1.0
    last = remaining(met, torch.tensor(2), ONE_OF_EACH)
    assert last.tolist() == pytest.approx([math.log(LEAST), 0.0, math.log(LEAST)])
    assert last.softmax(-1)[1].item() == pytest.approx(1.0 / (1.0 + 2.0 * LEAST))


def test_an_obstacle_does_not_speak_against_its_own_type() -> None:
    met = torch.zeros(2, 3)
    met[0, 1] = 1.0
    assert not remaining(met, torch.tensor(0), ONE_OF_EACH).any()


def test_of_two_alike_one_is_left() -> None:
    met = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    counts = remaining(met, torch.tensor(1), torch.tensor([2.0, 1.0])).exp()
    assert counts.tolist() == pytest.approx([1.0, 1.0])
    assert remaining(met, torch.tensor(1), torch.tensor([1.0, 0.0])).exp().tolist() == pytest.approx([LEAST] * 2)


def test_what_an_obstacle_seems_is_averaged_over_the_decisions_at_it() -> None:
    """n decisions leave 1 - 0.95^n of one type; three at the end that speak of another one hardly count."""
    met, sure = torch.zeros(2, 3), torch.tensor([50.0, 0.0, 0.0])
    for _ in range(60):
        met = noted(met, torch.tensor(0), sure)
    share = 1.0 - (1.0 - NOTED) ** 60
    assert met[0].tolist() == pytest.approx([share, 0.0, 0.0], abs=1e-6) and not met[1].any()
    for _ in range(3):
        met = noted(met, torch.tensor(0), sure.roll(1))
    assert met[0].tolist() == pytest.approx([share * (1.0 - NOTED) ** 3, 1.0 - (1.0 - NOTED) ** 3, 0.0], abs=1e-6)


def test_rows_have_slots_of_their_own_and_no_gradient_passes() -> None:
    logits = torch.randn(4, 2, 3, requires_grad=True)
    leg = torch.tensor([[0, 1], [1, 2], [2, 0], [0, 0]])
    met = noted(torch.zeros(4, 2, 3, 3), leg, logits)
    assert not met.requires_grad
    torch.testing.assert_close(met.take_along_dim(leg[..., None, None], -2)[..., 0, :], NOTED * logits.softmax(-1))
    assert int((met.sum(-1) > 0.0).sum()) == leg.numel()
    alone = remaining(met[1, 1], leg[1, 1], ONE_OF_EACH)
    assert torch.equal(remaining(met, leg, ONE_OF_EACH)[1, 1], alone)
