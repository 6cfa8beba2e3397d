"""Keys through a real pseudo-terminal."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import termios
import time
from collections.abc import Iterator
from typing import TextIO

import pytest

from agility_rl.deploy.controller import Mode
from agility_rl.deploy.operator import Device, Status, Stick
from agility_rl.deploy.terminal import SHOW_EVERY, TerminalDevice, keys_in
from tests.waiting import until


@pytest.fixture
def line() -> Iterator[tuple[int, TextIO]]:
    """The operator's end of a terminal, and ours."""
    person, program = pty.openpty()
    with os.fdopen(program, "r") as stream:
        yield person, stream
    if person >= 0:
        os.close(person)


def pressed(device: Device, wait: float = 2.0) -> list[str | Stick]:
    """What arrives, within some time."""
    end = time.monotonic() + wait
    while time.monotonic() < end:
        if found := list(device.read()):
            return found
        time.sleep(0.005)
    return []


@pytest.mark.parametrize(
    ("sent", "keys"),
    [
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA", ["up"]),
        (b"12345", ["1", "2", "3", "4", "5"]),
        (b" \r\n\x7f", ["space", "enter", "enter", "backspace"]),
        (b"\x1b", ["escape"]),
        (b"\x1b\x1b", ["escape", "escape"]),
        (b"\x1b[A\x1b", ["up", "escape"]),
        (b"aD", ["a", "d"]),
        (b"\x1b[3~\x1b[15~\x1b[1;5C2", ["2"]),  # delete, F5, control with an arrow: not an escape and a number
        (b"\xc3\xa4;,", []),
    ],
)
def test_sequences_become_keys(sent: bytes, keys: list[str]) -> None:
    assert keys_in(sent) == keys


def test_keys_arrive_without_a_return_and_the_terminal_is_given_back(line: tuple[int, TextIO]) -> None:
    person, program = line
    before = termios.tcgetattr(program.fileno())
    screen = io.StringIO()
    device = TerminalDevice(program, screen)
    assert device.read() == [], "it does not wait"
    os.write(person, b"3\x1b[A ")
    assert pressed(device) == ["3", "up", "space"]
    assert device.connected() and not device.ended()
    device.close()
    device.close()
    assert termios.tcgetattr(program.fileno()) == before


def test_an_arrow_in_two_halves_is_no_stop(line: tuple[int, TextIO]) -> None:
    person, program = line
    device = TerminalDevice(program, io.StringIO())
    for first, second in ((b"\x1b", b"[A"), (b"\x1b[", b"A")):
        os.write(person, first)
        time.sleep(0.01)
        assert device.read() == []
        os.write(person, second)
        assert pressed(device) == ["up"]
    os.write(person, b"2\x1b")
    assert pressed(device) == ["2"]
    assert device.read() == ["escape"], "one control step later nothing has followed"
    assert device.read() == []
    device.close()


def test_the_state_is_one_line_no_wider_than_the_terminal(line: tuple[int, TextIO]) -> None:
    person, program = line
    termios.tcsetwinsize(person, (24, 50))
    screen = io.StringIO()
    device = TerminalDevice(program, screen)
    for number in range(2 * SHOW_EVERY):
        device.show(Status(Mode.RUN, "trot", "policy", (0.1 * number, 0.0, 0.0), (0.0, 0.0, 0.0), "requested"))
        until(device._lines.empty)
    device.close()
    written = screen.getvalue().rstrip("\n").split("\r\x1b[K")[1:]
    assert len(written) == 2 and all(len(text) <= 49 and "\n" not in text for text in written)
    assert written[0].startswith("run: trot commanded +0.00 m/s") or written[0].startswith("run: trot  commanded")


def test_a_screen_that_takes_nothing_holds_nobody_up(line: tuple[int, TextIO]) -> None:
    person, program = line
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, bytes(4096))
    os.set_blocking(write, True)
    with os.fdopen(read, "rb"), os.fdopen(write, "w") as screen:
        device = TerminalDevice(program, screen)
        for _ in range(10 * SHOW_EVERY):
            device.show(Status(Mode.RUN))  # would never return if it waited for the screen
        os.write(person, b"\x13\x1a\x1b")  # Ctrl-S and Ctrl-Z are mere bytes, and Escape is heard
        assert until(lambda: "escape" in device.read())
        device.close()
        os.read(read, 1 << 20)
        device._writer.join()


def test_a_person_who_hangs_up_is_gone() -> None:
    person, program = pty.openpty()
    with os.fdopen(program, "r") as stream:
        device = TerminalDevice(stream, io.StringIO())
        os.close(person)
        assert device.read() == []
        assert not device.connected() and device.ended()


def test_no_terminal_is_said_clearly() -> None:
    read, write = os.pipe()
    os.close(write)
    with os.fdopen(read, "r") as stream, pytest.raises(ValueError, match="expected a terminal"):
        TerminalDevice(stream, io.StringIO())
