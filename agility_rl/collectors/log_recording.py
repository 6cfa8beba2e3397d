"""Makes robot logs in simulation: from a policy in bare physics, or beside any loop or environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.collectors.easi import one_thread
from agility_rl.collectors.robot_log import MIN_STEPS, RobotLog
from agility_rl.collectors.rollout import MeasuredPolicy, roll_out
from agility_rl.collectors.sensors import RobotSensors
from agility_rl.go2 import constants, features
from agility_rl.simulation import Simulator

LOG_STEPS = 4000
"""Rows of the paper's log: 80 s at 50 Hz (supplement S2)."""


def record_robot_log(
    simulator: Simulator,
    policy: MeasuredPolicy,
    num_steps: int = LOG_STEPS,
    *,
    generator: torch.Generator,
    row: int = 0,
    start: TensorDictBase | None = None,
    noise: float | Mapping[str, float] = 0.0,
    latency: int = 0,
) -> RobotLog:
    """Let a policy act in a simulation and log one robot, as if it were a real one.

    The policy acts on the same noisy, late measurements that are logged. After a fall the robot is put back, and the
    log marks the row.

    Source: supplement S2 (4,000 steps of the pre-trained BBC, or any other controller).

    Args:
        simulator: one robot or more; set its parameters before to make a target for a search.
        policy: from measurements to actions, as :data:`agility_rl.collectors.rollout.MeasuredPolicy` says.
        num_steps: rows.
        generator: source of start states and noise.
        row: which robot is logged.
        start: start states, as :func:`agility_rl.collectors.rollout.roll_out` takes them.
        noise: as :class:`RobotSensors` takes it.
        latency: control steps by which measurements are late.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> generator = torch.Generator().manual_seed(0)
        >>> log = record_robot_log(
        ...     make_simulator(num_simulations=1, num_threads=1),
        ...     lambda measured: 0.3 * torch.randn(1, 12, generator=generator), 100, generator=generator,
        ... )
        >>> len(log), log.joint_position.shape
        (100, torch.Size([100, 12]))
    """
    sensors = RobotSensors(simulator.num_simulations, noise=noise, latency=latency, generator=generator)
    # On one thread: a closed loop magnifies the last bit, and a single robot's networks are too small for two.
    with torch.no_grad(), one_thread():
        rollout = roll_out(simulator, policy, num_steps, sensors=sensors, generator=generator, start=start)
    return RobotLog.from_rollout(rollout, row, control_dt=simulator.control_dt, name="simulated log")


class RobotLogRecorder:
    """Log one robot of a simulator while somebody else steps it, for example an environment.

    Call :meth:`record` with the action before every step, and :meth:`restart` after every reset of the robot. The
    measurements in the log have noise and latency of their own; what the policy sees is the loop's business.

    Args:
        simulator: the simulator that is stepped, such as ``env.simulator``.
        row: which robot is logged.
        noise: as :class:`RobotSensors` takes it.
        latency: control steps by which measurements are late.
        generator: source of the noise.

    Example:
        >>> from agility_rl.envs import LocomotionEnv
        >>> env = LocomotionEnv(2, simulator_options={"num_threads": 1})
        >>> recorder = RobotLogRecorder(env.simulator, row=1)
        >>> td = env.reset()
        >>> for _ in range(3):
        ...     td = env.rand_action(td)
        ...     recorder.record(td["action"])
        ...     td = env.step_mdp(env.step(td))
        >>> recorder.log(min_steps=3).action.shape
        torch.Size([3, 12])
        >>> env.close()
    """

    def __init__(
        self,
        simulator: Simulator,
        *,
        row: int = 0,
        noise: float | Mapping[str, float] = 0.0,
        latency: int = 0,
        generator: torch.Generator | None = None,
    ) -> None:
        self.simulator, self.row = simulator, row
        self.sensors = RobotSensors(simulator.num_simulations, noise=noise, latency=latency, generator=generator)
        self._everyone = torch.ones(simulator.num_simulations, dtype=torch.bool)
        self._restarted = True
        self._rows: list[tuple[Tensor, Tensor, bool]] = []

    def restart(self) -> None:
        """Say that the robot was reset: no transition leads into the next row."""
        self._restarted = True

    def record(self, action: Tensor) -> None:
        """Measure the present state and note the action about to be taken in it.

        Args:
            action: ``[N, 12]`` of all robots, or ``[12]`` of the logged one.

        Raises:
            ValueError: if it has another shape.
        """
        mine = action if action.ndim == 1 else action[self.row]
        if tuple(mine.shape) != (constants.NUM_JOINTS,):
            raise ValueError(
                f"action must be [N, {constants.NUM_JOINTS}] or [{constants.NUM_JOINTS}], got {action.shape}"
            )
        if self._restarted:
            reading = self.sensors.reset(self.simulator, self._everyone)
        else:
            reading = self.sensors.read(self.simulator)
        self._rows.append((reading[self.row].clone(), mine.detach().clone(), self._restarted))
        self._restarted = False

    def log(self, *, name: str = "simulated log", min_steps: int = MIN_STEPS) -> RobotLog:
        """The log so far.

        Raises:
            RobotLogError: if it is no good log.
        """
        if not self._rows:
            raise ValueError("nothing was recorded yet")
        readings, actions, starts = zip(*self._rows, strict=True)
        state, layout = torch.stack(readings), features.MEASUREMENT_LAYOUT
        columns: dict[str, Any] = {e.name: state[:, features.layout_slice(layout, e.name)].clone() for e in layout}
        dt = self.simulator.control_dt
        columns |= {"time": dt * torch.arange(len(state), dtype=torch.float64), "action": torch.stack(actions)}
        return RobotLog(**columns, start=torch.tensor(starts), control_dt=dt, name=name, min_steps=min_steps)
