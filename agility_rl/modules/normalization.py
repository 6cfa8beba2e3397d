"""Fixed normalisation of motion features, with a weight per feature that a curriculum may fade."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class FeatureNormalizer(nn.Module):
    r"""Normalise features by fixed statistics, clip them, and weight them.

    Statistics come once from the motion data, so that expert and policy are scaled identically and a reward does not
    drift with running averages. The weights serve the released code's curriculum that fades velocities, feet and
    contacts out of the discriminator's sight.

    .. math:: y = w \cdot \mathrm{clip}\left(\frac{x - \mu}{\max(\sigma, \varepsilon)}, -c, c\right)

    Source: clip at 10 and epsilon 1e-4: released code (method notes, sections 3.2 and 3.4). Differs from it: the
    statistics are fixed instead of running, because the released normaliser is updated with already normalised data
    and stays near the identity.

    Args:
        mean: ``[F]``, mean of every feature, in the feature's unit.
        std: ``[F]``, standard deviation of every feature, in the feature's unit.
        clip: bound of the normalised features [1].
        epsilon: smallest standard deviation used; constant features become 0.

    Raises:
        ValueError: if ``mean`` and ``std`` are not vectors of one length, or not finite.

    Example:
        >>> normalizer = FeatureNormalizer(torch.tensor([1.0, 0.0]), torch.tensor([2.0, 1.0]))
        >>> normalizer(torch.tensor([[3.0, 50.0]]))
        tensor([[ 1., 10.]])
        >>> normalizer.set_weight([1.0, 0.0])
        >>> normalizer(torch.tensor([[3.0, 50.0]]))
        tensor([[1., 0.]])
    """

    mean: Tensor
    std: Tensor
    weight: Tensor

    def __init__(
        self,
        mean: Tensor | Sequence[float],
        std: Tensor | Sequence[float],
        *,
        clip: float = 10.0,
        epsilon: float = 1e-4,
    ) -> None:
        super().__init__()
        dtype = torch.get_default_dtype()
        mean, std = (torch.as_tensor(x, dtype=dtype).detach().clone() for x in (mean, std))
        if mean.ndim != 1 or mean.shape != std.shape:
            raise ValueError(
                f"mean and std must be vectors of one length, got {list(mean.shape)} and {list(std.shape)}"
            )
        if not (mean.isfinite().all() and std.isfinite().all()):
            raise ValueError("mean and std must be finite; look for NaN in the motion data")
        self.clip = clip
        self.register_buffer("mean", mean)
        self.register_buffer("std", std.clamp_min(epsilon))
        self.register_buffer("weight", torch.ones_like(mean))

    def set_weight(self, weight: Tensor | Sequence[float]) -> None:
        """Replace the weight of every feature, in place, so that losses which share this module follow.

        Args:
            weight: ``[F]``, factor of every normalised feature [1].

        Raises:
            ValueError: if the length differs from the number of features.
        """
        weight = torch.as_tensor(weight)
        if weight.shape != self.weight.shape:
            raise ValueError(f"weight must have shape {list(self.weight.shape)}, got {list(weight.shape)}")
        with torch.no_grad():
            self.weight.copy_(weight)

    def forward(self, features: Tensor) -> Tensor:
        """Normalise ``[*B, F]`` features."""
        return ((features - self.mean) / self.std).clamp(-self.clip, self.clip) * self.weight
