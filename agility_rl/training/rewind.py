"""Practice of what fails: robots begin where others were shortly before they failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from agility_rl.training.exploration import Policy
from agility_rl.training.rollout import Rollout

BACK = (0.8, 2.8)
"""So long before a failure robots begin [s]: late enough that it comes again, early enough to be averted (ours)."""
APART = 0.4
"""Time between two snapshots of a roll-out [s]."""
LEAST = 40
"""With fewer snapshots nobody begins there: they would be practised too often."""
CAPACITY = 1500
"""Snapshots that are kept, the newest ones."""


class Snapshots(Protocol):
    """An environment whose robots can go on from where others were."""

    @property
    def num_robots(self) -> int:
        """N."""

    def snapshot(self) -> TensorDict:
        """All that belongs to each robot, ``[N]``."""

    def restore(self, rows: Tensor, snapshot: TensorDictBase) -> TensorDict:
        """Let robots ``rows`` go on from snapshots; what all observe then."""


class Rewind:
    """Let some robots begin each roll-out where others were shortly before they failed.

    A policy that rarely fails learns little from its failures: few of the steps of a roll-out lead to one. Snapshots
    are taken in every roll-out; of each robot that fails in it, the one is kept that is nearest to a moment drawn from
    :data:`BACK` before, of the same episode and roll-out. The first ``num_rewound`` robots begin the next roll-out from
    kept snapshots, and the others go on; only their failures are kept, so that what cannot be averted does not pile up.

    Source: ours; to begin from states that matter: Salimans and Chen 2018 (arXiv:1812.03381), Ecoffet et al. 2021
    (doi:10.1038/s41586-020-03157-9).

    Args:
        env: where the robots live.
        num_rewound: how many begin so.
        dt: time between two decisions [s].
        generator: source of randomness; where it is, the snapshots are.
        carried: entries in which the policy carries what it remembers from step to step; snapshots hold them too.

    Raises:
        ValueError: if all robots would begin so, or none.

    Attributes:
        kept: snapshots ``[K]``; ``None`` before the first failure.
        rows: the robots that begin so, int64 ``[R]``.
        apart: steps between two snapshots of a roll-out.

    Example:
        >>> from agility_rl.envs import AgilityEnv
        >>> env = AgilityEnv(4, lambda td: td.set("action", torch.zeros(4, 12)), simulator_options={"num_threads": 1})
        >>> rollout = Rollout(env, 3, keep=["place"], keep_next=["reward"], value=lambda td: torch.zeros(*td.shape, 1))
        >>> rewind = Rewind(env, 2, env.dt, torch.Generator())
        >>> rewind.begin(rollout)
        >>> batch = rollout.collect(rewind.watching(env.rand_action))
        >>> rewind.remember(batch["next", "terminated"], batch["next", "done"])
        >>> rewind.kept is None  # nobody has fallen
        True
        >>> env.close()
    """

    def __init__(
        self,
        env: Snapshots,
        num_rewound: int,
        dt: float,
        generator: torch.Generator,
        carried: Sequence[NestedKey] = (),
    ) -> None:
        if not 0 < num_rewound < env.num_robots:
            raise ValueError(f"expected 1 to {env.num_robots - 1} of {env.num_robots} robots, got {num_rewound}")
        self.env, self.dt, self.generator, self.carried = env, dt, generator, list(carried)
        self.apart = max(1, round(APART / dt))
        self.rows = torch.arange(num_rewound, device=generator.device)
        self.kept: TensorDictBase | None = None
        self._taken: list[TensorDict] = []

    def begin(self, rollout: Rollout) -> None:
        """Put the robots that are rewound where others were, before the next roll-out."""
        if self.kept is None or len(self.kept) < LEAST:
            return
        shape, device = self.rows.shape, self.rows.device
        chosen = torch.randint(len(self.kept), shape, generator=self.generator, device=device)
        begun = self.kept[chosen]
        rollout.go_on_from(self.rows, self.env.restore(self.rows, begun)[self.rows].update(begun["carried"]))

    def watching(self, policy: Policy) -> Policy:
        """The same policy; snapshots are taken while it acts in one roll-out."""
        self._taken, step = [], 0

        def act(td: TensorDictBase) -> TensorDictBase:
            nonlocal step
            if step % self.apart == 0:
                self._taken.append(self.env.snapshot().set("carried", td.select(*self.carried).clone()))
            step += 1
            return policy(td)

        return act

    def remember(self, failed: Tensor, done: Tensor) -> None:
        """Keep where robots were before they failed.

        Args:
            failed: bool ``[T, N, 1]``, of each step of the roll-out whether the episode ended so.
            done: bool ``[T, N, 1]``, whether it ended.
        """
        taken, self._taken = self._taken, []
        count, steps = len(self.rows), torch.arange(len(done), device=done.device)[:, None]
        began = torch.where(done[..., 0], steps + 1, 0).cummax(0).values.roll(1, 0)
        began[0] = 0  # step in which the episode of each step began, as far as this roll-out knows
        end, robot = failed[:, count:, 0].nonzero().unbind(-1)
        robot = robot + count
        least, most = (seconds / self.dt for seconds in BACK)
        back = least + (most - least) * torch.rand(len(end), generator=self.generator, device=end.device)
        moments = self.apart * torch.arange(len(taken), device=end.device)
        far = (moments - (end - back)[:, None]).abs()
        usable = (moments >= began[end, robot][:, None]) & (moments <= end[:, None] - least)
        far, nearest = far.masked_fill(~usable, torch.inf).min(-1)
        found = far.isfinite()
        if not bool(found.any()):
            return
        fresh = torch.stack(taken)[nearest[found], robot[found]]
        self.kept = fresh if self.kept is None else torch.cat((self.kept, fresh))[-CAPACITY:]

    def state_dict(self) -> dict[str, Any]:
        """The snapshots; the generator belongs to whoever gave it."""
        return {} if self.kept is None else {"kept": self.kept.to_dict(), "count": len(self.kept)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.kept = TensorDict(state["kept"], [state["count"]]) if "kept" in state else None
