"""What a held decision brings, added up by hand."""

from __future__ import annotations

import torch
from torchrl.data import Composite

from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.outcome import DecisionOutcome, outcome_specs
from agility_rl.envs.progress import Events

KIND = torch.nn.functional.one_hot(torch.tensor([0, 1, 5]), len(OBSTACLES)).bool()
"""A bar, an A-frame and a tunnel are before the three robots."""


def flags(*rows: int) -> torch.Tensor:
    return torch.tensor([row in rows for row in range(3)])


def add(outcome: DecisionOutcome, reward: float, **rows: tuple[int, ...]) -> None:
    """One control step that brings everybody the same; what happens to which rows is given by name."""
    values = torch.full((3,), reward)
    lost, finished, late, passed, bypassed = (
        flags(*rows.get(name, ())) for name in ("lost", "finished", "late", "passed", "bypassed")
    )
    causes = {"lost": lost, "tilted": flags()}
    events = Events(flags(), passed, bypassed)
    outcome.add({"a": values}, values, causes, kind=KIND, events=events, finished=finished, late=late)


def test_nothing_counts_after_the_end_of_an_episode() -> None:
    outcome = DecisionOutcome(3, ["a"], ["lost", "tilted"])
    add(outcome, 1.0, lost=(0,))
    assert outcome.running.tolist() == [False, True, True]
    add(outcome, 2.0, lost=(0, 1), finished=(0,), passed=(0,))
    add(outcome, 4.0, finished=(0, 1), late=(2,))
    assert outcome.reward.tolist() == [1.0, 3.0, 7.0]
    entries = outcome.entries(flags())
    assert entries["terminated"][:, 0].tolist() == [True, True, False]
    assert entries["truncated"][:, 0].tolist() == [False, False, True]
    assert entries["done"].all() and not entries["outcome", "finished"].any() and not entries["outcome", "passed"].any()
    assert entries["terminations", "lost"][:, 0].tolist() == [True, True, False]
    assert not entries["terminations", "tilted"].any()
    assert torch.equal(entries["outcome", "failed"], KIND)  # a time-out fails too
    assert torch.equal(entries["reward_terms", "a"], entries["reward"])


def test_success_is_a_truncation_without_detour() -> None:
    outcome = DecisionOutcome(3, ["a"], ["lost", "tilted"])
    add(outcome, 1.0, finished=(0, 1, 2), lost=(2,), late=(0,))
    entries = outcome.entries(flags(1))
    assert entries["truncated"][:, 0].tolist() == [True, True, False] and entries["terminated"][2].item()
    assert entries["outcome", "success"][:, 0].tolist() == [True, False, False]
    assert entries["outcome", "finished"][:, 0].tolist() == [True, True, False]
    assert entries["outcome", "failed"].any(-1).tolist() == [False, False, True]


def test_every_obstacle_is_passed_bypassed_or_failed_once() -> None:
    outcome = DecisionOutcome(3, ["a"], ["lost", "tilted"])
    add(outcome, 0.0, passed=(0, 1, 2), bypassed=(1,), lost=(2,), finished=(2,))  # the third falls at its last goal
    assert outcome.passed.any(-1).tolist() == [True, False, False] and outcome.passed[0, 0]
    assert outcome.bypassed.any(-1).tolist() == [False, True, False] and outcome.bypassed[1, 1]
    assert outcome.failed.any(-1).tolist() == [False, False, True] and outcome.failed[2, 5]
    assert not outcome.finished.any()
    late = DecisionOutcome(3, ["a"], ["lost", "tilted"])
    add(late, 0.0, passed=(0,), late=(0, 1))  # time is over just when an obstacle was passed: nothing has failed
    assert late.failed.any(-1).tolist() == [False, True, False]


def test_specs_hold_what_is_written() -> None:
    outcome = DecisionOutcome(3, ["a"], ["lost", "tilted"])
    add(outcome, 1.0)
    entries = outcome.entries(flags())
    spec = Composite(outcome_specs(3, ["a"], ["lost", "tilted"]), shape=(3,))
    assert spec.is_in(entries.select(*spec.keys()))
