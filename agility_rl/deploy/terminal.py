"""An operator at a terminal: raw keys from the standard input, and one line about the robot."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import sys
import threading
from collections.abc import Sequence
from typing import Any, TextIO

from agility_rl.deploy.operator import Status, Stick

SEQUENCES: dict[bytes, str] = {
    b"\x1b[A": "up",
    b"\x1b[B": "down",
    b"\x1b[C": "right",
    b"\x1b[D": "left",
    b"\x1bOA": "up",  # terminals in application mode
    b"\x1bOB": "down",
    b"\x1bOC": "right",
    b"\x1bOD": "left",
    b"\r": "enter",
    b"\n": "enter",
    b" ": "space",
    b"\x7f": "backspace",
    b"\x08": "backspace",
}
"""What a terminal sends, and our names of keys; other printable characters are their own names."""
SHOW_EVERY = 5
"""Looks at the robot between two lines that are written."""
CLOSE_SECONDS = 0.2
"""Longest wait for a screen that does not take its last line [s]."""
ESCAPE = b"\x1b"
TOKEN = re.compile(rb"\x1b[\[O][0-9;]*[A-Za-z~]|.", re.DOTALL)
"""A key with a sequence of its own, known or not, or one byte."""
UNFINISHED = re.compile(rb"\x1b([\[O][0-9;]*)?$")
"""An escape key, or the beginning of a sequence whose rest is on its way."""


def keys_in(received: bytes) -> list[str]:
    """Names of the keys in what a terminal sent; an escape that begins no sequence is the key itself.

    Example:
        >>> keys_in(b"3\\x1b[A\\x1b ")
        ['3', 'up', 'escape', 'space']
    """
    keys = []
    for token in TOKEN.findall(received):
        if token in SEQUENCES:
            keys.append(SEQUENCES[token])
        elif token == ESCAPE:
            keys.append("escape")
        elif len(token) == 1 and token.isalnum():
            keys.append(token.decode("ascii").lower())
    return keys


class TerminalDevice:
    """Reads keys without waiting for the end of a line; Ctrl-C works as ever, Ctrl-S and Ctrl-Z halt nothing.

    It counts as connected while its input is open. A connection that is closed ends the input, or the program by the
    system's signal (:func:`agility_rl.training.cli.interruptible`); one that goes dead without a word is not noticed
    before its own time is out. Lines are written by a thread: a screen that does not take them holds nobody up.

    Args:
        keys: where keys come from; the standard input by default.
        screen: where lines go; the standard output by default.

    Raises:
        ValueError: if the input is no terminal.
    """

    def __init__(self, keys: TextIO | None = None, screen: TextIO | None = None) -> None:
        import termios  # not on every system, and only needed here
        import tty

        self._screen = sys.stdout if screen is None else screen
        self._file = (sys.stdin if keys is None else keys).fileno()
        if not os.isatty(self._file):
            raise ValueError("expected a terminal to read keys from, got a pipe or a file; run this in a terminal")
        self._termios = termios
        self._before: list[Any] | None = termios.tcgetattr(self._file)
        tty.setcbreak(self._file)
        now = termios.tcgetattr(self._file)
        now[0] &= ~termios.IXON
        now[6][termios.VSUSP] = b"\0"
        termios.tcsetattr(self._file, termios.TCSADRAIN, now)
        self._open, self._shown, self._rest = True, 0, b""
        self._lines: queue.Queue[str | None] = queue.Queue(maxsize=1)
        self._writer = threading.Thread(target=self._write, name="screen", daemon=True)
        self._writer.start()

    def _write(self) -> None:
        with contextlib.suppress(OSError):  # the other end of the terminal has gone
            while (text := self._lines.get()) is not None:
                columns = os.get_terminal_size(self._file).columns or 80
                self._screen.write("\r\x1b[K" + text[: columns - 1])
                self._screen.flush()
            self._screen.write("\n")
            self._screen.flush()

    def read(self) -> Sequence[str | Stick]:
        """Keys since the last call; an escape waits for the next call, since it may be half of an arrow."""
        new = b""
        while self._open and select.select([self._file], [], [], 0)[0]:
            try:
                part = os.read(self._file, 1024)
            except OSError:  # the other end of the terminal has gone
                part = b""
            self._open = bool(part)
            new += part
        received, self._rest = self._rest + new, b""
        if new and (half := UNFINISHED.search(received)):
            received, self._rest = received[: half.start()], received[half.start() :]
        return keys_in(received)

    def connected(self) -> bool:
        """Whether the input is open."""
        return self._open

    def ended(self) -> bool:
        """Whether the input is closed."""
        return not self._open

    def show(self, status: Status) -> None:
        """Write the state over the last line, a few times a second."""
        if self._shown % SHOW_EVERY == 0:
            text = "  ".join(" ".join(words.split()) for _, words in status.lines())
            with contextlib.suppress(queue.Full):  # the line before is still being written
                self._lines.put_nowait(text)
        self._shown += 1

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._before is not None:
            with contextlib.suppress(self._termios.error):  # the other end has gone
                self._termios.tcsetattr(self._file, self._termios.TCSADRAIN, self._before)
            self._before = None
            with contextlib.suppress(queue.Empty):  # a line that is still to be written
                self._lines.get_nowait()
            self._lines.put(None)
            self._writer.join(CLOSE_SECONDS)
