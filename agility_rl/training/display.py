"""Live progress of a recipe in the terminal: the numbers that matter, grouped, and the time that is left."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.table import Table


class Display:
    """Shows metrics of the present iteration; prints plain lines instead when the output is no terminal.

    Metrics named ``group/name`` stand together. Use as a context manager.

    Args:
        title: name of the recipe.
        total: number of iterations.
        lines_every: iterations between two lines when the output is no terminal.
        headline: metrics that a plain line shows.
        console: where to print.

    Example:
        >>> with Display("demo", 2, headline=("loss",), console=Console(file=__import__("sys").stdout)) as display:
        ...     display.update(1, {"loss": 0.5})
        demo 1/2  loss 0.5
    """

    def __init__(
        self,
        title: str,
        total: int,
        *,
        lines_every: int = 10,
        headline: tuple[str, ...] = (),
        console: Console | None = None,
    ) -> None:
        self.title = title
        self.total = total
        self.lines_every = lines_every
        self.headline = headline
        self.console = console or Console()
        self._start = time.monotonic()
        self._first: int | None = None
        self._live = Live(console=self.console, refresh_per_second=2) if self.console.is_terminal else None

    def __enter__(self) -> Display:
        if self._live is not None:
            self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            with contextlib.suppress(OSError):  # a terminal that was closed; what is to be saved comes after this
                self._live.__exit__(kind, error, trace)

    def update(self, iteration: int, metrics: Mapping[str, float]) -> None:
        """Show the metrics of a finished iteration."""
        if self._first is None:
            self._first = iteration - 1
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.update(self._table(iteration, metrics))
        elif (iteration - self._first) % self.lines_every == 1 or self.lines_every == 1 or iteration == self.total:
            shown = "  ".join(f"{name} {metrics[name]:.3g}" for name in self.headline if name in metrics)
            self._print(f"{self.title} {iteration}/{self.total}  {shown}", soft_wrap=True)

    def note(self, message: str) -> None:
        """Print a line above the display."""
        self._print(message)

    def _print(self, line: str, soft_wrap: bool | None = None) -> None:
        # Where a reader has gone (``| head``, a Ctrl-C that ended ``| tee`` too), rich asks to exit and is silent from
        # then on; a training is not to end unsaved by that.
        with contextlib.suppress(OSError, SystemExit):
            self.console.print(line, highlight=False, markup=False, soft_wrap=soft_wrap)

    def _table(self, iteration: int, metrics: Mapping[str, float]) -> Table:
        elapsed = time.monotonic() - self._start
        done = max(1, iteration - (self._first or 0))
        left = elapsed / done * (self.total - iteration)
        table = Table(title=f"{self.title}  {iteration}/{self.total}  {_clock(elapsed)} (at most {_clock(left)} left)")
        table.add_column("group")
        table.add_column("values")
        groups: dict[str, list[str]] = {}
        for name, value in metrics.items():
            group, _, rest = name.rpartition("/")
            groups.setdefault(group or "losses", []).append(f"{rest} [bold]{value:.3g}[/bold]")
        for group, values in groups.items():
            table.add_row(group, "  ".join(values))
        return table


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"
