"""What PPO leaves as it is, computed once an iteration instead of once for every minibatch of every epoch."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from agility_rl import keys
from agility_rl.losses import AdaptationLoss

INFERRED = "inferred_latent"
"""Latent that the history encoder infers, float32 ``[T, N, 29]``, in collected experience."""


@torch.no_grad()
def infer(history_encoder: TensorDictModule, batch: TensorDictBase) -> None:
    """Write :data:`INFERRED` beside the experience ``[T, N]``."""
    flat = history_encoder(batch.select(*history_encoder.in_keys).flatten())
    batch[INFERRED] = flat[keys.LATENT].unflatten(0, batch.batch_size)


def privileged_loss(privileged_encoder: TensorDictModule) -> AdaptationLoss:
    """The regularisation of the privileged encoder towards :data:`INFERRED`: its ``loss_privileged``."""
    inferred = TensorDictModule(torch.nn.Identity(), in_keys=[INFERRED], out_keys=[keys.LATENT])
    return AdaptationLoss(inferred, privileged_encoder)
