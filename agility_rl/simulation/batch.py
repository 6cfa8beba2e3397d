"""Many robots on the CPU: ``mujoco.batch`` on a pool of C++ threads."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from typing import Any
from weakref import WeakSet

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.go2.model import ROBOT_GROUP
from agility_rl.simulation.depth_camera import DepthCamera
from agility_rl.simulation.openmp import rest
from agility_rl.simulation.parameters import SimulationParameters
from agility_rl.simulation.scenery import Piece
from agility_rl.simulation.terrain import HeightField
from agility_rl.simulation.world import FORCES, JOINT_SPEEDS, JOINTS, World, check_finite, check_target

_WARNINGS = [
    int(warning)
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
        mujoco.mjtWarning.mjWARN_BADCTRL,
    )
]
_VIEWS = ("_qpos", "_qvel", "_ctrl", "_sensordata", "_mocap_position", "_mocap_quaternion")
"""Attributes that look into the memory of the batch."""


class BatchSimulator:
    """:class:`agility_rl.simulation.Simulator` on the CPU, results independent of the number of threads.

    The PD controller is the engine's position actuator and runs in every physics step. Contact forces are those of
    the last physics step of a control step. Parameters become per-simulation model fields when they are first set.

    Args:
        num_simulations: N.
        num_threads: C++ threads; by default the CPUs that this process may use.
        control_dt: control step [s], a multiple of ``sim_dt``.
        sim_dt: physics step [s].
        terrain: height field instead of a plane.
        scenery: pieces that every simulation places for itself by :meth:`place`; below the ground until then.
        **model_options: keyword arguments of :func:`agility_rl.go2.model.build_spec`.

    Raises:
        ValueError: if the steps do not fit each other or a number is not positive.

    Example:
        >>> simulator = BatchSimulator(2, num_threads=1)
        >>> simulator.step(torch.tensor(constants.DEFAULT_POSE).expand(2, 12))
        >>> simulator.contact_force.shape
        torch.Size([2, 17])
    """

    def __init__(
        self,
        num_simulations: int,
        *,
        num_threads: int | None = None,
        control_dt: float = constants.CONTROL_DT,
        sim_dt: float = constants.SIM_DT,
        terrain: HeightField | None = None,
        scenery: Sequence[Piece] = (),
        **model_options: Any,
    ) -> None:
        if num_simulations < 1:
            raise ValueError(f"num_simulations must be at least 1, got {num_simulations}")
        self.num_simulations, self.device = num_simulations, torch.device("cpu")
        self.num_threads = num_threads or len(os.sched_getaffinity(0))
        self.world = World(control_dt=control_dt, sim_dt=sim_dt, terrain=terrain, scenery=scenery, **model_options)
        self.control_dt, self.sim_dt, self.substeps = control_dt, sim_dt, self.world.substeps
        self.terrain, self.ground_extent = terrain, self.world.ground_extent
        self.scenery: Sequence[Piece] = self.world.scenery
        self.model: mujoco.MjModel = self.world.model
        self.batch = Batch(self.model, num_simulations, self.num_threads)
        self._qpos, self._qvel = self.batch.bind("qpos"), self.batch.bind("qvel")
        self._ctrl, self._sensordata = self.batch.bind("ctrl"), self.batch.bind("sensordata")
        if self.scenery:
            self._mocap_position, self._mocap_quaternion = self.batch.bind("mocap_pos"), self.batch.bind("mocap_quat")
        self._hinges, self._hinge_speeds = self.world.hinges, self.world.hinge_speeds
        self._parameters = SimulationParameters(
            self.world, num_simulations, lambda field: torch.from_numpy(self.batch.expand(field))
        )
        self._previous_target = torch.tensor(constants.DEFAULT_POSE).repeat(num_simulations, 1)
        self._cameras: WeakSet[DepthCamera] = WeakSet()
        self.unstable = torch.zeros(num_simulations, dtype=torch.bool)
        self._qpos[:, JOINTS] = self._ctrl[:] = constants.DEFAULT_POSE
        self.batch.forward()
        self._read()

    def step(self, target: Tensor) -> None:
        """Hold joint position targets ``[N, 12]`` [rad] for one control step.

        Raises:
            ValueError: if ``target`` has another shape.
        """
        check_target(target, self.num_simulations)
        self.batch.warning[:, _WARNINGS, 1] = 0  # it forgets its counts where it begins anew: none can be compared
        failed: list[int] = []
        if self._parameters.delay is None:
            self._ctrl[:] = target.numpy()
            failed += self._advance(self.substeps)
        else:
            failed += self._step_delayed(target)
        self._previous_target = target.clone()
        self.unstable = torch.from_numpy(self.batch.warning[:, _WARNINGS, 1].any(-1))
        self._read()
        self.unstable[failed] = True

    def _advance(self, steps: int) -> list[int]:
        """Physics steps for all; the simulations in which the engine raised (they keep their state, the rest go on)."""
        rest()
        try:
            self.batch.step(nstep=steps)
        except SimulationError as error:
            return list(error.ids.tolist())
        return []

    def _step_delayed(self, target: Tensor) -> list[int]:
        """Step one physics step at a time; each simulation takes its new target after its own delay."""
        assert self._parameters.delay is not None
        new, old = target.numpy(), self._previous_target.numpy()
        delay = self._parameters.delay.numpy()
        edges = sorted({0, self.substeps, *np.unique(delay[delay < self.substeps]).tolist()})
        failed: list[int] = []
        for start, end in pairwise(edges):
            self._ctrl[:] = np.where(delay[:, None] <= start, new, old)
            failed += self._advance(end - start)
        return failed

    def reset(
        self,
        mask: Tensor,
        *,
        root_position: Tensor,
        root_quaternion: Tensor,
        root_linear_velocity: Tensor,
        root_angular_velocity: Tensor,
        joint_position: Tensor,
        joint_velocity: Tensor,
    ) -> None:
        """Put the rows of a bool mask ``[N]`` into given states; the other rows stay bit-identical.

        Scenery stays as it is.

        Raises:
            ValueError: if a state is not finite; the engine would replace it without a word.
        """
        ids = mask.numpy()
        if not ids.any():
            return
        qpos = torch.cat((root_position, root_quaternion, joint_position), -1)[mask]
        qvel = torch.cat((root_linear_velocity, root_angular_velocity, joint_velocity), -1)[mask]
        check_finite(mask.nonzero()[:, 0], qpos, qvel)
        angle, rate = self._qpos[ids][:, self._hinges], self._qvel[ids][:, self._hinge_speeds]
        placed = (self._mocap_position[ids], self._mocap_quaternion[ids]) if self.scenery else None
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if placed is not None:
            self._mocap_position[ids], self._mocap_quaternion[ids] = placed
        state, speed = self._qpos[ids], self._qvel[ids]
        state[:, : JOINTS.stop], speed[:, : JOINT_SPEEDS.stop] = qpos.numpy(), qvel.numpy()
        state[:, self._hinges], speed[:, self._hinge_speeds] = angle, rate
        self._qpos[ids], self._qvel[ids] = state, speed
        self._ctrl[ids] = joint_position[mask].numpy()
        self._previous_target = torch.where(mask[:, None], joint_position, self._previous_target)
        rest()
        self.batch.forward(ids)
        self.unstable = self.unstable & ~mask
        self._read()

    def place(self, mask: Tensor, position: Tensor, quaternion: Tensor, hinge_angle: Tensor) -> None:
        """Put the scenery of some rows somewhere (:meth:`agility_rl.simulation.Simulator.place`).

        Raises:
            ValueError: if a shape is another or a number is not finite.
        """
        self.world.check_places(mask, position, quaternion, hinge_angle)
        ids = mask.numpy()
        if not self.scenery or not ids.any():
            return
        self._mocap_position[ids], self._mocap_quaternion[ids] = position[mask].numpy(), quaternion[mask].numpy()
        state, speed = self._qpos[ids], self._qvel[ids]
        state[:, self._hinges], speed[:, self._hinge_speeds] = hinge_angle[mask].numpy(), 0.0
        self._qpos[ids], self._qvel[ids] = state, speed
        rest()
        self.batch.forward(ids)
        self._read()

    def _read(self) -> None:
        qpos = torch.from_numpy(self._qpos.astype(np.float32))
        qvel = torch.from_numpy(self._qvel.astype(np.float32))
        self.root_position, self.root_quaternion, self.joint_position = qpos[:, :3], qpos[:, 3:7], qpos[:, JOINTS]
        self.root_linear_velocity, self.root_angular_velocity = qvel[:, :3], qvel[:, 3:6]
        self.joint_velocity = qvel[:, JOINT_SPEEDS]
        self.hinge_angle = qpos[:, self._hinges]
        self.motor_target = torch.from_numpy(self._ctrl.astype(np.float32))
        forces = torch.from_numpy(self._sensordata[:, FORCES].astype(np.float32))
        self.contact_force = torch.linalg.vector_norm(forces.unflatten(-1, (-1, 3)), dim=-1)

    def set_parameters(self, mask: Tensor, **fields: Tensor) -> None:
        """Change parameters of :data:`PARAMETERS` in the rows of a bool mask; each value is ``[N, size]``.

        Raises:
            ValueError: if a parameter is unknown or has a wrong shape.
        """
        if self._parameters.set(mask, fields) and bool(mask.any()):
            self.batch.set_const(mask.numpy())

    def parameter(self, name: str) -> Tensor:
        """Present value ``[N, size]`` of a parameter, as a copy."""
        return self._parameters.value(name)

    def push(self, mask: Tensor, velocity: Tensor) -> None:
        """Set the horizontal trunk velocity ``[N, 2]`` [m/s] of the rows of a bool mask."""
        self._qvel[mask.numpy(), :2] = velocity[mask].numpy()

    def ground_height(self, position: Tensor) -> Tensor:
        """Height of the ground [m] under horizontal positions ``[N, 2]``, as ``[N]``."""
        return torch.zeros(len(position)) if self.terrain is None else self.terrain.height_at(position)

    def ray(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Distance [m] to the nearest surface that is not the robot, ``[N, R]``; infinite when there is none."""
        groups = np.ones(6, dtype=np.uint8)
        groups[ROBOT_GROUP] = 0
        towards = torch.nn.functional.normalize(direction.double(), dim=-1).numpy()
        rest()
        distance, _ = self.batch.ray(origin.double().numpy(), towards, groups)[:2]
        found = torch.from_numpy(np.array(distance, dtype=np.float32))
        return torch.where(found < 0, torch.inf, found)

    def make_camera(self) -> DepthCamera:
        """A depth camera on every robot, which follows these simulations."""
        camera = DepthCamera(self.world.spec, self.batch, self.num_threads)
        self._cameras.add(camera)
        return camera

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs: integration states, parameters, derived fields last read."""
        return {
            "state": torch.from_numpy(self.batch.state.copy()),
            "parameters": {name: value.clone() for name, value in self._parameters.values.items()},
            "previous_target": self._previous_target.clone(),
            "contact_force": self.contact_force.clone(),
            "unstable": self.unstable.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if the state belongs to another model, number of simulations or simulator.
        """
        saved = state["state"]
        found = "several tensors" if isinstance(saved, dict) else tuple(saved.shape)
        if found != self.batch.state.shape:
            raise ValueError(
                f"simulator state must be {self.batch.state.shape}, got {found}; resume with the simulator, the number "
                "of robots and the model that wrote it"
            )
        everyone = torch.ones(self.num_simulations, dtype=torch.bool)
        # What was never set in the saved simulation has its nominal value there, whatever it is here.
        nominal = {name: self._parameters.nominal(name) for name in self._parameters.values}
        self.set_parameters(everyone, **{**nominal, **state["parameters"]})
        self.batch.state[:] = saved.numpy()
        self._read()
        self._previous_target = state["previous_target"].clone()
        self.contact_force = state["contact_force"].clone()
        self.unstable = state["unstable"].clone()

    def close(self) -> None:
        """Release threads and memory, those of its cameras too; the simulator cannot be used afterwards."""
        for camera in self.__dict__.pop("_cameras", ()):
            camera.close()
        for name in ("batch", *_VIEWS):  # every view keeps the batch alive
            self.__dict__.pop(name, None)
