"""Reduction of losses over groups of samples whose batch sizes differ."""

from __future__ import annotations

from typing import Literal

Reduction = Literal["mean", "sum"]


def check_reduction(reduction: str | None) -> str:
    """Return the reduction, ``"mean"`` if none is given.

    Raises:
        ValueError: if it is neither ``"mean"`` nor ``"sum"``.

    Example:
        >>> check_reduction(None)
        'mean'
    """
    reduction = "mean" if reduction is None else reduction
    if reduction not in ("mean", "sum"):
        raise ValueError(
            f"reduction must be 'mean' or 'sum', got {reduction!r}; the groups may have different batch sizes, so "
            "unreduced losses have no common shape: use agility_rl.losses.functional for those"
        )
    return reduction
