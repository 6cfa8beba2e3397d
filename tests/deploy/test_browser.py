"""The viewer's process: whom it listens to, when it counts as there, and how it ends."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from agility_rl.deploy.browser import SILENCE, BrowserDevice, exposure
from agility_rl.deploy.controller import Mode
from agility_rl.deploy.operator import Status
from agility_rl.deploy.web_viewer import HOLD_LONG_ENOUGH
from agility_rl.go2.appearance import dress
from agility_rl.go2.model import build_spec
from tests.waiting import until

POSE = tuple(dress(build_spec()).compile().qpos0.tolist())


@pytest.fixture(scope="module")
def device() -> Iterator[BrowserDevice]:
    found = BrowserDevice(dress(build_spec()).compile())
    yield found
    found.close()


def port_of(device: BrowserDevice) -> int:
    return int(device.url.rstrip("/").rsplit(":", 1)[1])


def reachable(address: str, port: int) -> bool:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as line:
        line.settimeout(2.0)
        return line.connect_ex((address, port)) == 0


def other_addresses() -> list[str]:
    """Addresses of this machine, apart from the one that is meant: on Linux all of 127.0.0.0/8 is the machine's."""
    found = ["127.0.0.2"] if sys.platform == "linux" else []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        try:
            line.connect(("192.0.2.1", 9))  # sends nothing; the system says from where it would
            found.append(line.getsockname()[0])
        except OSError:
            pass
    return [address for address in found if address != "127.0.0.1"]


def test_it_serves_a_page_on_the_loopback_address_and_on_no_other(device: BrowserDevice) -> None:
    assert device.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(device.url, timeout=10) as page:
        assert page.status == 200 and b"web_client" in page.read()
    others = other_addresses()
    if not others:
        pytest.skip("this machine has no second address")
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as everywhere:  # what the viewer does by itself
        everywhere.bind(("0.0.0.0", 0))
        everywhere.listen()
        assert all(reachable(address, everywhere.getsockname()[1]) for address in others), "the test itself"
    assert not any(reachable(address, port_of(device)) for address in others)


def test_the_page_holds_what_is_pressed_and_is_whole(device: BrowserDevice) -> None:
    """What the script does in a page: ``test_web_viewer.py``, whose Chromium draws two pictures a second."""
    with urllib.request.urlopen(device.url, timeout=10) as page:
        body = page.read()
        assert int(page.headers["Content-Length"]) == len(body) and page.headers.get_all("Content-Length")[1:] == []
    assert body.index(HOLD_LONG_ENOUGH) < body.index(b"<title>") and body.rstrip().endswith(b"</html>")
    with urllib.request.urlopen(device.url + "web_client.js", timeout=10) as script:
        assert HOLD_LONG_ENOUGH not in script.read()


@pytest.mark.skipif(sys.platform != "linux", reason="reads the kernel's table of sockets")
def test_no_socket_of_the_process_listens_elsewhere(device: BrowserDevice) -> None:
    mine = set()
    links = subprocess.run(
        ["ls", "-l", f"/proc/{device._process.pid}/fd"], capture_output=True, text=True, check=True
    ).stdout
    for word in links.split():
        if word.startswith("socket:["):
            mine.add(word[8:-1])
    listening = []
    for table in ("tcp", "tcp6"):
        with open(f"/proc/{device._process.pid}/net/{table}") as rows:
            for row in list(rows)[1:]:
                entries = row.split()
                if entries[3] == "0A" and entries[9] in mine:
                    listening.append(entries[1].split(":")[0])
    assert listening and set(listening) == {"0100007F"}, "127.0.0.1, in the kernel's notation"


def test_pages_of_other_sites_are_refused(device: BrowserDevice) -> None:
    for path in ("ui", "state", "drop"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{port_of(device)}/{path}", origin="https://example.org").__enter__()
    with connect(f"ws://127.0.0.1:{port_of(device)}/state", origin=f"http://localhost:{port_of(device)}") as own:
        assert isinstance(own.recv(timeout=10), (str, bytes))


def test_it_counts_as_connected_while_the_page_with_the_controls_speaks(device: BrowserDevice) -> None:
    assert not device.connected()
    with connect(f"ws://127.0.0.1:{port_of(device)}/state") as watching:
        watching.send("heartbeat")
        time.sleep(0.2)
        assert not device.connected(), "whoever only watches is no operator"
    with connect(f"ws://127.0.0.1:{port_of(device)}/ui") as page:
        page.send(bytes(120))
        assert until(device.connected)
        begin = time.monotonic()
        assert until(lambda: not device.connected()), "silent, though the line is open: a hidden tab"
        assert time.monotonic() - begin == pytest.approx(SILENCE, abs=2.0)
    assert not device.ended()


def test_showing_never_waits(device: BrowserDevice) -> None:
    status = Status(Mode.RUN, "trot", "policy", (1.0, 0.0, 0.0), (0.9, 0.0, 0.0), "x" * 10000, POSE)
    begin = time.monotonic()
    for _ in range(500):
        device.show(status)
    assert time.monotonic() - begin < 5.0
    device.show(Status(Mode.PASSIVE))  # nothing known of the robot yet
    assert device.read() == [] and not device.ended()


def test_a_viewer_that_dies_is_noticed_and_closing_is_safe() -> None:
    device = BrowserDevice(dress(build_spec()).compile(), controls=False)
    device._process.kill()
    assert until(device.ended)
    device.show(Status(Mode.RUN, pose=POSE))
    assert not device.connected() and device.read() == []
    device.close()
    device.close()


def test_a_taken_port_is_an_error_that_says_so(device: BrowserDevice, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConnectionError, match="ended with status"):
        BrowserDevice(dress(build_spec()).compile(), port=port_of(device))
    said = capfd.readouterr().err
    assert f"Port {port_of(device)} is already in use" in said and "Traceback" not in said


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2", "::1"])
def test_loopback_is_harmless(address: str) -> None:
    assert "only programs on this machine" in exposure(address)


@pytest.mark.parametrize(("address", "named"), [("0.0.0.0", "any address"), ("::", "any"), ("192.168.1.7", "192.168")])
def test_any_other_address_is_explained(address: str, named: str) -> None:
    text = exposure(address)
    assert text.startswith("WARNING") and "AND DRIVE" in text and "no password" in text and named in text


def test_a_name_is_no_address() -> None:
    with pytest.raises(ValueError, match=r"expected an IP address .* got 'robot\.local'"):
        BrowserDevice(None, address="robot.local")
