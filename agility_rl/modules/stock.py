"""Of which types obstacles may be, on a course on which a known number of each type stands."""

from __future__ import annotations

import torch
from torch import Tensor

ANY = 1e6
"""So many of a type that it makes no difference how many were met."""
LEAST = 0.02
"""A type of which none is left is still held for possible by so much of one obstacle: it may have been misjudged."""
NOTED = 0.05
"""Share by which the type of a slot's obstacle is what it seems now, after each decision at it: for a few decisions
before it is left, images speak of the next one."""


def remaining(met: Tensor, leg: Tensor, stock: Tensor) -> Tensor:
    r"""How likely types are beforehand: by how many of each are left for one slot, without those met in others.

    .. math:: \log \max\Bigl(n_k - \sum_{l' \neq l} m_{l' k},\ 0.02\Bigr)

    Source: ours; drawing without replacement, as obstacles are dealt out to the slots (method notes, section 5.7).

    Args:
        met: ``[*B, L, K]``, how surely the obstacle of each slot is of each type; 0 where none was met.
        leg: the slot, int64 ``[*B]``.
        stock: ``[K]``, how many of each type the course has.

    Returns:
        ``[*B, K]``, logits.

    Example:
        >>> met = torch.tensor([[0.9, 0.1], [0.0, 0.0]])
        >>> remaining(met, torch.tensor(1), torch.ones(2)).exp()
        tensor([0.1000, 0.9000])
        >>> remaining(met, torch.tensor(0), torch.ones(2)).exp()
        tensor([1., 1.])
    """
    elsewhere = met.sum(-2) - met.take_along_dim(leg[..., None, None], -2)[..., 0, :]
    return (stock - elsewhere).clamp(min=LEAST).log()


def noted(met: Tensor, leg: Tensor, logits: Tensor) -> Tensor:
    """What is known of the obstacles met, ``[*B, L, K]``, after one of slot ``leg`` seemed to be of some type.

    Source: ours; a moving average.

    Args:
        met: ``[*B, L, K]``.
        leg: int64 ``[*B]``.
        logits: of its type, ``[*B, K]``; no gradient passes.

    Example:
        >>> noted(torch.zeros(2, 2), torch.tensor(1), torch.tensor([0.0, 9.0])).round(decimals=3)
        tensor([[0.0000, 0.0000],
                [0.0000, 0.0500]])
    """
    here = torch.arange(met.shape[-2], device=met.device) == leg[..., None]
    seems = logits.detach().softmax(-1)[..., None, :]
    return met + NOTED * here[..., None] * (seems - met)
