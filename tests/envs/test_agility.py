"""The course environment on the real engine: specs, determinism, resets, ends, rewards, decisions, continuation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from agility_rl import keys
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.envs.agility import COURSE_RANDOMIZATION
from agility_rl.envs.agility_rewards import AGILITY_REWARDS, AgilityTerm
from agility_rl.simulation import make_simulator

Build = Callable[..., AgilityEnv]
EVERYTHING: dict[str, Any] = {
    "randomization": COURSE_RANDOMIZATION,
    "observation_noise": 1.0,
    "push_interval": 0.1,
    "episode_length": 0.4,
    "decision_steps": 2,
}
"""All randomness there is, often."""


def sway(td: TensorDictBase) -> TensorDictBase:
    """A controller that depends on everything a real one reads, and keeps the robots on their feet for a while."""
    history = td[keys.HISTORY].mean(1)[:, 5:17]
    action = 0.3 * torch.sin(5.0 * history + td[keys.COMMAND].sum(-1, keepdim=True)) + td[keys.PEAK]
    return td.set(keys.ACTION, action)


@pytest.fixture
def build() -> Iterator[Build]:
    """Make an :class:`AgilityEnv` on one thread; options as its constructor takes them."""
    made: list[AgilityEnv] = []

    def make(num_robots: int = 4, controller: Any = sway, **options: Any) -> AgilityEnv:
        if "simulator" not in options:
            options.setdefault("simulator_options", {"num_threads": 1})
        made.append(AgilityEnv(num_robots, controller, **options))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)


def decide(n: int, step: int) -> TensorDict:
    generator = torch.Generator().manual_seed(step)
    return TensorDict(
        {
            keys.BEHAVIOUR: torch.randint(5, (n,), generator=generator),
            keys.PARAMETERS: torch.randn(n, 5, 6, generator=generator),
        },
        [n],
    )


def run(
    env: AgilityEnv, steps: int, carrier: TensorDictBase | None = None, offset: int = 0
) -> tuple[list[TensorDict], TensorDictBase]:
    """Steps with given decisions and resets, as a collector does them."""
    carrier = env.reset() if carrier is None else carrier
    seen = []
    for step in range(offset, offset + steps):
        full, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, decide(env.num_robots, step)))
        seen.append(full.clone())
    return seen, carrier


def assert_same(one: list[TensorDict], other: list[TensorDict]) -> None:
    for a, b in zip(one, other, strict=True):
        for name, value in a.items(include_nested=True, leaves_only=True):
            assert torch.equal(value, b[name]), name


@pytest.mark.parametrize("course", ["full", "hurdles", "box"])
def test_specs(build: Build, course: str) -> None:
    check_env_specs(build(3, course=COURSES[course], **EVERYTHING), break_when_any_done="both", seed=0)


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
        keys.MOTION: (2, 49),
        keys.HEADING_ERROR: (2,),
        keys.PLACE: (8,),
        keys.OBSTACLE: (7,),
        keys.SCANDOTS: (132,),
        (keys.OUTCOME, "success"): (1,),
        (keys.OUTCOME, "passed"): (7,),
        (keys.TERMINATIONS, "lost"): (1,),
        (keys.REWARD_TERMS, "termination"): (1,),
    }
    for key, shape in shapes.items():
        assert rollout[key].shape == rollout["next", key].shape == (2, 3, *shape), key
    assert rollout[keys.ACTION, keys.PARAMETERS].shape == (2, 3, 5, 6)
    assert set(rollout["next", keys.REWARD_TERMS].keys()) == {*AGILITY_REWARDS, "termination"}


def test_the_fastest_canter_reaches_the_controller(build: Build) -> None:
    env = build(2, command_noise=(1.0, 1.0), fastest_canter=3.2)
    decision = {keys.BEHAVIOUR: torch.tensor([3, 2]), keys.PARAMETERS: torch.ones(2, 5, 6)}
    after = env.step(env.reset().set(keys.ACTION, TensorDict(decision, [2])))["next"]
    assert after[keys.COMMAND][:, 0].tolist() == pytest.approx([3.2, 1.5])
    with pytest.raises(ValueError, match=r"fastest canter: expected more than 0.8 and at most 5 m/s, got 7"):
        build(2, fastest_canter=7.0)


def test_the_number_of_threads_changes_nothing(build: Build) -> None:
    one, two = (run(build(5, simulator_options={"num_threads": n}, **EVERYTHING), 25)[0] for n in (1, 2))
    assert_same(one, two)
    assert torch.stack([step["next", "done"] for step in one]).any()


def test_seeds_reproduce_and_the_global_generator_is_left_alone(build: Build) -> None:
    before = torch.get_rng_state()
    first = run(build(3, seed=4, **EVERYTHING), 12)[0]
    assert_same(first, run(build(3, seed=4, **EVERYTHING), 12)[0])
    other = build(3, seed=5, **EVERYTHING)
    assert not torch.equal(first[0][keys.SCANDOTS], run(other, 12)[0][0][keys.SCANDOTS])
    assert torch.equal(torch.get_rng_state(), before)


def test_partial_reset_leaves_the_other_rows_bit_identical(build: Build) -> None:
    env = build(4, **EVERYTHING)
    carrier = run(env, 3)[1].exclude(keys.ACTION)
    before = carrier.clone()
    state = env.simulator.state_dict()["state"]
    position = env.arena.layout.position
    mask = torch.tensor([False, True, False, True])
    after = env.reset(carrier.set("_reset", mask[:, None]))
    for name, value in before.items(include_nested=True, leaves_only=True):
        assert torch.equal(after[name][~mask], value[~mask]), name
    now = env.simulator.state_dict()["state"]
    assert torch.equal(now[~mask], state[~mask]) and not torch.equal(now[mask], state[mask])
    moved = env.arena.layout.position
    assert torch.equal(moved[~mask], position[~mask]) and not torch.equal(moved[mask], position[mask])
    raw = env._reset(TensorDict({"_reset": torch.zeros(4, 1, dtype=torch.bool)}, [4]))  # its own answer, not merged
    for name in (keys.SCANDOTS, keys.HEADING_ERROR, keys.OBSTACLE, keys.HISTORY, keys.COMMAND):
        assert torch.equal(raw[name], after[name]), name


def test_other_rows_go_on_as_if_nothing_had_been_reset(build: Build) -> None:
    one, two = (build(2, command_noise=(1.0, 1.0)) for _ in range(2))
    carriers = [run(env, 5)[1] for env in (one, two)]
    carriers[0] = one.reset(carriers[0].exclude(keys.ACTION).set("_reset", torch.tensor([[True], [False]])))
    futures = [run(env, 8, carrier, 5)[0] for env, carrier in zip((one, two), carriers, strict=True)]
    assert_same([step[1:] for step in futures[0]], [step[1:] for step in futures[1]])


def test_time_limit_truncates_and_fails_the_obstacle_without_terminating(build: Build) -> None:
    env = build(2, episode_length=0.12, decision_steps=2, terminations={"never": lambda state: state.at_goal & False})
    flags = []
    for step in run(env, 6)[0]:
        after = step["next"]
        assert not after["terminated"].any() and torch.equal(after["done"], after["truncated"])
        flags.append(after["truncated"].all().item())
        failed = after[keys.OUTCOME, "failed"]
        assert torch.equal(failed.any(-1), after["done"][:, 0])
        assert torch.equal(failed.float()[after["done"][:, 0]], step[keys.OBSTACLE][after["done"][:, 0]])
    assert flags == [False, False, True] * 2


def carry(env: AgilityEnv, *points: tuple[float, float]) -> list[TensorDictBase]:
    """Hold the robots at points of their current obstacle's frame, three steps each."""
    seen = []
    simulator = env.simulator
    everyone = torch.ones(env.num_robots, dtype=torch.bool)
    for point in points:
        for _ in range(3):
            place = env.arena.layout.world(env.arena.progress.obstacle, torch.tensor([point]).repeat(env.num_robots, 1))
            simulator.reset(
                everyone,
                root_position=torch.cat((place, torch.full((env.num_robots, 1), 3.0)), -1),
                root_quaternion=simulator.root_quaternion,
                root_linear_velocity=torch.zeros(env.num_robots, 3),
                root_angular_velocity=torch.zeros(env.num_robots, 3),
                joint_position=simulator.joint_position,
                joint_velocity=simulator.joint_velocity,
            )
            seen.append(env.step(TensorDict({keys.ACTION: decide(env.num_robots, 0)}, [env.num_robots]))["next"])
            if seen[-1]["done"].all():
                return seen
    return seen


