"""One Go2 in plain MuJoCo that behaves like the robot: motors with their own PD law, states, and no training stack."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from agility_rl.deploy.controller import DAMPING_GAIN, FOLDED_POSE
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec

SIM_DT = 0.001
"""Physics and PD step [s]: motors at 1,000 Hz (supplement S3)."""
COMMAND_TIMEOUT = 0.1
"""Without a new command for this long, the motors damp by themselves [s]."""
LYING_HEIGHT = 0.09
"""Trunk height from which a folded robot is let down on the ground [m]."""
PREFIX = "world/"
"""Before the names of what :func:`add_world` adds."""
_ROUNDING = 1e-6
"""Share of a physics step by which sums of times may be short."""
_JOINTS, _SPEEDS = slice(7, 19), slice(6, 18)
_FEET = [3 * group + axis for group in constants.FOOT_GROUPS for axis in range(3)]


class SimulatedRobot:
    """Physics and motors of one robot.

    The motors' law ``torque + stiffness (position - q) + damping (velocity - dq)`` is the engine's own actuator, which
    computes it in every physics step and cuts it at the torque limits.

    Source: supplement S3.

    Args:
        sim_dt: physics step [s].
        command_timeout: time without a command after which the motors damp [s]; ``None`` never.
        stiffness_factor: true stiffness of the motors as a multiple of the commanded, one number or twelve.
        damping_factor: likewise; a robot is not what its data sheet says.
        surround: called with the robot's spec before it is compiled, to add what stands around it.
        **model_options: keyword arguments of :func:`agility_rl.go2.model.build_spec`.

    Raises:
        ValueError: if the physics step is not above 0.

    Attributes:
        model: engine model; :attr:`data` its state.
        time: simulated seconds.

    Example:
        >>> robot = SimulatedRobot()
        >>> robot.reset("lying")
        >>> robot.advance(0.01)
        >>> robot.state(now=0.0).joint_position.shape
        torch.Size([12])
    """

    def __init__(
        self,
        *,
        sim_dt: float = SIM_DT,
        command_timeout: float | None = COMMAND_TIMEOUT,
        stiffness_factor: float | Sequence[float] = 1.0,
        damping_factor: float | Sequence[float] = 1.0,
        surround: Callable[[mujoco.MjSpec], object] = lambda spec: None,
        **model_options: Any,
    ) -> None:
        if not sim_dt > 0.0:
            raise ValueError(f"expected a physics step above 0 s, got {sim_dt}")
        spec = build_spec(sim_dt=sim_dt, **model_options)
        surround(spec)
        self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self.sim_dt, self.command_timeout = sim_dt, command_timeout
        self._owed = 0.0
        self._factors = np.asarray(stiffness_factor, np.float32), np.asarray(damping_factor, np.float32)
        self._sequence = 0
        self.reset()

    @property
    def time(self) -> float:
        """Simulated seconds since the last reset."""
        return float(self.data.time)

    def reset(self, pose: str = "standing") -> None:
        """Put the robot on the ground, ``standing`` in the default pose or ``lying`` with folded legs, motors damping.

        Raises:
            ValueError: if there is no such pose.
        """
        poses = {
            "standing": (constants.STANDING_HEIGHT, constants.DEFAULT_POSE),
            "lying": (LYING_HEIGHT, FOLDED_POSE),
        }
        if pose not in poses:
            raise ValueError(f"expected the pose {' or '.join(poses)}, got {pose!r}")
        height, joints = poses[pose]
        self.place(np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *joints]), np.zeros(18))

    def place(self, qpos: np.ndarray, qvel: np.ndarray, command: JointCommand | None = None) -> None:
        """Put the robot into a state of the engine, ``[19]`` and ``[18]``; without a command, the motors damp."""
        mujoco.mj_resetData(self.model, self.data)
        self._owed = 0.0
        self.data.qpos[: len(qpos)], self.data.qvel[: len(qvel)] = qpos, qvel  # moving obstacles come behind
        self.command(JointCommand.damped(DAMPING_GAIN) if command is None else command)
        mujoco.mj_forward(self.model, self.data)

    def command(self, command: JointCommand) -> None:
        """Give the motors a new command."""
        stiffness, damping = self._factors[0] * command.stiffness.numpy(), self._factors[1] * command.damping.numpy()
        self.model.actuator_gainprm[:, 0] = stiffness
        self.model.actuator_biasprm[:, 0] = command.torque.numpy() + damping * command.velocity.numpy()
        self.model.actuator_biasprm[:, 1] = -stiffness
        self.model.actuator_biasprm[:, 2] = -damping
        self.data.ctrl[:] = command.position.numpy()
        self._commanded = self.time

    def advance(self, seconds: float) -> None:
        """Let time pass; what is no whole physics step is made up for by later calls."""
        steps = int((self._owed + seconds) / self.sim_dt + _ROUNDING)
        self._owed += seconds - steps * self.sim_dt
        for _ in range(steps):
            if self.command_timeout is not None and self.time - self._commanded > self.command_timeout:
                self.command(JointCommand.damped(DAMPING_GAIN))
            mujoco.mj_step(self.model, self.data)

    def state(self, now: float) -> RobotState:
        """What the robot says about itself; ``now`` becomes its time."""
        position, velocity = _float(self.data.qpos), _float(self.data.qvel)
        force = _float(self.data.sensordata[_FEET]).reshape(4, 3)
        self._sequence += 1
        return RobotState(
            time=now,
            quaternion=position[3:7],
            angular_velocity=velocity[3:6],
            joint_position=position[_JOINTS],
            joint_velocity=velocity[_SPEEDS],
            joint_torque=_float(self.data.actuator_force),
            foot_force=torch.linalg.vector_norm(force, dim=-1),
            linear_acceleration=_float(self.data.sensor("accelerometer").data),
            trunk_position=position[:3],
            sequence=self._sequence,
        )


def add_world(file: Path) -> Callable[[mujoco.MjSpec], None]:
    """What adds the bodies of an MJCF file to a robot's model; the robot starts at its origin.

    Args:
        file: MJCF; its own ground, if it has one, comes on top of the robot's.

    Raises:
        ValueError: if the file cannot be read as MJCF (when it is added).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "step.xml"
        ...     _ = file.write_text('<mujoco><worldbody><geom name="step" type="box" size="1 1 .1" pos="2 0 0"/>'
        ...         "</worldbody></mujoco>")
        ...     SimulatedRobot(surround=add_world(file)).model.geom("world/step").pos.tolist()
        [2.0, 0.0, 0.0]
    """

    def add(spec: mujoco.MjSpec) -> None:
        try:
            world = mujoco.MjSpec.from_file(str(file))
        except (ValueError, OSError) as error:
            raise ValueError(f"{file}: expected an MJCF file of what stands around the robot: {error}") from error
        spec.attach(world, frame=spec.worldbody.add_frame(), prefix=PREFIX)

    return add


class SimulatedBus:
    """Transport and clock in one: simulated time passes while the controller waits, never while it computes.

    For tests and comparisons, where a run must be repeatable; in real time, the robot lives in a process of its own
    (:mod:`agility_rl.deploy.loopback`).

    Args:
        robot: what is driven.

    Example:
        >>> bus = SimulatedBus(SimulatedRobot())
        >>> bus.sleep_until(0.02)
        >>> round(bus.robot.time, 6), bus.read().time == bus.now()
        (0.02, True)
    """

    joint_names: Sequence[str] = constants.JOINT_NAMES

    def __init__(self, robot: SimulatedRobot) -> None:
        self.robot = robot
        self._time = 0.0

    def now(self) -> float:
        """Simulated seconds."""
        return self._time

    def sleep_until(self, moment: float) -> None:
        """Advance the physics."""
        steps = round((moment - self._time) / self.robot.sim_dt)
        if steps > 0:
            self.robot.advance(steps * self.robot.sim_dt)
            self._time += steps * self.robot.sim_dt

    def read(self) -> RobotState:
        """The present state."""
        return self.robot.state(self._time)

    def send(self, command: JointCommand) -> None:
        """Give the motors a command."""
        self.robot.command(command)

    def other_commanders(self) -> Sequence[str]:
        """Nobody else can."""
        return ()

    def close(self) -> None:
        """Nothing to release."""


def _float(values: Any) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32))
