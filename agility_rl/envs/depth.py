"""What the student sees: late, noisy depth images of a camera that is not mounted quite straight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from agility_rl.envs.randomization import uniform
from agility_rl.go2 import camera
from agility_rl.simulation import Simulator
from agility_rl.tensors import rows_of


class DepthObservation:
    """Depth images of ``N`` robots, with the rate, latency, mounting and noise of a camera.

    A robot sees the newest frame that was taken at least its latency ago. Of the frames between two observations only
    that one is rendered, so deciding at 10 Hz costs a fifth of the images. Latency and mounting angle are drawn at each
    reset; the first frame of an episode is there at once, and noise belongs to a frame: shown twice, it is the same.

    Source: method notes, section 5.8; camera: :mod:`agility_rl.go2.camera`. Ours: latency and angle are drawn anew for
    each episode, and latency counts control steps, so that it stays the camera's own at any rate of decisions.

    Args:
        simulator: where the robots live; the tensors are on its device.
        generator: source of randomness, on the simulator's device.
        decision_steps: control steps between two observations.
        frame_steps: control steps between two frames of the camera; 1 is 50 Hz.
        latency: fewest and most control steps by which an image is late; (1, 1) as released.
        pitch: half-width of the mounting angle [rad].
        offset_noise: half-width of an image's common error [m].
        pixel_noise: half-width of its pixels' errors [m], times U(0, 1) drawn for each image.

    Raises:
        ValueError: if a number is negative, a period is not positive or the range of latencies is none.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> simulator = make_simulator(num_simulations=2, num_threads=1)
        >>> depth = DepthObservation(simulator, torch.Generator().manual_seed(0))
        >>> depth.begin(torch.tensor([True, True]))
        >>> depth.image().shape
        torch.Size([2, 58, 87])
    """

    def __init__(
        self,
        simulator: Simulator,
        generator: torch.Generator,
        decision_steps: int = 1,
        *,
        frame_steps: int = 1,
        latency: tuple[int, int] = (1, 1),
        pitch: float = camera.PITCH_JITTER,
        offset_noise: float = camera.OFFSET_NOISE,
        pixel_noise: float = camera.PIXEL_NOISE,
    ) -> None:
        if decision_steps < 1 or frame_steps < 1:
            raise ValueError(f"decision_steps and frame_steps must be positive, got {decision_steps} and {frame_steps}")
        if not 0 <= latency[0] <= latency[1]:
            raise ValueError(f"latency must be (fewest, most) control steps from 0 on, got {latency}")
        if min(pitch, offset_noise, pixel_noise) < 0.0:
            raise ValueError(f"pitch and noise must not be negative, got {pitch}, {offset_noise}, {pixel_noise}")
        n, device = simulator.num_simulations, simulator.device
        self.generator, self.camera, self.control_dt = generator, simulator.make_camera(), simulator.control_dt
        self.decision_steps, self.frame_steps, self.latency = decision_steps, frame_steps, latency
        self.pitch, self.offset_noise, self.pixel_noise = pitch, offset_noise, pixel_noise
        kept = math.ceil(latency[1] / max(decision_steps, frame_steps)) + 1
        self._frames = torch.zeros(n, kept, camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH, device=device)  # newest last
        self._taken = torch.zeros(n, kept, dtype=torch.int64, device=device)  # control step of each frame
        self._late = torch.full((n,), latency[0], device=device)
        self._step = torch.zeros(n, dtype=torch.int64, device=device)

    def begin(self, mask: Tensor) -> None:
        """Start episodes of the rows of a bool mask ``[N]``, which the simulator has just put somewhere."""
        n, device = len(mask), mask.device
        late = torch.randint(self.latency[0], self.latency[1] + 1, (n,), generator=self.generator, device=device)
        pitch = self.pitch * uniform((n,), (-1.0, 1.0), self.generator)
        self._late = torch.where(mask, late, self._late)
        self._step = self._step.masked_fill(mask, 0)
        self.camera.set_pitch(mask, pitch)
        rows, first = rows_of(mask), self._take(mask)[:, None]
        self._frames[rows] = torch.where(mask[rows, None, None, None], first, self._frames[rows])
        self._taken = self._taken.masked_fill(mask[:, None], -self.latency[1])

    def advance(self) -> None:
        """Count a control step of every robot, and take the frames that an observation will show."""
        self._step = self._step + 1
        # Steps until the next observation that may show a frame taken now: it is the newest then if there is none
        # between. An observation every `decision_steps` looks `_late` steps back, at frames every `frame_steps`.
        until = -(self._step + self._late) % self.decision_steps
        due = (self._step % self.frame_steps == 0) & (until < self.frame_steps)
        # A GPU is waited for where that can spare it the images of all robots, and only there.
        if max(self.decision_steps, self.frame_steps) > 1 and not bool(due.any()):
            return
        rows = rows_of(due)
        frames = self._frames[rows]
        newer = torch.cat((frames[:, 1:], self._take(due)[:, None]), 1)
        self._frames[rows] = torch.where(due[rows, None, None, None], newer, frames)
        taken = torch.cat((self._taken[:, 1:], self._step[:, None]), 1)
        self._taken = torch.where(due[:, None], taken, self._taken)

    def image(self) -> Tensor:
        """What the robots see, normalised, ``[N, 58, 87]``."""
        index = self._shown()
        return self._frames[torch.arange(len(index), device=index.device), index]

    def age(self) -> Tensor:
        """How long ago that was taken, ``[N, 1]`` [s]; an episode's first frame, as if the robot had stood before."""
        taken = self._taken.gather(1, self._shown()[:, None])[:, 0].clamp(min=0)
        return (self.control_dt * torch.maximum(self._step - taken, self._late))[:, None]

    def _shown(self) -> Tensor:
        """Index of the frame that robots see, ``[N]``."""
        old_enough = self._taken <= (self._step - self._late)[:, None]
        return old_enough.sum(-1).clamp(min=1) - 1  # frames are ordered by age

    def _take(self, mask: Tensor) -> Tensor:
        """Normalised frames ``[M, 58, 87]`` of :func:`~agility_rl.tensors.rows_of` a bool mask."""
        depth = self.camera.render(mask)
        if self.offset_noise or self.pixel_noise:
            # Drawn for every robot, whoever's frame is due, so that one robot's noise does not depend on the others.
            n = len(mask)
            offset, scale = uniform((2, n, 1, 1), (0.0, 1.0), self.generator)
            pixel = uniform((n, *depth.shape[1:]), (-1.0, 1.0), self.generator)
            noise = self.offset_noise * (2.0 * offset - 1.0) + self.pixel_noise * scale * pixel
            depth = depth + noise[rows_of(mask)]
        return camera.normalize_depth(depth)

    def state_dict(self) -> dict[str, Any]:
        """Frames, clocks and angles, without the generator."""
        names = ("_frames", "_taken", "_late", "_step")
        return {**{name[1:]: getattr(self, name).clone() for name in names}, "pitch": self.camera.pitch.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if it was written with other latencies or another number of robots.
        """
        if state["frames"].shape != self._frames.shape:
            raise ValueError(
                f"the frames of the depth camera must be {list(self._frames.shape)}, got "
                f"{list(state['frames'].shape)}; resume with the latency and the number of robots that wrote them"
            )
        for name in ("frames", "taken", "late", "step"):
            setattr(self, f"_{name}", state[name].clone())
        self.camera.set_pitch(torch.ones_like(self._step, dtype=torch.bool), state["pitch"])
