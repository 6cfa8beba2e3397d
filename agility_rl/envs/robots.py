"""A batch of simulated robots with the short memory that rewards and observations need: what all environments share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.randomization import DESCRIBED, NOMINAL, Randomization, described, sample_parameters, uniform
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import constants, features
from agility_rl.simulation import Simulator
from agility_rl.tensors import constant, worthwhile

STRIDE = 0.5
"""Time constant over which a robot's velocities are averaged [s]: a dog does not walk at a constant speed."""
CLEARANCE = 0.005
"""Height added at a reset, so that no foot starts in the ground [m]."""

_BUFFERS = (
    *("action", "torque", "joint_velocity", "mean_velocity", "mean_yaw_rate"),
    *("heights", "privileged", "stiffness", "damping"),
)


class Robots:
    """``N`` robots: actions to joint targets, simulator and last values to a :class:`LocomotionState`.

    Args:
        simulator: where they live.
        generator: source of randomness of their parameters.
        ground: height of the ground [m] under horizontal positions ``[N, 2]``; by default the simulator's own.

    Attributes:
        privileged: ``[N, 29]`` (:data:`agility_rl.keys.PRIVILEGED`).

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> robots = Robots(make_simulator(num_simulations=2, num_threads=1), torch.Generator())
        >>> robots.step(torch.zeros(2, 12))
        >>> state = robots.state(torch.zeros(2, 12), CommandSampler(2, torch.Generator(), None))
        >>> state.joint_position.shape
        torch.Size([2, 12])
    """

    def __init__(
        self,
        simulator: Simulator,
        generator: torch.Generator,
        ground: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        n = simulator.num_simulations
        self.simulator, self.generator = simulator, generator
        self.ground = simulator.ground_height if ground is None else ground
        self.dt = simulator.control_dt
        device = simulator.device
        self._default_pose = constant(constants.DEFAULT_POSE, device)
        self._action_scale = constant(constants.ACTION_SCALE, device)
        self.action, self.torque, self.joint_velocity = (
            torch.zeros(n, constants.NUM_JOINTS, device=device) for _ in range(3)
        )
        self.mean_velocity, self.mean_yaw_rate = torch.zeros(n, 3, device=device), torch.zeros(n, device=device)
        self.heights = torch.zeros(n, round(features.PEAK_WINDOW / self.dt), device=device)
        sample_parameters(n, NOMINAL, generator)  # what is drawn afterwards is then what results were drawn with
        present = {name: simulator.parameter(name) for name in DESCRIBED}
        self.privileged, self.stiffness, self.damping = described(present), present["stiffness"], present["damping"]
        self._delayed = False

    def step(self, action: Tensor) -> None:
        """Hold joint targets ``q_default + scale * action`` for one control step."""
        self.simulator.step(self._default_pose + self._action_scale * action)
        self.heights = torch.cat((self.heights[:, 1:], self._height()), -1)
        self.mean_velocity = torch.lerp(self.mean_velocity, self._velocity(), self.dt / STRIDE)
        self.mean_yaw_rate = torch.lerp(self.mean_yaw_rate, self._yaw_rate(), self.dt / STRIDE)

    def remember(self, state: LocomotionState) -> None:
        """Keep of a step's state what the next one compares with."""
        self.action, self.torque, self.joint_velocity = state.action.clone(), state.torque, state.joint_velocity

    def begin(self, mask: Tensor, commands: CommandSampler) -> LocomotionState:
        """Forget the past of the rows of a bool mask ``[N]``, which the simulator has just put somewhere."""
        row = mask[:, None]
        self.action = self.action.masked_fill(row, 0.0)
        self.joint_velocity = torch.where(row, self.simulator.joint_velocity, self.joint_velocity)
        self.heights = torch.where(row, self._height(), self.heights)
        self.mean_velocity = torch.where(row, self._velocity(), self.mean_velocity)
        self.mean_yaw_rate = torch.where(mask, self._yaw_rate(), self.mean_yaw_rate)
        state = self.state(self.action, commands)
        self.torque = torch.where(row, state.torque, self.torque)
        return state

    def randomize(self, mask: Tensor, ranges: Randomization) -> None:
        """Draw physical parameters of the rows of a bool mask anew."""
        fields, privileged = sample_parameters(len(mask), ranges, self.generator)
        if self._delayed and "action_delay" not in fields:
            fields["action_delay"] = torch.zeros_like(fields["ground_friction"])
        self._delayed |= "action_delay" in fields
        self.simulator.set_parameters(mask, **fields)
        row = mask[:, None]
        self.privileged = torch.where(row, privileged, self.privileged)
        self.stiffness = torch.where(row, fields["stiffness"], self.stiffness)
        self.damping = torch.where(row, fields["damping"], self.damping)

    def _height(self) -> Tensor:
        position = self.simulator.root_position
        return position[:, 2:] - self.ground(position[:, :2])[:, None]

    def _velocity(self) -> Tensor:
        return rotations.rotate_inverse(self.simulator.root_quaternion, self.simulator.root_linear_velocity)

    def _yaw_rate(self) -> Tensor:
        return self.simulator.root_angular_velocity[:, 2]

    def state(self, action: Tensor, commands: CommandSampler) -> LocomotionState:
        """The present, as the terms of an environment see it."""
        simulator = self.simulator
        roll, pitch, yaw = rotations.to_euler(simulator.root_quaternion)
        force = simulator.contact_force
        legs = force[:, 1:].unflatten(-1, (4, 4))
        return LocomotionState(
            root_height=self.heights[:, -1:],
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            linear_velocity=self._velocity(),
            mean_velocity=self.mean_velocity,
            mean_yaw_rate=self.mean_yaw_rate,
            angular_velocity=simulator.root_angular_velocity,
            joint_position=simulator.joint_position,
            joint_velocity=simulator.joint_velocity,
            previous_joint_velocity=self.joint_velocity,
            torque=self.stiffness * (simulator.motor_target - simulator.joint_position)
            - self.damping * simulator.joint_velocity,
            previous_torque=self.torque,
            action=action,
            previous_action=self.action,
            trunk_contact=force[:, 0],
            hip_contact=legs[..., 0],
            thigh_contact=legs[..., 1],
            calf_contact=legs[..., 2],
            foot_contact=legs[..., 3],
            command=commands.command,
            jumping=commands.jumping,
            peak_height=self.heights.amax(-1),
            rhythm=torch.zeros_like(roll),
            low_feet=torch.zeros_like(roll),
            unstable=simulator.unstable,
            dt=self.dt,
        )

    def state_dict(self) -> dict[str, Any]:
        """The memories, without the simulator."""
        return {name: getattr(self, name).clone() for name in _BUFFERS}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, after the simulator; further entries are left alone."""
        self._delayed = bool(self.simulator.parameter("action_delay").any())
        for name in _BUFFERS:
            setattr(self, name, state[name].clone())


class Pushes:
    """Horizontal kicks of the trunk at a steady interval, at another moment for each robot.

    Source: method notes, sections 4.5 and 5.11: every 8 s, v_xy set to U(-0.5, 0.5) m/s.

    Args:
        num_robots: N.
        generator: source of randomness.
        interval: control steps between two pushes of a robot; ``None`` for no pushes.
        velocity: largest speed on each axis that a push sets [m/s].

    Raises:
        ValueError: if the interval is no control step.

    Attributes:
        phase: int64 ``[N]``, control steps by which a robot's pushes are early.
    """

    def __init__(self, num_robots: int, generator: torch.Generator, interval: int | None, velocity: float) -> None:
        if interval is not None and interval < 1:
            raise ValueError(f"push_interval must be at least a control step, or None for none; got {interval} steps")
        self.generator, self.interval, self.velocity = generator, interval, velocity
        self.phase = torch.zeros(num_robots, dtype=torch.int64, device=generator.device)

    def begin(self, mask: Tensor) -> None:
        """Draw the moments of the rows of a bool mask ``[N]``."""
        if self.interval is not None:
            phase = torch.randint(self.interval, (len(mask),), generator=self.generator, device=mask.device)
            self.phase = torch.where(mask, phase, self.phase)

    def apply(self, simulator: Simulator, step_count: Tensor) -> None:
        """Push whose turn it is after ``step_count`` ``[N]`` control steps of their episode."""
        if self.interval is None:
            return
        mask = (step_count + self.phase) % self.interval == self.interval - 1
        if worthwhile(mask):
            simulator.push(mask, self.velocity * uniform((len(mask), 2), (-1.0, 1.0), self.generator))
