"""What belongs to single robots in the state of an environment, taken out and put back row by row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

SHARED = ("generator", "max_obstacles", "start_weights", "difficulty", "probabilities")
"""Entries that belong to all robots together."""


def per_robot(state: Mapping[str, Any], num_robots: int) -> TensorDict:
    """The robots' own part of what ``state_dict`` says, ``[N]``.

    Source: ours.

    Example:
        >>> import torch
        >>> per_robot({"arena": {"leg": torch.arange(2), "start_weights": torch.ones(6)}}, 2)["arena"].keys()
        _StringKeys(dict_keys(['leg']))
    """
    own = {name: value for name, value in state.items() if name not in SHARED}
    return TensorDict(
        {name: per_robot(value, num_robots) if isinstance(value, Mapping) else value for name, value in own.items()},
        [num_robots],
    )


def with_rows(state: Mapping[str, Any], rows: Tensor, snapshot: TensorDictBase) -> dict[str, Any]:
    """The same state with the rows, int64 ``[M]``, as a snapshot ``[M]`` says.

    Source: ours.

    Raises:
        ValueError: if the snapshot is of an environment that remembers something else.

    Example:
        >>> import torch
        >>> other = TensorDict({"leg": torch.tensor([7])}, [1])
        >>> with_rows({"leg": torch.arange(3), "difficulty": 1.0}, torch.tensor([2]), other)
        {'leg': tensor([0, 1, 7]), 'difficulty': 1.0}
    """

    def changed(name: str, value: Any) -> Any:
        if name in SHARED or (isinstance(value, Mapping) and not value):
            return value
        if name not in snapshot:
            raise ValueError(f"the snapshot holds no {name!r}: it is of an environment with other options")
        if isinstance(value, Mapping):
            return with_rows(value, rows, snapshot[name])
        return value.index_copy(0, rows, snapshot[name])

    return {name: changed(name, value) for name, value in state.items()}
