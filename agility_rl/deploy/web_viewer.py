"""A process that shows a robot in MuJoCo's web viewer, and passes on the keys that are pressed there.

    python -m agility_rl.deploy.web_viewer '{"model": "scene.mjb", "address": "127.0.0.1", "port": 0, ...}'

:class:`agility_rl.deploy.browser.BrowserDevice` starts it. One JSON object a line each way: in come what to show
(``qpos``, ``lines``), out go the port, then keys and signs of life of the page. It ends when its input does.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, TextIO

import mujoco
import numpy as np
from mujoco.studio import launch_thread, messages, plugin, ux, viewer_protocol, web_viewer
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.web import web_server
from websockets.asyncio.server import ServerConnection, serve

SIGN_OF_LIFE = 0.1
"""Time between two signs of life of the page that are passed on [s]."""
SERVER_SECONDS = 30.0
"""Time that the viewer's server gets to come up [s]."""
LONGEST_FRAME = 0.5
"""Time after which the next frame is prepared although the page has not drawn the last one [s]."""
CONTROLS = "/ui"
"""Where the page that holds the controls sends what is pressed, and something in every frame that it draws."""
FRAME_PERIOD = 0.02
"""Time between two poses that are shown [s]."""
REPEATING = {"up": "UpArrow", "down": "DownArrow", "left": "LeftArrow", "right": "RightArrow", "a": "A", "d": "D"}
"""Keys that go on while they are held: our names and the viewer's."""
SINGLE = {
    "enter": "Enter",
    "space": "Space",
    "escape": "Escape",
    "backspace": "Backspace",
    **{str(digit): f"N{digit}" for digit in range(1, 6)},
}
"""Keys that count once each time they are pressed."""
COLUMN = 120.0
"""Where the second column of the panel begins [pixels]; two spaces in a line lead there."""
LOCAL_PAGES = r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"
"""Addresses of pages that may talk to a viewer on this machine, also through a tunnel."""
HOLD_LONG_ENOUGH = b"""<script>
  // The viewer asks once a picture what is held. On a page that draws slowly, a stop that is pressed and let go between
  // two pictures would never be heard: what goes down stays down for two pictures.
  const drawn = new Map();
  const count = () => { drawn.forEach((n, what) => drawn.set(what, n + 1)); requestAnimationFrame(count); };
  requestAnimationFrame(count);
  const what = (event) => event.code ?? event.type.replace(/down|up/, "") + event.button;
  for (const down of ["keydown", "mousedown", "pointerdown"])
    addEventListener(down, (event) => { if (!event.repeat) drawn.set(what(event), 0); }, true);
  for (const up of ["keyup", "mouseup", "pointerup"])
    addEventListener(up, (event) => {
      if (!event.isTrusted || (drawn.get(what(event)) ?? 2) >= 2) return;
      event.stopImmediatePropagation();
      const again = new event.constructor(up, event), target = event.target;
      const later = () => {
        if (drawn.get(what(event)) >= 2) target.dispatchEvent(again);
        else requestAnimationFrame(later);
      };
      requestAnimationFrame(later);
    }, true);
</script>
"""
"""Script of the page, ahead of the viewer's own."""
_HEAD = b"<head>"
_COLOURS = {
    "title": (1.0, 1.0, 1.0, 1.0),
    "good": (0.45, 0.9, 0.5, 1.0),
    "bad": (1.0, 0.45, 0.4, 1.0),
    "dim": (0.72, 0.76, 0.8, 1.0),
}


def pages(address: str) -> re.Pattern[str]:
    """Origins of pages that may drive the robot: those that this viewer serves, not any page that is open elsewhere.

    Example:
        >>> pages("127.0.0.1").fullmatch("http://localhost:8080") is not None
        True
        >>> pages("127.0.0.1").fullmatch("http://example.org") is None
        True
    """
    ip = ipaddress.ip_address(address)
    if ip.is_unspecified:
        return re.compile(r"https?://.+")
    own = re.escape(f"[{address}]" if ip.version == 6 else address)
    return re.compile(rf"{LOCAL_PAGES}|https?://{own}(:\d+)?")


