"""Errors of the place as a robot that has only images makes them."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.envs.misjudgement import A_METRE, LASTING, NEARBY, Misjudgement

N = 4000
EVERY = torch.ones(N, dtype=torch.bool)


def errors(factor: float = 1.0, period: float = 0.04) -> Misjudgement:
    made = Misjudgement(N, torch.Generator().manual_seed(0), factor, period)
    made.begin(EVERY)
    return made


def seen(local: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
    """The obstacle's middle in the robot's frame, by complex numbers."""
    place = torch.view_as_complex(local.contiguous()) * torch.polar(torch.ones_like(turned), -turned)
    return torch.view_as_real(-place)


def test_who_does_not_err_is_told_the_truth() -> None:
    local, turned = torch.randn(N, 2), torch.randn(N)
    found = errors(factor=0.0).misjudged(local, turned)
    torch.testing.assert_close(found, (local, turned), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (-1.5, 2.0)])
def test_errors_are_of_the_obstacle_as_the_robot_sees_it(x: float, y: float) -> None:
    local, turned = torch.tensor([x, y]).expand(N, 2), torch.full((N,), 2.5)
    where, heading = errors(factor=2.0).misjudged(local, turned)
    off = torch.cat((seen(where, heading) - seen(local, turned), (heading - turned)[:, None]), -1)
    sizes = [2.0 * (near + metre * math.hypot(x, y)) for near, metre in zip(NEARBY, A_METRE, strict=True)]
    assert off.mean(0).abs().max() < 0.02
    assert off.std(0).tolist() == pytest.approx(sizes, rel=0.05)
    assert torch.corrcoef(off.T).fill_diagonal_(0.0).abs().max() < 0.06


def test_errors_last_for_a_second_and_stay_as_large() -> None:
    made = errors()
    before = made.error.clone()
    for _ in range(round(LASTING / 0.04)):
        made.advance()
    assert made.error.std().item() == pytest.approx(1.0, rel=0.03)
    assert (before * made.error).mean().item() == pytest.approx(math.exp(-1.0), abs=0.03)


def test_only_episodes_that_begin_draw_anew_and_a_saved_state_goes_on_alike() -> None:
    made = errors()
    before, mask = made.error.clone(), torch.arange(N) < 10
    made.begin(mask)
    changed = (made.error != before).any(-1)
    assert torch.equal(changed, mask)
    other = errors(period=0.04)
    other.load_state_dict(made.state_dict())
    other.generator.set_state(made.generator.get_state())
    made.advance()
    other.advance()
    assert torch.equal(made.error, other.error)


def test_a_factor_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="misjudgement must be a factor from 0 to 10, got -1"):
        errors(factor=-1.0)
