"""The Gymnasium adapter: its three autoreset modes against the environment itself, on real robots."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.gymnasium import GROUPS, LOCOMOTION_ID, LocomotionVectorEnv

ONE_THREAD = {"num_threads": 1}
SHORT = 0.1  # seconds: five control steps
N = 3

Make = Callable[..., LocomotionVectorEnv]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[LocomotionVectorEnv] = []

    def build(**options: Any) -> LocomotionVectorEnv:
        options.setdefault("simulator_options", ONE_THREAD)
        made.append(gymnasium.make_vec(LOCOMOTION_ID, num_envs=N, **options))
        return made[-1]

    yield build
    for envs in made:
        envs.close()


def actions(count: int) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return [generator.normal(0.0, 0.3, (N, 12)).astype(np.float32) for _ in range(count)]


def assert_same(
    one: dict[str, np.ndarray], other: dict[str, np.ndarray], rows: slice | list[int] = slice(None)
) -> None:
    for name in one:
        np.testing.assert_array_equal(one[name][rows], other[name][rows], err_msg=name)


def test_spaces_hold_what_comes_out(make: Make) -> None:
    envs = make()
    observation, info = envs.reset(seed=0)
    assert info == {}
    assert set(observation) == set(GROUPS)
    assert observation in envs.observation_space
    assert envs.single_observation_space["history"].shape == (10, 45)
    assert envs.action_space.shape == (N, 12) and envs.single_action_space.shape == (12,)
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
    assert observation in envs.observation_space
    assert reward.shape == terminated.shape == truncated.shape == (N,)
    assert reward.dtype == np.float32 and terminated.dtype == truncated.dtype == np.bool_
    terms = info["reward_terms"]
    named = [name for name in terms if not name.startswith("_")]
    assert named and all(terms[name].shape == (N,) and terms[f"_{name}"].all() for name in named)
    np.testing.assert_allclose(np.maximum(sum(terms[name] for name in named), 0.0), reward, atol=1e-6)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_metadata_and_spec_name_the_autoreset_mode(make: Make, mode: AutoresetMode) -> None:
    envs = make(autoreset_mode=mode.value)
    assert envs.metadata["autoreset_mode"] is mode
    assert envs.spec is not None and envs.spec.id == LOCOMOTION_ID


def test_steps_are_those_of_the_environment(make: Make) -> None:
    envs = make()
    own, _ = envs.reset(seed=7)
    bare = LocomotionEnv(N, simulator_options=ONE_THREAD)
    bare.generator.manual_seed(7)
    expected = bare.reset()
    for action in actions(8):
        assert_same(own, {name: expected[name].numpy() for name in own})
        own, reward, *_ = envs.step(action)
        expected = bare.step(TensorDict({keys.ACTION: torch.from_numpy(action)}, [N]))["next"]
        np.testing.assert_array_equal(reward, expected["reward"][:, 0].numpy())
    bare.close()


def test_next_step_mode_returns_the_last_observation_and_then_starts_anew(make: Make) -> None:
    envs, waiting = make(episode_length=SHORT), make(episode_length=SHORT, autoreset_mode="Disabled")
    envs.reset(seed=1)
    waiting.reset(seed=1)
    for step, action in enumerate(actions(5)):
        observation, _, terminated, truncated, _ = envs.step(action)
        last, *_ = waiting.step(action)
        assert not terminated.any()
        assert truncated.all() == (step == 4)
    assert_same(observation, last)
    first, reward, terminated, truncated, info = envs.step(np.full((N, 12), np.nan, np.float32))
    assert (reward == 0.0).all() and not terminated.any() and not truncated.any() and info == {}
    np.testing.assert_array_equal(first["history"], first["history"][:, -1:].repeat(10, 1))
    assert all(np.isfinite(value).all() for value in first.values())
    for step, action in enumerate(actions(5)):
        *_, truncated, _ = envs.step(action)
        assert truncated.all() == (step == 4)


def test_same_step_mode_keeps_the_last_observation_in_the_info(make: Make) -> None:
    envs = make(episode_length=SHORT, autoreset_mode="SameStep")
    waiting = make(episode_length=SHORT, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=1)
    waiting.reset(seed=1)
    for step, action in enumerate(actions(5)):
        observation, reward, _, truncated, info = envs.step(action)
        last, last_reward, _, _, last_info = waiting.step(action)
        assert ("final_obs" in info) == (step == 4)
    assert truncated.all() and info["_final_obs"].all() and info["_final_info"].all()
    np.testing.assert_array_equal(reward, last_reward)
    for row in range(N):
        assert_same(info["final_obs"][row], {name: value[row] for name, value in last.items()})
    for name, value in last_info["reward_terms"].items():
        np.testing.assert_array_equal(info["final_info"]["reward_terms"][name], value)
    assert "reward_terms" not in info
    np.testing.assert_array_equal(observation["history"], observation["history"][:, -1:].repeat(10, 1))
    *_, truncated, info = envs.step(actions(1)[0])
    assert not truncated.any() and "final_obs" not in info


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_an_ending_episode_leaves_the_other_robots_alone(make: Make, mode: str) -> None:
    envs = make(episode_length=SHORT, autoreset_mode=mode)
    envs.reset(seed=2)
    rows = [0, 2]
    for action in actions(2):
        before, *_ = envs.step(action)
    # Robot 1 restarts alone, so that robots 0 and 2 end three steps from now and robot 1 does not.
    after, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert_same(after, before, rows)
    ends = [envs.step(action)[3] for action in actions(4)]
    assert [end.tolist() for end in ends[:3]] == [[False] * 3, [False] * 3, [True, False, True]]
    assert not ends[3].any()
    assert [envs.step(action)[3].tolist() for action in actions(1)] == [[False, True, False]]


def test_the_mask_of_a_partial_info_names_the_running_robots(make: Make) -> None:
    envs = make(episode_length=SHORT)
    envs.reset(seed=2)
    envs.step(actions(1)[0])
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    for action in actions(4):
        *_, info = envs.step(action)
    *_, reward, _, _, info = envs.step(actions(1)[0])
    assert info["_reward_terms"].tolist() == [False, True, False]
    assert reward[[0, 2]].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_gymnasiums_own_episode_statistics_agree(make: Make, mode: str) -> None:
    envs = RecordEpisodeStatistics(make(episode_length=SHORT, autoreset_mode=mode))
    envs.reset(seed=0)
    lengths, returns, total = [], [], np.zeros(N)
    for action in actions(12):
        _, reward, _, truncated, info = envs.step(action)
        total += reward
        if truncated.any():
            lengths.append(info["episode"]["l"].tolist())
            returns.append((info["episode"]["r"], total))
            total = np.zeros(N)
    assert lengths == [[5] * N] * 2
    for theirs, ours in returns:
        np.testing.assert_allclose(theirs, ours, atol=1e-5)


def test_a_fall_is_a_termination_and_no_truncation(make: Make) -> None:
    envs = make(autoreset_mode="SameStep")
    envs.reset(seed=0)
    collapse = np.tile(np.float32([0.0, 8.0, -8.0]), (N, 4))
    fallen = np.zeros(N, bool)
    for _ in range(150):
        _, _, terminated, truncated, info = envs.step(collapse)
        assert not truncated.any()
        if terminated.any():
            np.testing.assert_array_equal(info["_final_obs"], terminated)
        fallen |= terminated
        if fallen.all():
            break
    assert fallen.all()


def test_disabled_mode_waits_for_a_reset(make: Make) -> None:
    envs = make(episode_length=SHORT, autoreset_mode="Disabled")
    with pytest.raises(gymnasium.error.ResetNeeded, match="all robots need a reset"):
        envs.step(actions(1)[0])
    envs.reset(seed=0)
    for action in actions(5):
        envs.step(action)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"robots \[0, 1, 2\] need a reset"):
        envs.step(actions(1)[0])
    envs.reset(options={"reset_mask": np.ones(N, bool)})
    envs.step(actions(1)[0])


def test_a_seed_repeats_the_episode(make: Make) -> None:
    one, two = make(observation_noise=1.0), make(observation_noise=1.0)
    (first, _), (second, _) = one.reset(seed=5), two.reset(seed=5)
    assert_same(first, second)
    for action in actions(3):
        assert_same(one.step(action)[0], two.step(action)[0])
    assert (one.reset(seed=6)[0]["command"] != first["command"]).any()


def test_actions_beyond_the_limit_are_clipped(make: Make) -> None:
    one, two = make(action_limit=1.0), make(action_limit=1.0)
    one.reset(seed=0)
    two.reset(seed=0)
    for sign in (1.0, -1.0):
        assert_same(one.step(np.full((N, 12), 50.0 * sign))[0], two.step(np.full((N, 12), sign))[0])


def test_writing_into_an_observation_does_not_reach_the_robots(make: Make) -> None:
    one, two = make(), make()
    spoiled, _ = one.reset(seed=0)
    two.reset(seed=0)
    for value in spoiled.values():
        value[:] = 99.0
    assert_same(one.step(actions(1)[0])[0], two.step(actions(1)[0])[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"groups": ["proprioception", "vision"]},
            r"'vision' is no float32 observation group; expected some of .*motion",
        ),
        ({"groups": ["skill"]}, "'skill' is no float32 observation group"),
        ({"groups": ["reward_terms"]}, "'reward_terms' is no float32 observation group"),
        ({"groups": []}, "expected at least one observation group, got none"),
        ({"action_limit": 0.0}, "expected an action_limit above 0 action units, got 0.0"),
        ({"autoreset_mode": "Never"}, "'Never' is not a valid AutoresetMode"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gymnasium.make_vec(LOCOMOTION_ID, num_envs=N, simulator_options=ONE_THREAD, **options)


def test_bad_calls_are_refused(make: Make) -> None:
    envs = make(groups=["proprioception"])
    with pytest.raises(ValueError, match="the first reset must be of all robots"):
        envs.reset(options={"reset_mask": np.array([True, False, False])})
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected actions of shape \(3, 12\), got \(3, 11\)"):
        envs.step(np.zeros((N, 11)))
    for mask in (np.ones(N), np.ones(N + 1, bool), np.zeros(N, bool)):
        with pytest.raises(ValueError, match=r"expected options\['reset_mask'\] to be a bool array of shape \(3,\)"):
            envs.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="a ready env of 3 robots was given, with num_envs=2"):
        LocomotionVectorEnv(2, env=envs.env)


def test_who_was_closed_says_so(make: Make) -> None:
    envs = make()
    envs.reset(seed=0)
    envs.close()
    for call in (envs.reset, lambda: envs.step(actions(1)[0])):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="make the environment anew"):
            call()


def test_without_gymnasium_the_package_works_and_the_adapter_says_what_to_install() -> None:
    script = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "import agility_rl.envs\n"
        "try:\n    import agility_rl.envs.gymnasium\n"
        "except ModuleNotFoundError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, check=True)
    assert "pip install 'agility_rl[gymnasium]'" in done.stdout