def test_success_is_a_truncation_and_names_its_obstacle(build: Build) -> None:
    env = build(2, course=COURSES["tunnel"])
    env.reset()
    seen = carry(env, (-2.025, 0.0), (-1.525, 0.0), (1.0, 0.0), (1.525, 0.0))
    last, outcome = seen[-1], seen[-1][keys.OUTCOME]
    assert last["truncated"].all() and not last["terminated"].any()
    assert outcome["success"].all() and outcome["finished"].all() and not outcome["failed"].any()
    assert outcome["passed"].int().argmax(-1).tolist() == [5, 5] and not outcome["bypassed"].any()
    assert not torch.stack([step[keys.OUTCOME, "passed"].any() for step in seen[:-1]]).any()
    at_goal = torch.stack([step[keys.REWARD_TERMS, "reach_goal"][:, 0] for step in seen])
    assert (at_goal[:2] == 5.0 * 0.02).all()


def test_walking_around_finishes_without_success(build: Build) -> None:
    env = build(2, course=COURSES["tunnel"])
    env.reset()
    around = (-2.025, 0.0), (-1.525, 0.0), (-0.5, 0.8), (0.5, 0.8), (1.0, 0.0), (1.525, 0.0)
    outcome = carry(env, *around)[-1][keys.OUTCOME]
    assert outcome["finished"].all() and not outcome["success"].any()
    assert outcome["bypassed"].any(-1).all() and not outcome["passed"].any()


