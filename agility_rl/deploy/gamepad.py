"""An operator with a gamepad: events of Linux's joystick interface, without a library."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from agility_rl.deploy.operator import Status, Stick

EVENT = struct.Struct("<IhBB")
"""Time [ms], value, type, number (Linux, ``Documentation/input/joydev/joystick-api.rst``)."""
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80
"""Types of events; ``INITIAL`` is added to those that say how things stand when the device is opened."""
FULL = 32767
"""Value of a stick at its stop."""
DEAD = 0.12
"""Share of a stick's way in which it counts as released; ours."""
FORWARD_AXIS, LEFT_AXIS, TURN_AXIS = 1, 0, 3
"""Left stick forward and sideways, right stick sideways; every axis is negative forward and to the left."""
CROSS_AXES = (6, 7)
"""Directional pad, sideways and forward: slow behaviours to fast ones."""
BUTTONS: dict[int, str] = {0: "enter", 1: "escape", 2: "space", 3: "5", 4: "escape", 5: "escape"}
"""A: go on, B and both shoulders: stop, X: give control back, Y: jump (order of Linux's xpad driver)."""
CROSS: dict[tuple[int, int], str] = {(0, -1): "1", (0, 1): "2", (1, -1): "3", (1, 1): "4"}
"""Left: walk, right: pace, forward: trot, back: canter."""


class GamepadDevice:
    """Reads a gamepad; it counts as connected until it is pulled out.

    Args:
        path: device file, such as ``/dev/input/js0``.

    Raises:
        ValueError: if there is no such device.
    """

    def __init__(self, path: str | Path = "/dev/input/js0") -> None:
        try:
            self._file: int | None = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ValueError(f"expected a gamepad at {path}, got: {error.strerror}; is it plugged in?") from error
        self._stick = Stick()
        self._rest = b""

    def read(self) -> Sequence[str | Stick]:
        """Buttons that were pressed since the last call, and the sticks if they moved."""
        found: list[str | Stick] = []
        before = self._stick
        for value, kind, number in self._events():
            if kind == BUTTON and value == 1 and number in BUTTONS:
                found.append(BUTTONS[number])
            elif kind & ~INITIAL == AXIS:
                found += self._move(value, number, bool(kind & INITIAL))
        return [*found, self._stick] if self._stick != before else found

    def _move(self, value: int, number: int, initial: bool) -> list[str]:
        if number in CROSS_AXES:
            key = CROSS.get((CROSS_AXES.index(number), (value > 0) - (value < 0)))
            return [key] if key and not initial else []
        names = {FORWARD_AXIS: "forward", LEFT_AXIS: "left", TURN_AXIS: "turn"}
        if number in names:
            share = -value / FULL
            free = max(abs(share) - DEAD, 0.0) / (1.0 - DEAD)  # no jump where the dead zone ends
            self._stick = self._stick._replace(**{names[number]: min(free, 1.0) * (1.0 if share > 0 else -1.0)})
        return []

    def _events(self) -> list[tuple[int, int, int]]:
        while self._file is not None:
            try:
                part = os.read(self._file, 64 * EVENT.size)
            except BlockingIOError:
                break
            except OSError:  # pulled out
                part = b""
            if not part:
                self.close()
            self._rest += part
        whole = len(self._rest) - len(self._rest) % EVENT.size
        packed, self._rest = self._rest[:whole], self._rest[whole:]
        return [event[1:] for event in EVENT.iter_unpack(packed)]

    def connected(self) -> bool:
        """Whether it is still plugged in."""
        return self._file is not None

    def ended(self) -> bool:
        """Whether it was pulled out."""
        return self._file is None

    def show(self, status: Status) -> None:
        """A gamepad shows nothing."""

    def close(self) -> None:
        """Let go of the device."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
