"""The whole environment on the real engine: specs, determinism, resets, ends of episodes, rewards, continuation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from agility_rl import keys, rotations
from agility_rl.behaviours import BEHAVIOURS, RESAMPLE_PERIOD
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.locomotion import EDGE
from agility_rl.envs.randomization import Randomization
from agility_rl.envs.rewards import LOCOMOTION_REWARDS, RewardTerm, rhythm
from agility_rl.go2 import kinematics
from agility_rl.go2.constants import FOOT_RADIUS, STANDING_HEIGHT
from agility_rl.motion import synthesize_gait
from agility_rl.motion.stride_patterns import stride_patterns
from agility_rl.simulation import make_simulator, rough_pyramids

Build = Callable[..., LocomotionEnv]
EVERYTHING: dict[str, Any] = {
    "randomization": Randomization(action_delay=(0.0, 0.02)),
    "observation_noise": 1.0,
    "push_interval": 0.1,
    "resample_period": 0.3,
    "episode_length": 0.5,
    "rewards": {**LOCOMOTION_REWARDS, "rhythm": RewardTerm(1.0, rhythm)},
    "patterns": stride_patterns([synthesize_gait(name) for name in BEHAVIOURS]),
    "encounters": 0.8,
    "boxes": 0.5,
}
"""All randomness there is, often."""


def run(
    env: LocomotionEnv, steps: int, carrier: TensorDictBase | None = None, offset: int = 0
) -> tuple[list[TensorDict], TensorDictBase]:
    """Steps with given actions and resets, as a collector does them."""
    carrier = env.reset() if carrier is None else carrier
    seen = []
    for step in range(offset, offset + steps):
        action = torch.randn(env.num_robots, 12, generator=torch.Generator().manual_seed(step))
        full, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, action))
        seen.append(full.clone())
    return seen, carrier


def assert_same(one: list[TensorDict], other: list[TensorDict]) -> None:
    for a, b in zip(one, other, strict=True):
        for name, value in a.items(include_nested=True, leaves_only=True):
            assert torch.equal(value, b[name]), name


def finite(observation: TensorDictBase) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in observation.values(True, True))


def test_specs(build: Build) -> None:
    check_env_specs(build(3, **EVERYTHING), break_when_any_done="both", seed=0)


def test_a_reset_says_on_which_device_it_is(build: Build) -> None:
    env = build(2)
    assert env.reset().device == env.device


def test_shapes_are_those_of_the_documentation(build: Build) -> None:
    rollout = build(2).rollout(3)
    shapes = {
        keys.PROPRIOCEPTION: (45,),
        keys.EXPLICIT: (4,),
        keys.PRIVILEGED: (29,),
        keys.HISTORY: (10, 45),
        keys.COMMAND: (11,),
        keys.PEAK: (1,),
        keys.MOTION: (2, 49),
        keys.SKILL: (),
        keys.SHIFT: (1,),
    }
    for key, shape in shapes.items():
        assert rollout[key].shape == rollout["next", key].shape == (2, 3, *shape), key
    for key in ("reward", "done", "terminated", "truncated"):
        assert rollout["next", key].shape == (2, 3, 1), key
    assert set(rollout["next", keys.REWARD_TERMS].keys()) == set(LOCOMOTION_REWARDS)


def test_the_number_of_threads_changes_nothing(build: Build) -> None:
    one, two = (run(build(5, simulator_options={"num_threads": n}, **EVERYTHING), 40)[0] for n in (1, 2))
    assert_same(one, two)
    assert torch.stack([step["next", "done"] for step in one]).any()


def test_seeds_reproduce(build: Build) -> None:
    first = run(build(3, seed=4, **EVERYTHING), 20)[0]
    assert_same(first, run(build(3, seed=4, **EVERYTHING), 20)[0])
    other = build(3, seed=5, **EVERYTHING)
    assert not torch.equal(first[0][keys.COMMAND], run(other, 20)[0][0][keys.COMMAND])
    fresh = build(3, **EVERYTHING)
    for env in (other, fresh):  # one of them in the middle of its episodes
        env.set_seed(4)
    assert_same(run(fresh, 20)[0], run(other, 20)[0])


def test_the_global_generator_is_left_alone(build: Build) -> None:
    env = build(2, **EVERYTHING)
    before = torch.get_rng_state()
    run(env, 30)
    assert torch.equal(torch.get_rng_state(), before)


def test_partial_reset_leaves_the_other_rows_bit_identical(build: Build) -> None:
    env = build(4, **EVERYTHING)
    carrier = run(env, 7)[1].exclude(keys.ACTION)
    before = carrier.clone()
    state = env.simulator.state_dict()["state"]
    mask = torch.tensor([False, True, False, True])
    after = env.reset(carrier.set("_reset", mask[:, None]))
    raw = env._reset(TensorDict({"_reset": torch.zeros(4, 1, dtype=torch.bool)}, [4]))  # its own answer, not merged
    for name, value in before.items(include_nested=True, leaves_only=True):
        assert torch.equal(after[name][~mask], value[~mask]), name
        if name[0] != keys.REWARD_TERMS:
            assert torch.equal(raw[name][~mask], value[~mask]), name
    now = env.simulator.state_dict()["state"]
    assert torch.equal(now[~mask], state[~mask]) and not torch.equal(now[mask], state[mask])
    assert (after[keys.HISTORY][mask] == after[keys.PROPRIOCEPTION][mask][:, None]).all()
    assert torch.equal(after[keys.MOTION][mask][:, 0], after[keys.MOTION][mask][:, 1])


def test_other_rows_go_on_as_if_nothing_had_been_reset(build: Build) -> None:
    """Without draws the rows are independent, so a twin without the reset shows the same future."""
    one, two = build(2, resample_period=None), build(2, resample_period=None)
    for env in (one, two):
        env.set_commands(torch.tensor([0, 4]), torch.zeros(2, 5))
    carriers = [run(env, 10)[1] for env in (one, two)]
    carriers[0] = one.reset(carriers[0].exclude(keys.ACTION).set("_reset", torch.tensor([[True], [False]])))
    futures = [run(env, 10, carrier, 10)[0] for env, carrier in zip((one, two), carriers, strict=True)]
    assert_same([step[1:] for step in futures[0]], [step[1:] for step in futures[1]])


def test_time_limit_truncates_and_does_not_terminate(build: Build) -> None:
    env = build(2, episode_length=0.1)  # five steps
    carrier, flags = env.reset(), []
    for _ in range(10):
        full, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, torch.zeros(2, 12)))
        after = full["next"]
        assert not after["terminated"].any() and torch.equal(after["done"], after["truncated"])
        flags.append(after["truncated"][:, 0].tolist())
    assert flags == ([[False, False]] * 4 + [[True, True]]) * 2


def test_a_fall_in_the_last_step_is_no_truncation(build: Build) -> None:
    env = build(1, episode_length=0.02, terminations=(lambda state: torch.ones(1, dtype=torch.bool),))
    after = env.rand_step(env.reset())["next"]
    assert after["terminated"].all() and after["done"].all() and not after["truncated"].any()


def test_reward_is_the_clipped_sum_of_its_terms(build: Build) -> None:
    clipped = 0
    for full in run(build(6), 40)[0]:
        terms = torch.stack(list(full["next", keys.REWARD_TERMS].values())).sum(0)
        torch.testing.assert_close(full["next", "reward"], terms.clamp(min=0.0), atol=1e-6, rtol=0)
        clipped += int((terms < 0).sum())
    assert clipped > 0  # random actions cost enough to reach the clip


def test_a_term_is_logged_with_weight_and_time_step(build: Build) -> None:
    env = build(2, resample_period=None)
    env.set_commands(torch.tensor([0, 4]), torch.tensor([[0.5, 0.0, 0.2, 0.0, 0.3], [1.0, 0.1, 0.0, 0.5, 0.0]]))
    carrier = run(env, 10)[1]
    full = env.step(carrier.set(keys.ACTION, torch.zeros(2, 12)))["next"]
    terms, velocity = full[keys.REWARD_TERMS], full[keys.EXPLICIT][:, 1:] / 0.5
    rate = full[keys.MOTION][:, -1, 8] / 0.25
    error = (torch.tensor([[0.5, 0.0], [1.0, 0.1]]) - velocity[:, :2]).square().sum(-1)
    torch.testing.assert_close(terms["linear_velocity"][:, 0], 2.0 * 0.02 * torch.exp(-error / 0.25))
    turn = (torch.tensor([0.2, 0.0]) - rate).square()
    torch.testing.assert_close(terms["yaw_rate"][:, 0], 1.5 * 0.02 * torch.exp(-turn / 0.25))
    change = full[keys.PROPRIOCEPTION][:, 29:41] - carrier[keys.PROPRIOCEPTION][:, 29:41]
    torch.testing.assert_close(terms["action_smoothness"][:, 0], -0.1 * 0.02 * change.square().sum(-1))


def test_state_dict_restores_the_exact_continuation(build: Build) -> None:
    env = build(4, seed=1, **EVERYTHING)
    env.set_skill_probabilities(torch.tensor([0.1, 0.1, 0.1, 0.1, 0.6]))  # jumps show the memory of heights
    carrier = run(env, 13)[1]
    saved, carried = env.state_dict(), carrier.clone()
    expected = run(env, 40, carrier, 13)[0]
    assert torch.stack([step["next", "done"] for step in expected]).any()
    other = build(4, seed=2, **EVERYTHING)
    other.load_state_dict(saved)
    assert_same(expected, run(other, 40, carried.clone(), 13)[0])
    env.load_state_dict(saved)  # a saved state is not consumed by running on
    assert_same(expected, run(env, 40, carried.clone(), 13)[0])


def test_a_state_of_another_size_is_refused(build: Build) -> None:
    with pytest.raises(ValueError, match="resume with the simulator, the number of robots and the model"):
        build(2).load_state_dict(build(3).state_dict())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_a_broken_state_terminates_and_stays_finite(
    build: Build, value: float, tmp_path: Any, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)  # the engine writes MUJOCO_LOG.TXT
    env = build(3, rewards={**LOCOMOTION_REWARDS, "alive": RewardTerm(1.0, lambda state: torch.ones(3))})
    carrier = run(env, 3)[1]
    env.simulator.batch.bind("qpos")[1, 9] = value
    full, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, torch.zeros(3, 12)))
    after = full["next"]
    assert after["terminated"][1] and not after["truncated"][1] and after["reward"][1] == 0
    assert after[keys.REWARD_TERMS, "alive"][:, 0].tolist() == pytest.approx([0.02, 0.0, 0.02])
    assert not after["terminated"][[0, 2]].any()
    assert finite(after) and finite(carrier)
    for step in run(env, 10, carrier)[0]:
        assert finite(step)


def test_500_random_steps_stay_finite(build: Build) -> None:
    seen, _ = run(build(2, **EVERYTHING), 500)
    assert finite(torch.stack(seen))


def test_pushes_set_the_trunk_velocity(build: Build) -> None:
    env = build(50, push_interval=0.1, push_velocity=0.5)
    carrier = env.reset()
    phases = env.state_dict()["buffers"]["push_phase"]
    pushed = torch.zeros(10, 50, dtype=torch.bool)
    for step in range(10):
        before = env.simulator.root_linear_velocity
        carrier = env.step(carrier.set(keys.ACTION, torch.zeros(50, 12)))["next"]
        jump = (env.simulator.root_linear_velocity - before)[:, :2].norm(dim=-1)
        due = (step + phases) % 5 == 4
        pushed[step] = due
        assert jump[due].mean() > 4 * jump[~due].mean()
        assert env.simulator.root_linear_velocity[:, :2].abs().max() < 0.65
    assert (pushed.sum(0) == 2).all() and (pushed.float().mean(1) < 0.5).all()


def test_set_commands_holds_until_told_otherwise(build: Build) -> None:
    env = build(2, resample_period=None)
    skill, command = torch.tensor([2, 4]), torch.tensor([[1.0, 0.0, 0.5, 0.0, 0.3], [1.0, 0.0, 0.0, 0.5, 0.0]])
    env.set_commands(skill, command, torch.tensor([[0.25], [-1.0]]))
    seen, carrier = run(env, 5)
    for step in seen:
        assert torch.equal(step[keys.COMMAND][:, :5], command) and torch.equal(step[keys.SKILL], skill)
        assert step[keys.SHIFT][:, 0].tolist() == [0.25, -1.0]
        assert step[keys.COMMAND][:, 6:].argmax(-1).tolist() == [2, 4]
    env.set_commands(skill.flip(0), command.flip(0))
    assert env.step(carrier.set(keys.ACTION, torch.zeros(2, 12)))["next", keys.SKILL].tolist() == [4, 2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"push_interval": 0.0}, "push_interval must be at least a control step, or None for none; got 0 steps"),
        ({"rewards": {}}, "at least one reward term and one termination, got 0 and"),
        ({"terminations": ()}, "at least one reward term and one termination, got .* and 0"),
    ],
)
def test_what_cannot_be_an_environment_is_refused(build: Build, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build(1, **options)


def test_skills_follow_the_prior(build: Build) -> None:
    env = build(40)
    with pytest.raises(ValueError, match=r"expected \[5\] probabilities, got \[4\]"):
        env.set_skill_probabilities(torch.ones(4))
    assert RESAMPLE_PERIOD == 6.0
    env.set_skill_probabilities(torch.tensor([0.0, 0.0, 0.5, 0.5, 0.0]))
    assert set(env.reset()[keys.SKILL].tolist()) == {BEHAVIOURS.index("trot"), BEHAVIOURS.index("canter")}


def test_rough_ground(build: Build) -> None:
    field = rough_pyramids(torch.Generator().manual_seed(0), tiles=2, smooth_share=0.0, difficulties=(0.4,))
    env = build(16, simulator_options={"num_threads": 1, "terrain": field})
    first = env.reset()
    robots = env.simulator
    ground = field.height_at(robots.root_position[:, :2])
    assert ground.std() > 0.05 and robots.root_position[:, :2].abs().max() <= robots.ground_extent
    torch.testing.assert_close(first[keys.EXPLICIT][:, 0], robots.root_position[:, 2] - ground)
    # As high above the ground below its trunk as a robot that stands, but where a sole would then be in the ground.
    feet = kinematics.forward(robots.joint_position)
    feet = robots.root_position[:, None] + rotations.rotate(robots.root_quaternion[:, None], feet)
    below = field.height_at(feet[..., :2].flatten(0, 1)).view(16, 4)
    deepest = (feet[..., 2] - FOOT_RADIUS - below).amin(-1)
    height = first[keys.EXPLICIT][:, 0]
    lifted = height > STANDING_HEIGHT + 0.0051
    assert 0 < lifted.sum() < 16 and (deepest > 0.0049).all()
    torch.testing.assert_close(deepest[lifted], torch.full_like(deepest[lifted], 0.005), atol=1e-4, rtol=0)
    standing = torch.full_like(height[~lifted], STANDING_HEIGHT + 0.005)
    torch.testing.assert_close(height[~lifted], standing, atol=1e-4, rtol=0)
    for _ in range(30):
        after = env.step(TensorDict({keys.ACTION: torch.zeros(16, 12)}, [16]))["next"]
    height = after[keys.EXPLICIT][~after["terminated"][:, 0]][:, 0]
    assert len(height) > 8 and (height - STANDING_HEIGHT).abs().max() < 0.12


def test_who_comes_to_the_edge_of_the_ground_has_not_fallen(build: Build) -> None:
    """Robots that are carried off a small field: their episodes are cut while there is still ground under them."""
    field = rough_pyramids(torch.Generator().manual_seed(0), tiles=1, noise=0.0, difficulties=(0.0,))
    env = build(64, simulator_options={"num_threads": 1, "terrain": field})
    carrier = env.reset().set(keys.ACTION, torch.zeros(64, 12))
    place = env.simulator.root_position.clone()
    limit = env.simulator.ground_extent + EDGE
    assert limit == 4.0 and field.half_size == (5.0, 5.0)
    place[:, 0] = torch.linspace(0.0, 4.5, 64)
    place[:, 1] = torch.linspace(-4.5, 0.0, 64)
    env.simulator.reset(
        torch.ones(64, dtype=torch.bool),
        root_position=place,
        root_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(64, 1),
        root_linear_velocity=torch.zeros(64, 3),
        root_angular_velocity=torch.zeros(64, 3),
        joint_position=env.simulator.joint_position,
        joint_velocity=torch.zeros(64, 12),
    )
    after = env.step(carrier)["next"]
    beyond = (place[:, :2].abs() > limit).any(-1)
    assert 10 < beyond.sum() < 20
    assert torch.equal(after["truncated"][:, 0], beyond) and not after["terminated"].any()


def test_close_releases_the_engine(build: Build) -> None:
    for used in (False, True):
        env = build(1)
        if used:
            env.rollout(1)
        assert hasattr(env.simulator, "batch")
        env.close()
        assert env.is_closed and not hasattr(env.simulator, "batch")
        env.close()


def test_actions_with_gradients_are_taken(build: Build) -> None:
    env = build(2)
    action = torch.zeros(2, 12, requires_grad=True)
    found = env.step(env.reset().set(keys.ACTION, 2.0 * action))["next"]
    assert not any(value.requires_grad for value in found.values(True, True))


def test_commands_of_another_shape_are_refused(build: Build) -> None:
    env = build(3)
    skill, command = torch.zeros(3, dtype=torch.int64), torch.zeros(3, 5)
    message = r"expected skill, command and shift of \[\[3\], \[3, 5\], \[3, 1\]\], got \[\[3\], \[3, 5\], \[3\]\]"
    with pytest.raises(ValueError, match=message):
        env.set_commands(skill, command, torch.zeros(3))
    assert env.commands.vector().shape == (3, 11)


def test_a_simulator_of_another_size_is_refused(build: Build) -> None:
    with pytest.raises(ValueError, match=r"simulator or simulator_options, got both, with \['sim_dt'\]"):
        build(2, simulator=make_simulator(num_simulations=2), simulator_options={"sim_dt": 0.01})
    with pytest.raises(ValueError, match="holds 2 robots, expected 3"):
        build(3, simulator=make_simulator(num_simulations=2, num_threads=1))
