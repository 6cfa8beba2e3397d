"""Let a controller perform: an episode for Foxglove or rerun, a picture strip, and a replay in the browser.

To steer a robot yourself: recipes/play.py.

In:  a run or artifact folder; the behaviours to show, one after another.
Out: ``RUN/episodes/perform_N.mcap`` with a Foxglove layout beside it, ``RUN/figures/perform_N.png`` where the machine
     can render; with ``--viewer`` the episode plays in a browser, again and again, until Ctrl-C.

    python recipes/perform.py runs/my_run [--behaviours walk trot jump --seconds 4 --speed 0.8 --viewer]
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from picture_strip import visible_model
from rich.console import Console
from rollouts import Controller, MotionConfig, drive, load_controller, load_motion, make_env
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS, COMMANDS, command_bounds, skill_index
from agility_rl.deploy import Mode
from agility_rl.deploy.browser import LOOPBACK, BrowserDevice, exposure
from agility_rl.deploy.operator import Status
from agility_rl.go2 import features
from agility_rl.record import EpisodeRecorder, free_file, read_episode
from agility_rl.record.episode import read_metadata
from agility_rl.record.layout import write_layout
from agility_rl.training import cli

MEASURED = ("velocity_x", "velocity_y", "yaw_rate", "height")


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder."""
    behaviours: tuple[str, ...] = BEHAVIOURS
    """What to show, in this order."""
    seconds: float = 4.0
    """Length of each."""
    speed: float | None = None
    """Forward velocity [m/s], kept inside each behaviour's range; the middle of the range by default."""
    yaw_rate: float = 0.0
    """Turn rate [rad/s], kept inside each behaviour's range."""
    strip: bool = True
    """Render pictures, if this machine can."""
    skin: Path | None = None
    """Folder with the meshes of a Go2, for looks."""
    viewer: bool = False
    """Show the episode in MuJoCo's browser viewer."""
    address: str = LOOPBACK
    """IP address that the viewer listens on."""
    port: int = 0
    """Port of the viewer; 0 takes the first free one from 8080 on."""
    seed: int = 0
    """Seed of the start state."""
    output: Path | None = None
    """Folder for episodes and figures; the run by default."""
    motion: MotionConfig = field(default_factory=MotionConfig)


def command_for(skill: int, speed: float | None, yaw_rate: float) -> Tensor:
    """Command ``[1, 5]``: the middle of a behaviour's range (Table S2), with a speed and a turn rate if given."""
    low, high = (bound[skill] for bound in command_bounds())
    command = (low + high) / 2
    command[0] = command[0] if speed is None else min(max(speed, float(low[0])), float(high[0]))
    command[2] = min(max(yaw_rate, float(low[2])), float(high[2]))
    return command[None]


