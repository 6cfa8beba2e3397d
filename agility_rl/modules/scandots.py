"""The encoder of the terrain around the robot, as the teacher sees it."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import nn

from agility_rl.keys import SCANDOTS, TERRAIN_LATENT
from agility_rl.modules.mlp import ConcatenatedMLP

NUM_TERRAIN_LATENT = 32
"""Size of the encoding, which the student imitates (supplement, section S6)."""


class ScandotsEncoder(TensorDictModule):
    r"""Encode the terrain heights around and ahead of the robot into a bounded latent.

    .. math:: z = \tanh\left(W_3\, \mathrm{ELU}(W_2\, \mathrm{ELU}(W_1 s + b_1) + b_2) + b_3\right)

    Source: 11 x 12 scandots, sizes {128, 64, 32}: section S6; ELU, ELU, tanh: released code (method notes, section
    5.3).

    Keys read:
        scandots        float32 ``[*B, 132]``  heights [m]
    Keys written:
        terrain_latent  float32 ``[*B, L]``, L = ``out_features``, in (-1, 1)

    Args:
        in_features: number of scandots.
        out_features: L, size of the latent.
        hidden: size of the hidden layers (ELU).
        in_key: key of the scandots.
        out_key: key of the latent.
        grid: whether the scandots end in two dimensions, such as ``[11, 12]``; they are flattened.

    Raises:
        ValueError: if there are not ``in_features`` scandots (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"scandots": torch.zeros(8, 132)}, batch_size=[8])
        >>> ScandotsEncoder()(td)["terrain_latent"].shape
        torch.Size([8, 32])
    """

    def __init__(
        self,
        in_features: int = 132,
        out_features: int = NUM_TERRAIN_LATENT,
        *,
        hidden: Sequence[int] = (128, 64),
        in_key: NestedKey = SCANDOTS,
        out_key: NestedKey = TERRAIN_LATENT,
        grid: bool = False,
    ) -> None:
        layers = ConcatenatedMLP([in_key], in_features, hidden, out_features, sequence_keys=[in_key] if grid else [])
        super().__init__(nn.Sequential(layers, nn.Tanh()), in_keys=[in_key], out_keys=[out_key])
