"""An operator in a browser: MuJoCo's web viewer in a process of its own, so that drawing delays no control step."""

from __future__ import annotations

import contextlib
import ipaddress
import json
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.operator import Status, Stick

LOOPBACK = "127.0.0.1"
"""Address that only programs on this machine reach."""
SILENCE = 0.3
"""Time without a sign of life of the page after which the operator counts as gone [s]."""
PATIENCE = 60.0
"""Time that the viewer gets to come up, and to end by itself [s]."""
HELP = (
    "Up, Down      faster, slower",
    "Left, Right   turn",
    "A, D          sideways",
    "1 to 5        " + ", ".join(BEHAVIOURS),
    "Space         give control back",
    "Enter         stand up, run, stand",
)


def exposure(address: str) -> str:
    """What listening on an address means, in one line.

    Raises:
        ValueError: if it is no IP address.

    Example:
        >>> exposure("127.0.0.1")
        'only programs on this machine can reach the viewer'
    """
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        raise ValueError(
            f"expected an IP address to listen on, such as {LOOPBACK} or 0.0.0.0, got {address!r}"
        ) from None
    if ip.is_loopback:
        return "only programs on this machine can reach the viewer"
    whose = "any address of this machine" if ip.is_unspecified else address
    return (
        f"WARNING: whoever reaches {whose} over the network can watch AND DRIVE the robot: there is no password and no "
        f"encryption. Safer: --address {LOOPBACK}, and a tunnel such as ssh -L 8080:localhost:8080"
    )


class BrowserDevice:
    """The robot in a browser, with its state, a stop button, and the keyboard as controls.

    It counts as connected while a page that is being looked at holds the controls: a closed or hidden tab falls silent.

    Args:
        model: what to draw; its first 19 coordinates are the robot's.
        address: IP address to listen on.
        port: to listen on; 0 takes the first free one from 8080 on.
        open_browser: open a page, if there is a screen.
        title: of the page.
        more_help: further lines of keys and what they do.
        controls: show keys and the stop button; without, there is something to look at only.

    Attributes:
        url: where the page is.

    Raises:
        ValueError: if ``address`` is no IP address.
        ConnectionError: if the viewer does not come up.
    """

    def __init__(
        self,
        model: Any,
        *,
        address: str = LOOPBACK,
        port: int = 0,
        open_browser: bool = False,
        title: str = "Go2",
        more_help: Sequence[str] = (),
        controls: bool = True,
    ) -> None:
        exposure(address)
        options = {"address": address, "port": port, "open": open_browser, "title": title}
        self._events: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._alive = -float("inf")
        self._ready: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._wake, self._frame, self._closed = threading.Condition(), "", False
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.mjb"
            mujoco.mj_saveModel(model, str(path), None)
            options |= {"model": str(path), "help": [*HELP, *more_help] if controls else []}
            command = [sys.executable, "-m", "agility_rl.deploy.web_viewer", json.dumps(options)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
            )
            self._threads = [threading.Thread(target=body, daemon=True) for body in (self._listen, self._speak)]
            for thread in self._threads:
                thread.start()
            try:
                found = self._ready.get(timeout=PATIENCE)
            except queue.Empty:
                found = None
        if found is None:
            self.close()
            raise ConnectionError(
                f"the viewer's process ended with status {self._process.returncode} before it began; see its message"
            )
        host = f"[{address}]" if ":" in address else address
        host = "localhost" if ipaddress.ip_address(address).is_unspecified else host
        self.url = f"http://{host}:{found}/"

    def read(self) -> Sequence[str | Stick]:
        """Keys since the last call."""
        found: list[str | Stick] = []
        while not self._events.empty():
            found.append(self._events.get())
        return found

    def connected(self) -> bool:
        """Whether the page that holds the controls has lately been heard."""
        return time.monotonic() - self._alive <= SILENCE

    def ended(self) -> bool:
        """Whether the viewer's process has ended."""
        return self._process.poll() is not None

    def show(self, status: Status) -> None:
        """Hand over what to draw; only the latest is drawn."""
        if status.pose is not None:
            with self._wake:
                self._frame = json.dumps({"qpos": status.pose, "lines": status.lines()})
                self._wake.notify()

    def close(self) -> None:
        """End the viewer; calling it again does nothing."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        try:
            self._process.wait(PATIENCE / 6)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:
            thread.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _listen(self) -> None:
        """Body of the thread that hears the viewer."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            message = json.loads(line)
            if "port" in message:
                self._ready.put(message["port"])
            elif "key" in message:
                self._events.put(message["key"])
            else:
                self._alive = time.monotonic()
        self._ready.put(None)

    def _speak(self) -> None:
        """Body of the thread that tells the viewer, so that a slow viewer delays nobody else."""
        pipe = self._process.stdin
        assert pipe is not None
        try:
            while True:
                with self._wake:
                    self._wake.wait_for(lambda: self._frame or self._closed)
                    frame, self._frame = self._frame, ""
                if self._closed:
                    break
                pipe.write(frame + "\n")
                pipe.flush()
        except (BrokenPipeError, ValueError):  # the viewer has ended
            pass
        finally:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
