"""Play with a robot: it stands up in a browser, and the keyboard steers it.

Plain MuJoCo in real time, driven by what would drive the robot: the controller's state machine, its safety checks, and
the operator above a policy. Keys are in docs/deployment.md, and on the page.

In:  an artifact folder, or a run with one; the shipped controller by default.
Out: nothing but what there is to see. For an episode and pictures: recipes/perform.py.

    python recipes/play.py
    python recipes/play.py runs/my_run --course bidirectional
    python recipes/play.py pretrained/bbc_leaping --task pretrained/student_leaping --course full  # keys correct it
    python recipes/play.py --operator gamepad         # sticks steer, the browser shows
    python recipes/play.py --operator terminal        # keys in the terminal, no browser: for machines without one
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import torch
import tyro
from controls import ControlsConfig, make_device
from deployed_policy import PolicyConfig, standing

from agility_rl.deploy import Controller, Mode, SafetyLimits
from agility_rl.deploy.controller import StepRecord
from agility_rl.deploy.operator import Operation, SharedControl
from agility_rl.deploy.simulated import SimulatedBus, SimulatedRobot
from agility_rl.deploy.simulated_camera import SimulatedCamera
from agility_rl.go2.appearance import dress
from agility_rl.training import cli

SHIPPED = Path(__file__).parents[1] / "pretrained" / "bbc"
PUT_BACK = "backspace"
"""Key that puts the simulated robot back to its start."""
MOST_BEHIND = 0.1
"""Time behind real time that is made up for [s]; beyond it, the robot is slower than life."""


@dataclass(frozen=True)
class Config(ControlsConfig, PolicyConfig):
    artifact: Annotated[Path, tyro.conf.Positional] = SHIPPED
    """Artifact folder of a BBC, or a run with one."""
    operator: Literal["browser", "terminal", "gamepad"] = "browser"
    """What steers the robot; with a gamepad, the browser shows it, and its keys work too."""
    course: str | None = None
    """Obstacles to stand around the robot: a name of agility_rl.envs.COURSES, such as bidirectional (figure S1)."""
    pose: Literal["lying", "standing"] = "lying"
    """How the robot waits."""
    skin: Path | None = None
    """Folder with the meshes of a Go2, for looks."""
    seconds: float | None = None
    """Simulated time after which to end; until Ctrl-C by default."""
    seed: int = 0
    """Seed of the course."""


class RealTimeBus(SimulatedBus):
    """Simulated time that passes no faster than real time, and slower where the machine cannot keep up."""

    def __init__(self, robot: SimulatedRobot) -> None:
        super().__init__(robot)
        self._origin = time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Advance the physics, then wait until as much real time has passed."""
        behind = time.monotonic() - self._origin - self.now()
        self._origin += max(0.0, behind - MOST_BEHIND)
        super().sleep_until(moment)
        time.sleep(max(0.0, self._origin + self.now() - time.monotonic()))


class Start:
    """Takes the robot from its start to a run by itself, and back to the start when the operator says so."""

    def __init__(self, operation: Operation, robot: SimulatedRobot, pose: str) -> None:
        self.operation, self.robot, self.pose = operation, robot, pose
        self._left: list[Mode] = [Mode.STAND_UP, Mode.RUN]

    def __call__(self, step: StepRecord) -> None:
        """Ask for the next mode, once somebody is there to see it."""
        controller = self.operation.controller
        if PUT_BACK in self.operation.others:
            controller.request(Mode.DAMPING)
            self._left = [Mode.PASSIVE, Mode.STAND_UP, Mode.RUN]
            return
        if self.operation.asked:
            self._left = []
        if not self._left or not self.operation.device.connected():
            return
        waits_in = {Mode.PASSIVE: Mode.DAMPING, Mode.STAND_UP: Mode.PASSIVE, Mode.RUN: Mode.READY}
        if step.mode is waits_in[self._left[0]]:
            if self._left[0] is Mode.PASSIVE:
                self.robot.reset(self.pose)
            controller.request(self._left.pop(0))


def surroundings(cfg: Config) -> Callable[[mujoco.MjSpec], object]:
    """What stands around the robot, and how all of it looks."""
    if cfg.course is None:
        return dress
    from play_course import surround  # the environments take seconds to import

    course = surround(cfg.course, cfg.seed)

    def add(spec: mujoco.MjSpec) -> None:
        course(spec)
        dress(spec)

    return add


def play(cfg: Config, interrupted: Callable[[], bool]) -> Controller:
    """Until interrupted, or for some simulated time."""
    bbc = cfg.controller(cfg.artifact)
    friction = bbc.manifest.get("simulation", {}).get("friction_loss", 0.0)
    robot = SimulatedRobot(friction_loss=friction, skin=cfg.skin, surround=surroundings(cfg))
    robot.reset(cfg.pose)
    keys = {PUT_BACK.capitalize(): "back to the start"}
    with contextlib.closing(make_device(cfg.operator, cfg, lambda: robot.model, keys)) as device:
        bus = RealTimeBus(robot)
        policy = cfg.commander(bbc, SimulatedCamera(robot, now=bus.now), standing(), bus.now())
        control = SharedControl(policy, bus.now())
        # Nobody is hurt by a simulated robot whose operator looks away.
        ages = {**SafetyLimits().source_age, "operator": math.inf}
        limits = SafetyLimits.from_manifest(bbc.manifest, source_age=ages)
        controller = Controller(bus, bbc, control, limits=limits, clock=bus)
        operation = Operation(controller, control, device, pose=lambda: robot.data.qpos.tolist())
        start = Start(operation, robot, cfg.pose)

        def on_step(step: StepRecord) -> None:
            operation(step)
            start(step)

        controller.on_step = on_step
        controller.run(seconds=cfg.seconds, until=lambda: interrupted() or device.ended())
    return controller


def main(cfg: Config) -> None:
    """Play until Ctrl-C."""
    logging.getLogger("agility_rl.deploy").setLevel(logging.ERROR)  # what happens is on the page
    torch.set_num_threads(1)
    with cli.interruptible() as interrupted:
        play(cfg, interrupted)


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__))
