"""The depth camera of one simulated robot in plain MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import mujoco
import numpy as np

from agility_rl.deploy.depth import DEPTH_UNIT, Frame, sensor_image
from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.go2 import camera
from agility_rl.go2.appearance import BONE_GROUP

FRAME_PERIOD = 0.02
"""Time between two images [s]: 50 Hz (supplement S3)."""
RANGE = 10.0
"""What is farther, or nothing at all, counts as this far [m]; the network's range ends at 4 m."""
_SEEN: Any = (np.arange(mujoco.mjNGROUP) != BONE_GROUP).astype(np.uint8)


class SimulatedCamera:
    """One ray through the centre of each pixel of the network, in millimetres, as the real camera counts them.

    The sky counts as far away, as it does in training. A real camera measures nothing (0) there, and what is not
    measured is taken from the nearest pixel that was: under the open sky, a real image differs.

    Source: pose and rays: :mod:`agility_rl.go2.camera`; the engine's ``mj_multiRay``.

    Args:
        robot: whose camera it is.
        pitch: mounting angle [rad], positive looks down.
        now: the controller's clock [s]; the robot's simulated time by default.

    Example:
        >>> robot = SimulatedRobot()
        >>> counts = SimulatedCamera(robot).counts()
        >>> counts.shape, int(counts[0, 43]), 700 < int(counts[-1, 43]) < 800  # sky above, floor below
        ((58, 87), 10000, True)
    """

    def __init__(self, robot: SimulatedRobot, pitch: float = 0.0, *, now: Callable[[], float] | None = None) -> None:
        self.robot = robot
        self._now = (lambda: robot.time) if now is None else now
        self._trunk = robot.model.body("trunk").id
        self._model = copy(robot.model)
        own = self._model.body_rootid[self._model.geom_bodyid] == self._trunk
        self._model.geom_rgba[own, 3] = 1.0  # a skin makes them transparent, and rays pass through what is
        self._rays = camera.pixel_directions(pitch).reshape(-1, 3).double().numpy()
        self._distance: Any = np.empty(len(self._rays))
        self._geom: Any = np.empty(len(self._rays), dtype=np.int32)
        self._frame: Frame | None = None

    def counts(self) -> np.ndarray:
        """Depths as the robot stands now, uint16 ``[58, 87]`` [mm]."""
        model, data, trunk = self._model, self.robot.data, self._trunk
        turn = data.xmat[trunk].reshape(3, 3)
        eye = data.xpos[trunk] + turn @ np.array(camera.POSITION)
        rays = np.ascontiguousarray(self._rays @ turn.T).reshape(-1)
        mujoco.mj_multiRay(
            model, data, eye, rays, _SEEN, 1, trunk, self._geom, self._distance, None, len(self._geom), mujoco.mjMAXVAL
        )
        depth = np.where((self._distance < 0.0) | (self._distance > RANGE), RANGE, self._distance)
        return np.rint(depth / DEPTH_UNIT).astype(np.uint16).reshape(camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)

    def latest(self) -> Frame:
        """The newest of the images, which are taken every 20 ms."""
        now = self._now()
        if self._frame is None or not 0.0 <= now - self._frame.time < FRAME_PERIOD - 1e-9:
            self._frame = Frame(now, sensor_image(self.counts()))
        return self._frame
