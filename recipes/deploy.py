"""Run a controller at 50 Hz in real time against a robot: a simulated one in a process of its own, or a real one.

The robot stands up, moves in the behaviour that is asked for, stops, and sinks down; or a person drives it, from a
browser, a terminal or with a gamepad. Ctrl-C stops it at once, as every fault does.

In:  an artifact folder (or a run), best after recipes/export.py; and a student's, which then decides what to do.
Out: one MCAP file that opens in Foxglove and rerun, and is a robot log for recipes/easi.py.

    python recipes/deploy.py pretrained/bbc --transport mujoco --seconds 20 --skill trot --speed 1.0
    python recipes/deploy.py pretrained/bbc --transport dds                    # a simulated Go2 that speaks DDS
    python recipes/deploy.py exported/bbc --transport dds --interface eth0 --operator terminal    # docs/deployment.md!
    python recipes/deploy.py pretrained/bbc --transport lcm                    # a simulated robot, over LCM
    python recipes/deploy.py pretrained/bbc --operator terminal                # drive it by hand
    python recipes/deploy.py pretrained/bbc_leaping --task pretrained/student_leaping --course full

Status: 0 if all went well, 1 if a fault ended the run or it never began.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, cast

import torch
import tyro
from controls import ByHand, ControlsConfig, make_device
from deployed_policy import PolicyConfig, load_camera, standing
from robot_line import RobotConfig, connect
from run_record import Recorder

from agility_rl.deploy import (
    BehaviourCommand,
    Controller,
    DeployedStudent,
    Mode,
    SafetyLimits,
)
from agility_rl.deploy.controller import SINK_SECONDS, StepRecord
from agility_rl.deploy.deadlines import Clock, Durations, MonotonicClock
from agility_rl.deploy.depth import DepthSource
from agility_rl.deploy.operator import Operation, SharedControl
from agility_rl.go2.appearance import dress
from agility_rl.go2.model import build_spec
from agility_rl.record import EpisodeRecorder, free_file, is_free
from agility_rl.training import cli, run_folder

PATIENCE = 3.0
"""Time for which a refused request is repeated [s]."""
SHOWN_MISSES = 20
"""Missed deadlines that are listed one by one."""
READY_SECONDS = 0.5
"""Time for which the robot stands before it starts."""


@dataclass(frozen=True)
class Config(RobotConfig, ControlsConfig, PolicyConfig):
    artifact: Annotated[Path, tyro.conf.Positional]
    """Artifact folder of a BBC, or a run with one."""
    operator: Literal["script", "browser", "terminal", "gamepad"] = "script"
    """Who drives: a script (stand up, one command, stop), or a person, until the device or Ctrl-C ends it."""
    unattended: bool = False
    """Let a script drive a real robot: it stands up at once, without asking."""
    seconds: float = 20.0
    """With a script: time in the behaviour, without standing up and sinking down."""
    skill: str = "trot"
    """With a script and without a student: walk, pace, trot, canter or jump."""
    speed: float | None = None
    """Forward velocity [m/s], kept inside the behaviour's range (Table S2); its middle by default."""
    yaw_rate: float = 0.0
    """Turn rate [rad/s], likewise."""
    height: float | None = None
    """Trunk height, of a jump the highest [m], likewise."""
    output: Path | None = None
    """File to record to, ending in .mcap; ``runs/deploy/deploy_N.mcap`` by default. Nothing is overwritten."""
    state_age: float = SafetyLimits.state_age
    """Oldest state to act on [s]."""
    missed_deadlines: int = SafetyLimits.missed_deadlines
    """Missed control steps in a row that end the run."""
    operator_age: float = 0.5
    """Time without a word of the operator that ends the run [s]."""
    camera: str | None = None
    """With a student: MODULE:NAME that makes the depth camera (agility_rl.deploy.depth.DepthSource); a robot simulated
    with --transport mujoco has one."""
    depth_age: float = 0.2
    """Oldest depth image that ends the run [s]: ten at 50 Hz."""


class Procedure:
    """Asks for one mode after the other: stand up, run for some time, stop, sink down."""

    def __init__(self, controller: Controller, operator: SharedControl, seconds: float) -> None:
        self.controller, self.operator, self.seconds = controller, operator, seconds
        self.finished = False
        self._since: tuple[Mode, float] | None = None
        self._ran = False

    def __call__(self, step: StepRecord) -> None:
        """Decide after every control step what to ask for next."""
        self.operator.heard(step.time)
        if self._since is None or self._since[0] is not step.mode:
            self._since = (step.mode, step.time)
        elapsed = step.time - self._since[1]
        if step.mode is Mode.PASSIVE and step.state is not None:
            self.finished = elapsed > PATIENCE  # every request was refused; the log says why
            self.controller.request(Mode.STAND_UP)
        elif step.mode is Mode.READY and (self._ran or elapsed > PATIENCE):
            self.finished = True
        elif step.mode is Mode.READY and elapsed >= READY_SECONDS:
            self.controller.request(Mode.RUN)
        elif step.mode is Mode.RUN and elapsed >= self.seconds:
            self._ran = True
            self.controller.request(Mode.STAND_UP)
        elif step.mode is Mode.DAMPING:
            self.finished = True


