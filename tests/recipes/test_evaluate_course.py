"""Evaluation on courses as a user runs it, and its numbers on episodes that are known by hand."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from rich.console import Console
from tensordict import TensorDict

from agility_rl.deploy.artifact import Artifact
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES, SEESAW_TILT
from agility_rl.record.footprint import footprint

TUNNEL = list(OBSTACLES).index("tunnel")
Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("evaluate_course")


@pytest.fixture
def rollouts(module: Module) -> ModuleType:
    return module("course_rollouts")


@pytest.fixture
def deciders(module: Module) -> ModuleType:
    return module("deciders")


@pytest.fixture
def judgement(module: Module) -> ModuleType:
    return module("course_judgement")


@pytest.fixture
def teacher(untrained_teacher: Path) -> Path:
    return untrained_teacher


@pytest.fixture
def config(recipe: ModuleType, teacher: Path, untrained: Path) -> Any:
    return recipe.Config(teacher, bbc=untrained, episodes=3, robots=2, episode_length=0.3, num_threads=1)


def screen() -> Console:
    return Console(file=StringIO(), width=200)


def episode(rollouts: ModuleType, course: str = "tunnel", **changes: Any) -> Any:
    """Ten control steps at 1 m/s along y."""
    position = torch.stack((torch.full((10,), 2.0), 1.0 + 0.02 * torch.arange(1.0, 11.0), torch.full((10,), 0.3)), -1)
    steps = {
        "position": position,
        "behaviour": torch.full((10,), 2),
        "obstacle": torch.full((10,), TUNNEL),
        "touching": torch.zeros(10, 8, dtype=torch.bool),
    }
    steps |= {name: changes.pop(name) for name in list(changes) if name in steps}
    none = torch.zeros(len(OBSTACLES), dtype=torch.int64)
    fields = {"passed": none, "bypassed": none, "failed": none, "cause": ""} | changes
    layout = CourseLayout(COURSES[course], 1, torch.Generator()).state_dict()
    start = torch.tensor([2.0, 1.0, 0.3])
    return rollouts.Episode(start=start, steps=TensorDict(steps, [10]), layout=layout, **fields)


def at(index: int) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.tensor(index), len(OBSTACLES))


def test_a_teacher_is_evaluated_on_its_course(recipe: ModuleType, config: Any, teacher: Path) -> None:
    console = screen()
    recipe.evaluate(config, console)
    printed = console.file.getvalue()
    assert "bar_jump: success" in printed and "FAIL" in printed and "0 of 1 targets reached" in printed
    found = json.loads((teacher / "course_evaluation.json").read_text())
    assert found["format"] == "agility_rl.course_evaluation" and found["decision_period"] == pytest.approx(0.04)
    assert found["weights"] == Artifact.load(teacher / "policy").manifest["weights"]["sha256"]
    bar = found["courses"]["bar_jump"]
    assert bar["episodes"] == 3 and bar["success"]["estimate"] == 0.0 and bar["time"] is None
    assert sum(bar["causes"].values()) == 3
    obstacle = bar["obstacles"]["bar_jump"]
    assert obstacle["met"] == 3 and sum(obstacle["causes"].values()) == 3
    assert sum(obstacle["behaviours"].values()) == pytest.approx(1.0, abs=1e-5)
    assert {path.name for path in (teacher / "figures").iterdir()} == {"course_bar_jump.png", "course_behaviours.png"}


def test_a_script_needs_no_teacher_and_a_course_may_be_a_file(
    recipe: ModuleType, config: Any, tmp_path: Path, untrained: Path
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('name = "my course"\nsize = [4.0, 7.0]\n[[slots]]\nobstacle = "seesaw"\nposition = [2.0, 3.5]\n'
                    "yaw_degrees = 90.0\n")  # fmt: skip
    (tmp_path / "other").mkdir()
    other = shutil.copy(file, tmp_path / "other" / "mine.toml")
    courses = (str(file), "box", str(other))
    scripted = replace(config, run=None, script="canter:1.4", output=tmp_path / "out", course=courses)
    found = recipe.evaluate(scripted, screen())
    assert tuple(found["courses"]) == courses and found["weights"] is None
    assert found["behaviours"] == ("canter",)
    assert found["courses"]["box"]["obstacles"]["box_jump"]["behaviours"]["canter"] == 1.0
    assert [row["name"] for row in found["targets"]] == ["box: success"]
    pictures = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    assert {"course_box.png", "course_behaviours.png"} < pictures and len(pictures) == 4
    assert all("mine.png" in name for name in pictures - {"course_box.png", "course_behaviours.png"})


def test_a_script_may_canter_faster(recipe: ModuleType, config: Any, tmp_path: Path) -> None:
    scripted = replace(config, run=None, script="canter:2.8", fastest_canter=3.0, output=tmp_path, course=("hurdles",))
    assert recipe.evaluate(scripted, screen())["fastest_canter"] == 3.0


def test_fewer_behaviours(deciders: ModuleType, teacher: Path, untrained: Path) -> None:
    decider = deciders.load_decider(teacher, untrained, ("jump",))
    sizes = {"proprioception": (45,), "history": (10, 45), "heading_error": (2,), "obstacle": (7,), "scandots": (132,)}
    sizes["place"] = (8,)
    td = TensorDict({name: torch.randn(50, *size) for name, size in sizes.items()}, [50])
    assert set(decider.decide(td)["action", "behaviour"].tolist()) == {4}
    free = deciders.load_decider(teacher, untrained, None)
    assert (decider.behaviours, len(free.behaviours)) == (("jump",), 5)
    assert len(set(free.decide(td)["action", "behaviour"].tolist())) > 1, "else the line above would show nothing"


def test_a_held_decision_is_what_the_environment_would_hold(
    deciders: ModuleType, rollouts: ModuleType, recipe: ModuleType, untrained: Path
) -> None:
    decider = replace(deciders.load_script("trot:1.2", untrained), decision_steps=5)
    options: dict[str, Any] = {"start": "first", "command_noise": (1.0, 1.0), "episode_length": 0.4, "seed": 3}
    options |= {"simulator_options": {"num_threads": 1}, "terminations": {"never": lambda state: state.at_goal & False}}
    held = AgilityEnv(3, recipe.frozen(decider.controller), COURSES["tunnel"], decision_steps=5, **options)
    td = held.reset()
    expected = []
    for _ in range(4):
        td = held.step(decider.decide(td))["next"]
        expected.append(held.simulator.root_position.clone())
    held.close()
    env = AgilityEnv(3, recipe.frozen(decider.controller), COURSES["tunnel"], decision_steps=1, **options)
    episodes = rollouts.record_episodes(env, decider, torch.ones(3, dtype=torch.int64))
    env.close()
    assert [episode.cause for episode in episodes] == ["time"] * 3
    got = torch.stack([episode.steps["position"][4::5] for episode in episodes], 1)
    assert torch.equal(got, torch.stack(expected))
    with pytest.raises(ValueError, match="decides at every control step, got 5"):
        rollouts.record_episodes(held, decider, torch.ones(3))


def test_every_robot_gives_its_share_of_whole_episodes(
    deciders: ModuleType, rollouts: ModuleType, recipe: ModuleType, untrained: Path
) -> None:
    """Half of the episodes end at once; whoever counted the first 16 to finish would hardly see the other half."""
    decider = deciders.load_script("walk:0.3", untrained)
    env = AgilityEnv(
        4,
        recipe.frozen(decider.controller),
        COURSES["tunnel"],
        simulator_options={"num_threads": 1},
        terminations={"right half": lambda state: state.position[:, 0] > 2.0},
        start="first",
        episode_length=0.6,
        seed=5,
    )
    quota = rollouts.shares(16, 4)
    seen: list[None] = []
    episodes = rollouts.record_episodes(env, decider, quota, lambda: seen.append(None))
    env.close()
    assert len(episodes) == len(seen) == 16
    late = [episode for episode in episodes if episode.cause == "time"]
    assert 4 <= len(late) <= 12 and {len(episode.steps) for episode in late} == {30}
    for one in episodes:
        right = one.steps["position"][:, 0] > 2.0
        assert one.cause == ("right half" if right.any() else "time")
        assert not right[:-1].any() and one.failed[TUNNEL] == 1
        assert (one.path[1] - one.path[0]).norm() < 0.05, "a path starts where its own episode did"
    assert rollouts.shares(10, 4).tolist() == [3, 3, 2, 2] and rollouts.shares(3, 8).tolist() == [1, 1, 1]


def test_speeds_by_hand(judgement: ModuleType) -> None:
    def path(*pieces: tuple[int, float, float]) -> torch.Tensor:
        moves = [torch.tensor([[x, y]]).repeat(steps, 1) * 0.02 for steps, x, y in pieces]
        return torch.cat((torch.zeros(1, 2), *moves)).double().cumsum(0)

    assert judgement.speeds(path((25, 0.0, 1.5))) == pytest.approx((1.5, 1.5))
    assert judgement.speeds(path((3, 2.0, 0.0))) == pytest.approx((2.0, 2.0))
    # 0.4 s at 1 m/s and 0.2 s at 3 m/s: 1.0 m in 0.6 s
    assert judgement.speeds(path((20, 1.0, 0.0), (10, 3.0, 0.0))) == pytest.approx((1.0 / 0.6, 3.0))
    assert judgement.speeds(path((10, 1.0, 0.0), (10, 0.0, 1.0))) == pytest.approx((1.0, 1.0))  # round a corner
    # a sway of 3 m/s to and fro in every 0.1 s leads nowhere: half of it is left in no speed
    sway = [(5, 1.0, 3.0), (5, 1.0, -3.0)] * 4
    assert judgement.speeds(path(*sway)) == pytest.approx((1.0, 1.0), abs=1e-6)
    goals = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 2.0]])
    assert judgement.route_length(torch.tensor([[0.0, 0.0], [9.0, 9.0], [1.0, 1.6]]), goals) == pytest.approx(2.6)


def test_a_summary_by_hand(rollouts: ModuleType, judgement: ModuleType) -> None:
    flags = torch.zeros(10, 8, dtype=torch.bool)
    flags[2:4, 0] = flags[6, 0] = flags[3:, 5] = True  # two touches of one thigh, one of a calf
    mixed = torch.tensor([2, 2, 2, 2, 2, 2, 2, 4, 4, 4])
    episodes = [
        episode(rollouts, passed=at(TUNNEL), touching=flags, behaviour=mixed),
        episode(rollouts, failed=at(TUNNEL), cause="tilted"),
        episode(rollouts, failed=at(TUNNEL), cause="tilted"),
        episode(rollouts, bypassed=at(TUNNEL), cause=rollouts.WALKED_AROUND),
    ]
    found = judgement.summarise(COURSES["tunnel"], episodes)
    assert found["success"].estimate == 0.25 and found["causes"] == {"tilted": 2, "walked around": 1}
    assert found["time"].estimate == pytest.approx(0.2) and found["speed"].estimate == pytest.approx(1.0, rel=1e-5)
    assert found["collisions_of_all"].estimate == pytest.approx(3 / 4)
    assert found["fastest"] == found["peak_speed"].estimate == pytest.approx(1.0, rel=1e-5)
    assert found["each"]["cause"] == ["", "tilted", "tilted", "walked around"]
    tunnel = found["obstacles"]["tunnel"]
    assert (tunnel["met"], tunnel["passed"], tunnel["walked_around"]) == (4, 1, 1)
    assert tunnel["causes"] == {"tilted": 2} and tunnel["seconds"] == pytest.approx(0.2)
    assert tunnel["behaviours"] == pytest.approx({"walk": 0, "pace": 0, "trot": 37 / 40, "canter": 0, "jump": 3 / 40})
    rows = judgement.targets({"tunnel": found, "full": found | {"speed": None}})
    assert [(row["name"], row["passed"]) for row in rows] == [
        ("full: success", False), ("full: mean speed, m/s", False), ("tunnel: success", False)
    ]  # fmt: skip
    for peak, passed in ((3.19, False), (3.2, True)):
        hurdles = found | {"peak_speed": found["success"]._replace(estimate=peak)}
        assert judgement.targets({"hurdles": hurdles})[0]["passed"] is passed


def test_the_course_is_drawn_to_scale(module: Module) -> None:
    """Before anything is drawn at random a single obstacle stands at (2.0, 3.5) m and is passed along y."""

    def reach(name: str, colour: tuple[float, float, float]) -> list[float]:
        shapes = module("course_pictures").drawable(CourseLayout(COURSES[name], 1, torch.Generator()))
        points = torch.cat([footprint(shape) for shape in shapes if shape.color[:3] == colour])
        return (points.amax(0) - torch.tensor([2.0, 3.5])).tolist()

    assert reach("bar_jump", (0.82, 0.22, 0.18)) == pytest.approx([0.6 + 0.03, 0.03], abs=1e-3)
    plank = 1.5 * math.cos(SEESAW_TILT) + 0.015 * math.sin(-SEESAW_TILT)
    assert reach("seesaw", (0.93, 0.75, 0.2)) == pytest.approx([0.3, plank], abs=1e-4)


def test_way_points_follow_the_route(rollouts: ModuleType) -> None:
    layout = CourseLayout(COURSES["full"], 1, torch.Generator().manual_seed(4))
    layout.draw(torch.tensor([True]))
    goals = rollouts.way_points(layout)
    assert goals.shape == (24, 2)
    for place, index in enumerate(layout.route[0].tolist()):
        local = torch.tensor([layout.course.slots[index].goals[1]])
        torch.testing.assert_close(goals[4 * place + 1], layout.world(torch.tensor([index]), local)[0])


def test_a_teacher_that_misjudges_its_place_goes_elsewhere(
    recipe: ModuleType, deciders: ModuleType, config: Any
) -> None:
    decider = deciders.load_decider(config.run, config.bbc)
    ends = []
    for factor in (0.0, 0.0, 1.0):
        episodes = recipe.simulate(COURSES["tunnel"], decider, replace(config, misjudgement=factor))
        ends.append(torch.stack([one.steps["position"][-1] for one in episodes]))
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


def test_groups_of_courses(deciders: ModuleType, recipe: ModuleType, untrained: Path) -> None:
    decider = deciders.load_script("trot:1.0", untrained)
    config = recipe.Config(script="trot:1.0", course=("tunnel", "each", "tunnel"))
    assert recipe.names(config, decider) == ["tunnel", "bar_jump", "a_frame", "weave_poles", "seesaw", "tire_jump"]
    every = recipe.names(replace(config, course=("targets",)), decider)
    assert len(every) == 9 and {"full", "box", "hurdles"} <= set(every)
    assert recipe.names(replace(config, course=()), decider) == ["full"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "expected --episodes"),
        ({"push_interval": 0.0}, "expected --push-interval"),
        ({"script": "trot:1"}, "either the folder of a teacher or student, or --script"),
        ({"run": None}, "either the folder of a teacher or student, or --script"),
        ({"run": None, "script": "gallop:2"}, "expected BEHAVIOUR:SPEED such as trot:1.2, got 'gallop:2'"),
        ({"run": None, "script": "trot"}, "expected BEHAVIOUR:SPEED such as trot:1.2, got 'trot'"),
        ({"run": None, "script": "trot:9"}, r"trot goes at 0\.5 to 1\.5 m/s \(Table S2\), got 9 m/s"),
        ({"run": None, "script": "canter:2.1"}, r"canter goes at 0\.8 to 2 m/s \(Table S2\), got 2.1 m/s"),
        ({"run": None, "script": "trot:1", "fastest_canter": 9.0}, "fastest canter: expected more than 0.8"),
        ({"fastest_canter": 3.0}, "what a teacher or student commands was settled in training"),
        ({"course": ("nowhere",)}, "unknown course 'nowhere'"),
        ({"behaviours": ("gallop",)}, "'gallop' is no behaviour"),
        ({"run": Path("nowhere")}, "nowhere: expected the folder of a run"),
    ],
)
def test_impossible_options_are_refused(
    recipe: ModuleType, config: Any, teacher: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises((ValueError, OSError), match=message):
        recipe.evaluate(replace(config, **changes), screen())
    assert not (teacher / "course_evaluation.json").exists()


def test_a_bare_artifact_finds_its_controller_beside_it(
    module: Module, deciders: ModuleType, teacher: Path, untrained: Path, tmp_path: Path
) -> None:
    shelf, artifacts = tmp_path / "shelf", module("tsc_artifacts")
    controller = Artifact.load(untrained)
    others = {name: tensor + 1.0 for name, tensor in controller.state.items()}
    manifest = {name: value for name, value in controller.manifest.items() if name != "weights"}
    Artifact.save(shelf / "another", others, manifest)
    Artifact.save(shelf / "controller", controller.state, manifest)
    (shelf / "broken").mkdir()
    (shelf / "broken" / "manifest.json").write_text("{")
    decided = Artifact.load(teacher)
    Artifact.save(shelf / "teacher", decided.state, decided.manifest)
    assert artifacts.trained_bbc(artifacts.load_trained(shelf / "teacher", "teacher")) == shelf / "controller"
    assert deciders.load_decider(shelf / "teacher", None).controller.artifact.folder == shelf / "controller"


def test_the_wrong_artifact_is_refused(
    deciders: ModuleType, recipe: ModuleType, config: Any, teacher: Path, untrained: Path
) -> None:
    with pytest.raises(ValueError, match=r"a student of tsc_student\.py, got an artifact of kind 'bbc'"):
        recipe.evaluate(replace(config, run=untrained), screen())
    with pytest.raises(ValueError, match="expected an artifact of kind 'bbc', got 'teacher'"):
        recipe.evaluate(replace(config, bbc=teacher), screen())
    other = deciders.load_script("trot:1.0", untrained).controller
    weights = {name: tensor + 1.0 for name, tensor in other.artifact.state.items()}
    manifest = {name: value for name, value in other.artifact.manifest.items() if name != "weights"}
    Artifact.save(untrained.parent / "other", weights, manifest)
    with pytest.raises(ValueError, match=r"holds the BBC .{12}, but .* was trained on .{12}; give that one as --bbc"):
        recipe.evaluate(replace(config, bbc=untrained.parent / "other"), screen())
    limited = Artifact.load(teacher / "policy")
    network = limited.manifest["network"] | {"allowed": [2]}
    Artifact.save(teacher / "policy", limited.state, limited.manifest | {"network": network})
    with pytest.raises(ValueError, match=r"those that it was trained with, trot; got \('jump',\)"):
        recipe.evaluate(replace(config, behaviours=("jump",)), screen())
    next((teacher / "policy").glob("*.safetensors")).write_bytes(b"short")
    with pytest.raises(ValueError, match="truncated or altered"):
        recipe.evaluate(config, screen())


def test_a_user_sees_one_line(recipe: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        recipe.main([str(tmp_path / "nowhere"), "--course", "full", "tunnel", "--episodes", "5"])
    errors = capsys.readouterr().err
    assert stop.value.code == 2 and errors.count("\n") == 1 and "check the path" in errors
