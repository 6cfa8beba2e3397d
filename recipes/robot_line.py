"""The robot that ``deploy.py`` drives, and the way to it: a simulated one in a process of its own, or a real one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from agility_rl.deploy.dds import DOMAIN, DDSTransport
from agility_rl.deploy.lcm import LCMTransport, address
from agility_rl.deploy.loopback import LoopbackTransport
from agility_rl.deploy.robot_process import RobotProcess
from agility_rl.deploy.transport import Transport
from agility_rl.deploy.unitree_messages import FootCalibration

CONNECT_SECONDS = 60.0
"""Time to wait for the robot's first state [s]."""


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
    simulator: Path | None = None
    """Motors and joints that the simulated robot truly has: a log's ``NAME.truth.json``, or ``result.json`` of
    ``easi.py``."""

    @property
    def real(self) -> bool:
        """Whether motors of a real robot move."""
        return self.interface is not None or self.ttl > 0

    def check(self) -> None:
        """Refuse options of another transport.

        Raises:
            ValueError: naming the option.
        """
        for option, transport in {"interface": "dds", "ttl": "lcm"}.items():
            if getattr(self, option) and self.transport != transport:
                raise ValueError(
                    f"expected --{option} only with --transport {transport}, got --transport {self.transport}"
                )
        if self.real and self.simulator is not None:
            raise ValueError("expected --simulator only with a simulated robot, got a real one")

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
def connect(cfg: RobotConfig, options: Mapping[str, Any]) -> Iterator[tuple[Transport, RobotProcess | None]]:
    """The way to the robot, and the process of a simulated one, which ends with the context."""
    line: dict[str, Any] = {}
    if cfg.transport == "dds":
        line["dds"] = {"domain": cfg.domain}
    elif cfg.transport == "lcm":
        line["lcm"] = {"url": address(cfg.domain, cfg.ttl)}
    with contextlib.nullcontext() if cfg.real else RobotProcess(**line, **options) as process:
        if cfg.transport == "dds":
            transport: Transport = DDSTransport(
                cfg.interface, domain=cfg.domain, feet=cfg.feet, patience=CONNECT_SECONDS
            )
        elif cfg.transport == "lcm":
            transport = LCMTransport(line["lcm"]["url"], patience=CONNECT_SECONDS)
        else:
            assert process is not None
            transport = LoopbackTransport(process.port, patience=CONNECT_SECONDS)
        try:
            yield transport, process
        finally:
            transport.close()
