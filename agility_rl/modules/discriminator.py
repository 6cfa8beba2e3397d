"""The discriminator of semi-supervised InfoGAIL and the trunk it shares with the predictor."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from agility_rl.keys import DISCRIMINATOR_LOGIT, MOTION, SKILL
from agility_rl.modules.mlp import mlp
from agility_rl.modules.normalization import FeatureNormalizer

NORMALIZED_MOTION = "normalized_motion"
"""float32 ``[*B, H, F]``, motion as the trunk sees it: the gradient penalty differentiates with respect to this."""


class MotionTrunk(nn.Module):
    """Normalise consecutive motion frames, flatten them, and apply ReLU layers.

    One instance serves discriminator and predictor, which then share its parameters.

    Source: Table S1 (two frames); layer sizes, ReLU and zero biases: released code (method notes,
    section 3.1).

    Args:
        num_features: F, numbers of one frame.
        horizon: H, consecutive frames of one observation.
        hidden: size of every layer.
        normalizer: scales each frame; ``None`` takes frames as they are.

    Example:
        >>> import torch
        >>> trunk = MotionTrunk(num_features=49, horizon=2)
        >>> trunk(torch.zeros(8, 2, 49)).shape
        torch.Size([8, 256])
    """

    def __init__(
        self,
        num_features: int = 49,
        horizon: int = 2,
        hidden: Sequence[int] = (512, 256),
        *,
        normalizer: FeatureNormalizer | None = None,
    ) -> None:
        super().__init__()
        if normalizer is not None and normalizer.mean.shape[0] != num_features:
            raise ValueError(
                f"the normaliser has statistics of {normalizer.mean.shape[0]} features, "
                f"but the trunk takes num_features={num_features}"
            )
        self.num_features = num_features
        self.horizon = horizon
        self.out_features = hidden[-1]
        self.normalizer = normalizer
        self.layers = mlp(horizon * num_features, hidden, activation=nn.ReLU)

    def normalize(self, motion: Tensor) -> Tensor:
        """Check and scale ``[*B, H, F]`` motion; the identity without a normaliser.

        Raises:
            ValueError: if the trailing dimensions are not ``[H, F]``.
        """
        if motion.shape[-2:] != (self.horizon, self.num_features):
            raise ValueError(
                f"motion must be [*B, {self.horizon} frames, {self.num_features} features], got {list(motion.shape)}; "
                "build the trunk with the horizon and num_features of your data"
            )
        return motion if self.normalizer is None else self.normalizer(motion)

    def encode(self, normalized: Tensor) -> Tensor:
        """Map normalised ``[*B, H, F]`` motion to ``[*B, out_features]``."""
        return self.layers(normalized.flatten(-2))

    def forward(self, motion: Tensor) -> Tensor:
        """Map ``[*B, H, F]`` motion to ``[*B, out_features]``."""
        return self.encode(self.normalize(motion))


class Discriminator(TensorDictModuleBase):
    r"""Judge whether consecutive frames come from a dog or from the policy.

    .. math:: D(o) = w^\top \phi(o) + b \quad [\, + \; e_c^\top \phi(o) \,]

    The bracket exists only with ``num_skills``: a projection discriminator that also asks whether the motion suits
    the skill.

    Source: Eq. (10) takes D; released code for the sizes (98-512-256-1, head weights U(-1, 1), biases
    zero; method notes, section 3.1). The conditional form is our option, off in the paper (Miyato and Koyama 2018,
    arXiv:1802.05637).

    Keys read:
        motion        float32 ``[*B, H, F]``  consecutive frames, oldest first
        skill         int64 ``[*B]``          only with ``num_skills``
    Keys written:
        discriminator_logit  float32 ``[*B, 1]``     D(o), unbounded [1]
        normalized_motion    float32 ``[*B, H, F]``  what the trunk sees; a reference, no copy, without normaliser

    Args:
        num_features: F, numbers of one frame; ignored with ``trunk``.
        horizon: H, frames of one observation; ignored with ``trunk``.
        hidden: sizes of the trunk; ignored with ``trunk``.
        trunk: a trunk to share, for example ``predictor.trunk``.
        normalizer: scales each frame; only without ``trunk``.
        num_skills: K, makes the discriminator conditional on the skill.
        motion_key: key of the frames.
        skill_key: key of the skill index.
        out_key: key of the logit.
        normalized_key: key of the normalised frames.

    Raises:
        ValueError: if ``trunk`` and ``normalizer`` are both given, or the motion has another shape (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> discriminator = Discriminator(num_features=49, horizon=2)
        >>> td = discriminator(TensorDict({"motion": torch.zeros(8, 2, 49)}, batch_size=[8]))
        >>> td["discriminator_logit"].shape
        torch.Size([8, 1])
    """

    def __init__(
        self,
        num_features: int = 49,
        horizon: int = 2,
        hidden: Sequence[int] = (512, 256),
        *,
        trunk: MotionTrunk | None = None,
        normalizer: FeatureNormalizer | None = None,
        num_skills: int | None = None,
        motion_key: NestedKey = MOTION,
        skill_key: NestedKey = SKILL,
        out_key: NestedKey = DISCRIMINATOR_LOGIT,
        normalized_key: NestedKey = NORMALIZED_MOTION,
    ) -> None:
        super().__init__()
        self.trunk = resolve_trunk(trunk, num_features, horizon, hidden, normalizer)
        self.motion_key, self.skill_key = motion_key, skill_key
        self.out_key, self.normalized_key = out_key, normalized_key
        self.in_keys = [motion_key] if num_skills is None else [motion_key, skill_key]
        self.out_keys = [out_key, normalized_key]
        self.head = nn.Linear(self.trunk.out_features, 1)
        nn.init.uniform_(self.head.weight, -1.0, 1.0)
        nn.init.zeros_(self.head.bias)
        self.embedding: nn.Embedding | None = None
        if num_skills is not None:
            self.embedding = nn.Embedding(num_skills, self.trunk.out_features)
            nn.init.zeros_(self.embedding.weight)  # starts as the unconditional discriminator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the logit and the normalised motion."""
        normalized = self.trunk.normalize(tensordict.get(self.motion_key))
        skill = None if self.embedding is None else tensordict.get(self.skill_key)
        tensordict.set(self.out_key, self.judge(self.trunk.encode(normalized), skill))
        tensordict.set(self.normalized_key, normalized)
        return tensordict

    def judge(self, features: Tensor, skill: Tensor | None = None) -> Tensor:
        """Logit ``[*B, 1]`` of what the trunk made of motion, ``[*B, hidden]``; ``skill`` ``[*B]`` where it counts."""
        logit = self.head(features)
        if self.embedding is None:
            return logit
        return logit + (self.embedding(skill) * features).sum(-1, keepdim=True)


def resolve_trunk(
    trunk: MotionTrunk | None,
    num_features: int,
    horizon: int,
    hidden: Sequence[int],
    normalizer: FeatureNormalizer | None,
) -> MotionTrunk:
    """Return the trunk to share, or build one.

    Raises:
        ValueError: if both a trunk and a normaliser are given.
    """
    if trunk is None:
        return MotionTrunk(num_features, horizon, hidden, normalizer=normalizer)
    if normalizer is not None:
        raise ValueError("a shared trunk brings its own normaliser; pass normalizer where the trunk is built")
    return trunk
