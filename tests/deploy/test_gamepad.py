"""Events as Linux's joystick interface sends them, through a pipe in its place."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agility_rl.deploy.gamepad import AXIS, BUTTON, DEAD, EVENT, FULL, INITIAL, GamepadDevice
from agility_rl.deploy.operator import Stick

Line = tuple[GamepadDevice, Callable[..., None], Callable[[], None]]


@pytest.fixture
def pad(tmp_path: Path) -> Iterator[Line]:
    """A gamepad, what sends an event, and what pulls it out."""
    path = tmp_path / "js0"
    os.mkfifo(path)
    hold = os.open(path, os.O_RDWR)  # so that neither end waits for the other
    device = GamepadDevice(path)
    write = os.open(path, os.O_WRONLY)
    os.close(hold)
    ends = [write]

    def send(*events: tuple[int, int, int]) -> None:
        os.write(write, b"".join(EVENT.pack(1234, value, kind, number) for kind, number, value in events))

    yield device, send, lambda: os.close(ends.pop())
    device.close()
    for end in ends:
        os.close(end)


def test_an_event_has_the_size_of_the_kernel_s(pad: Line) -> None:
    assert EVENT.size == 8, "struct js_event: u32 time, s16 value, u8 type, u8 number"


def test_buttons_count_when_they_go_down(pad: Line) -> None:
    device, send, _ = pad
    assert device.read() == []
    send((BUTTON, 0, 1), (BUTTON, 0, 0), (BUTTON, 1, 1), (BUTTON, 9, 1))
    assert device.read() == ["enter", "escape"]
    send((BUTTON | INITIAL, 1, 1))
    assert device.read() == [], "what is held when it is plugged in is no press"


def test_sticks_are_reported_when_they_move_and_rest_in_the_middle(pad: Line) -> None:
    device, send, _ = pad
    send((AXIS | INITIAL, 1, 0), (AXIS | INITIAL, 0, 0), (AXIS | INITIAL, 3, 0))
    assert device.read() == [], "plugging in takes nothing over"
    send((AXIS, 1, -FULL), (AXIS, 0, FULL))
    assert device.read() == [Stick(1.0, -1.0, 0.0)], "forward is up, left is positive"
    send((AXIS, 3, -FULL // 2))
    (stick,) = device.read()
    assert isinstance(stick, Stick) and stick.turn == pytest.approx((0.5 - DEAD) / (1 - DEAD), abs=1e-3)
    send((AXIS, 1, round(-0.9 * DEAD * FULL)), (AXIS, 0, 0), (AXIS, 3, 0))
    assert device.read() == [Stick()], "the dead zone"
    send((AXIS, 1, round(-0.5 * DEAD * FULL)))
    assert device.read() == []


def test_the_cross_chooses_the_behaviour(pad: Line) -> None:
    device, send, _ = pad
    send((AXIS, 6, -FULL), (AXIS, 6, 0), (AXIS, 7, -FULL), (AXIS | INITIAL, 7, FULL), (AXIS, 2, FULL))
    assert device.read() == ["1", "3"]


def test_half_an_event_waits_for_its_other_half(pad: Line, tmp_path: Path) -> None:
    device, _, _ = pad
    packed = EVENT.pack(0, 1, BUTTON, 2)
    end = os.open(tmp_path / "js0", os.O_WRONLY)
    os.write(end, packed[:3])
    assert device.read() == []
    os.write(end, packed[3:])
    assert device.read() == ["space"]
    os.close(end)


def test_pulled_out_is_gone(pad: Line) -> None:
    device, send, pull = pad
    send((BUTTON, 1, 1))
    pull()
    assert device.read() == ["escape"], "what was pressed before still counts"
    assert not device.connected() and device.ended() and device.read() == []
    device.close()


def test_no_gamepad_is_said_clearly(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected a gamepad at .*js7.*plugged in"):
        GamepadDevice(tmp_path / "js7")
