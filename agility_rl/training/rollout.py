"""Collect experience from one batched environment, keeping only what the losses read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from agility_rl.tensors import rows_of
from agility_rl.training.compilation import compiled


class Rollout:
    """Steps a batched environment with a policy and stores ``[T, N]`` experience in preallocated memory.

    TorchRL's collectors keep every observation twice, once as present and once as next. Here each observation is kept
    once, and the value of the true last observation is computed where an episode ends, before the environment is
    reset, so that truncations are bootstrapped rightly.

    Args:
        env: batched environment, ``batch_size == [N]``.
        num_steps: T.
        keep: root entries to store (observations, actions, log-probabilities).
        keep_next: entries of the next state to store, e.g. reward and discriminator frames.
        value: callable that maps a TensorDict of observations to values ``[*B, 1]``.
        compile: compile ``value`` for all robots at once (:func:`~agility_rl.training.compilation.compiled`), not for
            those alone whose episode ends, whose number differs; a policy may be given compiled.

    Raises:
        ValueError: if the environment has no batch dimension, or there is no step.
    """

    def __init__(
        self,
        env: EnvBase,
        num_steps: int,
        *,
        keep: Sequence[NestedKey],
        keep_next: Sequence[NestedKey],
        value: Callable[[TensorDictBase], Tensor],
        compile: bool = False,
    ) -> None:
        if len(env.batch_size) != 1:
            raise ValueError(f"expected an environment with batch_size [N], got {list(env.batch_size)}")
        if num_steps < 1:
            raise ValueError(f"num_steps must be at least 1, got {num_steps}")
        self.env = env
        self.num_steps = num_steps
        self.keep = list(keep)
        self.keep_next = [*keep_next, "done", "terminated", "truncated"]
        self.value = value
        self._value_of_all = compiled(value, compile)
        self.carrier: TensorDictBase | None = None
        self._storage: TensorDictBase | None = None
        self._last_done: Tensor

    @torch.no_grad()
    def collect(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> TensorDictBase:
        """Run ``num_steps`` steps from where the last call ended.

        Returns:
            TensorDict ``[T, N]``: the kept entries, ``state_value`` and ``("next", "state_value")`` [T, N, 1]. The
            memory is reused by the next call.
        """
        carrier = self.env.reset() if self.carrier is None else self.carrier
        for step in range(self.num_steps):
            carrier = policy(carrier)
            value = self._value_of_all(carrier)
            full, upcoming = self.env.step_and_maybe_reset(carrier)
            row = full.select(*self.keep)
            row["state_value"] = value
            after = full["next"]
            row["next"] = after.select(*self.keep_next)
            row["next", "state_value"] = torch.zeros_like(value)
            if self._storage is None:
                self._storage = _allocate(row, self.num_steps)
            self._storage[step] = row
            if step:
                self._storage["next", "state_value"][step - 1] += value.masked_fill(self._last_done, 0.0)
            self._last_done = after["done"]
            if len(ended := rows_of(self._last_done[:, 0])):
                last = self.value(after[ended]).masked_fill(~self._last_done[ended], 0.0)
                self._storage["next", "state_value"][step].index_copy_(0, ended, last)
            carrier = upcoming
        assert self._storage is not None
        self.carrier = carrier
        final = self._value_of_all(carrier)
        self._storage["next", "state_value"][-1] += final.masked_fill(self._last_done, 0.0)
        return self._storage

    def go_on_from(self, rows: Tensor, observed: TensorDictBase) -> None:
        """Let the next call begin, for the robots ``rows`` (int64 ``[M]``), with what they observe, ``[M]``.

        Raises:
            ValueError: if nothing was collected yet: then the next call begins with a reset.
        """
        if self.carrier is None:
            raise ValueError("robots cannot go on before the first roll-out; collect one")
        known = self.carrier.keys(True, True)
        for key in observed.keys(True, True):
            if key in known:
                self.carrier[key] = self.carrier[key].index_copy(0, rows, observed[key])

    def state_dict(self) -> dict[str, Any]:
        """The observations from which the next call goes on, as nested dicts of tensors."""
        return {} if self.carrier is None else {"carrier": self.carrier.clone().to_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        carrier = state.get("carrier")
        self.carrier = None if carrier is None else TensorDict(carrier, self.env.batch_size)


def _allocate(row: TensorDictBase, num_steps: int) -> TensorDictBase:
    return TensorDict(
        {
            key: torch.empty((num_steps, *entry.shape), dtype=entry.dtype, device=entry.device)
            for key, entry in row.items(include_nested=True, leaves_only=True)
        },
        [num_steps, *row.batch_size],
    )
