"""What a user sees while a recipe runs: lines in a log, a table in a terminal."""

from __future__ import annotations

import subprocess
import sys
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from agility_rl.training.display import Display, _clock


def plain() -> Console:
    return Console(file=StringIO(), force_terminal=False, width=200)


def terminal() -> Console:
    return Console(file=StringIO(), force_terminal=True, width=120, height=40)


def text(console: Console) -> str:
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_lines_show_the_headline_in_its_order() -> None:
    console = plain()
    with Display("bbc", 3, headline=("b/y", "a", "missing"), lines_every=1, console=console) as display:
        display.update(1, {"a": 1.0, "b/y": 0.123456, "other": 9.0})
    assert text(console) == "bbc 1/3  b/y 0.123  a 1\n"


def test_lines_come_at_their_interval_and_at_the_end() -> None:
    console = plain()
    with Display("bbc", 25, lines_every=10, console=console) as display:
        for iteration in range(1, 26):
            display.update(iteration, {})
    assert [line.split()[1] for line in text(console).splitlines()] == ["1/25", "11/25", "21/25", "25/25"]


def test_lines_of_a_resumed_run_start_at_once() -> None:
    console = plain()
    with Display("bbc", 100, lines_every=10, console=console) as display:
        for iteration in range(58, 70):
            display.update(iteration, {})
    assert [line.split()[1] for line in text(console).splitlines()] == ["58/100", "68/100"]


def test_notes_are_printed_as_they_are() -> None:
    console = plain()
    with Display("bbc", 1, console=console) as display:
        display.note("saved in runs/[bold]/x [of 3]")
    assert text(console) == "saved in runs/[bold]/x [of 3]\n"


def test_a_reader_that_is_gone_ends_no_training(tmp_path: Path) -> None:
    script = """
import sys
from agility_rl.training.display import Display
with Display("bbc", 3, lines_every=1) as display:
    for iteration in (1, 2, 3):
        display.update(iteration, {})
        sys.stdout.flush()
        sys.stdin.readline()  # the reader closes its end here
    display.note("done")
open(sys.argv[1], "w").write("saved")
"""
    command = [sys.executable, "-c", script, str(tmp_path / "end")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None
        assert process.stdout.readline() == b"bbc 1/3  \n"
        process.stdout.close()
        process.stdin.close()
        assert process.wait(60) == 0
    assert (tmp_path / "end").read_text() == "saved"


def test_a_terminal_shows_groups() -> None:
    console = terminal()
    with Display("bbc", 4, console=console) as display:
        display.update(1, {"loss": 0.5, "reward/task": 1.25, "reward/skill": float("nan")})
        display.note("a note")
    shown = text(console)
    for part in ("bbc  1/4", "losses", "reward", "task", "1.25", "skill", "nan", "a note", "left"):
        assert part in shown


def test_a_terminal_is_given_back_after_an_error() -> None:
    console = terminal()
    with pytest.raises(KeyboardInterrupt), Display("bbc", 4, console=console) as display:
        display.update(1, {})
        raise KeyboardInterrupt
    assert text(console).rstrip().endswith("\x1b[?25h")  # the cursor is back


def test_remaining_time_counts_only_what_this_process_did() -> None:
    display = Display("bbc", 110, console=terminal())
    display.update(101, {})
    display._start -= 60.0  # a minute for the one iteration since the resume, nine are left
    title = str(display._table(101, {}).title)
    assert "0:01:00" in title and "0:09:00 left" in title


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0, "0:00:00"), (59.9, "0:00:59"), (3661, "1:01:01"), (36000, "10:00:00")]
)
def test_clock(seconds: float, shown: str) -> None:
    assert _clock(seconds) == shown
