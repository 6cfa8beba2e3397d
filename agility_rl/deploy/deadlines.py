"""A loop at a fixed rate: absolute deadlines that never drift, and a count of those that were missed."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Something that tells the time and waits."""

    def now(self) -> float:
        """Seconds since some moment."""

    def sleep_until(self, moment: float) -> None:
        """Return at a moment, or at once if it has passed."""


class MonotonicClock:
    """The machine's clock, which no change of the date moves.

    Example:
        >>> clock = MonotonicClock()
        >>> start = clock.now()
        >>> clock.sleep_until(start + 0.001)
        >>> clock.now() >= start + 0.001
        True
    """

    def now(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Return at a moment, or at once if it has passed."""
        while (left := moment - time.monotonic()) > 0.0:
            time.sleep(left)


class ManualClock:
    """A clock that moves only when it is told to, for tests.

    Example:
        >>> clock = ManualClock()
        >>> clock.sleep_until(0.02)
        >>> clock.now()
        0.02
    """

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        """Seconds since the beginning."""
        return self.time

    def sleep_until(self, moment: float) -> None:
        """Be there at once."""
        self.time = max(self.time, moment)


@dataclass(frozen=True)
class Tick:
    """One turn of the loop.

    Attributes:
        index: number of the period since the start, skipped ones counted.
        due: when it was to begin [s].
        lateness: by how much later it did begin [s].
        skipped: whole periods right before it for which it was too late.
    """

    index: int
    due: float
    lateness: float
    skipped: int


class Deadlines:
    """Begins period ``k`` at ``start + k T``, whatever the earlier ones took.

    A period is missed if its work ends after the period does, or if it could not even begin within it; then it is
    skipped, and the loop goes on at the next multiple of ``T``, so that it does not fall behind.

    Source: no formula; ours (loops that sleep for T after their work run slower than 1 / T).

    Args:
        period: T [s].
        clock: what tells the time.

    Attributes:
        periods: how many have passed, skipped ones included.
        misses: how many of them were missed.
        consecutive: missed ones since the last that was in time.
        durations: from beginning to end of the work [s].
        latenesses: from due to beginning [s].

    Example:
        >>> clock = ManualClock()
        >>> deadlines = Deadlines(0.02, clock)
        >>> tick = deadlines.wait()
        >>> clock.time += 0.05  # work that takes two and a half periods
        >>> _ = deadlines.finish(tick)
        >>> deadlines.wait().index, deadlines.misses
        (2, 2)
    """

    def __init__(self, period: float, clock: Clock) -> None:
        if period <= 0.0:
            raise ValueError(f"expected a positive period [s], got {period}")
        self.period, self.clock = period, clock
        self.durations, self.latenesses = Durations(), Durations()
        self.restart()

    def restart(self) -> None:
        """Begin anew at the present, all counts at zero."""
        self.periods = self.misses = self.consecutive = 0
        self._start = self.clock.now()

    def wait(self) -> Tick:
        """Sleep until the next period begins."""
        due = self._start + self.periods * self.period
        self.clock.sleep_until(due)
        begun = self.clock.now()
        skipped = max(math.floor((begun - due) / self.period + 1e-9), 0)
        due += skipped * self.period
        self.periods += skipped
        self.misses += skipped
        self.consecutive += skipped
        self.latenesses.add(begun - due)
        self._begun = begun
        tick = Tick(self.periods, due, begun - due, skipped)
        self.periods += 1
        return tick

    def finish(self, tick: Tick) -> float:
        """Say that the work of a period is done; returns how long it took [s]."""
        now = self.clock.now()
        self.durations.add(now - self._begun)
        if now > tick.due + self.period:
            self.misses += 1
            self.consecutive += 1
        else:
            self.consecutive = 0
        return now - self._begun


class Durations:
    """Counts of durations in bins of 10 microseconds, so that an hour of them takes no more memory than a second.

    Example:
        >>> durations = Durations()
        >>> for milliseconds in range(100):
        ...     durations.add(1e-3 * milliseconds)
        >>> round(durations.quantile(0.5), 3), durations.largest
        (0.049, 0.099)
    """

    BIN = 1e-5
    BINS = 20_000  # up to 0.2 s, and everything longer in the last

    def __init__(self) -> None:
        self.count, self.largest = 0, 0.0
        self._counts = [0] * self.BINS

    def add(self, duration: float) -> None:
        """Count one [s]."""
        self.count += 1
        self.largest = max(self.largest, duration)
        self._counts[min(max(int(duration / self.BIN), 0), self.BINS - 1)] += 1

    def quantile(self, share: float) -> float:
        """Upper edge [s] of the bin below which this share of the durations lies; NaN without any."""
        below, wanted = 0, share * self.count
        for index, count in enumerate(self._counts):
            below += count
            if below >= wanted and below:
                return min((index + 1) * self.BIN, self.largest)
        return math.nan
