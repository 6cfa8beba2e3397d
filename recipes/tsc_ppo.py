"""Hybrid-PPO on a course, as teachers and students learn by it: critic, optimiser, roll-outs, update, rewards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import KLAdaptiveLR
from torchrl.objectives.value import GAE
from tsc_config import PPOConfig

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.losses import HybridPPOLoss, ImitationReward
from agility_rl.modules import Critic, HybridActor
from agility_rl.training.exploration import LastingNoise, Policy
from agility_rl.training.ppo import FirstGroup, PPOUpdate
from agility_rl.training.precision import hidden_precision
from agility_rl.training.rewind import Rewind
from agility_rl.training.rollout import Rollout
from agility_rl.training.seeding import Seeds

OBSERVED = (
    *(keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.HISTORY),
    *(keys.HEADING_ERROR, keys.PLACE, keys.OBSTACLE, keys.SCANDOTS),
)
"""What the critic reads (method notes, section 5.4: all of it; where the robot stands: ours)."""


@dataclass
class Learner:
    """What improves a policy on a course."""

    critic: Critic
    optimizer: torch.optim.Optimizer
    rollout: Rollout
    rewind: Rewind | None
    noise: LastingNoise | None
    advantage: GAE
    update: PPOUpdate

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike."""
        return {"critic": self.critic, "policy_optimizer": self.optimizer}

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself."""
        parts = {"rollout": self.rollout, "rewind": self.rewind, "noise": self.noise}
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def num_rewound(self) -> int:
        """How many robots, the first ones, begin roll-outs where others failed."""
        return 0 if self.rewind is None else len(self.rewind.rows)

    def collect(self, policy: Policy) -> TensorDictBase:
        """Experience ``[T, N]`` of a policy that tries something else now and then.

        The first :attr:`num_rewound` robots practise what fails.
        """
        policy = policy if self.noise is None else self.noise.around(policy)
        if self.rewind is None:
            return self.rollout.collect(policy)
        self.rewind.begin(self.rollout)
        batch = self.rollout.collect(self.rewind.watching(policy))
        self.rewind.remember(batch["next", "terminated"], batch["next", "done"])
        return batch


def make_learner(
    ppo: PPOConfig,
    env: AgilityEnv,
    trained: ProbabilisticTensorDictSequential,
    actor: HybridActor,
    seeds: Seeds,
    *,
    stepped: EnvBase | None = None,
    carried: Sequence[NestedKey] = (),
    keep: Sequence[NestedKey] = (),
    keep_in_minibatches: Sequence[NestedKey] = (),
) -> Learner:
    """Critic, optimiser, roll-outs and update of a policy.

    Args:
        ppo: options.
        env: the course.
        trained: the policy as PPO's loss takes it; all of it learns.
        actor: its last part, whose deviations have a floor.
        seeds: sources of randomness.
        stepped: what roll-outs step, if that is more than ``env``.
        carried: entries in which the policy carries what it remembers.
        keep: entries that roll-outs keep beside those that every learner needs.
        keep_in_minibatches: entries that the update's ``extra`` reads.

    Raises:
        ValueError: if ``ppo.rewound`` is no share of the robots, or leaves none that go on from where they were.
    """
    if not 0.0 <= ppo.rewound < 1.0:
        raise ValueError(f"--ppo.rewound: expected a share from 0 to less than 1, got {ppo.rewound}")
    num_rewound = round(ppo.rewound * env.num_robots)
    if num_rewound == env.num_robots:
        raise ValueError(
            f"--ppo.rewound {ppo.rewound} of {num_rewound} robots is all of them; expected one left that goes on: "
            "take a smaller share, or more robots (--env.num-robots)"
        )
    width = sum(env.observation_spec[key].shape[1:].numel() for key in OBSERVED)
    critic = Critic(width, in_keys=list(OBSERVED), hidden=ppo.hidden).to(env.device)
    groups: list[dict[str, Any]] = [{"params": list(trained.parameters())}]
    if ppo.critic_learning_rate is None:
        groups[0]["params"] += critic.parameters()
    else:
        groups.append({"params": list(critic.parameters()), "lr": ppo.critic_learning_rate})
    optimizer = torch.optim.Adam(groups, lr=ppo.learning_rate, fused=True)
    loss = HybridPPOLoss(
        trained,
        critic,
        continuous=ppo.continuous,
        clip_epsilon=ppo.clip,
        critic_coeff=ppo.value,
        discrete_entropy_coeff=ppo.entropy,
        continuous_entropy_coeff=ppo.entropy,
        bounds_coeff=ppo.bounds,
    )

    def divergence(sample: TensorDictBase) -> Tensor:
        actor.project_std()
        return loss.divergence(sample)["continuous"]  # of this part alone: method notes, section 5.2

    schedule = None
    if ppo.desired_kl is not None:
        schedule = KLAdaptiveLR(FirstGroup(optimizer), ppo.desired_kl, max_lr=ppo.max_learning_rate)
    decision_dt, noise, rewind = env.dt * env.decision_steps, None, None
    if num_rewound:
        rewind = Rewind(env, num_rewound, decision_dt, seeds.generator("rewind"), carried)
    if ppo.noise_seconds is not None:
        noise = LastingNoise(
            ppo.noise_seconds, decision_dt, seeds.generator("exploration"), (keys.ACTION, keys.PARAMETERS)
        )
    outcome = [keys.OUTCOME, keys.TERMINATIONS, keys.REWARD_TERMS, keys.MOTION, keys.SKILL, keys.OBSTACLE]
    said = ["logits", "loc", "scale"]
    return Learner(
        critic=critic,
        optimizer=optimizer,
        rollout=Rollout(
            env if stepped is None else stepped,
            ppo.steps,
            keep=[*dict.fromkeys([*OBSERVED, *keep, keys.ACTION, *said])],
            keep_next=["reward", *outcome],
            value=lambda observation: critic(observation.select(*OBSERVED))["state_value"],
            compile=ppo.compile,
        ),
        rewind=rewind,
        noise=noise,
        advantage=GAE(gamma=ppo.gamma, lmbda=ppo.lmbda, value_network=None, time_dim=0),
        update=PPOUpdate(
            loss,
            optimizer,
            epochs=ppo.epochs,
            minibatches=ppo.minibatches,
            max_grad_norm=ppo.max_grad_norm,
            keep=[*said, *keep_in_minibatches],
            divergence=divergence,
            schedule=schedule,
            precision=hidden_precision(ppo.precision, env.device),
            compile=ppo.compile,
        ),
    )


def limit_deviations(actor: HybridActor, ppo: PPOConfig) -> None:
    """Let a trained actor begin with the deviations of the options: at least the floor, at most the initial one."""
    actor.network.parameters_head.std.data.clamp_(ppo.min_std, ppo.initial_std)


@torch.no_grad()
def add_rewards(imitation: ImitationReward | None, weight: float, batch: TensorDictBase) -> dict[str, Tensor]:
    """``r = 2.0 r^T + 0.2 r^I dt`` (Table S4), of which ``weight`` is the first number, added
    to a batch ``[T, N]``; returns the means of both."""
    after, task = batch["next"], weight * batch["next", "reward"]
    after["reward"] = task
    metrics = {"reward/task": task.mean()}
    if imitation is not None:
        metrics["reward/imitation"] = (imitation(after)["reward"] - task).mean()
    return metrics


def value_finished(batch: TensorDictBase, value: float | None) -> None:
    """Bootstrap finished courses by ``value`` in place of what the critic makes of states that it never sees.

    Source: ours (docs/agility.md, "What helped, by experiment").

    Args:
        batch: ``(next, state_value)`` [T, N, 1], changed in place, and bool ``(next, outcome, finished)`` [T, N, 1].
        value: discounted reward after the finish; ``None`` leaves the critic's, as released.
    """
    if value is not None:
        batch["next", "state_value"].masked_fill_(batch["next", keys.OUTCOME, "finished"], value)


def what_happened(batch: TensorDictBase, actor: HybridActor) -> dict[str, Tensor]:
    """Means of the reward's terms over a batch ``[T, N]``, and of the actor's deviations."""
    means = {f"task/{name}": value.mean() for name, value in batch["next", keys.REWARD_TERMS].items()}
    return means | {"std": actor.network.parameters_head.std.detach().mean()}
