"""What a decision has brought each robot while it was held: rewards, obstacles, and how an episode ended."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from agility_rl import keys
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.progress import Events

_PER_TYPE = ("passed", "bypassed", "failed")


class DecisionOutcome:
    """Sums and flags over the control steps of one decision; a robot whose episode has ended gathers nothing more.

    ``passed`` holds the types of obstacles that were passed, ``bypassed`` those that the robot walked around,
    ``failed`` the type at which an episode ended without the last way-point. An episode is a ``success`` when all
    way-points were reached and nothing was bypassed.

    Source: method notes, sections 5.6 (truncation of successes and time-outs) and 8 (success).

    Args:
        num_robots: N.
        terms: names of the reward terms.
        causes: names of the failures.
        device: of the sums.

    Attributes:
        running: bool ``[N]``, the episode goes on.

    Example:
        >>> outcome = DecisionOutcome(2, ["heading"], ["lost"])
        >>> none, late, one = torch.zeros(2, dtype=torch.bool), torch.tensor([False, True]), torch.ones(2)
        >>> bar = torch.eye(7, dtype=torch.bool)[[0, 0]]
        >>> events = Events(none, none, none)
        >>> outcome.add({"heading": one}, one, {"lost": none}, kind=bar, events=events, finished=none, late=late)
        >>> outcome.truncated.tolist(), outcome.running.tolist()
        ([False, True], [True, False])
    """

    def __init__(
        self, num_robots: int, terms: Iterable[str], causes: Iterable[str], device: torch.device | str = "cpu"
    ) -> None:
        def none(*shape: int) -> Tensor:
            return torch.zeros(num_robots, *shape, dtype=torch.bool, device=device)

        self.running = ~none()
        self.reward = torch.zeros(num_robots, device=device)
        self.terms = {name: torch.zeros(num_robots, device=device) for name in terms}
        self.causes = {name: none() for name in causes}
        self.finished, self.terminated, self.truncated = none(), none(), none()
        self.passed, self.bypassed, self.failed = (none(len(OBSTACLES)) for _ in range(3))

    def add(
        self,
        terms: Mapping[str, Tensor],
        reward: Tensor,
        causes: Mapping[str, Tensor],
        *,
        kind: Tensor,
        events: Events,
        finished: Tensor,
        late: Tensor,
    ) -> None:
        """Count one control step.

        Args:
            terms: of the reward, each ``[N]``.
            reward: ``[N]``, all of it.
            causes: failures, each bool ``[N]``.
            kind: bool ``[N, 7]``, one-hot type of the obstacle that was before the robots.
            events: what they did there; an obstacle in whose last step a robot fails counts as failed only.
            finished: bool ``[N]``, all way-points reached.
            late: bool ``[N]``, the time is over.
        """
        running = self.running
        for name, value in terms.items():
            self.terms[name] = self.terms[name] + torch.where(running, value, 0.0)
        self.reward = self.reward + torch.where(running, reward, 0.0)
        for name, cause in causes.items():
            self.causes[name] = self.causes[name] | (running & cause)
        failure = running & torch.stack(tuple(causes.values())).any(0)
        done = running & ~failure & finished
        passed = running & ~failure & events.passed
        self.passed = self.passed | (kind & (passed & ~events.bypassed)[:, None])
        self.bypassed = self.bypassed | (kind & (passed & events.bypassed)[:, None])
        self.terminated = self.terminated | failure
        self.finished = self.finished | done
        self.truncated = self.truncated | done | (running & ~failure & late)
        self.running = running & ~self.terminated & ~self.truncated
        self.failed = self.failed | (kind & (running & ~self.running & ~done & ~passed)[:, None])

    def entries(self, detour: Tensor) -> TensorDict:
        """What an environment returns of it.

        Args:
            detour: bool ``[N]``, some obstacle of the episode was bypassed.
        """
        size = [len(self.running)]
        outcome = {"success": (self.finished & ~detour)[:, None], "finished": self.finished[:, None]}
        outcome |= {"passed": self.passed, "bypassed": self.bypassed, "failed": self.failed}
        return TensorDict(
            {
                "reward": self.reward[:, None],
                "terminated": self.terminated[:, None],
                "truncated": self.truncated[:, None],
                "done": (self.terminated | self.truncated)[:, None],
                keys.REWARD_TERMS: TensorDict({name: value[:, None] for name, value in self.terms.items()}, size),
                keys.OUTCOME: TensorDict(outcome, size),
                keys.TERMINATIONS: TensorDict({name: value[:, None] for name, value in self.causes.items()}, size),
            },
            size,
        )


def outcome_specs(num_robots: int, terms: Iterable[str], causes: Iterable[str]) -> dict[str, Composite]:
    """Specs of the nested entries that :meth:`DecisionOutcome.entries` writes."""
    n = num_robots

    def flags(size: int = 1) -> Binary:
        return Binary(shape=(n, size), dtype=torch.bool)

    outcome = {"success": flags(), "finished": flags(), **{name: flags(len(OBSTACLES)) for name in _PER_TYPE}}
    return {
        keys.REWARD_TERMS: Composite({name: Unbounded((n, 1), dtype=torch.float32) for name in terms}, shape=(n,)),
        keys.OUTCOME: Composite(outcome, shape=(n,)),
        keys.TERMINATIONS: Composite({name: flags() for name in causes}, shape=(n,)),
    }
