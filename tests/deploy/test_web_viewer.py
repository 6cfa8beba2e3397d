"""The robot in a real browser, headless and with software graphics: what is seen, and real key presses."""

from __future__ import annotations

import base64
import importlib
import io
import json
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

from agility_rl.deploy.browser import BrowserDevice
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.operator import Status
from agility_rl.deploy.web_viewer import REPEATING, SINGLE, pages
from agility_rl.go2.appearance import dress
from agility_rl.go2.model import build_spec
from tests.waiting import until

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless --no-sandbox --no-first-run --disable-sync --disable-background-networking --disable-component-update "
    "--remote-debugging-port=0 --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--window-size=1000,500"
)
CODES = {
    "up": ("ArrowUp", "ArrowUp", 38),
    "left": ("ArrowLeft", "ArrowLeft", 37),
    "space": (" ", "Space", 32),
    "escape": ("Escape", "Escape", 27),
    "enter": ("Enter", "Enter", 13),
    "a": ("a", "KeyA", 65),
    **{str(digit): (str(digit), f"Digit{digit}", 48 + digit) for digit in range(1, 6)},
}
"""What Chromium calls a key: value, code, number."""
SLOW = 90.0
"""Time that software graphics on a busy machine may take [s]."""


class Page:
    """A page in Chromium, by its DevTools protocol."""

    def __init__(self, url: str, folder: Path) -> None:
        assert CHROMIUM is not None
        self._log = open(folder / "chromium.log", "w")  # noqa: SIM115
        command = [CHROMIUM, *FLAGS.split(), f"--user-data-dir={folder / 'profile'}", "about:blank"]
        self._process = subprocess.Popen(command, stderr=self._log)
        said = folder / "profile" / "DevToolsActivePort"
        assert until(lambda: said.exists() and said.read_text().strip()), "Chromium does not start"
        port = said.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            tabs = json.load(answer)
        address = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
        self._line = connect(address, max_size=None).__enter__()
        self._number = 0
        self.call("Page.navigate", url=url)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        self._line.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._line.recv(timeout=SLOW))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def press(self, key: str) -> None:
        """As long as a finger does."""
        # A window that nobody looks at has no focus, and a page without focus takes no keys.
        self.call("Emulation.setFocusEmulationEnabled", enabled=True)
        value, code, number = CODES[key]
        entries = {"key": value, "code": code, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", **entries)
        time.sleep(0.1)
        self.call("Input.dispatchKeyEvent", type="keyUp", **entries)

    def click(self, x: float, y: float) -> None:
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        time.sleep(1.0)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
            time.sleep(1.0)

    def picture(self) -> np.ndarray:
        """``[height, width, 3]``, 0 to 255."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.array(Image.open(io.BytesIO(data)).convert("RGB")).astype(np.int64)

    def close(self) -> None:
        """Once or twice."""
        self._line.close()
        self._process.terminate()
        self._process.wait(SLOW)
        self._log.close()


@pytest.fixture
def open_page(tmp_path: Path) -> Iterator[Callable[[str], Page]]:
    if CHROMIUM is None:
        pytest.skip("needs Chromium: apt-get install chromium, or your system's own way")
    opened: list[Page] = []

    def begin(url: str) -> Page:
        opened.append(Page(url, tmp_path))
        return opened[-1]

    yield begin
    for page in opened:
        page.close()


def orange(picture: np.ndarray) -> np.ndarray:
    """Where the trunk is."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return (red > 120) & (red > 1.3 * green) & (green > 1.3 * blue) & (green > 60)


def signal_red(picture: np.ndarray) -> np.ndarray:
    """Where the stop button is."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return (red > 150) & (green < 60) & (blue < 60)


@pytest.mark.parametrize(
    ("origin", "own"),
    [
        ("http://localhost:8080", True),
        ("http://127.0.0.1:9000", True),  # through a tunnel
        ("http://[::1]:8080", True),
        ("https://example.org", False),
        ("http://localhost.example.org:8080", False),
        ("http://evil.org/http://localhost:8080", False),
        ("null", False),
    ],
)
def test_only_pages_of_this_machine_may_talk_to_it(origin: str, own: bool) -> None:
    assert (pages("127.0.0.1").fullmatch(origin) is not None) is own


def test_a_named_address_adds_its_own_pages() -> None:
    assert pages("192.168.1.7").fullmatch("http://192.168.1.7:8080")
    assert not pages("192.168.1.7").fullmatch("http://192.168.1.70:8080")
    assert not pages("192.168.1.7").fullmatch("http://192x168.1.7:8080"), "a dot is a dot"
    assert pages("0.0.0.0").fullmatch("http://robot.local:8080"), "any name may lead here then"


def test_every_key_that_means_something_is_passed_on() -> None:
    from agility_rl.deploy.operator import BEHAVIOUR_KEYS, GIVE_BACK, GO_ON, STEPS, STOP

    assert set(STEPS) == set(REPEATING)
    assert {*BEHAVIOUR_KEYS, GIVE_BACK, GO_ON, STOP} <= set(SINGLE)


@pytest.mark.slow
def test_keys_and_the_stop_button_of_a_real_page(open_page: Callable[[str], Page]) -> None:
    device = BrowserDevice(dress(build_spec()).compile())
    try:
        status = Status(Mode.RUN, "trot", "policy", (1.0, 0.0, 0.0), (0.9, 0.0, 0.0), "requested")
        page = open_page(device.url)
        assert until(device.connected), "no page"
        assert until(lambda: signal_red(page.picture()).sum() > 2000), "no stop button is to be seen"
        assert until(lambda: orange(page.picture()).sum() > 200), "no robot is to be seen"
        before = device.read()
        assert list(before) == [], "nobody has pressed anything"
        for key in CODES:
            found: list[Any] = []
            page.press(key)
            assert until(lambda found=found: found.extend(device.read()) or found), f"{key} has not arrived"
            assert set(found) == {key}
        rows, columns = np.nonzero(signal_red(page.picture()))
        page.click(float(columns.mean()), float(rows.mean()))
        found = []
        assert until(lambda: found.extend(device.read()) or found) and found == ["escape"]
        # The camera follows: a robot that has moved on is where it was on the picture, one that has fallen is not.
        pose = dress(build_spec()).compile().qpos0.copy()
        pose[0] += 3.0
        device.show(Status(status.mode, "trot", "policy", (1.0, 0.0, 0.0), (0.9, 0.0, 0.0), "requested", tuple(pose)))
        time.sleep(3.0)
        assert orange(page.picture()).sum() > 200
        page.close()
        assert until(lambda: not device.connected()), "a closed page is no operator"
    finally:
        device.close()


@pytest.fixture
def play(repository: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    folder = repository / "recipes"
    monkeypatch.syspath_prepend(str(folder))
    yield importlib.import_module("play")
    for path in folder.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.mark.slow
def test_play_is_steered_from_a_page(
    play: ModuleType, open_page: Callable[[str], Page], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture
) -> None:
    """The shipped controller, as on a bare clone: it stands up by itself, and the keyboard steers it."""
    found: list[Controller] = []

    class Seen(Controller):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            found.append(self)

    monkeypatch.setattr(play, "Controller", Seen)
    done = threading.Event()
    thread = threading.Thread(target=play.play, args=(play.Config(open=False), done.is_set))
    begin = time.monotonic()
    thread.start()
    try:
        said: list[str] = []
        assert until(lambda: said.append(capfd.readouterr().out) or "robot: http" in "".join(said))
        address = re.search(r"robot: (\S+)", "".join(said))
        assert address is not None and "only programs on this machine" in "".join(said)
        page = open_page(address.group(1))
        (controller,) = found
        control: Any = controller.commander
        assert until(lambda: controller.mode is Mode.RUN), list(controller.events)
        print(f"running {time.monotonic() - begin:.1f} s after the start")
        state = controller.transport.read
        assert until(lambda: control.latest is not None)
        assert control.chosen_by == "policy" and control.latest.name == "walk"
        page.press("3")
        assert until(lambda: control.chosen_by == "operator: behaviour")
        page.press("up")
        assert until(lambda: control.chosen_by == "operator: behaviour and velocity")
        assert until(lambda: control.latest.name == "trot" and float(control.latest.command[0]) > 0.59)
        start = state().trunk_position
        assert until(lambda: (state().trunk_position - start).norm() > 1.0), "it trots away"
        page.press("space")
        assert until(lambda: control.chosen_by == "policy" and control.latest.name == "walk")
        page.press("escape")
        assert until(lambda: controller.mode is Mode.DAMPING) and controller.fault is None
        assert until(lambda: state().trunk_position[2] < 0.15), "it lies"
    finally:
        done.set()
        thread.join(SLOW)
    assert not thread.is_alive()
