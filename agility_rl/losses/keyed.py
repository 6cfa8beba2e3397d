"""What losses over TensorDicts share: the keys they read, and a logit with the penalty on its slope."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

from agility_rl.losses.functional import gradient_penalty


class KeyedLoss(LossModule):
    """A loss that lists the entries it reads; a subclass writes them in ``_set_in_keys``, also after ``set_keys``.

    Example:
        >>> from agility_rl.losses import StateEstimationLoss
        >>> issubclass(StateEstimationLoss, KeyedLoss)
        True
    """

    _in_keys: list[NestedKey]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries read."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def register_coeff_buffer(
        self,
        name: str,
        value: float | Tensor | None,
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        """As TorchRL's, beside the parameters: a number on the CPU cannot be the bound of a tensor on a GPU."""
        super().register_coeff_buffer(name, value, device=device or parameter_device(self), dtype=dtype)

    def _mean(self, values: Tensor, group: TensorDictBase) -> Tensor:
        """Mean of a metric ``[*B, ...]`` over the samples that count."""
        return self._reduce_loss(values.detach(), group, reduction="mean")

    def _counting(self, group: TensorDictBase) -> Tensor | None:
        """Which samples of a group ``[*B]`` count, bool ``[*B]``, where it has a mask; else all do."""
        masks = [mask for key in self._loss_mask_keys() if (mask := group.get(key, default=None)) is not None]
        return torch.stack([mask.reshape(group.batch_size) for mask in masks]).all(0) if masks else None


def parameter_device(module: nn.Module) -> torch.device | None:
    """Where a module's parameters are; ``None`` if it has none.

    Example:
        >>> parameter_device(nn.Linear(2, 1))
        device(type='cpu')
    """
    return next((parameter.device for parameter in module.parameters()), None)


def penalized_logit(
    network: TensorDictModule, group: TensorDictBase, logit_key: NestedKey, penalty_key: NestedKey
) -> tuple[Tensor, Tensor]:
    r"""Logit of a discriminator and its gradient penalty :math:`\\|\\nabla D\\|^2`, under ``torch.no_grad`` too.

    Args:
        network: writes a logit ``[*B, 1]``.
        group: its inputs ``[*B]``; changed in place, so pass a selection.
        logit_key: where the logit is written.
        penalty_key: entry with respect to which the penalty differentiates; where there is none after the call, all
            floating-point inputs.

    Returns:
        Logit ``[*B, 1]`` and penalty ``[*B]``, without a graph under ``torch.no_grad``.
    """
    differentiable = torch.is_grad_enabled()
    with torch.enable_grad():
        inputs = []
        for name in network.in_keys:
            value = group.get(name)
            if value.is_floating_point():
                value = value.detach().requires_grad_()
                group.set(name, value)
                inputs.append(value)
        group = network(group)
        logit, at = group.get(logit_key), group.get(penalty_key, None)
        penalty = gradient_penalty(logit, inputs if at is None else at, create_graph=differentiable)
    return (logit, penalty) if differentiable else (logit.detach(), penalty)
