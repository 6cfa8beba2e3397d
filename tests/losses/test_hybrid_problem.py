"""Hybrid-PPO on a problem that it has to solve: one step, three choices, each with its own best parameters."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import Tensor
from torchrl.objectives import KLAdaptiveLR
from torchrl.objectives.value import GAE

from agility_rl.losses import HybridPPOLoss
from agility_rl.modules import Critic, HybridActor, selected_parameters
from agility_rl.training.ppo import PPOUpdate

BOTH = pytest.mark.parametrize("continuous", ["all", "selected"])
BEST = torch.tensor([[0.6, -0.4], [-0.5, 0.5], [0.1, -0.8]])


def right_choice(context: Tensor) -> Tensor:
    """The sector of the plane that the context lies in."""
    return ((torch.atan2(context[..., 1], context[..., 0]) + math.pi) * 3 / (2 * math.pi)).long().clamp(0, 2)


def solve(continuous: Any, iterations: int) -> tuple[HybridActor, dict[str, Tensor]]:
    """Train on one-step episodes: the context says which choice pays; each choice has its own best parameters."""
    torch.manual_seed(0)  # initial weights
    generator = torch.Generator().manual_seed(1)
    actor = HybridActor(
        2, 3, (3, 2), in_keys=["context"], hidden=(32, 32), initial_std=0.5, min_std=0.05, generator=generator
    )
    critic = Critic(2, in_keys=["context"], hidden=(32, 32))
    loss = HybridPPOLoss(actor, critic, continuous=continuous)
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=5e-3)

    def divergence(sample: TensorDict) -> Tensor:
        actor.project_std()
        return loss.divergence(sample)["continuous"]

    update = PPOUpdate(
        loss,
        optimizer,
        epochs=2,
        minibatches=4,
        keep=["logits", "loc", "scale"],
        divergence=divergence,
        schedule=KLAdaptiveLR(optimizer, 0.02, min_lr=1e-3),
    )
    gae = GAE(gamma=0.99, lmbda=0.95, value_network=None, time_dim=0)
    end = torch.ones(4, 128, 1, dtype=torch.bool)
    for _ in range(iterations):
        with torch.no_grad():
            batch = TensorDict({"context": 2 * torch.rand(4, 128, 2, generator=generator) - 1}, [4, 128])
            critic(actor(batch))
            choice = batch["action", "behaviour"]
            error = selected_parameters(choice, batch["action", "parameters"]) - BEST[choice]
            reward = (choice == right_choice(batch["context"])).float() - error.square().sum(-1)
            after = {"reward": reward.unsqueeze(-1), "state_value": 0.0 * end, "done": end, "terminated": end}
            batch["next"] = TensorDict(after, [4, 128])
            gae(batch)
        metrics = update(batch, generator)
    return actor, metrics


@BOTH
def test_it_solves_a_hybrid_problem(continuous: Any) -> None:
    actor, metrics = solve(continuous, 40)
    test = TensorDict({"context": 2 * torch.rand(2000, 2, generator=torch.Generator().manual_seed(2)) - 1}, [2000])
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        actor(test)
    choice = test["action", "behaviour"]
    error = selected_parameters(choice, test["action", "parameters"]) - BEST[choice]
    assert (choice == right_choice(test["context"])).float().mean() > 0.95
    assert error.abs().mean() < 0.1
    assert {"loss_discrete", "loss_continuous", "kl", "learning_rate", "clip_fraction_continuous"} <= metrics.keys()


@BOTH
def test_a_seed_repeats_the_training(continuous: Any) -> None:
    (one, _), (two, _) = (solve(continuous, 2) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters()))