def with_script(process_request: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """What answers requests, with :data:`HOLD_LONG_ENOUGH` in the page."""

    def answer(connection: Any, request: Any) -> Any:
        response = process_request(connection, request)
        if response is not None and _HEAD in response.body:
            response.body = response.body.replace(_HEAD, _HEAD + HOLD_LONG_ENOUGH, 1)
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    return answer


def guard(address: str, spoke: Callable[[], None]) -> None:
    """Make the viewer's server refuse pages of other sites, and say when the page with the controls speaks.

    Without the first, whatever page the operator has open in the same browser could drive the robot, loopback or not.

    Args:
        address: that the viewer listens on.
        spoke: called whenever the page with the controls has drawn, from the server's thread.
    """

    class Page(ServerConnection):
        async def recv(self, *args: Any, **options: Any) -> Any:
            message = await super().recv(*args, **options)
            path = "" if self.request is None else self.request.path
            if path.split("?")[0] == CONTROLS:
                spoke()
            return message

    def serve_page(*args: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
        options |= {"origins": [None, pages(address)], "create_connection": Page}
        return serve(*args, process_request=with_script(process_request), **options)

    web_server.serve = serve_page


class Pulse:
    """The page's own pace: it says something whenever it has drawn.

    Args:
        alive: called a few times a second while it does.
    """

    def __init__(self, alive: Callable[[], None]) -> None:
        self.drawn = threading.Event()
        self._alive, self._last = alive, 0.0

    def __call__(self) -> None:
        """The page has spoken."""
        self.drawn.set()
        if (now := time.monotonic()) - self._last >= SIGN_OF_LIFE:
            self._last = now
            self._alive()

    def wait(self) -> None:
        """Until the page has drawn again, or seems to be gone."""
        self.drawn.wait(LONGEST_FRAME)
        self.drawn.clear()


class AddressedWebViewer(web_viewer.WebViewer):
    """MuJoCo's web viewer on one address, at the pace of its page.

    By itself, it listens on every interface of the machine, and sends panels that a slow page reads ever later.

    Args:
        address: IP address to listen on.
        pulse: of the page.

    Raises:
        RuntimeError: if it listens elsewhere, which would be another version of MuJoCo.
    """

    def __init__(self, *args: Any, address: str, pulse: Pulse, **options: Any) -> None:
        self.address, self.pulse = address, pulse
        super().__init__(*args, **options)
        bound = self._http_sock.getsockname()[0]
        if ipaddress.ip_address(bound) != ipaddress.ip_address(address):
            self.close()
            raise RuntimeError(f"the viewer listens on {bound}, expected {address}; MuJoCo {mujoco.__version__}")

    def prepare_next_frame(self) -> bool:
        """One frame for each that the page has drawn."""
        self.pulse.wait()
        return bool(super().prepare_next_frame())

    @property
    def _host(self) -> str:
        return self.address

    @_host.setter
    def _host(self, value: str) -> None:
        """The viewer asks for every interface here, and reads what it gets before it binds."""


class OperatorPanel(plugin.ViewerPlugin):
    """What the operator sees and presses.

    Args:
        send: called with ``{"key": name}`` for every key.
        help_lines: keys, two spaces, what they do; none for a panel without controls.
        body: name of the body that the camera follows.
    """

    def __init__(self, send: Callable[[Mapping[str, Any]], None], help_lines: list[str], body: str = "trunk") -> None:
        self.send, self.help_lines, self.body = send, help_lines, body
        self.lines: list[tuple[str, str]] = []
        self._keys = {name: getattr(imgui.Key, key) for name, key in (REPEATING | SINGLE).items()}

    @messages.handler
    def _on_init(self, _: plugin.ViewerInitEvent) -> None:
        ux.setup_theme(ux.GuiTheme.DARK)

    @messages.handler
    def _on_model(self, event: messages.PostModelEvent) -> None:
        """The camera follows the robot, from behind its left side."""
        camera = self.viewer.camera
        camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
        camera.trackbodyid = event.model.body(self.body).id
        camera.distance, camera.azimuth, camera.elevation = 2.0, 30.0, -22.0
        self.viewer.camera_index = ux.TRACKING_CAMERA_IDX

    @messages.handler
    def _on_update(self, _: messages.UpdateEvent) -> None:
        for name, key in self._keys.items():
            if imgui.IsKeyPressed(key, name in REPEATING):
                self.send({"key": name})

    @messages.handler
    def _on_gui(self, _: messages.BuildGuiEvent) -> None:
        flags = imgui.WindowFlags
        fixed = int(flags.NoDecoration) | int(flags.NoMove) | int(flags.NoNav) | int(flags.AlwaysAutoResize)
        imgui.SetNextWindowPos(imgui.Vec2(12.0, 12.0))
        imgui.SetNextWindowBgAlpha(0.8)
        if imgui.Begin("robot", flags=fixed)[0]:
            imgui.SetWindowFontScale(1.25)
            for style, line in self.lines:
                _columns(style, line)
            if self.help_lines:
                self._controls()
        imgui.End()

    def _controls(self) -> None:
        imgui.Spacing()
        imgui.PushStyleColor(int(imgui.Col.Button), imgui.Vec4(0.75, 0.12, 0.1, 1.0))
        if imgui.Button("STOP  (Esc)", imgui.Vec2(260.0, 44.0)):
            self.send({"key": "escape"})
        imgui.PopStyleColor(1)
        imgui.Spacing()
        for line in self.help_lines:
            _columns("dim", line)


def _columns(style: str, line: str) -> None:
    name, gap, rest = line.partition("  ")
    imgui.TextColored(imgui.Vec4(*_COLOURS[style]), name)
    if gap:
        imgui.SameLine(COLUMN)
        imgui.TextColored(imgui.Vec4(*_COLOURS[style]), rest.strip())


def wait_for_server(address: str, port: int) -> None:
    """Return once the viewer's server, which has a thread of its own, answers.

    Raises:
        ConnectionError: if it does not.
    """
    ip = ipaddress.ip_address(address)
    own = ("::1" if ip.version == 6 else "127.0.0.1") if ip.is_unspecified else address
    for _ in range(round(SERVER_SECONDS / FRAME_PERIOD)):
        with contextlib.suppress(OSError), socket.create_connection((own, port), timeout=1.0):
            return
        time.sleep(FRAME_PERIOD)
    raise ConnectionError(f"the viewer does not answer on {own}, port {port}, within {SERVER_SECONDS:.0f} s")


class Show:
    """The newest of what is to be shown, taken from lines of JSON in a thread of its own."""

    def __init__(self, lines: TextIO) -> None:
        self.latest: dict[str, Any] = {}
        self.ended = False
        self._lines = lines
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self._lines:
            self.latest = json.loads(line)
        self.ended = True


def main(options: dict[str, Any], lines: TextIO, out: TextIO) -> None:
    """Serve until the input ends."""
    address = options["address"]
    model = mujoco.MjModel.from_binary_path(options["model"])
    data = mujoco.MjData(model)
    lock = threading.Lock()

    def send(message: Mapping[str, Any]) -> None:
        with lock:
            out.write(json.dumps(message) + "\n")
            out.flush()

    pulse = Pulse(lambda: send({"alive": True}))
    guard(address, pulse)
    panel = OperatorPanel(send, options["help"])
    config = viewer_protocol.ViewerConfig(
        title=options["title"], gfx="web", http_port=options["port"], open_browser=options["open"]
    )

    def target(endpoint: Any) -> None:
        try:
            viewer = AddressedWebViewer(config, endpoint, address=address, pulse=pulse, plugins=[panel])
        except (RuntimeError, OSError) as error:  # such as a port that is taken
            sys.stderr.write(f"{error}\n")
            os._exit(2)  # this is a thread, and there is nothing to end in order yet
        wait_for_server(address, viewer._http_port)
        send({"port": viewer._http_port})
        viewer_protocol.run_viewer_loop(viewer)

    show = Show(lines)
    with launch_thread.launch_thread(target) as handle:
        handle.set_model(model, data=data)
        while handle.is_running() and not show.ended:
            begin = time.monotonic()
            if latest := show.latest:
                data.qpos[: len(latest["qpos"])] = np.array(latest["qpos"])
                mujoco.mj_forward(model, data)
                panel.lines = latest["lines"]
            handle.sync()
            time.sleep(max(0.0, FRAME_PERIOD - (time.monotonic() - begin)))


if __name__ == "__main__":
    # The viewer prints to the standard output; what we say goes where that was, and its words to the errors.
    protocol = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    main(json.loads(sys.argv[1]), sys.stdin, protocol)
