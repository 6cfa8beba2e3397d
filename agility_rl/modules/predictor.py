"""The predictor of semi-supervised InfoGAIL: which skill, and which shift, does a motion show?"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from agility_rl.behaviours import NUM_BEHAVIOURS
from agility_rl.keys import MOTION, SHIFT_ESTIMATE, SKILL_LOGITS
from agility_rl.modules.discriminator import MotionTrunk, resolve_trunk
from agility_rl.modules.normalization import FeatureNormalizer


class Predictor(TensorDictModuleBase):
    r"""Infer the latent skill c and the latent shift epsilon from consecutive frames.

    .. math:: Q^c(\cdot | o) = \mathrm{softmax}(W_c \phi(o) + b_c), \qquad Q^\epsilon(o) = w_\epsilon^\top \phi(o) + b

    Source: Q of Eq. (10); sizes and shared trunk: released code (method notes, section 3.1). Differs from it: the
    skill head writes logits, not clamped probabilities, so that no loss applies softmax twice.

    Keys read:
        motion          float32 ``[*B, H, F]``  consecutive frames, oldest first
    Keys written:
        skill_logits    float32 ``[*B, K]``     unnormalised log Q^c
        shift_estimate  float32 ``[*B, S]``     Q^epsilon [1], S = ``num_shifts``

    Args:
        num_features: F, numbers of one frame; ignored with ``trunk``.
        horizon: H, frames of one observation; ignored with ``trunk``.
        num_skills: K, number of skills.
        num_shifts: S, numbers of the latent shift.
        hidden: sizes of the trunk; ignored with ``trunk``.
        trunk: a trunk to share, usually ``discriminator.trunk``.
        normalizer: scales each frame; only without ``trunk``.
        motion_key: key of the frames.
        skill_logits_key: key of the skill logits.
        shift_estimate_key: key of the shift estimate.

    Raises:
        ValueError: if ``trunk`` and ``normalizer`` are both given, or the motion has another shape (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from agility_rl.modules import Discriminator
        >>> discriminator = Discriminator(num_features=49, horizon=2)
        >>> predictor = Predictor(trunk=discriminator.trunk)
        >>> td = predictor(TensorDict({"motion": torch.zeros(8, 2, 49)}, batch_size=[8]))
        >>> td["skill_logits"].shape, td["shift_estimate"].shape
        (torch.Size([8, 5]), torch.Size([8, 1]))
    """

    def __init__(
        self,
        num_features: int = 49,
        horizon: int = 2,
        num_skills: int = NUM_BEHAVIOURS,
        num_shifts: int = 1,
        hidden: Sequence[int] = (512, 256),
        *,
        trunk: MotionTrunk | None = None,
        normalizer: FeatureNormalizer | None = None,
        motion_key: NestedKey = MOTION,
        skill_logits_key: NestedKey = SKILL_LOGITS,
        shift_estimate_key: NestedKey = SHIFT_ESTIMATE,
    ) -> None:
        super().__init__()
        self.trunk = resolve_trunk(trunk, num_features, horizon, hidden, normalizer)
        self.motion_key = motion_key
        self.skill_logits_key, self.shift_estimate_key = skill_logits_key, shift_estimate_key
        self.in_keys = [motion_key]
        self.out_keys = [skill_logits_key, shift_estimate_key]
        self.skill_head = nn.Linear(self.trunk.out_features, num_skills)
        self.shift_head = nn.Linear(self.trunk.out_features, num_shifts)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write skill logits and shift estimate."""
        skill_logits, shift_estimate = self.predict(self.trunk(tensordict.get(self.motion_key)))
        tensordict.set(self.skill_logits_key, skill_logits)
        tensordict.set(self.shift_estimate_key, shift_estimate)
        return tensordict

    def predict(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Skill logits ``[*B, K]`` and shift ``[*B, S]`` from what the trunk made of motion, ``[*B, hidden]``."""
        return self.skill_head(features), self.shift_head(features)