def perform(controller: Controller, config: Config, folder: Path) -> tuple[Path, str | None]:
    """Drive one robot and write the episode; returns its file, and when and in which behaviour it fell, if it did."""
    motion = load_motion(config.motion, controller.trained, config.seed)
    env = make_env(1, controller, motion.start_states(config.seed), num_threads=1, seed=config.seed)
    skills = [skill_index(name) for name in config.behaviours]
    steps = max(1, round(config.seconds / env.dt))
    schedule = [(steps, torch.tensor([skill]), command_for(skill, config.speed, config.yaw_rate)) for skill in skills]
    pieces = [(name, index * steps, steps) for index, name in enumerate(config.behaviours)]
    metadata = {"pieces": pieces, "weights": controller.artifact.manifest["weights"]["sha256"], "seed": config.seed}
    fall: str | None = None
    simulator = env.simulator
    path = free_file(folder, "perform")
    with EpisodeRecorder(path, dt=env.dt, metadata=metadata) as recorder:
        for step, td in enumerate(drive(controller.bbc, env, schedule)):
            name = config.behaviours[step // steps]
            if fall is None and bool(td["terminated"]):
                fall = f"{name}, after {step * env.dt:.2f} s"
            velocity = rotations.rotate_inverse(simulator.root_quaternion, simulator.root_linear_velocity)[0]
            turn, height = simulator.root_angular_velocity[0, 2], simulator.root_position[0, 2]
            measured = (velocity[0], velocity[1], turn, height)
            recorder.record(
                simulator.root_position[0],
                simulator.root_quaternion[0],
                simulator.joint_position[0],
                joint_velocity=simulator.joint_velocity[0],
                foot_contact=simulator.contact_force[0, 1:].unflatten(-1, (4, 4))[:, 3] > features.FOOT_CONTACT_FORCE,
                signals={
                    "command": dict(zip(COMMANDS, schedule[step // steps][2][0].tolist(), strict=True)),
                    "behaviour": {"name": name},
                    "measured": dict(zip(MEASURED, (float(value) for value in measured), strict=True)),
                },
            )
    env.close()
    return path, fall


def render(episode: Path, picture: Path, skin: Path | None) -> str | None:
    """Draw the picture strip in a process of its own; returns why it could not, if so.

    MuJoCo chooses its graphics library when it is imported, and a broken driver may end the process.
    """
    environment = dict(os.environ)
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        environment.setdefault("MUJOCO_GL", "egl")
    command = [sys.executable, str(Path(__file__).with_name("picture_strip.py")), str(episode), str(picture)]
    command += ["--skin", str(skin)] if skin else []
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    if result.returncode == 0:
        return None
    return (result.stderr.strip().splitlines() or [f"exit status {result.returncode}"])[-1]


def show(episode: Path, skin: Path | None, address: str, port: int, console: Console) -> None:
    """Play an episode in MuJoCo's browser viewer, again and again, until Ctrl-C."""
    recorded, metadata = read_episode(episode), read_metadata(episode)
    pose = torch.cat([recorded[name] for name in ("root_position", "root_quaternion", "joint_position")], -1)
    names = [name for name, _, steps in metadata["pieces"] for _ in range(steps)]
    viewer = BrowserDevice(
        visible_model(skin), address=address, port=port, open_browser=True, title=episode.stem, controls=False
    )
    console.print(f"{viewer.url}  ({exposure(address)}); Ctrl-C ends", markup=False)
    with contextlib.closing(viewer), contextlib.suppress(KeyboardInterrupt):
        while not viewer.ended():
            for name, row in zip(names, pose.tolist(), strict=True):
                begin = time.monotonic()
                viewer.show(Status(Mode.RUN, name, pose=tuple(row)))
                time.sleep(max(0.0, metadata["dt"] - (time.monotonic() - begin)))


def main(config: Config, console: Console) -> Path:
    """Perform, record, draw, show; returns the episode."""
    if not config.behaviours or config.seconds <= 0:
        raise ValueError("expected at least one of --behaviours and --seconds above 0")
    for name in config.behaviours:
        skill_index(name)
    controller = load_controller(config.run)
    output = config.output or controller.run
    episode, fall = perform(controller, config, output / "episodes")
    plots = {
        f"{title}": [f"/command.{key}", f"/measured.{key}"]
        for title, key in zip(
            ("Forward velocity [m/s]", "Lateral velocity [m/s]", "Yaw rate [rad/s]"), MEASURED[:3], strict=True
        )
    }
    plots["Trunk height [m]"] = ["/command.locomotion_height", "/command.jump_height", "/measured.height"]
    layout = write_layout(episode.parent, plots)
    shown = f"{', '.join(config.behaviours)}; " + (f"fell in {fall}" if fall else "no fall")
    console.print(f"{episode}: {shown}", markup=False)
    console.print(f"{layout}: import it in Foxglove beside the episode", markup=False)
    if config.strip:
        picture = output / "figures" / f"{episode.stem}.png"
        reason = render(episode, picture, config.skin)
        console.print(
            f"{picture}" if reason is None else f"no pictures, this machine cannot render: {reason}", markup=False
        )
    if config.viewer:
        show(episode, config.skin, config.address, config.port, console)
    return episode


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__), cli.console(80))
