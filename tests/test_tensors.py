"""Shared constants, and that to work on all rows, as a GPU does, changes nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.envs import AgilityEnv, LocomotionEnv
from agility_rl.tensors import constant
from agility_rl.training.rollout import Rollout


def test_a_constant_is_made_once_for_each_type() -> None:
    cpu = torch.device("cpu")
    one = constant((0.5, -1.0), cpu)
    assert one.tolist() == [0.5, -1.0] and one.dtype == torch.float32
    assert constant((0.5, -1.0), cpu) is one
    assert constant((0.5, -1.0), cpu, torch.float64).dtype == torch.float64
    assert constant(((1.0, 2.0), (3.0, 4.0)), cpu).shape == (2, 2)


def test_a_constant_of_inference_can_be_trained_with() -> None:
    with torch.inference_mode():
        made = constant((0.125, 8.0), torch.device("cpu"))
    weight = torch.ones(2, requires_grad=True)
    (weight * made).sum().backward()
    assert weight.grad is not None and weight.grad.tolist() == [0.125, 8.0]


def hold(td: TensorDict) -> TensorDict:
    """Disturbed standing, so that some robots fall."""
    phase = torch.arange(float(td.shape[0]))[:, None] + torch.arange(12.0)
    return td.set("action", 4.0 * phase.sin())


def locomotion() -> list[Tensor]:
    env = LocomotionEnv(24, resample_period=0.1, push_interval=0.1, encounters=0.5, episode_length=0.3, seed=3)
    keep, keep_next = ["proprioception", "command"], ["reward", "motion"]
    stored = Rollout(env, 25, keep=keep, keep_next=keep_next, value=lambda td: td["command"][:, :1]).collect(hold)
    assert bool(stored["next", "done"].any()) and not bool(stored["next", "done"].all())
    return [value.clone() for value in stored.values(True, True)]


def course() -> list[Tensor]:
    depth = {"frame_steps": 3, "latency": (1, 4)}  # so that frames of all, of some and of no robots are due
    env = AgilityEnv(12, hold, decision_steps=2, episode_length=0.3, seed=3, depth=depth)
    torch.manual_seed(3)
    td = env.rollout(20, break_when_any_done=False)
    assert bool(td["next", "done"].any())
    return list(td.exclude("action").values(True, True))


@pytest.mark.parametrize("world", [locomotion, course])
def test_working_on_all_rows_as_a_gpu_does_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, world: Callable[[], list[Tensor]]
) -> None:
    some = world()
    for module in [module for name, module in sys.modules.items() if name.startswith("agility_rl")]:
        if hasattr(module, "rows_of"):
            monkeypatch.setattr(module, "rows_of", lambda mask: torch.arange(len(mask)))
    everyone = world()
    assert len(some) == len(everyone) > 5
    for one, other in zip(some, everyone, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
