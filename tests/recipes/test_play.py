"""Steering by hand: from a terminal, simulated and in real time, and around obstacles."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.behaviours import skill_index
from agility_rl.deploy import Mode
from agility_rl.deploy.artifact import Artifact
from agility_rl.deploy.operator import Status, Stick
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.record import read_episode

Module = Callable[[str], ModuleType]


class Terminal:
    """A recipe at a pseudo-terminal, and a person who presses keys there."""

    def __init__(self, repository: Path, recipe: str, *arguments: object) -> None:
        self._person, program = pty.openpty()
        command = [sys.executable, f"recipes/{recipe}.py", *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(repository), "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            command, cwd=repository, env=environment, stdin=program, stdout=program, stderr=program
        )
        os.close(program)
        os.set_blocking(self._person, False)
        self.text = ""

    def sees(self, words: str, seconds: float = 60.0) -> bool:
        """Whether something new with these words is written within some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if words in self.text:
                self.text = self.text.split(words, 1)[1]
                return True
            try:
                self.text += os.read(self._person, 65536).decode()
            except BlockingIOError:
                time.sleep(0.01)
            except OSError:  # the recipe has ended
                return False
        return False

    def press(self, keys: str) -> None:
        os.write(self._person, keys.encode())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._person)


@pytest.fixture
def terminal(repository: Path) -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def begin(recipe: str, *arguments: object) -> Terminal:
        opened.append(Terminal(repository, recipe, *arguments))
        return opened[-1]

    yield begin
    for one in opened:
        one.close()


def test_the_shipped_controller_obeys_a_terminal(terminal: Callable[..., Terminal]) -> None:
    person = terminal("play", "--operator", "terminal", "--pose", "standing")
    assert person.sees("Escape stops")
    assert person.sees("run: walk"), person.text
    person.press("3\x1b[A\x1b[A")
    assert person.sees("run: trot"), person.text
    assert person.sees("commanded +0.70 m/s")
    person.press("\x7f")
    assert person.sees("stand up") and person.sees("run: walk"), "back at the start, it begins again"
    person.press("\x1b")
    assert person.sees("damping")
    person.process.send_signal(signal.SIGINT)  # Ctrl-C
    assert person.process.wait(30) == 0


def test_a_robot_in_real_time_is_driven_by_hand_and_recorded(
    terminal: Callable[..., Terminal], untrained: Path, tmp_path: Path
) -> None:
    path = tmp_path / "by_hand.mcap"
    patient = ("--state-age", 600, "--operator-age", 600, "--missed-deadlines", 10**9)
    person = terminal(
        "deploy",
        untrained,
        "--operator",
        "terminal",
        "--pose",
        "standing",
        "--output",
        path,
        *patient,
    )
    assert person.sees("passive")
    person.press("\r")
    assert person.sees("ready")
    person.press("\r")
    assert person.sees("run: walk")
    person.press("2")
    assert person.sees("run: pace")
    person.press("\x1b")
    assert person.sees("damping")
    person.process.send_signal(signal.SIGINT)  # Ctrl-C
    assert person.sees("recorded:")
    assert person.process.wait(30) == 0
    episode = read_episode(path)
    assert episode["command/velocity_x"].max() == pytest.approx(0.5), "a pace's slowest"
    assert float(episode["command/velocity_x"][0]) == 0.0


def test_a_student_decides_until_a_person_does(
    terminal: Callable[..., Terminal], untrained: Path, make_student: Callable[..., Path]
) -> None:
    student = make_student()
    artifact = Artifact.load(student)
    (choice,) = (name for name in artifact.state if name.endswith("choice_head.0.bias"))
    wanted = artifact.state | {choice: artifact.state[choice] + 100.0 * torch.eye(5)[skill_index("trot")]}
    rest = {name: value for name, value in artifact.manifest.items() if name != "weights"}
    Artifact.save(artifact.folder, wanted, rest)
    arguments = ("--task", student, "--course", "tunnel", "--pose", "standing", "--operator", "terminal")
    person = terminal("play", untrained, *arguments)
    assert person.sees("run: trot"), person.text[-500:]  # nobody asked for it: without a student, it is a walk
    person.press("5")
    assert person.sees("run: jump"), person.text[-500:]
    person.press(" ")
    assert person.sees("run: trot"), person.text[-500:]


def test_no_terminal_no_run(recipe: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    result = recipe("play", "--operator", "terminal")
    assert result.returncode == 2 and "expected a terminal" in result.stderr
    result = recipe("play", "--operator", "gamepad", "--gamepad", "nowhere")
    assert result.returncode == 2 and "expected a gamepad at nowhere" in result.stderr


@pytest.mark.parametrize("course", ["bidirectional", "full"])
def test_a_course_stands_before_the_robot(module: Module, course: str) -> None:
    surround = module("play_course").surround(course, seed=0)
    robot, alone = SimulatedRobot(surround=surround), SimulatedRobot()
    for one in (robot, alone):
        one.advance(0.1)
    np.testing.assert_allclose(robot.data.qpos[:19], alone.data.qpos, atol=1e-6, err_msg="it stands in something")
    ray, hit = np.array([1.0, 0.0, 0.0]), np.zeros(1, np.int32)
    group = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # without the robot's own
    distance = min(
        mujoco.mj_ray(robot.model, robot.data, np.array([0.0, y, z]), ray, group, 1, -1, hit)
        for y in (-0.3, 0.0, 0.3)
        for z in (0.05, 0.15, 0.3, 0.5)
    )
    assert 0.6 < distance < 3.0, "the first obstacle is ahead"


def test_courses_have_names(module: Module) -> None:
    with pytest.raises(ValueError, match=r"expected --course to be one of full.*bidirectional.*got 'maze'"):
        module("play_course").surround("maze", seed=0)


def test_simulated_time_is_never_faster_than_real_time(module: Module) -> None:
    bus = module("play").RealTimeBus(SimulatedRobot())
    begin = time.monotonic()
    for step in range(1, 11):
        bus.sleep_until(0.02 * step)
    assert bus.now() == pytest.approx(0.2) and time.monotonic() - begin >= 0.2
    time.sleep(0.5)  # a machine that was busy elsewhere
    begin = time.monotonic()
    bus.sleep_until(0.6)
    assert time.monotonic() - begin >= 0.25, "what was lost is not made up for beyond a tenth of a second"


class Held:
    """A gamepad that can be pulled out."""

    def __init__(self, entries: Sequence[str | Stick]) -> None:
        self.entries, self.there, self.shown = entries, True, 0

    def read(self) -> Sequence[str | Stick]:
        return self.entries

    def connected(self) -> bool:
        return self.there

    def ended(self) -> bool:
        return not self.there

    def show(self, status: Status) -> None:
        self.shown += 1

    def close(self) -> None:
        self.there = False


def test_a_gamepad_beside_a_page(module: Module) -> None:
    held, seen = Held([Stick(1.0)]), Held(["escape"])
    both = module("controls").Both(held, seen)
    assert list(both.read()) == [Stick(1.0), "escape"]
    both.show(Status(Mode.READY))
    assert (held.shown, seen.shown) == (0, 1)
    seen.there = False
    assert both.connected() and both.ended(), "steered without being seen, until the loop ends"
    held.there, seen.there, held.entries, seen.entries = False, True, [], ["up"]
    assert list(both.read()) == ["up", "escape"], "pulled out, its sticks would stay where they were"
    assert list(both.read()) == ["up"]
    assert both.connected() and not both.ended(), "the page's keys are left"
    both.close()
    assert not held.there and not seen.there