def summary(controller: Controller, lost: float | None, started: float) -> str:
    """What the loop did, in lines."""

    def quantiles(durations: Durations) -> str:
        values = (1e3 * durations.quantile(share) for share in (0.5, 0.99))
        return "p50 {:.2f} ms, p99 {:.2f} ms, ".format(*values) + f"longest {1e3 * durations.largest:.1f} ms"

    deadlines = controller.deadlines
    share = deadlines.misses / max(deadlines.periods, 1)
    missed = [event for event in controller.events if event.kind == "missed"]
    shown = [event for event in controller.events if event.kind != "missed" or event in missed[:SHOWN_MISSES]]
    lines = [f"{event.time - started:7.2f} s  {event.mode:9}  {event.reason}" for event in shown]
    if len(missed) > SHOWN_MISSES:
        lines.append(f"... and {len(missed) - SHOWN_MISSES} more misses; the recording has the timing of every step")
    lines += [
        f"control steps: {deadlines.periods}, missed {deadlines.misses} ({share:.2%})",
        f"one step: {quantiles(deadlines.durations)}",
        f"late by: {quantiles(deadlines.latenesses)}",
    ]
    if lost is not None:
        lines.append(f"the simulated robot lost {lost:.3f} s against real time")
    return "\n".join(lines)


def recording(cfg: Config) -> Path:
    """The file to record to, which is not there yet."""
    path = free_file(Path("runs") / "deploy", "deploy") if cfg.output is None else cfg.output
    if path.suffix != ".mcap" or not is_free(path):
        raise ValueError(f"expected --output to be a new file that ends in .mcap, got {path}")
    return path


def sink(controller: Controller, on_step: Callable[[StepRecord], None] | None) -> None:
    """Go on commanding damping until the robot lies: one packet, if it is lost, leaves the motors stiff."""
    controller.on_step = on_step
    if controller.mode is Mode.DAMPING:  # not if another program has the robot, which was never driven
        for _ in range(round(SINK_SECONDS / controller.bbc.period)):
            controller.step()


def drive(cfg: Config, clock: Clock, interrupted: Callable[[], bool]) -> tuple[Path, Controller]:
    """Run, record, print what happened."""
    command = BehaviourCommand.of(cfg.skill, velocity_x=cfg.speed, yaw_rate=cfg.yaw_rate, height=cfg.height)
    bbc = cfg.controller(cfg.artifact)
    recording(cfg)
    cfg.check()
    if cfg.real and cfg.operator == "script" and not cfg.unattended:
        raise ValueError(
            "a script makes a real robot stand up and run at once: give --operator terminal, browser or gamepad, "
            "with which every change of mode is yours, or --unattended"
        )
    if cfg.task is not None and cfg.camera is None and cfg.transport != "mujoco":
        raise ValueError(
            "a student looks by a camera: the simulated robot of --transport mujoco has one, for any other give "
            "--camera MODULE:NAME (docs/deployment.md)"
        )
    if cfg.task is None and cfg.camera is not None:
        raise ValueError("expected --camera only with --task: nothing else looks")
    own_camera = load_camera(cfg.camera) if cfg.camera else None
    robot_options = {} if cfg.real else cfg.options(bbc.manifest)
    metadata = {
        "weights": bbc.manifest["weights"]["sha256"],
        "robot": {"transport": cfg.transport, "real": cfg.real, **robot_options},
        "versions": run_folder.versions(),
    }
    limits = SafetyLimits.from_manifest(
        bbc.manifest,
        state_age=cfg.state_age,
        source_age={"operator": cfg.operator_age, "depth": cfg.depth_age},
        missed_deadlines=cfg.missed_deadlines,
    )
    with contextlib.ExitStack() as stack:
        device = None
        if cfg.operator != "script":
            device = make_device(cfg.operator, cfg, lambda: dress(build_spec()).compile())
            stack.callback(device.close)
        simulated_camera = cfg.task is not None and own_camera is None
        transport, robot = stack.enter_context(connect(cfg, robot_options, simulated_camera))
        path = recording(cfg)  # anew: another run may have begun since
        episode = stack.enter_context(EpisodeRecorder(path, dt=bbc.period, metadata=metadata))
        started = clock.now()
        policy = cfg.commander(
            bbc, own_camera or cast(DepthSource, transport), command if device is None else standing(), started
        )
        control = SharedControl(policy, started)
        controller = Controller(transport, bbc, control, limits=limits, clock=clock)
        if device is None:
            procedure: Procedure | ByHand = Procedure(controller, control, cfg.seconds)
        else:
            procedure = ByHand(Operation(controller, control, device))
        record = Recorder(episode, bbc, policy if isinstance(policy, DeployedStudent) else None)

        def on_step(step: StepRecord) -> None:
            record(step)
            procedure(step)

        controller.on_step = on_step
        gc.collect()
        gc.freeze()  # what was loaded until here need not be looked through again in the middle of a step
        try:
            controller.run(until=lambda: procedure.finished or interrupted())
            sink(controller, record)
        except Exception:
            sink(controller, None)  # a recorder or device that fails is not asked again
            raise
        finally:
            gc.unfreeze()
    print(summary(controller, None if robot is None else robot.lost, started))
    print(f"recorded: {path}, {episode.num_steps} steps")
    return path, controller


def main(cfg: Config) -> int:
    """Returns the exit status."""
    logging.getLogger("agility_rl.deploy").setLevel(logging.ERROR)  # the summary lists the events
    torch.set_num_threads(1)
    with cli.interruptible() as interrupted:
        _, controller = drive(cfg, MonotonicClock(), interrupted)
    if controller.fault is not None:
        print(f"fault: {controller.fault}")
    ran = any(event.mode is Mode.RUN for event in controller.events)
    return 0 if ran and controller.fault is None else 1


if __name__ == "__main__":
    with cli.one_line_errors():
        sys.exit(main(cli.from_arguments(Config, doc=__doc__)))
