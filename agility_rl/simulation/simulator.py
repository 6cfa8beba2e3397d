"""What an environment needs of a physics engine."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from agility_rl.simulation.scenery import Piece


class HardwareError(ValueError):
    """A simulator cannot run here: no such device, driver or library, or too little room; the message says what helps.

    Example:
        >>> issubclass(HardwareError, ValueError)
        True
    """


_UNKNOWN = "unknown simulator {!r}; expected 'batch' (CPU) or 'warp' (NVIDIA GPU)"
_OF_WARP = ("device", "max_contacts", "max_constraints")
PARAMETERS: dict[str, tuple[int, str]] = {
    "stiffness": (12, "N m/rad"),
    "damping": (12, "N m s/rad"),
    "joint_damping": (12, "N m s/rad"),
    "armature": (12, "kg m^2"),
    "friction_loss": (12, "N m"),
    "torque_limit": (12, "N m"),
    "ground_friction": (1, "1"),
    "trunk_mass_offset": (1, "kg"),
    "trunk_com_offset": (3, "m"),
    "action_delay": (1, "s"),
}
"""Parameters that may differ between simulations: number of values and unit."""


class Camera(Protocol):
    """A depth camera on each of ``N`` robots, such as :class:`~agility_rl.simulation.DepthCamera`.

    Attributes:
        pitch: ``[N]``, mounting angle [rad], positive looks down; changed by :meth:`set_pitch`.

    Source: pose, size and field of view: :mod:`agility_rl.go2.camera`.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> camera: Camera = make_simulator(num_simulations=1, num_threads=1).make_camera()
        >>> camera.pitch
        tensor([0.])
    """

    pitch: Tensor

    def set_pitch(self, mask: Tensor, pitch: Tensor) -> None:
        """Tilt the cameras of the rows of a bool mask ``[N]`` to angles ``[N]`` [rad]."""
        ...

    def render(self, mask: Tensor) -> Tensor:
        """Distances along the optical axis [m], ``[M, 58, 87]``, of the M rows (:func:`~agility_rl.tensors.rows_of`) of
        a mask; infinite where nothing is."""
        ...


class Simulator(Protocol):
    """``N`` simulations of one robot, stepped together.

    All tensors are float32, rows are simulations, and every state tensor is new after :meth:`step` and :meth:`reset`,
    so that it may be kept.

    Attributes:
        num_simulations: N.
        device: of every tensor, those that are given to it too.
        control_dt: seconds of one :meth:`step`.
        sim_dt: seconds of one physics step.
        ground_extent: half side of the square in which robots may start [m], which a height field reaches beyond by at
            least 2 m; 0 on the plane.
        root_position: ``[N, 3]`` [m], world frame.
        root_quaternion: ``[N, 4]`` (w, x, y, z).
        root_linear_velocity: ``[N, 3]`` [m/s], world frame.
        root_angular_velocity: ``[N, 3]`` [rad/s], base frame.
        joint_position: ``[N, 12]`` [rad].
        joint_velocity: ``[N, 12]`` [rad/s].
        motor_target: ``[N, 12]`` [rad], joint targets that the motors had last: those of the last step, or of the one
            before where they come later than that; where a robot was put, its joint positions.
        contact_force: ``[N, 17]`` [N], net force on each group of :data:`agility_rl.go2.constants.CONTACT_GROUPS`.
        unstable: bool ``[N]``, the engine reported divergence in the last step.
        scenery: pieces that stand around the robot.
        hinge_angle: ``[N, H]`` [rad], of the pieces that have a hinge.

    Example:
        >>> simulator: Simulator = make_simulator(num_simulations=1, num_threads=1)
        >>> simulator.step(simulator.joint_position)
        >>> simulator.unstable
        tensor([False])
    """

    num_simulations: int
    device: torch.device
    control_dt: float
    sim_dt: float
    ground_extent: float
    root_position: Tensor
    root_quaternion: Tensor
    root_linear_velocity: Tensor
    root_angular_velocity: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    motor_target: Tensor
    contact_force: Tensor
    unstable: Tensor
    scenery: Sequence[Piece]
    hinge_angle: Tensor

    def step(self, target: Tensor) -> None:
        """Hold joint position targets ``[N, 12]`` [rad] for one control step."""
        ...

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
        """Put the rows of a bool mask ``[N]`` into given states; the other rows and the scenery stay bit-identical."""
        ...

    def place(self, mask: Tensor, position: Tensor, quaternion: Tensor, hinge_angle: Tensor) -> None:
        """Put the scenery of the rows of a bool mask ``[N]`` somewhere, hinges at rest; other rows are left alone.

        Args:
            mask: bool ``[N]``.
            position: ``[N, P, 3]`` [m], one for each piece of :attr:`scenery`, world frame.
            quaternion: ``[N, P, 4]`` (w, x, y, z).
            hinge_angle: ``[N, H]`` [rad], one for each piece that has a hinge, in the same order.
        """
        ...

    def set_parameters(self, mask: Tensor, **fields: Tensor) -> None:
        """Change parameters of :data:`PARAMETERS` in the rows of a bool mask; each value is ``[N, size]``."""
        ...

    def parameter(self, name: str) -> Tensor:
        """Present value ``[N, size]`` of a parameter, as a copy."""
        ...

    def push(self, mask: Tensor, velocity: Tensor) -> None:
        """Set the horizontal trunk velocity ``[N, 2]`` [m/s] of the rows of a bool mask."""
        ...

    def ground_height(self, position: Tensor) -> Tensor:
        """Height of the ground [m] under horizontal positions ``[N, 2]``, as ``[N]``."""
        ...

    def ray(self, origin: Tensor, direction: Tensor) -> Tensor:
        """Distance [m] to the nearest surface that is not the robot, ``[N, R]``; infinite when there is none."""
        ...

    def make_camera(self) -> Camera:
        """A depth camera on every robot, which follows these simulations."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        ...

    def close(self) -> None:
        """Release threads and memory."""
        ...


