"""Drives a behaviour controller from measurements alone, as on the robot."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.go2 import features


class BehaviourPolicy:
    """A TensorDict policy over proprioception, history and command as a policy over measurements.

    Keeps the history of every robot, and forgets it where ``is_init`` says that the robot was reset.

    Source: method notes, section 3.2 (layouts). Differs from training: the jump's peak height is not measured and
    counts as 0, so that gaits serve identification better than jumps.

    Args:
        policy: TensorDict module that reads ``proprioception`` [N, 45], ``history`` [N, 10, 45], ``command`` [N, 11]
            and ``peak`` [N, 1], and writes ``action`` [N, 12]: ``BasicBehaviourController.deployable_policy()``.
        command: ``[11]`` or ``[N, 11]`` (:data:`agility_rl.keys.COMMAND`), or a function from the number of steps since
            each robot's reset, int64 ``[N]``, to ``[N, 11]``: a schedule.
        deterministic: take the most probable action; otherwise draw from the global generator.

    Example:
        >>> from agility_rl.modules import BasicBehaviourController
        >>> bbc = BasicBehaviourController(hidden=(8,))
        >>> policy = BehaviourPolicy(bbc.deployable_policy(), torch.zeros(11))
        >>> measured = TensorDict({
        ...     "roll_pitch": torch.zeros(2, 2), "angular_velocity": torch.zeros(2, 3),
        ...     "joint_position": torch.zeros(2, 12), "joint_velocity": torch.zeros(2, 12),
        ...     "action": torch.zeros(2, 12), "foot_contact": torch.ones(2, 4, dtype=torch.bool),
        ...     "is_init": torch.ones(2, 1, dtype=torch.bool),
        ... }, [2])
        >>> policy(measured).shape
        torch.Size([2, 12])
    """

    def __init__(
        self,
        policy: Callable[[TensorDictBase], TensorDictBase],
        command: Tensor | Callable[[Tensor], Tensor],
        *,
        deterministic: bool = True,
    ) -> None:
        self.policy, self.command = policy, command
        self.exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        self._history: Tensor | None = None
        self._steps: Tensor | None = None

    @torch.no_grad()
    def __call__(self, measured: TensorDictBase) -> Tensor:
        """Action ``[N, 12]`` for the measurements of :data:`agility_rl.collectors.rollout.MeasuredPolicy`."""
        entries = ("roll_pitch", "angular_velocity", "joint_position", "joint_velocity", keys.ACTION, "foot_contact")
        present = features.proprioception(*(measured[name] for name in entries))
        is_init = measured["is_init"]
        if self._history is None or len(self._history) != len(present):
            self._history = torch.zeros(len(present), features.HISTORY, present.shape[-1])
            self._steps = torch.zeros(len(present), dtype=torch.int64)
        assert self._steps is not None
        shifted = torch.cat((self._history[:, 1:], present[:, None]), 1)
        self._history = torch.where(is_init[..., None], present[:, None], shifted)
        self._steps = torch.where(is_init[:, 0], 0, self._steps + 1)
        command = self.command(self._steps) if callable(self.command) else self.command
        observation = TensorDict(
            {
                keys.PROPRIOCEPTION: present,
                keys.HISTORY: self._history,
                keys.COMMAND: command.expand(len(present), -1),
                keys.PEAK: torch.zeros(len(present), 1),
            },
            [len(present)],
        )
        with set_exploration_type(self.exploration):
            return self.policy(observation)[keys.ACTION]
