"""Observation groups of a locomotion environment and the short memories behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.randomization import uniform
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import features
from agility_rl.tensors import rows_of


class RecentFrames:
    """The newest frames of ``N`` robots, in a ring: a step writes one frame and moves none.

    Args:
        num_robots: N.
        span: number of frames S.
        size: entries of a frame F.
        device: where they are kept.

    Example:
        >>> frames = RecentFrames(num_robots=1, span=3, size=1, device="cpu")
        >>> for number in (1.0, 2.0, 3.0, 4.0):
        ...     frames.push(torch.tensor([[number]]))
        >>> frames.read(torch.tensor([0, 2])).tolist()  # the oldest and the newest
        [[[2.0], [4.0]]]
    """

    def __init__(self, num_robots: int, span: int, size: int, device: torch.device | str) -> None:
        self._ring = torch.zeros(num_robots, span, size, device=device)
        self._oldest = 0

    def push(self, frame: Tensor) -> None:
        """Take ``[N, F]`` as the newest frame and forget the oldest."""
        self._ring[:, self._oldest] = frame
        self._oldest = (self._oldest + 1) % self._ring.shape[1]

    def fill(self, mask: Tensor, rows: Tensor, frames: Tensor) -> None:
        """Replace those of the rows of a bool mask ``[N]``, all of them among rows ``[K]``, by ``[K, S, F]``, oldest
        first."""
        frames = torch.where(mask[rows, None, None], frames.roll(self._oldest, 1), self._ring[rows])
        self._ring.index_copy_(0, rows, frames)

    def read(self, offsets: Tensor) -> Tensor:
        """A copy ``[N, O, F]`` of the frames so many steps after the oldest, int64 ``[O]``."""
        return self._ring.index_select(1, (offsets + self._oldest) % self._ring.shape[1])

    def all(self) -> Tensor:
        """A copy ``[N, S, F]``, oldest first."""
        return self._ring.roll(-self._oldest, 1)

    def restore(self, frames: Tensor) -> None:
        """Take back what :meth:`all` returned."""
        self._ring, self._oldest = frames.clone(), 0


class ObservationGroups:
    """Builds the named observations of ``N`` robots from their state.

    The history holds what the robot measured, noise included; its newest frame is the present proprioception.

    Source: method notes, section 3.2.

    Args:
        num_robots: N.
        generator: source of the noise.
        noise: factor on the half-widths of :data:`agility_rl.go2.features.PROPRIOCEPTION_LAYOUT`.
        motion_offsets: which frames ``motion`` holds, in control steps from the oldest.
    """

    def __init__(
        self,
        num_robots: int,
        generator: torch.Generator,
        noise: float = 0.0,
        motion_offsets: Sequence[int] = features.MOTION_OFFSETS,
    ) -> None:
        self.generator, device = generator, generator.device
        self.noise = noise * features.noise_scale(features.PROPRIOCEPTION_LAYOUT, device) if noise else None
        self.history = torch.zeros(num_robots, features.HISTORY, features.NUM_PROPRIOCEPTION, device=device)
        features.check_motion_offsets(motion_offsets)
        self.motion_offsets = torch.tensor(motion_offsets, device=device)
        self._span = motion_offsets[-1]
        self._motion = RecentFrames(num_robots, motion_offsets[-1] + 1, features.NUM_MOTION, device)
        self.touched = torch.zeros(num_robots, 4, dtype=torch.bool, device=device)

    def reset(self, mask: Tensor, state: LocomotionState, past: Tensor | None = None) -> None:
        """Fill the memories of the rows of a bool mask ``[N]`` with copies of the present.

        Args:
            mask: the rows.
            state: the present.
            past: ``[K, span, 49]`` of :func:`~agility_rl.tensors.rows_of` the mask, frames of the recorded motion that
                led here, for discriminators that look back.
        """
        touched = state.foot_contact > features.FOOT_CONTACT_FORCE
        row = mask[:, None]
        self.touched = torch.where(row, touched, self.touched)
        self.history = torch.where(row[..., None], self._measure(state, touched)[:, None], self.history)
        rows = rows_of(mask)
        present = _motion_frame(state)[rows, None]
        past = present.expand(-1, self._span, -1) if past is None else past
        self._motion.fill(mask, rows, torch.cat((past, present), 1))

    def update(self, state: LocomotionState) -> None:
        """Append the present to the memories of every robot."""
        touched = state.foot_contact > features.FOOT_CONTACT_FORCE
        measured = self._measure(state, touched | self.touched)
        self.touched = touched
        self.history = torch.cat((self.history[:, 1:], measured[:, None]), 1)
        self._motion.push(_motion_frame(state))

    def motion(self) -> Tensor:
        """A copy of the discriminator frames ``[N, H, 49]``, oldest first."""
        return self._motion.read(self.motion_offsets)

    def build(self, state: LocomotionState, commands: CommandSampler, privileged: Tensor) -> TensorDict:
        """All observation groups, ``[N]``."""
        return TensorDict(
            {
                # Not a view: a matrix product rounds otherwise where rows lie apart, and a resumed run has none.
                keys.PROPRIOCEPTION: self.history[:, -1].clone(),
                keys.EXPLICIT: features.explicit(state.root_height, state.linear_velocity),
                keys.PRIVILEGED: privileged,
                keys.HISTORY: self.history,
                keys.COMMAND: commands.vector(),
                keys.PEAK: (state.peak_height * commands.jumping)[:, None],
                keys.MOTION: self.motion(),
                keys.SKILL: commands.skill,
                keys.SHIFT: commands.shift,
            },
            [len(self.history)],
        )

    def _measure(self, state: LocomotionState, touched: Tensor) -> Tensor:
        measured = features.proprioception(
            torch.stack((state.roll, state.pitch), -1),
            state.angular_velocity,
            state.joint_position,
            state.joint_velocity,
            state.action,
            touched,
        )
        if self.noise is not None:
            measured = measured + self.noise * uniform(measured.shape, (-1.0, 1.0), self.generator)
        return measured.clamp(-features.OBSERVATION_LIMIT, features.OBSERVATION_LIMIT)

    def state_dict(self) -> dict[str, Any]:
        """The memories."""
        return {"history": self.history.clone(), "motion": self._motion.all(), "touched": self.touched.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.history, self.touched = state["history"].clone(), state["touched"].clone()
        self._motion.restore(state["motion"])


def _motion_frame(state: LocomotionState) -> Tensor:
    return features.motion_frame(
        state.root_height,
        state.roll,
        state.pitch,
        state.linear_velocity,
        state.angular_velocity,
        state.joint_position,
        state.joint_velocity,
        state.feet,
    )
