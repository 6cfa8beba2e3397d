from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from agility_rl.modules.way_points import FAR, NEAR, reached, shifted, to_come, told_of


def test_no_way_point_is_both_reached_and_to_come() -> None:
    offset = 4.0 * torch.rand(20_000, 2, generator=torch.Generator().manual_seed(0)) - 2.0
    assert (torch.minimum(reached(offset), to_come(offset)) <= 0.0).all()


@pytest.mark.parametrize(("logit", "edge", "slope"), [(reached, NEAR, -0.5), (to_come, FAR, 0.25)])
def test_edges_of_what_lies_straight_ahead(logit: Callable[[Tensor], Tensor], edge: float, slope: float) -> None:
    """A centimetre is half of the 0.02 m, a quarter of the 0.04 m, by which they are divided."""
    offset = torch.tensor([[edge, 0.0], [edge + 0.01, 0.0], [edge - 0.01, 0.0]], requires_grad=True)
    torch.testing.assert_close(logit(offset), slope * torch.tensor([0.0, 1.0, -1.0]), atol=1e-5, rtol=0.0)
    assert not logit(offset).requires_grad


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_way_point_that_was_passed_is_reached_if_it_was_near(side: float) -> None:
    """One 0.15 m behind and 0.4 m aside is 0.427 m away, within the 0.45 m that count; 0.45 m aside none was."""
    offset = torch.tensor([[-0.17, 0.38], [-0.6, 0.38], [-0.17, 0.42], [-0.6, 0.45]]) * torch.tensor([1.0, side])
    assert (reached(offset) > 0.0).tolist() == [True, True, False, False]


def test_belief_is_only_shifted() -> None:
    generator = torch.Generator().manual_seed(0)
    belief, logit = torch.rand(5, 6, generator=generator), torch.randn(5, 6, generator=generator)
    to = torch.tensor([0, 0, 1, 2, 4, 4])
    after = shifted(belief, logit, to)
    torch.testing.assert_close(after.sum(-1), belief.sum(-1))
    torch.testing.assert_close(after[:, 0], belief[:, 0] + (belief * logit.sigmoid())[:, 1])
    torch.testing.assert_close(shifted(belief, torch.full_like(logit, -40.0), to), belief)


def test_images_tell_the_first_way_point_of_an_obstacle_from_the_others_only() -> None:
    """Evidence of log 6 for the third of four that are believed in alike: 1 : 6 : 6 : 6."""
    belief, evidence = torch.full((4,), 0.25), torch.tensor([0.0, -3.0, math.log(6.0), 1.0])
    told = told_of(belief, evidence, torch.tensor([True]))
    torch.testing.assert_close(told.exp(), torch.tensor([[1.0, 6.0, 6.0, 6.0]]) / 19.0)
