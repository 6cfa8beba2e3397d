"""The reward of looking like a dog, as a TorchRL transform of an environment or of what was collected in it."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from agility_rl.keys import DISCRIMINATOR_LOGIT, MOTION, SKILL
from agility_rl.losses.functional import imitation_reward


class ImitationReward(Transform):
    r"""Add to a reward what a discriminator makes of the motion that it was given for.

    .. math:: r \leftarrow r + w \max\left(0, 1 - \tfrac14 (D(o) - 1)^2\right)

    Appended to an environment it acts in every step; called on the next states of a batch, on all of them at once,
    which takes a fraction of the time. The discriminator learns nothing from it.

    Source: Eq. (11), Eq. (2); the Task-Specific Controller's reward: Table S4 (w = 0.2 times the time step).

    Keys read:
        motion  float32 ``[*B, H, F]``  consecutive frames, oldest first
        skill   int64 ``[*B]``
        reward  float32 ``[*B, 1]``
    Keys written:
        reward  float32 ``[*B, 1]``

    Args:
        discriminator: reads motion and skill, writes ``discriminator_logit``.
        weight: w.
        reward_key: key of the reward.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> sure = TensorDictModule(lambda motion: motion[:, 0, :1], in_keys=[MOTION], out_keys=[DISCRIMINATOR_LOGIT])
        >>> after = TensorDict({MOTION: torch.ones(3, 2, 49), SKILL: torch.zeros(3), "reward": torch.ones(3, 1)}, [3])
        >>> ImitationReward(sure, weight=0.5)(after)["reward"][:, 0]
        tensor([1.5000, 1.5000, 1.5000])
    """

    def __init__(self, discriminator: TensorDictModuleBase, weight: float, *, reward_key: NestedKey = "reward") -> None:
        super().__init__(in_keys=[MOTION, SKILL, reward_key], out_keys=[reward_key])
        self.discriminator, self.weight, self.reward_key = discriminator, weight, reward_key

    @torch.no_grad()
    def reward(self, after: TensorDictBase) -> Tensor:
        """What it adds, ``[*B, 1]``."""
        seen = TensorDict({key: after[key] for key in (MOTION, SKILL)}, after.batch_size).flatten()
        style = imitation_reward(self.discriminator(seen)[DISCRIMINATOR_LOGIT])
        return self.weight * style.reshape(*after.batch_size, 1)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        added = self.reward(next_tensordict)
        return next_tensordict.set(self.reward_key, next_tensordict[self.reward_key] + added)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add to the rewards of next states ``[*B]``."""
        return self._call(tensordict)