def test_who_loses_the_way_fails(build: Build) -> None:
    env = build(1, course=COURSES["tunnel"])
    env.reset()
    last = carry(env, (2.5, 0.0))[-1]
    assert last["terminated"].all() and last[keys.TERMINATIONS, "lost"].all()
    assert not last[keys.TERMINATIONS, "body_contact"].any()
    assert last[keys.REWARD_TERMS, "termination"].item() == pytest.approx(-50.0 * 0.02)
    assert last["reward"].item() == pytest.approx(-1.0, abs=0.2)
    assert last[keys.OUTCOME, "failed"].int().argmax(-1).tolist() == [5]


def test_reward_is_the_clipped_sum_of_its_terms_and_the_punishment(build: Build) -> None:
    clipped = punished = 0
    kick = torch.tensor([0.0, 6.0, 0.0] * 4)  # throws the thighs back, so that everybody falls
    for full in run(build(6, lambda td: td.set(keys.ACTION, kick.repeat(6, 1))), 40)[0]:
        terms = full["next", keys.REWARD_TERMS]
        course = torch.stack([terms[name] for name in AGILITY_REWARDS]).sum(0)
        torch.testing.assert_close(full["next", "reward"], course.clamp(min=0.0) + terms["termination"])
        clipped += int((course < 0).sum())
        punished += int((terms["termination"] < 0).sum())
        assert torch.equal(terms["termination"] < 0, full["next", "terminated"])
    assert clipped > 0 and punished > 0


def test_a_held_decision_is_the_sum_of_its_steps(build: Build) -> None:
    """Without noise, k steps of one decision bring what the same decision brings in k single steps."""
    held, single = (build(3, decision_steps=k, command_noise=(1.0, 1.0), seed=3) for k in (4, 1))
    a, b = held.reset(), single.reset()
    for step in range(3):
        decision = decide(3, step)
        a = held.step(a.set(keys.ACTION, decision))["next"]
        rewards, running = torch.zeros(3, 1), torch.ones(3, 1, dtype=torch.bool)
        for _ in range(4):
            b = single.step(b.set(keys.ACTION, decision))["next"]
            rewards, running = rewards + b["reward"] * running, running & ~b["done"]
        torch.testing.assert_close(a["reward"], rewards)
        assert torch.equal(a["done"], ~running)
        assert torch.equal(a[keys.SCANDOTS], b[keys.SCANDOTS]) and torch.equal(a[keys.MOTION], b[keys.MOTION])


def test_the_controller_reads_the_decision_and_gets_no_gradient(build: Build) -> None:
    seen: list[TensorDictBase] = []

    def controller(td: TensorDictBase) -> TensorDictBase:
        assert not torch.is_grad_enabled()
        seen.append(td.clone())
        return sway(td)

    env = build(2, controller, command_noise=(1.0, 1.0), decision_steps=3)
    td = env.reset()
    action = TensorDict({keys.BEHAVIOUR: torch.tensor([4, 2]), keys.PARAMETERS: torch.zeros(2, 5, 6)}, [2])
    after = env.step(td.set(keys.ACTION, action))["next"]
    assert len(seen) == 3
    for given in seen:
        expected = torch.tensor([[1.3, 0.0, 0.0, 0.5, 0.0], [1.0, 0.0, 0.0, 0.0, 0.295]])
        torch.testing.assert_close(given[keys.COMMAND][:, :5], expected)
        assert given[keys.SKILL].tolist() == [4, 2] and given[keys.PEAK][1] == 0.0 and given[keys.PEAK][0] > 0.2
    assert torch.equal(after[keys.COMMAND], seen[-1][keys.COMMAND])


