"""The update of proximal policy optimisation that recipes share: epochs of minibatches, and a learning rate that
follows the divergence of the policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import KLAdaptiveLR, LossModule

from agility_rl.training import distributed
from agility_rl.training.compilation import compiled
from agility_rl.training.seeding import permutation

Extra = Callable[[TensorDictBase], Tensor]
MEASURED = 1024
"""Samples on which a divergence is measured: a mean over so many states is sure to a few per cent, and the schedule
asks whether it is twice or half of what is wanted."""


class FirstGroup:
    """The first group of an optimiser's parameters, for a learning-rate schedule that must leave the others alone.

    Args:
        optimizer: whose group it is, also after its state was loaded.

    Example:
        >>> weights = [torch.nn.Parameter(torch.zeros(1)) for _ in range(2)]
        >>> optimizer = torch.optim.Adam([{"params": weights[:1]}, {"params": weights[1:], "lr": 1e-3}], lr=1e-4)
        >>> KLAdaptiveLR(FirstGroup(optimizer), 0.01, factor=2.0).step(1.0)
        >>> [group["lr"] for group in optimizer.param_groups]
        [5e-05, 0.001]
    """

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self.optimizer = optimizer

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The one group."""
        return self.optimizer.param_groups[:1]


class PPOUpdate:
    """Descends a PPO loss over a collected batch.

    Advantages are normalised over the whole batch, or within each group of it. After each epoch the divergence between
    the policy that collected and the present one, on at most 1024 samples of the last minibatch, may change the
    learning rate. Of several processes (:mod:`agility_rl.training.distributed`), each brings a batch: moments,
    gradients and divergence are those of all.

    Source: Schulman et al. 2017, arXiv:1707.06347; Table S1 (clip, learning rate); normalisation and adaptive rate:
    released code (method notes, section 3.7).

    Args:
        loss: a loss whose entries ``loss_...`` add up to what is descended, as TorchRL's do.
        optimizer: optimiser of policy and critic.
        epochs: passes over the batch.
        minibatches: minibatches of a pass.
        max_grad_norm: bound of the gradient's norm.
        keep: entries of the batch beside the loss's own that ``extra`` or ``divergence`` read.
        groups: an int64 entry ``[T, N]`` and the number of its values: advantages are normalised within each of them.
            Of tasks that earn differently, the ones that earn more would else be learned at the others' expense.
        divergence: mean KL divergence [nat] of samples, ``()``; ``None`` with a fixed learning rate.
        schedule: adapts the learning rate to that divergence.
        precision: ``torch.bfloat16`` runs the hidden layers of policy and critic in it, about twice as fast where the
            processor multiplies in it; weights, the outputs and all that follows stay float32.
        compile: fuse the loss by ``torch.compile``, which takes half a minute at the first minibatch and needs a C++
            compiler on a CPU; numbers differ by rounding.

    Raises:
        ValueError: if there is no pass or no minibatch, or (at the call) the batch has no sample for each minibatch.

    Example:
        See ``recipes/bbc_pretrain.py``; ``PPOUpdate(loss, optimizer, epochs=5, minibatches=4)`` is the least.

        >>> PPOUpdate(torch.nn.Identity(), torch.optim.SGD([torch.zeros(1)]), epochs=5, minibatches=4).epochs
        5
    """

    def __init__(
        self,
        loss: LossModule,
        optimizer: torch.optim.Optimizer,
        *,
        epochs: int,
        minibatches: int,
        max_grad_norm: float = 1.0,
        keep: Sequence[NestedKey] = (),
        groups: tuple[NestedKey, int] | None = None,
        divergence: Extra | None = None,
        schedule: KLAdaptiveLR | None = None,
        precision: torch.dtype = torch.float32,
        compile: bool = False,
    ) -> None:
        if epochs < 1 or minibatches < 1:
            raise ValueError(f"expected epochs and minibatches of at least 1, got {epochs} and {minibatches}")
        self.loss = loss
        self._losses: Callable[[TensorDictBase], TensorDictBase] = compiled(loss, compile)
        self.optimizer = optimizer
        self.epochs = epochs
        self.minibatches = minibatches
        self.max_grad_norm = max_grad_norm
        self.keep = tuple(keep)
        self.groups = groups
        self.divergence = divergence
        self.schedule = schedule
        self.precision = precision

    def __call__(
        self,
        batch: TensorDictBase,
        generator: torch.Generator,
        extra: Extra | None = None,
        *,
        critic_only: bool = False,
    ) -> dict[str, Tensor]:
        """Update on a batch ``[T, N]`` that holds ``advantage`` and ``value_target``.

        Args:
            batch: collected experience with advantages, which are normalised in it.
            generator: source of the minibatch order.
            extra: another loss of a minibatch, added to PPO's.
            critic_only: leave the policy and the learning rate as they are: a fresh critic would mislead a good policy.

        Returns:
            Metrics of the last minibatch, ``kl`` and ``learning_rate``.
        """
        batch["advantage"] = self._normalized(batch)
        names = dict.fromkeys((*self.loss.in_keys, "advantage", "value_target", *self.keep))
        present = (name for name in names if (name if isinstance(name, str) else name[0]) != "next")
        flat = batch.select(*present, strict=False).flatten()
        size = flat.numel() // self.minibatches
        if size < 1:
            raise ValueError(f"expected at least {self.minibatches} samples, one a minibatch, got {flat.numel()}")
        parameters = distributed.optimized(self.optimizer)
        device = batch["advantage"].device.type
        metrics: dict[str, Tensor] = {}
        for _ in range(self.epochs):
            order = permutation(flat.numel(), generator)
            for rows in order.split(size)[: self.minibatches]:
                sample = flat[rows]
                with torch.autocast(device, self.precision, enabled=self.precision is not torch.float32):
                    result = self._losses(sample)
                    loss = result["loss_critic"]
                    if not critic_only:
                        loss = sum(value for name, value in result.items() if name.startswith("loss_"))
                        if extra is not None:
                            loss = loss + extra(sample)
                self.optimizer.zero_grad(set_to_none=True)
                loss.backward()
                distributed.average_gradients(parameters)
                torch.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
                self.optimizer.step()
            metrics = {name: value.detach() for name, value in result.items() if value.numel() == 1}
            if self.divergence is not None and not critic_only:
                with torch.no_grad():
                    metrics["kl"] = distributed.average(self.divergence(sample[:MEASURED]))
                if self.schedule is not None:
                    self.schedule.step(metrics["kl"])
        metrics["learning_rate"] = torch.tensor(self.optimizer.param_groups[0]["lr"])
        return metrics

    def _normalized(self, batch: TensorDictBase) -> Tensor:
        """Advantages ``[T, N, 1]`` of mean 0 and deviation 1 in each group."""
        advantage = batch["advantage"]
        name, number = self.groups or (None, 1)
        flat = advantage.flatten()
        group = torch.zeros_like(flat, dtype=torch.int64) if name is None else batch[name].flatten()
        mean, deviation = (moment[group].view_as(advantage) for moment in distributed.moments(flat, group, number))
        return (advantage - mean) / (deviation + 1e-8)
