"""What else than a reward a controller's policy is held to while PPO improves it: an earlier policy, and its own image
in a mirror."""

from __future__ import annotations

import torch
from bbc_setup import ANCHORED, Components
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import COMMANDS, JUMP
from agility_rl.envs.mirror import mirror
from agility_rl.go2.mirror import mirror_joints


@torch.no_grad()
def hold(parts: Components, batch: TensorDictBase) -> None:
    """Write the anchor's mean action beside the experience."""
    assert parts.anchor is not None
    policy = parts.anchor.trained_actor()[:-1]
    flat = policy(batch.select(*policy.in_keys).flatten())
    batch[ANCHORED] = flat["loc"].unflatten(0, batch.batch_size)


def distance_to_anchor(parts: Components, sample: TensorDictBase, turn_rate: float | None, jump: float = 1.0) -> Tensor:
    """Mean squared difference between the mean actions of policy and anchor [action units squared]; zero where a faster
    turn than ``turn_rate`` [rad/s] is commanded, ``jump`` times as much where a jump is."""
    policy = parts.bbc.trained_actor()[:-1]
    error = (policy(sample.select(*policy.in_keys))["loc"] - sample[ANCHORED]).square().mean(-1)
    error = torch.where(sample[keys.SKILL] == JUMP, jump * error, error)
    if turn_rate is not None:
        error = error * (sample[keys.COMMAND][:, COMMANDS.index("yaw_rate")].abs() <= turn_rate)
    return error.mean()


def asymmetry(parts: Components, sample: TensorDictBase, symmetric: Tensor) -> Tensor:
    """Mean squared difference between the mean actions before a mirror and in it [action units squared].

    Source: Yu, Turk and Liu 2018, arXiv:1801.08093, equation (3).

    Args:
        parts: whose policy it is.
        sample: observations and ``skill``.
        symmetric: bool ``[5]``, behaviours that count; the others add nothing to the mean.
    """
    policy = parts.bbc.trained_actor()[:-1]
    seen = sample.select(*policy.in_keys)[symmetric[sample[keys.SKILL]]]
    here, there = policy(seen.clone(recurse=False))["loc"], policy(mirror(seen))["loc"]
    return (mirror_joints(here) - there).square().mean(-1).sum() / len(sample)
