"""Errors of the place as a robot that has only images makes them."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.envs.misjudgement import (
    GUESSED,
    LASTING,
    RECOGNITION,
    SEEN,
    SPREAD,
    UNSEEN,
    VIEW_ANGLE,
    VIEW_DISTANCE,
    Misjudgement,
)

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


def test_who_has_seen_his_obstacle_sees_it_beside_where_it_is() -> None:
    made = errors(factor=2.0)
    made.unknown.zero_()
    assert made.scale.log().mean().item() == pytest.approx(0.0, abs=0.04)
    assert made.scale.log().std().item() == pytest.approx(SPREAD, rel=0.05)
    local, turned = torch.tensor([-1.5, 2.0]).expand(N, 2), torch.full((N,), 2.5)
    where, heading = made.misjudged(local, turned)
    off = torch.cat((seen(where, heading) - seen(local, turned), (heading - turned)[:, None]), -1) / made.scale[:, None]
    assert off.mean(0).abs().max() < 0.01
    assert off.std(0).tolist() == pytest.approx([2.0 * size for size in SEEN], rel=0.05)
    assert torch.corrcoef(off.T).fill_diagonal_(0.0).abs().max() < 0.06


def test_an_unseen_obstacle_is_thought_to_stand_where_it_does_not() -> None:
    made = errors(factor=0.5)
    made.seen.zero_()
    middle, turned = torch.zeros(N, 2), torch.full((N,), 2.5)
    where, heading = made.misjudged(middle, turned)
    off = torch.cat((where, (heading - turned)[:, None]), -1)
    assert off.std(0).tolist() == pytest.approx([0.5 * size for size in UNSEEN], rel=0.05)
    # It is a rigid motion of the robot about the obstacle: 2 m away an angle is what it is, and moves it aside.
    away, _ = made.misjudged(middle + torch.tensor([-2.0, 0.0]), turned)
    torch.testing.assert_close(torch.linalg.vector_norm(away - where, dim=-1), torch.full((N,), 2.0))
    torch.testing.assert_close((where - away)[:, 1], 2.0 * (heading - turned).sin(), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("x", "y", "yaw", "in_view"),
    [
        (-VIEW_DISTANCE + 0.01, 0.0, 0.0, True),
        (-VIEW_DISTANCE - 0.01, 0.0, 0.0, False),
        (-2.0, 0.0, VIEW_ANGLE - 0.01, True),
        (-2.0, 0.0, -VIEW_ANGLE - 0.01, False),
        (0.0, -1.0, math.pi / 2, True),
        (1.0, 0.0, 0.0, False),
        (1.0, 0.0, -math.pi + 0.1, True),
    ],
)
def test_what_comes_into_view_is_recognised(x: float, y: float, yaw: float, in_view: bool) -> None:
    made = errors()
    for _ in range(6):
        made.advance(~EVERY, torch.tensor([x, y]).expand(N, 2), torch.full((N,), yaw))
    left = math.exp(-6 * 0.04 / RECOGNITION) if in_view else 1.0
    torch.testing.assert_close(made.unknown, torch.full((N,), left))


def test_the_next_obstacle_is_unseen_and_stands_where_it_was_expected() -> None:
    made = errors()
    changed = torch.arange(N) < N // 2
    before = made.state_dict()
    unseen, upcoming = before["unseen"], before["upcoming"]
    made.unknown.fill_(0.2)
    made.advance(changed, torch.full((N, 2), 5.0), torch.zeros(N))
    assert torch.equal(made.unseen, torch.where(changed[:, None], upcoming, unseen))
    assert torch.equal((made.upcoming != upcoming).all(-1), changed)
    assert torch.equal(made.unknown, torch.where(changed, 1.0, 0.2))
    assert made.upcoming.std().item() == pytest.approx(1.0, rel=0.03)
    assert torch.equal(made.scale != before["scale"], changed)
    assert torch.equal(made.guessed, torch.where(changed, before["foreseen"], before["guessed"]))
    other = made.foreseen != before["foreseen"]
    assert other[changed].any() and not other[~changed].any()


def test_a_type_may_be_known_before_the_obstacle_is_in_view() -> None:
    made = errors()
    for known in (made.guessed, made.foreseen):
        assert known.float().mean().item() == pytest.approx(GUESSED, abs=0.02)
    made.unknown.fill_(0.4)
    present, coming = made.untyped()
    torch.testing.assert_close(present, torch.where(made.guessed, 0.0, 0.4))
    torch.testing.assert_close(coming, torch.where(made.foreseen, 0.0, 1.0))


def test_where_the_next_obstacle_is_expected_is_where_it_is_thought_to_be_later() -> None:
    made = errors()
    made.upcoming[:, 2] = 0.0
    axis = torch.full((N,), 0.7)
    expected = seen(-made.expected(axis), axis)  # of the obstacle's middle, in its frame
    made.advance(EVERY, torch.full((N, 2), 5.0), torch.zeros(N))
    made.seen.zero_()
    where, _ = made.misjudged(torch.zeros(N, 2), torch.zeros(N))
    torch.testing.assert_close(where, -expected, atol=1e-6, rtol=0)


def test_errors_of_what_is_seen_last_for_a_while_and_stay_as_large() -> None:
    made = errors()
    before = made.seen.clone()
    for _ in range(round(LASTING / 0.04)):
        made.advance(~EVERY, torch.zeros(N, 2), torch.zeros(N))
    assert made.seen.std().item() == pytest.approx(1.0, rel=0.03)
    assert (before * made.seen).mean().item() == pytest.approx(math.exp(-1.0), abs=0.03)


def test_only_episodes_that_begin_draw_anew_and_a_saved_state_goes_on_alike() -> None:
    made = errors()
    made.unknown.fill_(0.5)
    before, mask = made.state_dict(), torch.arange(N) < 10
    made.begin(mask)
    for name, then in before.items():
        differs = (getattr(made, name) != then).view(N, -1).any(-1)
        assert not (differs & ~mask).any() and (name in ("guessed", "foreseen") or torch.equal(differs, mask))
    other = errors(period=0.04)
    other.load_state_dict(made.state_dict())
    other.generator.set_state(made.generator.get_state())
    for each in (made, other):
        each.advance(mask, torch.zeros(N, 2), torch.zeros(N))
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in made.state_dict().items())


def test_a_state_of_other_errors_is_refused() -> None:
    with pytest.raises(ValueError, match="guessed, foreseen of a misjudged place, got error"):
        errors().load_state_dict({"error": torch.zeros(N, 3)})


def test_a_factor_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="misjudgement must be a factor from 0 to 10, got -1"):
        errors(factor=-1.0)
