"""What a person holds to drive a robot, for ``play.py`` and ``deploy.py``: a browser, a terminal, a gamepad."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agility_rl.deploy.browser import LOOPBACK, BrowserDevice, exposure
from agility_rl.deploy.controller import StepRecord
from agility_rl.deploy.gamepad import GamepadDevice
from agility_rl.deploy.operator import STOP, Device, Operation, Status, Stick
from agility_rl.deploy.terminal import TerminalDevice


@dataclass(frozen=True, kw_only=True)
class ControlsConfig:
    address: str = LOOPBACK
    """With a browser: IP address to listen on; with any but the default, others can drive the robot too."""
    port: int = 0
    """With a browser: port of the page; 0 takes the first free one from 8080 on."""
    open: bool = True
    """With a browser: open the page, if there is a screen."""
    gamepad: Path = Path("/dev/input/js0")
    """With a gamepad: its device."""


class Both:
    """A gamepad to steer, a page to look at; keys of both count, and to pull the gamepad out is a stop."""

    def __init__(self, held: Device, seen: Device) -> None:
        self.held, self.seen = held, seen
        self._pulled = False

    def read(self) -> Sequence[str | Stick]:
        """What came in from both."""
        entries = [*self.held.read(), *self.seen.read()]
        if self.held.ended() and not self._pulled:  # else the robot would go on with where its sticks stood last
            self._pulled = True
            entries.append(STOP)
        return entries

    def connected(self) -> bool:
        """Whether what is held in the hand is there; without it, whether the page is, which can go on after a stop."""
        return self.seen.connected() if self.held.ended() else self.held.connected()

    def ended(self) -> bool:
        """Whether the page has."""
        return self.seen.ended()

    def show(self, status: Status) -> None:
        """Only the page can."""
        self.seen.show(status)

    def close(self) -> None:
        """Let go of both."""
        self.held.close()
        self.seen.close()


class ByHand:
    """A run in which the operator asks for every mode; it ends with the device."""

    def __init__(self, operation: Operation) -> None:
        self.operation = operation

    def __call__(self, step: StepRecord) -> None:
        """Once in every control step."""
        self.operation(step)

    @property
    def finished(self) -> bool:
        """Whether the device has gone and the robot lies."""
        return self.operation.device.ended()


def make_device(
    operator: str, cfg: ControlsConfig, model: Callable[[], Any], more_help: dict[str, str] | None = None
) -> Device:
    """What the operator holds and sees.

    Args:
        operator: ``browser``, ``terminal`` or ``gamepad``, beside which a page shows the robot.
        cfg: the rest.
        model: makes what the page draws.
        more_help: further keys and what they do.
    """
    more = more_help or {}
    if operator == "terminal":
        device = TerminalDevice()
        extra = "".join(f", {key} {text}" for key, text in more.items())
        print(
            "Up, Down, Left, Right, A, D steer; 1 to 5 choose the behaviour, Space gives control back; "
            f"Enter: stand up, run, stand; Escape stops{extra}; Ctrl-C ends",
            flush=True,
        )
        return device
    held = GamepadDevice(cfg.gamepad) if operator == "gamepad" else None
    help_lines = [f"{key:14}{text}" for key, text in more.items()]
    seen = BrowserDevice(
        model(), address=cfg.address, port=cfg.port, open_browser=cfg.open, title="Go2", more_help=help_lines
    )
    print(f"robot: {seen.url}  ({exposure(cfg.address)})", flush=True)
    return seen if held is None else Both(held, seen)
