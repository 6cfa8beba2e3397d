"""Depth images of every robot: a camera rangefinder of the engine, on its thread pool, when somebody looks.

The camera lives in a model of its own, which holds the same bodies and of the robot only what it can see; the poses are
copied before each image. So images are taken when they are needed, at any rate and of any robots, physics is the same
bit for bit with and without a camera, and no physics step carries the 5,046 numbers of an image along.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from agility_rl.go2 import camera
from agility_rl.simulation.openmp import rest
from agility_rl.tensors import rows_of

CAMERA = "depth"
FORWARD = (0.5, 0.5, -0.5, -0.5)  # looks along +x of the trunk, image right is -y, image up is +z
_VISIBLE = {f"{leg}_{part}" for leg in ("FL", "FR") for part in ("thigh", "calf", "shin", "foot")}
"""Shapes of the robot that can come before its camera: all others, whatever the joints, stay behind it."""


def camera_spec(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """What the camera of a simulated robot can see, and the camera: no sensors, actuators or contacts.

    Args:
        spec: model of a simulation; it is copied.

    Example:
        >>> from agility_rl.go2.model import build_spec
        >>> [eye.name for eye in camera_spec(build_spec()).cameras]
        ['depth']
    """
    spec = spec.copy()
    for element in (*spec.sensors, *spec.actuators):
        spec.delete(element)
    trunk = spec.body("trunk")
    for shape in trunk.find_all("geom"):
        if shape.name in _VISIBLE:
            shape.rgba = (1.0, 1.0, 1.0, 1.0)  # rays pass through what is transparent, as under a skin
        else:
            spec.delete(shape)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    width, height = camera.IMAGE_WIDTH, camera.IMAGE_HEIGHT
    eye = trunk.add_camera(name=CAMERA, pos=camera.POSITION, quat=FORWARD)
    eye.resolution, eye.sensor_size = (width, height), (width * 1e-6, height * 1e-6)
    eye.focal_pixel, eye.principal_pixel = (camera.FOCAL_LENGTH, camera.FOCAL_LENGTH), camera.PRINCIPAL_POINT
    return spec


class DepthCamera:
    """The D435i of ``N`` simulated robots.

    Source: pose, size and field of view: :mod:`agility_rl.go2.camera`.

    Args:
        spec: model of the simulation; it is copied.
        source: the simulations whose poses count.
        num_threads: C++ threads.

    Attributes:
        pitch: ``[N]``, mounting angle [rad], positive looks down; changed by :meth:`set_pitch`.

    Example:
        >>> from agility_rl.simulation import BatchSimulator
        >>> eye = BatchSimulator(2, num_threads=1).make_camera()
        >>> image = eye.render(torch.tensor([True, False]))
        >>> image.shape
        torch.Size([1, 58, 87])
        >>> bool(image[0, 0, 0].isinf()), bool(image[0, -1, 0].isfinite())  # sky above, floor below
        (True, True)
    """

    def __init__(self, spec: mujoco.MjSpec, source: Batch, num_threads: int) -> None:
        spec = camera_spec(spec)
        spec.add_sensor(
            name=CAMERA,
            type=mujoco.mjtSensor.mjSENS_RANGEFINDER,
            objtype=mujoco.mjtObj.mjOBJ_CAMERA,
            objname=CAMERA,
            intprm=(1 << int(mujoco.mjtRayDataField.mjRAYDATA_DEPTH), 0, 0),
        )
        self.model: mujoco.MjModel = spec.compile()
        self._batch = Batch(self.model, source.nsim, num_threads)
        fields = ("qpos", "mocap_pos", "mocap_quat") if self.model.nmocap else ("qpos",)
        self._poses = [(self._batch.bind(field), source.bind(field)) for field in fields]
        self._depth = self._batch.bind("sensordata")
        self.pitch = torch.zeros(source.nsim)

    def set_pitch(self, mask: Tensor, pitch: Tensor) -> None:
        """Tilt the cameras of the rows of a bool mask ``[N]`` to angles ``[N]`` [rad], positive looks down."""
        self.pitch = torch.where(mask, pitch, self.pitch)
        half = (self.pitch / 2.0).double().numpy()
        turn = np.stack((np.cos(half), 0.0 * half, np.sin(half), 0.0 * half), -1)
        turned = np.empty((len(half), 4))
        for row, quaternion in zip(turned, turn, strict=True):
            mujoco.mju_mulQuat(row, quaternion, np.array(FORWARD))
        self._batch.expand("cam_quat")[:, self.model.camera(CAMERA).id] = turned

    def render(self, mask: Tensor) -> Tensor:
        """Depth images of the M rows (:func:`~agility_rl.tensors.rows_of`) of a bool mask ``[N]``, as robots stand now.

        Returns:
            float32 ``[M, 58, 87]``, distance along the optical axis [m]; infinite where nothing is.
        """
        rows = rows_of(mask).numpy()
        shape = (camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)
        if not len(rows):
            return torch.zeros(0, *shape)
        for own, source in self._poses:
            own[rows] = source[rows]
        rest()
        # Sensors of the position stage belong to what this stage comes after.
        self._batch.forward(mask.numpy(), stage=mujoco.mjtStage.mjSTAGE_VEL)
        depth = torch.from_numpy(self._depth[rows].astype(np.float32)).unflatten(-1, shape)
        return torch.where(depth < 0.0, torch.inf, depth)

    def close(self) -> None:
        """Release threads and memory; the camera cannot be used afterwards."""
        for name in ("_batch", "_poses", "_depth"):
            self.__dict__.pop(name, None)
