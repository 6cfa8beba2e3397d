"""Students where they are evaluated: their camera and memory, and the disturbances of both."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from rich.console import Console
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.deploy.task import describe_camera
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.modules.student import NEXT_HIDDEN

Module = Callable[[str], ModuleType]
PERFECT = {"frame_steps": 1, "latency": [1, 1], "pitch": 0.0, "offset_noise": 0.0, "pixel_noise": 0.0}


@pytest.fixture
def deciders(module: Module) -> ModuleType:
    return module("deciders")


@pytest.fixture
def disturbances(module: Module) -> ModuleType:
    return module("disturbances")


@pytest.fixture
def perfect(module: Module, make_student: Callable[..., Path], deciders: ModuleType, untrained: Path) -> Any:
    """A student whose camera errs in nothing, which decides every second control step."""
    camera = describe_camera() | {"training": PERFECT}
    return deciders.load_decider(make_student(camera=camera), untrained)


def env_of(module: Module, decider: Any, **options: Any) -> AgilityEnv:
    options = {"start": "first", "command_noise": (1.0, 1.0), "simulator_options": {"num_threads": 1}} | options
    return AgilityEnv(3, module("tsc_setup").frozen(decider.controller), COURSES["bar_jump"], **options)


def test_a_student_knows_where_obstacles_stand_on_its_own_course(perfect: Any) -> None:
    assert perfect.knows(COURSES["bar_jump"]) and perfect.knows(COURSES["box"]), "there is only one to find"
    assert not perfect.knows(COURSES["full"])
    perfect.student.settings["routes"] = [[list(leg) for leg in route] for route in COURSES["full"].legs]
    assert perfect.knows(COURSES["full"]) and not perfect.knows(COURSES["hurdles"])
    perfect.student.settings["routes"] = None
    assert perfect.knows(COURSES["hurdles"]), "who knows no places is not lost by them"


def test_an_evaluated_student_does_what_it_would_in_an_environment_with_a_camera(
    module: Module, disturbances: ModuleType, perfect: Any
) -> None:
    """The evaluation steps every 20 ms and looks when a decision is due; the environment of the training holds it."""
    never = {"never": lambda state: state.at_goal & False}
    options: dict[str, Any] = {"episode_length": 0.24, "seed": 3, "terminations": never}
    env = env_of(module, perfect, decision_steps=2, depth=PERFECT | {"latency": (1, 1)}, **options)
    td, hidden = env.reset(), perfect.student.initial_hidden(3)
    expected, seen = [], []
    for step in range(6):
        seen.append(td[keys.DEPTH].clone())
        td = td.set(keys.HIDDEN, hidden).set("is_init", torch.full((3, 1), step == 0))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = perfect.decide(td)
        hidden = td[NEXT_HIDDEN]
        td = env.step(td.select(keys.ACTION))["next"]
        expected.append(env.simulator.root_position.clone())
    env.close()
    assert (seen[0] - seen[-1]).abs().max() > 0.01, "else it would not matter when the camera looks"
    env = env_of(module, perfect, **options)
    still = disturbances.Disturbance("still", pitch=0.0)
    rollouts = module("course_rollouts")
    episodes = rollouts.record_episodes(env, perfect, torch.ones(3, dtype=torch.int64), disturbance=still)
    assert [episode.cause for episode in episodes] == ["time"] * 3
    got = torch.stack([episode.steps["position"][1::2] for episode in episodes], 1)
    torch.testing.assert_close(got, torch.stack(expected), atol=1e-5, rtol=0)
    late = disturbances.Disturbance("late", late=3, pitch=0.0)
    env = env_of(module, perfect, **options)
    other = rollouts.record_episodes(env, perfect, torch.ones(3, dtype=torch.int64), disturbance=late)
    assert any(not torch.equal(a.path, b.path) for a, b in zip(episodes, other)), "a late camera changes decisions"


def test_memory_begins_anew_with_an_episode_and_only_where_a_decision_was_due(
    module: Module, disturbances: ModuleType, perfect: Any
) -> None:
    env = env_of(module, perfect)
    env.reset()
    senses = perfect.senses(env, disturbances.DISTURBANCES["none"], 0)
    senses.begin(torch.ones(3, dtype=torch.bool))
    rows = torch.tensor([True, False, True])
    written = TensorDict({NEXT_HIDDEN: torch.ones(2, senses.hidden.shape[1])}, [2])
    senses.remember(written, rows)
    assert senses.hidden.mean(-1).tolist() == [1.0, 0.0, 1.0]
    assert senses.is_init[:, 0].tolist() == [False, True, False]
    senses.begin(torch.tensor([True, False, False]))
    td = senses.observe(TensorDict({}, [2]), rows)
    assert td["is_init"][:, 0].tolist() == [True, False] and td[keys.DEPTH].shape == (2, 58, 87)
    env.close()


def test_disturbances_by_hand(disturbances: ModuleType, generator: torch.Generator) -> None:
    images = torch.zeros(200, 58, 87)
    chosen = disturbances.chosen(("all",))
    assert list(chosen) == ["none", "rectangles", "noise", "blur", "dropout", "late_1", "late_2", "pitch"]
    for name in ("none", "late_1", "late_2", "pitch"):
        assert torch.equal(chosen[name].images(generator)(images), images)
    assert chosen["noise"].images(generator)(images).std() == pytest.approx(0.02, rel=0.02)
    stronger = disturbances.chosen(("noise", "dropout"), 4)
    assert stronger["noise"].images(generator)(images).std() == pytest.approx(0.04, rel=0.02)
    dropped = (stronger["dropout"].images(generator)(images) == -0.5).float().mean()
    assert dropped == pytest.approx(1.0 - 0.95**4, abs=0.005)
    covered = (chosen["rectangles"].images(generator)(images) != 0.0).flatten(1).any(-1)
    assert covered.all(), "every image has its rectangle"
    edge = images.index_fill(2, torch.arange(40), 0.5)
    assert not torch.equal(chosen["blur"].images(generator)(edge), edge)
    training = {"latency": [1, 2], "pitch": 0.2, "pixel_noise": 0.05}
    assert chosen["late_2"].camera(training) == {"latency": (3, 4), "pitch": math.radians(1.0), "pixel_noise": 0.05}
    assert chosen["pitch"].camera(training)["pitch"] == pytest.approx(math.radians(5.0))
    with pytest.raises(ValueError, match="unknown disturbance 'fog'; expected all, or some of none, rectangles"):
        disturbances.chosen(("fog",))
    with pytest.raises(ValueError, match="--strength of at least 1, got 0"):
        disturbances.chosen(("noise",), 0)


def test_a_student_is_evaluated_under_disturbance(
    module: Module, make_student: Callable[..., Path], untrained: Path, untrained_teacher: Path
) -> None:
    recipe, run = module("evaluate_course"), make_student()
    options: dict[str, Any] = {"bbc": untrained, "episodes": 2, "robots": 2, "episode_length": 0.2, "num_threads": 1}
    console = Console(file=StringIO(), width=200)
    recipe.evaluate(recipe.Config(run, disturbance=("none", "noise"), **options), console)
    found = json.loads((run / "course_evaluation.json").read_text())
    assert found["kind"] == "student" and list(found["courses"]) == ["bar_jump", "bar_jump, white noise"]
    assert all(entry["episodes"] == 2 for entry in found["courses"].values())
    names = {path.name for path in (run / "figures").iterdir()}
    assert names == {"course_bar_jump.png", "course_bar_jump_noise.png", "course_behaviours.png"}
    with pytest.raises(ValueError, match="teacher has no camera to disturb; give a student"):
        recipe.evaluate(recipe.Config(untrained_teacher, disturbance=("noise",), **options), console)
    with pytest.raises(ValueError, match=r"--misjudgement: .* misjudges its place by itself; give a teacher"):
        recipe.evaluate(recipe.Config(run, misjudgement=1.0, **options), console)
    with pytest.raises(ValueError, match=r"--misjudgement: .* nothing to do about an unseen obstacle; give a teacher"):
        recipe.evaluate(recipe.Config(script="trot:1.0", misjudgement=1.0, **options), console)
    wrong = make_student("wrong", camera=describe_camera() | {"depth_range": [0.3, 2.0]})
    with pytest.raises(ValueError, match=r"images of depth_range \[0.3, 2.0\], this code's camera has \[0.3, 4.0\]"):
        recipe.evaluate(recipe.Config(wrong, **options), console)
