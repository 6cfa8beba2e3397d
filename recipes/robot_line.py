"""The robot that ``deploy.py`` drives, and the way to it: a simulated one in a process of its own, or a real one."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from agility_rl.deploy.dds import DOMAIN, DDSTransport
from agility_rl.deploy.lcm import LCMTransport, address
from agility_rl.deploy.loopback import LoopbackTransport
from agility_rl.deploy.robot_process import RobotProcess
from agility_rl.deploy.simulated import add_world
from agility_rl.deploy.transport import Transport
from agility_rl.deploy.unitree_messages import FootCalibration
from agility_rl.go2.model import build_spec

CONNECT_SECONDS = 60.0
"""Time to wait for the robot's first state [s]."""
_TRANSPORTS = {"interface": ("dds",), "feet": ("dds",), "ttl": ("lcm",), "domain": ("dds", "lcm")}
"""Options that mean something with some transports only."""
_SIMULATED = {"pose", "sim_dt", "friction_loss", "course", "course_seed", "world", "simulator"}
"""Options of simulated robots."""


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    transport: Literal["mujoco", "dds", "lcm"] = "mujoco"
    """How to reach the robot: a simulated one by packets of our own, LowCmd and LowState over DDS (extra dds), or
    messages of our own over LCM (extra lcm)."""
    interface: str | None = None
    """With dds: network interface of a real robot; without one, a simulated robot on the loopback interface."""
    ttl: int = 0
    """With lcm: 0 stays on this machine, with a simulated robot; 1 reaches a real robot in the local network, in which
    everybody hears the commands and may command too."""
    domain: int = DOMAIN
    """With dds or lcm: keeps robots apart; the other side must have the same."""
    feet: FootCalibration = field(default_factory=FootCalibration)
    """With dds: from counts of the foot sensors to newtons."""
    pose: Literal["lying", "standing"] = "lying"
    """How the simulated robot waits."""
    sim_dt: float = 0.001
    """Step of the simulated physics and motors [s] (1,000 Hz: supplement S3)."""
    friction_loss: float | None = None
    """Dry friction of the simulated joints [N m]; as in training by default."""
    course: str | None = None
    """Obstacles around the simulated robot: a name of agility_rl.envs.COURSES, such as full."""
    course_seed: int = 0
    """What the course's places and heights are drawn with."""
    world: Path | None = None
    """MJCF file of what stands around the simulated robot, in place of a course; the robot starts at its origin."""
    simulator: Path | None = None
    """Motors and joints that the simulated robot truly has: a log's ``NAME.truth.json``, or ``result.json`` of
    ``easi.py``."""

    @property
    def real(self) -> bool:
        """Whether motors of a real robot move."""
        return self.interface is not None or self.ttl > 0

    def check(self) -> None:
        """Refuse options of another transport or robot.

        Raises:
            ValueError: naming the option, or a world that is no MJCF file.
        """
        default = RobotConfig()
        for option in (entry.name for entry in fields(RobotConfig)):
            if getattr(self, option) == getattr(default, option):
                continue
            flag, transports = "--" + option.replace("_", "-"), _TRANSPORTS.get(option, (self.transport,))
            if self.transport not in transports:
                wanted = " or ".join(transports)
                raise ValueError(f"expected {flag} only with --transport {wanted}, got --transport {self.transport}")
            if self.real and option in _SIMULATED:
                raise ValueError(f"expected {flag} only with a simulated robot, got a real one")
        if not self.sim_dt > 0.0:
            raise ValueError(f"expected --sim-dt above 0 s, got {self.sim_dt}")
        if self.course is not None and self.world is not None:
            raise ValueError("expected --course or --world, got both")
        if self.world is not None:
            add_world(self.world)(build_spec())

    def options(self, manifest: Mapping[str, Any]) -> dict[str, Any]:
        """The simulated robot, for :class:`agility_rl.deploy.robot_process.RobotProcess`."""
        found = {
            "pose": self.pose,
            "sim_dt": self.sim_dt,
            "friction_loss": manifest.get("simulation", {}).get("friction_loss", 0.0),
        }
        if self.simulator is not None:
            from identified import load_simulator  # it needs the training stack, a robot does not

            found |= load_simulator(self.simulator).one_robot(manifest["stiffness"], manifest["damping"])
        return found if self.friction_loss is None else {**found, "friction_loss": self.friction_loss}


@contextlib.contextmanager
def connect(
    cfg: RobotConfig, options: Mapping[str, Any], camera: bool = False
) -> Iterator[tuple[Transport, RobotProcess | None]]:
    """The way to the robot, and the process of a simulated one, which ends with the context.

    Args:
        cfg: which robot, and how to reach it.
        options: :meth:`RobotConfig.options`.
        camera: a simulated robot sends depths with its states.
    """
    line: dict[str, Any] = {}
    if cfg.transport == "dds":
        line["dds"] = {"domain": cfg.domain}
    elif cfg.transport == "lcm":
        line["lcm"] = {"url": address(cfg.domain, cfg.ttl)}
    with contextlib.ExitStack() as stack:
        process = None
        if not cfg.real:
            world = _world(cfg, Path(stack.enter_context(tempfile.TemporaryDirectory())))
            process = stack.enter_context(RobotProcess(camera=camera, world=world, **line, **options))
        if cfg.transport == "dds":
            transport: Transport = DDSTransport(
                cfg.interface, domain=cfg.domain, feet=cfg.feet, patience=CONNECT_SECONDS
            )
        elif cfg.transport == "lcm":
            transport = LCMTransport(line["lcm"]["url"], patience=CONNECT_SECONDS)
        else:
            assert process is not None
            transport = LoopbackTransport(process.port, patience=CONNECT_SECONDS)
        stack.callback(transport.close)
        yield transport, process


def _world(cfg: RobotConfig, folder: Path) -> str | None:
    """File of what stands around a simulated robot."""
    if cfg.course is None:
        return None if cfg.world is None else str(cfg.world)
    from play_course import write_world  # the environments need the training stack, a robot does not

    file = folder / "world.xml"
    write_world(cfg.course, cfg.course_seed, file)
    return str(file)
