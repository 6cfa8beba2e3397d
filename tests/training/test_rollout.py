"""Experience from the real environment: alignment in time, bootstrap values, continuation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictSequential, set_interaction_type
from torch import Tensor
from torchrl.objectives.value import GAE

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.modules import Critic, GaussianActor
from agility_rl.training.compilation import compiled
from agility_rl.training.rollout import Rollout

N, T = 4, 12
KEEP = [keys.PROPRIOCEPTION, keys.COMMAND, keys.ACTION]
KEEP_NEXT = ["reward", keys.MOTION, keys.REWARD_TERMS]
Build = Callable[..., LocomotionEnv]


@pytest.fixture
def build() -> Iterator[Build]:
    made: list[LocomotionEnv] = []

    def make(**options: Any) -> LocomotionEnv:
        options = {"episode_length": 0.1, "observation_noise": 1.0} | options  # five steps
        made.append(LocomotionEnv(N, simulator_options={"num_threads": 1}, **options))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)


def policy(observation: TensorDictBase) -> TensorDictBase:
    """Pull the joints back, and something that depends on the command."""
    seen = observation[keys.PROPRIOCEPTION]
    return observation.set(keys.ACTION, -2.0 * seen[:, 5:17] + observation[keys.COMMAND][:, :1])


def value(observation: TensorDictBase) -> Tensor:
    """A number that tells observations apart."""
    return observation[keys.EXPLICIT].sum(-1, keepdim=True) + observation[keys.HISTORY].sum((-1, -2))[..., None]


def rollout(env: LocomotionEnv, steps: int = T) -> Rollout:
    return Rollout(env, steps, keep=KEEP, keep_next=KEEP_NEXT, value=value)


def test_some_robots_go_on_with_what_is_observed_now(build: Build) -> None:
    env = build()
    run = rollout(env, 2)
    with pytest.raises(ValueError, match="cannot go on before the first roll-out"):
        run.go_on_from(torch.tensor([0]), env.reset())
    run.collect(policy)
    assert run.carrier is not None
    before, observed = run.carrier.clone(), env.step(policy(env.reset()))["next"].exclude("reward")[[1, 3]]
    run.go_on_from(torch.tensor([2, 0]), observed)
    for name in (keys.PROPRIOCEPTION, keys.HISTORY):
        assert not torch.equal(before[name][2], observed[name][0])
        assert torch.equal(run.carrier[name][[2, 0]], observed[name])
        assert torch.equal(run.carrier[name][[1, 3]], before[name][[1, 3]])
    assert set(run.carrier.keys(True)) == set(before.keys(True))


def one_by_one(env: LocomotionEnv, steps: int) -> list[TensorDict]:
    """The same experience by plain steps and resets, with every observation kept twice."""
    observation, rows = env.reset(), []
    for _ in range(steps):
        full = env.step(policy(observation))
        row = full.clone()
        row["state_value"], row["next", "state_value"] = value(full), value(full["next"])
        rows.append(row)
        observation = full["next"].exclude("reward").clone()
        if observation["done"].any():
            observation = env.reset(observation.set("_reset", observation["done"].clone()))
    return rows


def test_shapes_and_keys(build: Build) -> None:
    batch = rollout(build()).collect(policy)
    assert batch.batch_size == (T, N)
    assert set(batch.keys()) == {*KEEP, "state_value", "next"}
    assert set(batch["next"].keys()) == {*KEEP_NEXT, "done", "terminated", "truncated", "state_value"}
    assert batch["next", keys.MOTION].shape == (T, N, 2, 49)
    assert batch["state_value"].shape == batch["next", "state_value"].shape == (T, N, 1)
    assert not batch["state_value"].requires_grad


def test_experience_is_that_of_plain_steps(build: Build) -> None:
    """Over two calls, through truncations inside a call and across its edge."""
    rows = torch.stack(one_by_one(build(seed=3), 2 * T))
    collector = rollout(build(seed=3))
    batch = torch.cat([collector.collect(policy).clone() for _ in range(2)])
    for name, entry in batch.items(include_nested=True, leaves_only=True):
        assert torch.equal(entry, rows[name]), name
    assert batch["next", "truncated"][:, 0, 0].nonzero()[:, 0].tolist() == [4, 9, 14, 19]


def test_ended_rows_are_valued_at_their_true_last_observation(build: Build) -> None:
    """By hand: the last step of a truncated episode has the value of what was seen before the reset, not after it."""
    env = build(seed=1)
    rows = one_by_one(build(seed=1), 6)
    batch = rollout(env, 6).collect(policy)
    last, first = rows[4]["next"], rows[5]
    assert last["truncated"].all()
    by_hand = last[keys.EXPLICIT].sum(-1) + last[keys.HISTORY].sum((-1, -2))
    torch.testing.assert_close(batch["next", "state_value"][4, :, 0], by_hand)
    assert (batch["next", "state_value"][4] - value(first)).abs().min() > 1e-3
    assert torch.equal(batch["state_value"][5], value(first))
    for step in (0, 1, 2, 3):  # inside an episode the next value is the value one step later
        assert torch.equal(batch["next", "state_value"][step], batch["state_value"][step + 1])


def test_robots_end_at_their_own_times(build: Build) -> None:
    lame = {"terminations": (lambda state: state.foot_contact.sum(-1) > 150.0,), "episode_length": 0.14}
    rows = torch.stack(one_by_one(build(seed=2, **lame), 40))
    batch = rollout(build(seed=2, **lame), 40).collect(policy)
    done = batch["next", "done"][..., 0]
    assert (done.any(-1) & ~done.all(-1)).any() and batch["next", "terminated"].any()
    assert torch.equal(batch["next", "state_value"], rows["next", "state_value"])
    assert torch.equal(batch["state_value"], rows["state_value"])


def test_advantages_bootstrap_truncations(build: Build) -> None:
    batch = rollout(build(seed=1)).collect(policy)
    gamma, lmbda = 0.9, 0.8
    reward, now, after = batch["next", "reward"], batch["state_value"], batch["next", "state_value"]
    expected, running = torch.zeros(T, N, 1), torch.zeros(N, 1)
    for step in reversed(range(T)):
        alive = (~batch["next", "terminated"][step]).float()
        going = (~batch["next", "done"][step]).float()
        error = reward[step] + gamma * alive * after[step] - now[step]
        running = error + gamma * lmbda * going * running
        expected[step] = running
    GAE(gamma=gamma, lmbda=lmbda, value_network=None, time_dim=0)(batch)
    torch.testing.assert_close(batch["advantage"], expected, atol=1e-4, rtol=1e-4)


def test_memory_is_reused(build: Build) -> None:
    collector = rollout(build())
    first = collector.collect(policy)
    assert collector.collect(policy) is first


def test_resume_goes_on_exactly(build: Build) -> None:
    env = build(seed=5)
    collector = rollout(env, 7)
    collector.collect(policy)
    saved, state = collector.state_dict(), env.state_dict()
    expected = collector.collect(policy).clone()
    other_env = build(seed=6)
    other = rollout(other_env, 7)
    other.collect(policy)
    other_env.load_state_dict(state)
    other.load_state_dict(saved)
    batch = other.collect(policy)
    for name, entry in expected.items(include_nested=True, leaves_only=True):
        assert torch.equal(entry, batch[name]), name


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # torch's compiler, of torch itself
def test_a_compiled_roll_out_is_the_eager_one_but_for_rounding_and_its_draws(build: Build) -> None:
    """Without draws it sees the same; with them actions are the Gaussian's, have its density, and come again."""
    torch.manual_seed(0)
    actor = GaussianActor(45 + 11, in_keys=[keys.PROPRIOCEPTION, keys.COMMAND], hidden=(32,), initial_std=0.3)
    critic = Critic(45 + 450, in_keys=[keys.PROPRIOCEPTION, keys.HISTORY], hidden=(32,))

    def collect(compile: bool, times: int, seed: int = 0) -> TensorDictBase:
        keep = [keys.PROPRIOCEPTION, keys.ACTION, "loc", "scale", "action_log_prob"]
        worth = lambda td: critic(td.select(*critic.in_keys))["state_value"]  # noqa: E731
        made = Rollout(build(seed=4), T, keep=keep, keep_next=["reward"], value=worth, compile=compile)
        torch.manual_seed(seed)
        policies = [compiled(TensorDictSequential(actor), compile) for _ in range(times)]
        return torch.cat([made.collect(policy).clone() for policy in policies])

    with set_interaction_type(InteractionType.DETERMINISTIC):
        eager, fused = collect(False, 2), collect(True, 2)
    assert eager["next", "truncated"].any()
    for name, entry in eager.items(include_nested=True, leaves_only=True):
        torch.testing.assert_close(fused[name], entry, atol=2e-3, rtol=2e-3, msg=str(name))
    first, again, other = collect(True, 10, 1), collect(True, 10, 1), collect(True, 10, 2)
    assert torch.equal(first[keys.ACTION], again[keys.ACTION])
    assert not torch.equal(first[keys.ACTION], other[keys.ACTION])
    drawn = (first[keys.ACTION] - first["loc"]) / first["scale"]
    assert abs(drawn.mean()) < 0.06 and abs(drawn.std() - 1.0) < 0.04  # four deviations of 5,760 numbers
    by_hand = (-0.5 * drawn.square() - first["scale"].log() - 0.5 * math.log(2.0 * math.pi)).sum(-1)
    torch.testing.assert_close(first["action_log_prob"], by_hand, atol=1e-4, rtol=1e-4)


def test_before_the_first_call_there_is_nothing_to_save(build: Build) -> None:
    collector = rollout(build())
    assert collector.state_dict() == {}
    collector.load_state_dict({})
    assert collector.collect(policy).batch_size == (T, N)


def test_an_environment_without_a_batch_is_refused(build: Build) -> None:
    env = build()
    env.batch_size = torch.Size([])
    with pytest.raises(ValueError, match=r"batch_size \[N\], got \[\]"):
        rollout(env)
