"""What ends an episode as a failure: thresholds by hand, and robots that really fall."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.behaviours import NUM_BEHAVIOURS
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.reference import standing_states
from agility_rl.envs.state import LocomotionState
from agility_rl.envs.terminations import LOCOMOTION_TERMINATIONS, body_contact, diverged, thigh_contact

Neutral = Callable[..., LocomotionState]
Build = Callable[..., LocomotionEnv]


def test_trunk_and_hips_end_an_episode_above_one_newton(neutral: Neutral) -> None:
    hips = torch.zeros(4, 4)
    hips[2, 3] = 1.5
    state = neutral(4, trunk_contact=torch.tensor([0.9, 1.1, 0.0, 0.0]), hip_contact=hips)
    assert body_contact(state).tolist() == [False, True, True, False]


def test_other_links_do_not(neutral: Neutral) -> None:
    force = torch.full((2, 4), 50.0)
    assert not body_contact(neutral(thigh_contact=force, calf_contact=force, foot_contact=force)).any()


def test_thigh_contact_is_another_rule(neutral: Neutral) -> None:
    force = torch.tensor([[0.0, 1.5, 0.0, 0.0], [1.0, 0.5, 0.0, 0.0]])
    assert thigh_contact(neutral(thigh_contact=force)).tolist() == [True, False]
    assert thigh_contact not in LOCOMOTION_TERMINATIONS


def test_divergence(neutral: Neutral) -> None:
    assert diverged(neutral(unstable=torch.tensor([False, True]))).tolist() == [False, True]


def upside_down() -> TensorDict:
    standing = standing_states(torch.arange(NUM_BEHAVIOURS))
    standing["root_quaternion"][:] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    standing["root_height"][:] = 0.3
    return standing


def test_robots_dropped_on_their_backs_terminate_by_contact(build: Build) -> None:
    env = build(3, reference=upside_down())
    carrier = env.reset()
    ended = torch.zeros(3, dtype=torch.bool)
    for _ in range(25):
        step, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, torch.zeros(3, 12)))
        after = step["next"]
        assert not env.simulator.unstable.any() and not after["truncated"].any()
        assert torch.equal(after["done"], after["terminated"])
        ended |= after["terminated"][:, 0]
    assert ended.all()


def test_an_environment_takes_other_failures(build: Build) -> None:
    env = build(2, terminations=(diverged,), reference=upside_down())
    rollout = env.rollout(25)
    assert rollout.shape == (2, 25) and not rollout["next", "terminated"].any()
