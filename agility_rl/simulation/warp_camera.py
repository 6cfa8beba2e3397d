"""Depth images of every robot on a GPU: the batch renderer of ``mujoco-warp``, in a model of the camera's own."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import torch
from torch import Tensor

from agility_rl.go2 import camera
from agility_rl.rotations import multiply
from agility_rl.simulation.depth_camera import CAMERA, FORWARD, camera_spec
from agility_rl.simulation.warp_device import mjw, on_device, wp
from agility_rl.tensors import rows_of


class WarpDepthCamera:
    """The D435i of ``N`` simulated robots, as :class:`agility_rl.simulation.DepthCamera`.

    Images of all robots are rendered; on a GPU all are returned too, else those that are asked for.

    Source: pose, size and field of view: :mod:`agility_rl.go2.camera`.

    Args:
        spec: model of the simulation; it is copied.
        source: data of the simulations whose poses count.
        device: where they are.

    Attributes:
        pitch: ``[N]``, mounting angle [rad], positive looks down; changed by :meth:`set_pitch`.

    Example:
        >>> from agility_rl.simulation.warp import WarpSimulator
        >>> eye = WarpSimulator(2, device="cpu").make_camera()
        >>> eye.render(torch.tensor([True, False])).shape
        torch.Size([1, 58, 87])
    """

    def __init__(self, spec: mujoco.MjSpec, source: Any, device: torch.device) -> None:
        spec, (right, down) = camera_spec(spec), camera.PRINCIPAL_POINT
        # The renderer counts it from the middle of the image, to the right and up.
        spec.camera(CAMERA).principal_pixel = (camera.IMAGE_WIDTH / 2.0 - right, down - camera.IMAGE_HEIGHT / 2.0)
        self.model: mujoco.MjModel = spec.compile()
        number = source.nworld
        self._device = device
        with on_device(device):
            self._model = mjw.put_model(self.model, {"cam_quat": number})
            self._data = mjw.make_data(self.model, number, nconmax=1, njmax=1)
            self._context = mjw.create_render_context(
                self.model,
                number,
                cam_res=(camera.IMAGE_WIDTH, camera.IMAGE_HEIGHT),
                render_rgb=False,
                render_depth=True,
                use_textures=False,
                use_fast_math=False,
                enabled_geom_groups=list(range(6)),
            )
        self._image = wp.to_torch(self._context.depth_data)  # get_depth would clamp it to 1
        self._source = source
        self._quaternion = wp.to_torch(self._model.cam_quat)[:, self.model.camera(CAMERA).id]
        self._forward = torch.tensor(FORWARD, device=device)
        self.pitch = torch.zeros(number, device=device)

    def set_pitch(self, mask: Tensor, pitch: Tensor) -> None:
        """Tilt the cameras of the rows of a bool mask ``[N]`` to angles ``[N]`` [rad], positive looks down."""
        self.pitch = torch.where(mask, pitch, self.pitch)
        half = self.pitch / 2.0
        turn = torch.stack((half.cos(), 0.0 * half, half.sin(), 0.0 * half), -1)
        self._quaternion.copy_(multiply(turn, self._forward.expand_as(turn)))

    def render(self, mask: Tensor) -> Tensor:
        """Depth images of the M rows (:func:`~agility_rl.tensors.rows_of`) of a bool mask ``[N]``, as robots stand now.

        Returns:
            float32 ``[M, 58, 87]``, distance along the optical axis [m]; infinite where nothing is.
        """
        with on_device(self._device):
            for name in ("qpos", "mocap_pos", "mocap_quat"):
                wp.copy(getattr(self._data, name), getattr(self._source, name))
            mjw.kinematics(self._model, self._data)
            mjw.com_pos(self._model, self._data)
            mjw.camlight(self._model, self._data)
            mjw.refit_bvh(self._model, self._data, self._context)
            mjw.render(self._model, self._data, self._context)
        depth = self._image[rows_of(mask)].unflatten(-1, (camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH))
        return torch.where(depth <= 0.0, math.inf, depth)

    def close(self) -> None:
        """Release memory; the camera cannot be used afterwards."""
        for name in ("_image", "_quaternion", "_source", "_context", "_data", "_model"):
            self.__dict__.pop(name, None)