def make_simulator(name: str = "batch", *, num_simulations: int, **options: Any) -> Simulator:
    """Build a simulator by name.

    Args:
        name: ``"batch"`` (CPU, ``mujoco.batch``) or ``"warp"`` (NVIDIA GPU, ``mujoco-warp``: extra ``gpu``), to which
            ``num_threads`` says nothing; as little say ``device``, ``max_contacts`` and ``max_constraints`` to the CPU.
        num_simulations: N.
        **options: keyword arguments of the simulator's class.

    Raises:
        ValueError: if there is no simulator of this name.
        HardwareError: if it is not installed, or cannot run here.

    Example:
        >>> simulator = make_simulator(num_simulations=2, num_threads=1)
        >>> simulator.root_position.shape
        torch.Size([2, 3])
    """
    if name == "batch":
        from agility_rl.simulation.batch import BatchSimulator

        return BatchSimulator(num_simulations, **_without(options, *_OF_WARP))
    if name == "warp":
        with _installed():
            from agility_rl.simulation.warp import WarpSimulator

        return WarpSimulator(num_simulations, **_without(options, "num_threads"))
    raise ValueError(_UNKNOWN.format(name))


def simulator_device(name: str, device: torch.device | str = "cuda") -> torch.device:
    """Where the tensors of a simulator would be.

    Args:
        name: as of :func:`make_simulator`.
        device: wanted for ``"warp"``; ``"batch"`` is on the CPU.

    Raises:
        ValueError: if there is no simulator of this name.
        HardwareError: if it is not installed, or cannot run there.

    Example:
        >>> simulator_device("batch"), simulator_device("warp", "cpu")
        (device(type='cpu'), device(type='cpu'))
    """
    if name == "batch":
        return torch.device("cpu")
    if name != "warp":
        raise ValueError(_UNKNOWN.format(name))
    with _installed():
        from agility_rl.simulation.warp_device import usable_device
    return usable_device(device)


def _without(options: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name not in names}


@contextlib.contextmanager
def _installed() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise HardwareError(str(error)) from error
