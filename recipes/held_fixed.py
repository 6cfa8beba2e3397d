"""What PPO leaves as it is: computed once an iteration instead of once for every minibatch of every epoch, and fitted
afterwards."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import LossModule

from agility_rl import keys
from agility_rl.losses import AdaptationLoss
from agility_rl.training import distributed
from agility_rl.training.seeding import permutation

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


def fit(
    losses: Sequence[LossModule],
    optimizer: torch.optim.Optimizer,
    batch: TensorDictBase,
    minibatches: int,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """Fit what stands in for what the robot cannot measure (S6): history encoder, state estimator.

    Of every loss module the first loss counts; the privileged encoder's regularisation, a second one, is PPO's.
    Returns the metrics of the last minibatch.
    """
    names = dict.fromkeys(key for loss in losses for key in loss.in_keys)
    flat = batch.select(*names).flatten()
    metrics: dict[str, Tensor] = {}
    for rows in permutation(flat.numel(), generator).chunk(minibatches):
        found = [dict(loss(flat[rows]).items()) for loss in losses]
        optimizer.zero_grad(set_to_none=True)
        torch.stack([result[loss.out_keys[0]] for loss, result in zip(losses, found, strict=True)]).sum().backward()
        distributed.average_gradients(distributed.optimized(optimizer))
        optimizer.step()
        metrics = {name: value for result in found for name, value in result.items()}
    return {name: value.detach() for name, value in metrics.items() if value.numel() == 1}
