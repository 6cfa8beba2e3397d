"""On the way to which way-point a memory that knows its place believes itself."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.envs.course_presets import COURSES
from agility_rl.modules.placed_memory import PlacedMemory
from tests.placed_memories import BACK, FIRST, ON_THE_WAY, POINTS, STRAIGHT, silent, still


@torch.no_grad()
def test_a_way_point_counts_until_it_is_reached() -> None:
    """The second way-point is at x = -0.5, and is passed only where it is the present one, and not far beside it."""
    memory, _ = silent((FIRST, STRAIGHT))
    ways = (-1.5, 0.0, 0.0), (-0.92, 0.0, 0.5), (-0.8, 0.4, 0.0), (-0.5, 0.1, 1.0), (-0.2, 0.3, 1.0), (-0.2, 0.5, 0.0)
    for x, y, done in ways:
        *_, progress, _ = memory.step(*still(memory, [2.0 + x, 3.0 + y, 0.0, 1.0], 1))
        assert float(progress.exp()[0, 2]) == pytest.approx(done, abs=0.02)
        assert float(progress.exp()[0, 1]) == pytest.approx(1.0 - done, abs=0.02)


@torch.no_grad()
def test_who_took_a_way_point_for_reached_goes_back_to_it() -> None:
    """The first way-point is at x = -1.5; that of the second obstacle is not the last one of the first."""
    memory, _ = silent((FIRST, STRAIGHT))
    for x, y, back in ((-2.2, 0.0, 1.0), (-2.08, 0.0, 0.5), (-1.93, 0.0, 0.0), (-1.9, 0.6, 1.0), (-1.45, 0.7, 0.0)):
        *_, progress, _ = memory.step(*still(memory, [2.0 + x, 3.0 + y, 0.0, 1.0], 1))
        assert float(progress.exp()[0, 0]) == pytest.approx(back, abs=0.08)
        assert float(progress.exp()[0, 1]) == pytest.approx(1.0 - back, abs=0.08)
    *_, progress, _ = memory.step(*still(memory, [2.0, 3.0, 0.0, 1.0], 4))
    assert float(progress.exp()[0, 4]) == pytest.approx(1.0, abs=0.01)


@torch.no_grad()
def test_evidence_multiplies_the_belief() -> None:
    """Two way-points, believed in 3 : 1; evidence of log 6 for the second, of which half counts: 3 : sqrt 6."""
    memory, bias = silent((FIRST,))
    bias["progress"][:2] = torch.tensor([0.0, math.log(6.0)])
    bias["weight"].fill_(4.0)
    *inputs, hidden = still(memory, ON_THE_WAY, 1)
    hidden[0, 15] = math.log(3.0) - memory.prior[0]
    *_, progress, _ = memory.step(*inputs, hidden)
    assert float((progress[0, 0] - progress[0, 1]).exp()) == pytest.approx(3.0 / math.sqrt(6.0), rel=1e-2)


@torch.no_grad()
def test_evidence_moves_the_belief_to_a_neighbour() -> None:
    """Evidence of 4, three times: from a doubt of 1e-3 that is enough. It tells the first from those after it only."""
    for at, spoken, follows in ((0, 1, 1), (0, 3, 1), (1, 3, 1), (2, 3, 2), (1, 0, 0), (2, 0, 2)):
        memory, bias = silent((FIRST, STRAIGHT))
        bias["progress"][spoken] = 4.0
        bias["weight"].fill_(100.0)
        *inputs, state = still(memory, ON_THE_WAY, at)
        for _ in range(3):
            *_, state, _, progress, _ = memory.step(*inputs, state)
        torch.testing.assert_close(progress.exp().sum(), torch.tensor(1.0))
        assert int(progress.argmax()) == follows


@torch.no_grad()
def test_evidence_speaks_for_another_obstacle_only_where_the_robot_can_be() -> None:
    """Every image says that this is the second of three: that counts where the first is left, and not before.

    Of the third it counts as long as no way-point of it is reached.
    """
    frames = (FIRST, STRAIGHT, BACK)
    for x, y, at, moves in (
        (0.5, 3.0, 0, False),  # before the first
        (2.0, 3.0, 2, False),  # at it; its last way-point is 1.5 m on
        (2.85, 3.0, 3, False),  # 0.65 m before its last way-point
        (2.95, 3.0, 3, True),
        (8.2, 4.0, 8, True),  # on the way to the third
        (6.9, 4.4, 9, False),
    ):
        memory, bias = silent(frames)
        bias["weight"].fill_(100.0)
        bias["progress"][4:8] = 4.0
        *inputs, state = still(memory, [x, y, 0.0, 1.0], at)
        for _ in range(5):
            *_, state, _, progress, _ = memory.step(*inputs, state)
        torch.testing.assert_close(progress.exp().sum(), torch.tensor(1.0))
        assert (int(progress.argmax()) // 4 == 1) == moves, (x, y, at)


@torch.no_grad()
def test_an_episode_begins_before_the_first_obstacle_unless_told_otherwise() -> None:
    memory, _ = silent((FIRST, STRAIGHT, BACK))
    hidden, first = torch.randn(2, memory.size), torch.tensor([[True], [False]])
    for start, leg in ((None, 0), (torch.eye(12)[[8, 0]], 2)):
        begun = memory.begun(hidden, first, start)
        assert torch.equal(begun[1], hidden[1])
        *_, place, progress, _ = memory.step(
            torch.zeros(2, 32), torch.zeros(2, 45), torch.zeros(2, 4), torch.zeros(2, 58, 87), torch.zeros(2, 1), begun
        )
        torch.testing.assert_close(place[0, 4:], torch.tensor([-1.5, 0.0, 0.0, 1.0]), atol=1e-6, rtol=0.0)
        assert float(progress[0].exp().unflatten(0, (3, 4)).sum(-1)[leg]) > 0.99


def test_routes_do_not_mix() -> None:
    """The hurdle, then the ramp or the tunnel: who is on the first route stays on it."""
    memory = PlacedMemory(32, 45, 8, 7, 0.04, POINTS, COURSES["bidirectional"].legs)
    assert memory.parts == (8, 4, 3, 16, 21, 28) and memory.prior.nonzero()[:, 0].tolist() == [0, 8]
    assert memory.following.tolist() == [1, 2, 3, 4, 5, 6, 7, 7, 9, 10, 11, 12, 13, 14, 15, 15]