def test_state_dict_restores_the_exact_continuation(build: Build) -> None:
    env = build(4, seed=1, **EVERYTHING)
    env.set_curriculum(difficulty=0.5, obstacles=3, start_weights=torch.arange(1.0, 7.0))
    carrier = run(env, 5)[1]
    saved, carried = env.state_dict(), carrier.clone()
    expected = run(env, 25, carrier, 5)[0]
    assert torch.stack([step["next", "done"] for step in expected]).any()
    other = build(4, seed=2, **EVERYTHING)
    other.load_state_dict(saved)
    assert_same(expected, run(other, 25, carried.clone(), 5)[0])
    env.load_state_dict(saved)  # a saved state is not consumed by running on
    assert_same(expected, run(env, 25, carried.clone(), 5)[0])


@pytest.mark.filterwarnings("ignore")
def test_a_broken_state_terminates_and_stays_finite(build: Build, tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)  # the engine writes MUJOCO_LOG.TXT
    rewards = {**AGILITY_REWARDS, "alive": AgilityTerm(1.0, lambda state: torch.ones(3))}
    env = build(3, decision_steps=2, rewards=rewards)
    carrier = run(env, 2)[1]
    env.simulator.batch.bind("qpos")[1, 9] = float("nan")  # type: ignore[attr-defined]
    full, carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, decide(3, 0)))
    after = full["next"]
    assert after["terminated"][1] and after[keys.TERMINATIONS, "diverged"][1] and not after["truncated"][1]
    assert after["reward"][1].item() == pytest.approx(-50.0 * 0.02), "the punishment alone"
    assert after[keys.REWARD_TERMS, "alive"][:, 0].tolist() == pytest.approx([0.04, 0.0, 0.04])
    for td in (after, carrier, *run(env, 5, carrier)[0]):
        assert all(bool(torch.isfinite(value).all()) for value in td.values(True, True))


def test_many_random_steps_stay_finite_and_drop_nobody_through_the_floor(build: Build) -> None:
    env = build(4, randomization=COURSE_RANDOMIZATION, push_interval=0.5)
    seen = torch.stack(run(env, 200)[0])
    assert all(bool(torch.isfinite(value).all()) for value in seen.values(True, True))
    assert not seen["next", keys.TERMINATIONS, "sunk"].any() and not seen["next", keys.TERMINATIONS, "diverged"].any()


def test_pushes_set_the_trunk_velocity(build: Build) -> None:
    """In an interval of five control steps, each robot is pushed once."""
    env = build(20, lambda td: td.set(keys.ACTION, torch.zeros(20, 12)), course=COURSES["tunnel"], push_interval=0.1)
    carrier = env.reset()
    phases = env.state_dict()["push_phase"]
    for step in range(5):
        before = env.simulator.root_linear_velocity
        carrier = env.step(carrier.set(keys.ACTION, decide(20, step)))["next"]
        jump = (env.simulator.root_linear_velocity - before)[:, :2].norm(dim=-1)
        due = (step + phases) % 5 == 4
        assert jump[due].mean() > max(0.1, 4 * jump[~due].mean())


def test_decisions_with_gradients_keep_no_graph(build: Build) -> None:
    env = build(2)
    carrier = env.reset()
    for _ in range(3):
        decision = env.action_spec.rand()
        decision[keys.ACTION, keys.PARAMETERS].requires_grad_()
        carrier = env.step(carrier.update(decision))["next"]
    assert not any(value.requires_grad for value in carrier.values(True, True))
    assert not env.decisions.parameters.requires_grad


def test_wrong_arguments_are_refused(build: Build) -> None:
    with pytest.raises(ValueError, match="holds 2 robots, expected 3"):
        build(3, simulator=make_simulator(num_simulations=2, num_threads=1))
    with pytest.raises(ValueError, match=r"simulator or simulator_options, got both, with \['sim_dt'\]"):
        build(2, simulator=make_simulator(num_simulations=2), simulator_options={"sim_dt": 0.01})
    with pytest.raises(ValueError, match="must hold scenery\\(course\\) of 'full'"):
        build(2, simulator=make_simulator(num_simulations=2, num_threads=1))
    with pytest.raises(ValueError, match="decision_steps"):
        build(1, decision_steps=0)
    with pytest.raises(TypeError, match=r"expected a Course, such as .*, got str 'full'"):
        build(1, course="full")


def test_close_releases_the_engine(build: Build) -> None:
    env = build(1)
    env.close()
    assert env.is_closed and not hasattr(env.simulator, "batch")
