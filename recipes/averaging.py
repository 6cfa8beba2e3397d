"""A moving average of a network's weights, which a training saves in place of the last ones (ours)."""

from __future__ import annotations

from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn


def moving_average(network: nn.Module, decay: float) -> AveragedModel | None:
    """The average, to be updated once an iteration: ``theta' <- decay theta' + (1 - decay) theta``; none for 0."""
    return AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(decay)) if decay else None


def saved(network: nn.Module, averaged: AveragedModel | None) -> nn.Module:
    """What is written into a run: the average if there is one that has begun, otherwise the network itself."""
    if averaged is None or averaged.n_averaged == 0:
        return network
    module: nn.Module = averaged.module
    return module
