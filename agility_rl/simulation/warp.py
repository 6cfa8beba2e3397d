"""Many robots on an NVIDIA GPU: ``mujoco-warp``. On the CPU device of Warp the same code runs slowly, for tests."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any
from weakref import WeakSet

import mujoco
import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.go2.model import ROBOT_GROUP
from agility_rl.simulation.parameters import FIELDS, SimulationParameters
from agility_rl.simulation.scenery import Piece
from agility_rl.simulation.simulator import HardwareError
from agility_rl.simulation.terrain import HeightField
from agility_rl.simulation.warp_camera import WarpDepthCamera
from agility_rl.simulation.warp_device import mjw, on_device, usable_device, wp
from agility_rl.simulation.world import FORCES, JOINT_SPEEDS, JOINTS, World, check_finite, check_target

_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
"""Fields that :func:`mujoco_warp.set_const` computes from :data:`agility_rl.simulation.parameters.FIELDS`."""
_DIVERGED = 1e10
"""Positions or velocities beyond this are no motion any more (MuJoCo's ``mjMAXVAL``)."""
_OF_ONE = int(mjw.OverflowType.NEFC | mjw.OverflowType.CCD | mjw.OverflowType.HFIELD | mjw.OverflowType.CONTACT_MATCH)
"""What of a simulation did not fit into its own room."""
_OF_ALL = int(mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE)
"""What of anyone did not fit into the room of all."""
_VIEWS = ("_qpos", "_qvel", "_ctrl", "_warmstart", "_flags", "_sensordata", "_mocap_position", "_mocap_quaternion")
"""Attributes that look into the memory of the simulation."""
_LOOK_EVERY = 500
"""Control steps after which the host looks whether contacts fit; each look makes the GPU wait."""

_Groups = wp.types.vector(length=6, dtype=float)
_log = logging.getLogger(__name__)


class WarpSimulator:
    """:class:`agility_rl.simulation.Simulator` by ``mujoco-warp``, on the tensors of one device.

    As :class:`~agility_rl.simulation.BatchSimulator` steps it, in float32: the same model, solver and PD controller;
    contact forces are those of the last physics step. Different are: after a reset, contact forces are zero until the
    next step; a robot that diverges, or has more constraints than there is room for, is ``unstable`` and stands in its
    initial state. A physics step is captured as a CUDA graph, and stepping needs nothing of the host.

    Args:
        num_simulations: N.
        device: of torch and Warp; ``"cpu"`` for tests.
        control_dt: control step [s], a multiple of ``sim_dt``.
        sim_dt: physics step [s].
        terrain: height field instead of a plane.
        scenery: pieces that every simulation places for itself by :meth:`place`; below the ground until then.
        max_contacts: contacts that there is room for, on average of all simulations.
        max_constraints: rows of the constraint solver that each has room for (a contact takes four, a limit or dry
            friction of a joint one); by default enough for one and a half times ``max_contacts``.
        **model_options: keyword arguments of :func:`agility_rl.go2.model.build_spec`.

    Raises:
        ValueError: if the steps do not fit each other or a number is not positive.
        HardwareError: if there is no such device, or too little memory.

    Example:
        >>> simulator = WarpSimulator(2, device="cpu")
        >>> simulator.step(torch.tensor(constants.DEFAULT_POSE).expand(2, 12))
        >>> simulator.contact_force.shape
        torch.Size([2, 17])
    """

    def __init__(
        self,
        num_simulations: int,
        *,
        device: torch.device | str = "cuda",
        control_dt: float = constants.CONTROL_DT,
        sim_dt: float = constants.SIM_DT,
        terrain: HeightField | None = None,
        scenery: Sequence[Piece] = (),
        max_contacts: int = 48,
        max_constraints: int | None = None,
        **model_options: Any,
    ) -> None:
        wp.init()
        for name, number in (("num_simulations", num_simulations), ("max_contacts", max_contacts)):
            if number < 1:
                raise ValueError(f"{name} must be at least 1, got {number}")
        self.num_simulations, self.device = num_simulations, usable_device(device)
        self.world = World(control_dt=control_dt, sim_dt=sim_dt, terrain=terrain, scenery=scenery, **model_options)
        self.control_dt, self.sim_dt, self.substeps = control_dt, sim_dt, self.world.substeps
        self.ground_extent, self.scenery = self.world.ground_extent, self.world.scenery
        self.terrain = terrain and HeightField(terrain.heights.to(self.device), terrain.half_size)
        self.model: mujoco.MjModel = self.world.model
        rows = 6 * max_contacts + self.model.nv if max_constraints is None else max_constraints
        try:
            with on_device(self.device):
                self._model = mjw.put_model(self.model, dict.fromkeys((*FIELDS, *_DERIVED), num_simulations))
                self._model.opt.warn_overflow = 0  # reported by the log, once, with what helps
                self._data = mjw.make_data(self.model, num_simulations, nconmax=max_contacts, njmax=rows)
        except RuntimeError as error:
            raise HardwareError(
                f"{num_simulations} simulations with {max_contacts} contacts each do not fit on {self.device}; give "
                f"fewer robots or fewer max_contacts ({error})"
            ) from error
        data = self._data
        self._qpos, self._qvel, self._ctrl = (wp.to_torch(a) for a in (data.qpos, data.qvel, data.ctrl))
        self._warmstart, self._flags = wp.to_torch(data.qacc_warmstart), wp.to_torch(data.overflow)
        self._sensordata = wp.to_torch(data.sensordata)
        self._mocap_position, self._mocap_quaternion = wp.to_torch(data.mocap_pos), wp.to_torch(data.mocap_quat)
        self._parameters = SimulationParameters(self.world, num_simulations, self._field, self.device)
        hinges = self.world.hinges, self.world.hinge_speeds  # lists would be copied to the GPU whenever they are used
        self._hinges, self._hinge_speeds = (torch.tensor(x, dtype=torch.int64, device=self.device) for x in hinges)
        self._initial = self._qpos[:1].clone()
        self._initial[:, JOINTS] = torch.tensor(constants.DEFAULT_POSE, device=self.device)
        self._qpos.copy_(self._initial.expand_as(self._qpos))
        self._previous_target = self._initial[:, JOINTS].repeat(num_simulations, 1)
        self._ctrl.copy_(self._previous_target)
        self.unstable = torch.zeros(num_simulations, dtype=torch.bool, device=self.device)
        self._seen, self._steps, self._told = torch.zeros_like(self._flags), 0, False
        self._cameras: WeakSet[WarpDepthCamera] = WeakSet()
        self._graph = self._capture()
        with on_device(self.device):
            mjw.forward(self._model, data)
        self._read()

    def _field(self, name: str) -> Tensor:
        return wp.to_torch(getattr(self._model, name))

    def _capture(self) -> Any:
        """A physics step as a CUDA graph; ``None`` on the CPU. The state stays as it is."""
        if self.device.type != "cuda":
            return None
        kept = [array.clone() for array in (self._qpos, self._qvel, self._warmstart)]
        torch.cuda.synchronize(self.device)
        # On Warp's stream: torch's default one is not captured.
        with wp.ScopedDevice(wp.device_from_torch(self.device)):
            mjw.step(self._model, self._data)  # compiles what a capture could not
            with wp.ScopedCapture() as capture:
                mjw.step(self._model, self._data)
        torch.cuda.synchronize(self.device)
        for array, before in zip((self._qpos, self._qvel, self._warmstart), kept, strict=True):
            array.copy_(before)
        return capture.graph

    def step(self, target: Tensor) -> None:
        """Hold joint position targets ``[N, 12]`` [rad] for one control step.

        Raises:
            ValueError: if ``target`` has another shape.
            HardwareError: if there were more contacts than there is room for (on a GPU, after 500 steps at the latest).
        """
        check_target(target, self.num_simulations)
        delay = self._parameters.delay
        self._flags.zero_()
        self._ctrl.copy_(target)
        with on_device(self.device):
            for index in range(self.substeps):
                if delay is not None:
                    self._ctrl.copy_(torch.where(delay[:, None] <= index, target, self._previous_target))
                if self._graph is None:
                    mjw.step(self._model, self._data)
                else:
                    wp.capture_launch(self._graph)
        self._previous_target = target.clone()
        self._find_unstable(target)
        self._read()

    def _find_unstable(self, target: Tensor) -> None:
        """Flag what diverged or overflowed, and put it into the initial state."""
        state = torch.cat((self._qpos, self._qvel, target), -1)  # the engine would clip a target that is NaN
        sound = (state.abs() < _DIVERGED).all(-1)  # false for NaN
        overflowed = (self._flags & _OF_ONE) != 0
        self.unstable = ~sound | overflowed
        lost = self.unstable[:, None]
        self._qpos.copy_(torch.where(lost, self._initial, self._qpos))
        for array in (self._qvel, self._warmstart, self._sensordata):
            array.masked_fill_(lost, 0.0)
        self._seen |= self._flags
        self._steps += 1
        if self.device.type == "cpu" or self._steps % _LOOK_EVERY == 0:
            self._check_room()

    def _check_room(self) -> None:
        """Say once that constraints did not fit, or give up where contacts of anyone may be missing.

        Raises:
            HardwareError: if there were more contacts than there is room for.
        """
        if bool((self._seen & _OF_ALL).any()):
            contacts = self._data.naconmax // self.num_simulations
            raise HardwareError(
                f"more contacts than there is room for, and some were left out; give more max_contacts than {contacts}"
            )
        number = int(((self._seen & _OF_ONE) != 0).sum())
        if number and not self._told:
            self._told = True
            _log.warning(
                "constraints of %d of %d simulations did not fit, and their episodes ended; give more max_constraints "
                "than %d",
                number,
                self.num_simulations,
                self._data.njmax,
            )

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

        Scenery stays as it is. Contact forces of these rows are zero until the next step.

        Raises:
            ValueError: on the CPU, if a state is not finite; on a GPU, where looking would cost time, such a robot is
                ``unstable`` after the next step.
        """
        qpos = torch.cat((root_position, root_quaternion, joint_position), -1)
        qvel = torch.cat((root_linear_velocity, root_angular_velocity, joint_velocity), -1)
        if self.device.type == "cpu":
            check_finite(mask.nonzero()[:, 0], qpos[mask], qvel[mask])
        row = mask[:, None]
        for array, value in ((self._qpos, qpos), (self._qvel, qvel), (self._ctrl, joint_position)):
            part = array[:, : value.shape[1]]
            part.copy_(torch.where(row, value, part))
        for array in (self._warmstart, self._sensordata):
            array.masked_fill_(row, 0.0)
        self._previous_target = torch.where(row, joint_position, self._previous_target)
        self.unstable = self.unstable & ~mask
        self._read()

    def place(self, mask: Tensor, position: Tensor, quaternion: Tensor, hinge_angle: Tensor) -> None:
        """Put the scenery of some rows somewhere (:meth:`agility_rl.simulation.Simulator.place`).

        Raises:
            ValueError: if a shape is another or, on the CPU, a number is not finite.
        """
        self.world.check_places(mask, position, quaternion, hinge_angle, finite=self.device.type == "cpu")
        if not self.scenery:
            return
        for array, value in ((self._mocap_position, position), (self._mocap_quaternion, quaternion)):
            array.copy_(torch.where(mask[:, None, None], value, array))
        row = mask[:, None]
        self._qpos[:, self._hinges] = torch.where(row, hinge_angle, self._qpos[:, self._hinges])
        self._qvel[:, self._hinge_speeds] = self._qvel[:, self._hinge_speeds].masked_fill(row, 0.0)
        self._read()

    def _read(self) -> None:
        qpos, qvel = self._qpos.clone(), self._qvel.clone()
        self.root_position, self.root_quaternion, self.joint_position = qpos[:, :3], qpos[:, 3:7], qpos[:, JOINTS]
        self.root_linear_velocity, self.root_angular_velocity = qvel[:, :3], qvel[:, 3:6]
        self.joint_velocity = qvel[:, JOINT_SPEEDS]
        self.hinge_angle = qpos[:, self._hinges]
        self.motor_target = self._ctrl.clone()
        self.contact_force = torch.linalg.vector_norm(self._sensordata[:, FORCES].unflatten(-1, (-1, 3)), dim=-1)

    def set_parameters(self, mask: Tensor, **fields: Tensor) -> None:
        """Change parameters of :data:`PARAMETERS` in the rows of a bool mask; each value is ``[N, size]``.

        Raises:
            ValueError: if a parameter is unknown or has a wrong shape.
        """
        if self._parameters.set(mask, fields):
            with on_device(self.device):
                mjw.set_const(self._model, self._data)

    def parameter(self, name: str) -> Tensor:
        """Present value ``[N, size]`` of a parameter, as a copy."""
        return self._parameters.value(name)

    def push(self, mask: Tensor, velocity: Tensor) -> None:
        """Set the horizontal trunk velocity ``[N, 2]`` [m/s] of the rows of a bool mask."""
        self._qvel[:, :2] = torch.where(mask[:, None], velocity, self._qvel[:, :2])

    def ground_height(self, position: Tensor) -> Tensor:
        """Height of the ground [m] under horizontal positions ``[N, 2]``, as ``[N]``."""
        if self.terrain is None:
            return torch.zeros(len(position), device=self.device)
        return self.terrain.height_at(position)

    def ray(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Distance [m] to the nearest surface that is not the robot, ``[N, R]``; infinite when there is none."""
        n, rays = origin.shape[:2]
        start = wp.from_torch(origin.float().contiguous(), dtype=wp.vec3)
        way = wp.from_torch(torch.nn.functional.normalize(direction.float(), dim=-1).contiguous(), dtype=wp.vec3)
        groups = [1.0] * 6
        groups[ROBOT_GROUP] = 0.0
        with on_device(self.device):
            mjw.kinematics(self._model, self._data)
            distance = wp.empty((n, rays), dtype=float)
            shape, normal = wp.empty((n, rays), dtype=int), wp.empty((n, rays), dtype=wp.vec3)
            no_body = wp.full(rays, -1, dtype=int)
            mjw.rays(self._model, self._data, start, way, _Groups(*groups), True, no_body, distance, shape, normal)
        found = wp.to_torch(distance)
        return torch.where(found < 0.0, torch.inf, found)

    def make_camera(self) -> WarpDepthCamera:
        """A depth camera on every robot, which follows these simulations."""
        eye = WarpDepthCamera(self.world.spec, self._data, self.device)
        self._cameras.add(eye)
        return eye

    def _state(self) -> dict[str, Tensor]:
        return {
            "qpos": self._qpos,
            "qvel": self._qvel,
            "ctrl": self._ctrl,
            "warmstart": self._warmstart,
            "sensordata": self._sensordata,
            "mocap_position": self._mocap_position,
            "mocap_quaternion": self._mocap_quaternion,
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs: integration states, parameters, derived fields last read."""
        return {
            "state": {name: value.clone() for name, value in self._state().items()},
            "parameters": {name: value.clone() for name, value in self._parameters.values.items()},
            "previous_target": self._previous_target.clone(),
            "unstable": self.unstable.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if the state belongs to another model, number of simulations or simulator.
        """
        saved, own = state["state"], self._state()
        shapes = {name: tuple(value.shape) for name, value in own.items()}
        found = {name: tuple(saved[name].shape) for name in saved} if isinstance(saved, dict) else "one tensor"
        if found != shapes:
            raise ValueError(
                f"simulator state must be {shapes}, got {found}; resume with the simulator, the number of robots and "
                "the model that wrote it"
            )
        everyone = torch.ones(self.num_simulations, dtype=torch.bool, device=self.device)
        nominal = {name: self._parameters.nominal(name) for name in self._parameters.values}
        given = {name: value.to(self.device) for name, value in state["parameters"].items()}
        self.set_parameters(everyone, **{**nominal, **given})
        for name, value in own.items():
            value.copy_(saved[name])
        self._previous_target = state["previous_target"].to(self.device, copy=True)
        self.unstable = state["unstable"].to(self.device, copy=True)
        self._read()

    def close(self) -> None:
        """Release memory, the cameras' too; neither simulator nor cameras can be used afterwards."""
        for eye in self._cameras:
            eye.close()
        for name in ("_graph", "_data", "_model", "_parameters", *_VIEWS):
            self.__dict__.pop(name, None)
