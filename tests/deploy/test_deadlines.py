"""Deadlines that never drift, and a count of those that were missed."""

from __future__ import annotations

import math
import time

import pytest

from agility_rl.deploy.deadlines import Deadlines, Durations, ManualClock, MonotonicClock


def test_periods_begin_at_multiples_whatever_the_work_takes() -> None:
    clock = ManualClock()
    deadlines = Deadlines(0.02, clock)
    begun = []
    for work in (0.001, 0.019, 0.0, 0.012):
        tick = deadlines.wait()
        begun.append(clock.now())
        clock.time += work
        assert deadlines.finish(tick) == pytest.approx(work)
    assert begun == pytest.approx([0.0, 0.02, 0.04, 0.06])
    assert (deadlines.periods, deadlines.misses, deadlines.consecutive) == (4, 0, 0)


def test_work_that_ends_late_is_one_miss_and_the_next_period_begins_at_once() -> None:
    clock = ManualClock()
    deadlines = Deadlines(0.02, clock)
    tick = deadlines.wait()
    clock.time = 0.025
    deadlines.finish(tick)
    assert (deadlines.misses, deadlines.consecutive) == (1, 1)
    tick = deadlines.wait()
    assert (tick.index, tick.skipped, tick.lateness) == (1, 0, pytest.approx(0.005))
    clock.time += 0.001
    deadlines.finish(tick)
    assert (deadlines.misses, deadlines.consecutive) == (1, 0)
    assert deadlines.wait().due == pytest.approx(0.04) and clock.now() == pytest.approx(0.04)


def test_whole_periods_are_skipped_not_made_up_for() -> None:
    clock = ManualClock()
    deadlines = Deadlines(0.02, clock)
    tick = deadlines.wait()
    clock.time = 0.091  # ends in the fifth period: the first was late, three were skipped
    deadlines.finish(tick)
    tick = deadlines.wait()
    assert (tick.index, tick.skipped) == (4, 3)
    assert (deadlines.misses, deadlines.consecutive) == (4, 4)
    deadlines.finish(tick)
    assert deadlines.consecutive == 0 and deadlines.periods == 5


def test_a_sleep_that_lasts_too_long_counts_too() -> None:
    class Sleepy(ManualClock):
        def sleep_until(self, moment: float) -> None:
            super().sleep_until(moment + (0.05 if moment > 0.03 else 0.0))

    deadlines = Deadlines(0.02, Sleepy())
    for _ in range(2):
        deadlines.finish(deadlines.wait())
    tick = deadlines.wait()  # due at 0.04, woken at 0.09: the periods at 0.04 and 0.06 are gone
    assert tick.skipped == 2 and tick.due == pytest.approx(0.08) and deadlines.misses == 2


def test_a_restart_forgets() -> None:
    clock = ManualClock()
    deadlines = Deadlines(0.02, clock)
    clock.time = 10.0
    deadlines.restart()
    assert deadlines.wait().skipped == 0 and deadlines.misses == 0


def test_the_real_clock_keeps_the_rate() -> None:
    deadlines = Deadlines(0.005, MonotonicClock())
    begin = time.monotonic()
    for _ in range(20):
        deadlines.finish(deadlines.wait())
    assert time.monotonic() - begin >= (deadlines.periods - 1) * 0.005


def test_quantiles_and_constant_memory() -> None:
    durations = Durations()
    assert math.isnan(durations.quantile(0.5))
    for index in range(1, 1001):
        durations.add(1e-5 * index)
    assert durations.quantile(0.5) == pytest.approx(0.005, abs=2e-5)
    assert durations.quantile(0.99) == pytest.approx(0.0099, abs=2e-5)
    durations.add(3.0)
    assert durations.quantile(1.0) == pytest.approx(0.2) and durations.largest == 3.0


def test_a_period_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive period"):
        Deadlines(0.0, ManualClock())
