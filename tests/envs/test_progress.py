"""Way-points one after another, obstacles passed or walked around, computed along given paths."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from agility_rl.envs.course import Course, Slot
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.progress import CourseProgress, Events

UP = math.pi / 2
TWO = Course(
    "two",
    (4.0, 9.0),
    (Slot("bar_jump", (2.0, 2.5), UP), Slot("tunnel", (2.0, 6.5), UP, way_points=((-1.5, 0.0), (1.5, 0.0)))),
)
ALL = torch.ones(1, dtype=torch.bool)


def start(course: Course = TWO, first: int = 0, radius: float = 0.4) -> CourseProgress:
    layout = CourseLayout(course, 1, torch.Generator())
    layout.draw(ALL)
    progress = CourseProgress(layout, radius)
    progress.begin(ALL, torch.tensor([first]), layout.length)
    progress.locate(ALL, progress.goals()[0])
    return progress


def walk(progress: CourseProgress, *corners: tuple[float, float], step: float = 0.02) -> list[Events]:
    """Along straight lines."""
    seen = []
    for a, b in pairwise(corners):
        count = max(1, round(math.dist(a, b) / step))
        for index in range(1, count + 1):
            share = index / count
            point = torch.tensor([[a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])]])
            seen.append(progress.update(point))
    return seen


def count(seen: list[Events], name: str) -> int:
    return sum(int(getattr(events, name)) for events in seen)


def test_goals_are_the_way_points_in_order_and_one_beyond() -> None:
    progress = start()
    expected = [(2.0, 0.7), (2.0, 1.6), (2.0, 2.5), (2.0, 3.4), (2.0, 5.0), (2.0, 8.0), (2.0, 8.1)]
    for this, following in pairwise(expected):
        current, coming = progress.goals()
        torch.testing.assert_close(current, torch.tensor([this]))
        torch.testing.assert_close(coming, torch.tensor([following]))
        progress.update(current)
        progress.update(current)
    assert progress.finished.all()
    torch.testing.assert_close(progress.goals()[0], torch.tensor([(2.0, 8.0)]))  # stays at the last


@pytest.mark.parametrize(("distance", "reached"), [(0.39, True), (0.41, False)])
def test_a_goal_counts_within_its_radius_after_two_steps(distance: float, reached: bool) -> None:
    progress = start()
    near, far = torch.tensor([[2.0 + distance, 0.7]]), torch.tensor([[3.0, 0.7]])
    assert progress.update(near).at_goal.item() is reached and progress.point.item() == 0
    progress.update(far)
    progress.update(near)
    assert progress.point.item() == 0  # one step, away, one step
    progress.update(near)
    assert progress.point.item() == int(reached)
    assert start(radius=0.45).update(torch.tensor([[2.42, 0.7]])).at_goal.item()


def test_the_straight_way_passes_both_and_finishes() -> None:
    progress = start()
    seen = walk(progress, (2.0, 0.5), (2.0, 8.5))
    assert count(seen, "passed") == 2 and count(seen, "bypassed") == 0
    assert progress.finished.all() and not progress.detour.any()


def test_walking_around_is_noticed_and_can_be_made_good() -> None:
    around = [(2.0, 4.6), (2.7, 5.2), (2.7, 8.0), (2.0, 8.0)]
    progress = start()
    seen = walk(progress, (2.0, 0.5), (2.0, 4.6)) + walk(progress, *around)
    assert count(seen, "passed") == 2 and count(seen, "bypassed") == 1
    assert progress.finished.all() and progress.detour.all()
    # Around, back before the middle, and through.
    progress = start()
    seen = walk(progress, (2.0, 0.5), (2.0, 5.2), (2.7, 5.4), (2.7, 7.0), (2.7, 5.2), (2.0, 5.2), (2.0, 8.2))
    assert count(seen, "passed") == 2 and count(seen, "bypassed") == 0
    assert progress.finished.all() and not progress.detour.any()


def test_the_bar_is_not_passed_beside_its_wings() -> None:
    progress = start()
    seen = walk(progress, (2.0, 0.5), (2.0, 2.2), (3.3, 2.2), (3.3, 3.4), (2.0, 3.4))
    assert count(seen, "passed") == 1 and count(seen, "bypassed") == 1


def test_a_start_in_the_middle_of_the_route_and_an_early_end() -> None:
    progress = start(first=1)
    torch.testing.assert_close(progress.goals()[0], torch.tensor([[2.0, 5.0]]))
    assert count(walk(progress, (2.0, 4.6), (2.0, 8.4)), "passed") == 1 and progress.finished.all()
    progress = start()
    progress.begin(ALL, torch.tensor([0]), torch.tensor([1]))
    assert progress.goals()[0].tolist()[0] == pytest.approx([2.0, 0.7])
    assert count(walk(progress, (2.0, 0.5), (2.0, 4.0)), "passed") == 1 and progress.finished.all()


def test_beginning_changes_only_its_rows_and_a_saved_state_is_exact() -> None:
    layout = CourseLayout(TWO, 3, torch.Generator())
    layout.draw(torch.ones(3, dtype=torch.bool))
    progress = CourseProgress(layout)
    for y in torch.arange(0.5, 4.0, 0.05):
        progress.update(torch.tensor([[2.0, float(y)]]).repeat(3, 1))
    saved = progress.state_dict()
    progress.begin(torch.tensor([False, True, False]), torch.zeros(3, dtype=torch.int64), layout.length)
    assert progress.leg.tolist() == [1, 0, 1] and progress.point.tolist() == [0, 0, 0]
    other = CourseProgress(layout)
    other.load_state_dict(saved)
    assert all(torch.equal(value, saved[name]) for name, value in other.state_dict().items())
    assert other.leg.tolist() == [1, 1, 1]
