"""The recipe of stage 3 on a few robots, called in this process: a start of Python costs more than the run."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS, command_bounds, commands_from_parameters
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.envs import AgilityEnv
from agility_rl.envs.misjudgement import LASTING
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.modules import Teacher
from agility_rl.record.mcap_logger import read_scalars

Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("tsc_teacher")


@pytest.fixture
def smoke(recipe: ModuleType, untrained: Path, tmp_path: Path) -> Any:
    cfg = recipe.PRESETS["smoke"]
    env = replace(cfg.env, num_threads=1)
    return replace(cfg, runs=tmp_path, bbc=untrained, env=env, reward=replace(cfg.reward, imitation=0.0))


def test_a_run_writes_what_the_next_stage_needs(recipe: ModuleType, smoke: Any, untrained: Path) -> None:
    run = recipe.train(smoke)
    artifact = Artifact.load(run / "policy", kind="teacher")
    assert artifact.manifest["control_period"] == pytest.approx(0.04)  # decides every second control step
    assert artifact.manifest["bbc"] == Artifact.load(untrained / "policy").manifest["weights"]["sha256"]
    teacher = Teacher(**artifact.manifest["network"])
    teacher.load_state_dict(artifact.state)
    scalars = read_scalars(run)
    for name in ("reward/task", "task/heading", "use/trot", "success/tunnel", "curriculum/obstacles", "kl_discrete"):
        assert bool(scalars[name][1].isfinite().all()), name
    use = sum(scalars[f"use/{name}"][1] for name in ("walk", "pace", "trot", "canter", "jump"))
    torch.testing.assert_close(use, torch.ones_like(use), atol=1e-6, rtol=0)


def test_resume_equals_an_uninterrupted_run_bit_for_bit(recipe: ModuleType, smoke: Any) -> None:
    ppo = replace(smoke.ppo, noise_seconds=0.2, critic_learning_rate=1e-3, averaging=0.75)
    smoke = replace(smoke, ppo=ppo)
    whole = recipe.train(replace(smoke, name="whole", iterations=4))
    halves = recipe.train(replace(smoke, name="halves", iterations=2))
    recipe.train(replace(smoke, resume=halves, iterations=4))
    one, other = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in one if not torch.equal(one[name], other[name])]
    assert read_scalars(whole)["kl_continuous"][1][0].abs() < 1e-3, "the first iteration leaves the policy as it is"
    for name in ("reward/task", "loss_critic", "use/jump"):
        assert torch.equal(read_scalars(whole)[name][1], read_scalars(halves)[name][1]), name


@pytest.mark.usefixtures("failures")
def test_a_run_that_practises_what_failed_is_resumed_bit_for_bit(
    recipe: ModuleType, smoke: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Snapshots are of this run alone: those that are kept are in its checkpoints."""
    begun = []
    restore = AgilityEnv.restore

    def watched(env: AgilityEnv, rows: Tensor, snapshot: TensorDictBase) -> TensorDict:
        begun.append(rows.tolist())
        return restore(env, rows, snapshot)

    monkeypatch.setattr(AgilityEnv, "restore", watched)
    ppo, env = replace(smoke.ppo, steps=30, rewound=0.25), replace(smoke.env, push_interval=0.4)
    smoke = replace(smoke, ppo=ppo, env=env)
    whole = recipe.train(replace(smoke, name="whole", iterations=4))
    assert begun and begun[0] == [0, 1], "two of eight"
    count = len(begun)
    halves = recipe.train(replace(smoke, name="halves", iterations=2))
    recipe.train(replace(smoke, resume=halves, iterations=4))
    assert len(begun) == 2 * count
    one, other = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in one if not torch.equal(one[name], other[name])]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # torch's compiler, of torch itself
def test_a_compiled_run_is_resumed_bit_for_bit(recipe: ModuleType, smoke: Any) -> None:
    """Also where it is compiled anew, as in another process."""
    smoke = replace(smoke, ppo=replace(smoke.ppo, noise_seconds=0.2, compile=True))
    whole = recipe.train(replace(smoke, name="whole", iterations=4))
    halves = recipe.train(replace(smoke, name="halves", iterations=2))
    torch.compiler.reset()
    recipe.train(replace(smoke, resume=halves, iterations=4))
    one, other = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in one if not torch.equal(one[name], other[name])]


def test_a_finished_course_is_worth_what_the_option_says(recipe: ModuleType) -> None:
    finished = torch.tensor([[[True], [False]], [[False], [False]]])
    values = torch.tensor([[[46.0], [9.0]], [[0.0], [8.0]]])
    batch = TensorDict({"next": {"state_value": values.clone(), "outcome": {"finished": finished}}}, [2, 2])
    recipe.value_finished(batch, None)
    assert torch.equal(batch["next", "state_value"], values)
    recipe.value_finished(batch, 12.0)
    assert batch["next", "state_value"].flatten().tolist() == [12.0, 9.0, 0.0, 8.0]


def test_what_is_saved_is_the_moving_average_of_weights(
    recipe: ModuleType, module: Module, smoke: Any, tmp_path: Path
) -> None:
    setup, cfg = module("tsc_setup"), replace(smoke, ppo=replace(smoke.ppo, averaging=0.75, critic_warm_up=0))
    parts, name = recipe.build(cfg), "actor.module.0.module.trunk.layers.0.weight"
    setup.save_policy(parts, cfg, tmp_path / "start")  # nothing to average yet
    mean = None
    for iteration in (0, 2):  # in between the history encoder drives, and the policy stays
        recipe.iterate(parts, cfg, iteration)
        now = parts.teacher.state_dict()[name].clone()
        mean = now if mean is None else 0.75 * mean + 0.25 * now
    setup.save_policy(parts, cfg, tmp_path / "end")
    parts.env.close()
    start, end = (Artifact.load(tmp_path / part / "policy").state[name] for part in ("start", "end"))
    torch.testing.assert_close(end, mean)
    assert not torch.equal(end, start) and not torch.equal(end, parts.teacher.state_dict()[name])


def test_a_teacher_learns_to_read_its_place_from_where_it_was(recipe: ModuleType, smoke: Any) -> None:
    """The new input of the first layer counts nothing at first, and everything else is the parent's."""
    without = replace(smoke, place=False)
    blind = recipe.train(replace(without, name="blind", iterations=1))
    reading = replace(smoke, init_from=blind, place=True)
    parts = recipe.build(reading)
    recipe.begin(parts, reading)
    assert Artifact.load(blind / "policy").manifest["network"]["num_place"] == 0
    assert parts.teacher.settings["num_place"] == 8
    parent = Teacher(**Artifact.load(blind / "policy").manifest["network"])
    Artifact.load(blind / "policy").fill(parent)
    seen = parts.env.reset()
    with torch.no_grad():
        torch.testing.assert_close(
            parts.teacher.deployable_policy()(seen.clone())["loc"], parent.deployable_policy()(seen.clone())["loc"]
        )
        parts.teacher.actor.network.trunk.layers[0].weight[:, -8:] = 1.0
        moved = parts.teacher.deployable_policy()(seen.clone())["loc"]
    assert not torch.equal(moved, parent.deployable_policy()(seen.clone())["loc"])
    parts.env.close()
    reader = recipe.train(replace(smoke, name="reader", iterations=1, place=True))
    with pytest.raises(ArtifactError, match="reads its place, this run's teacher does not; give --place"):
        recipe.train(replace(without, name="refused", init_from=reader))
    wider = replace(smoke, name="wider", init_from=reader, ppo=replace(smoke.ppo, hidden=(64, 32)))
    with pytest.raises(ArtifactError, match=r"layers are \[.*\], this run builds \[64, 32\]; give --ppo.hidden"):
        recipe.train(wider)


def test_it_is_not_resumed_on_another_controller(recipe: ModuleType, smoke: Any, tmp_path: Path) -> None:
    own = tmp_path / "controller"
    shutil.copytree(smoke.bbc / "policy", own / "policy")
    run = recipe.train(replace(smoke, bbc=own, iterations=1))
    before = Artifact.load(own)
    moved = {name: value + 0.1 for name, value in before.state.items()}
    Artifact.save(own / "policy", moved, {k: v for k, v in before.manifest.items() if k != "weights"})
    with pytest.raises(ArtifactError, match=r"began with another policy \(bbc .{12}\) than .* holds now"):
        recipe.train(replace(smoke, resume=run, iterations=2))


def test_init_from_and_one_behaviour(recipe: ModuleType, smoke: Any, capsys: pytest.CaptureFixture[str]) -> None:
    parent = recipe.train(replace(smoke, iterations=1))
    copied = replace(smoke.cloning, script="trot:1.2", iterations=1)
    child = recipe.train(replace(smoke, name="child", iterations=1, init_from=parent, cloning=copied))
    assert f"--cloning.script trot:1.2 is not copied: {parent} is started from" in capsys.readouterr().out
    assert Artifact.load(child / "policy").manifest["course"] == "full"
    broad = replace(smoke.ppo, initial_std=0.5, min_std=0.4)
    wide = recipe.train(replace(smoke, name="wide", iterations=0, init_from=parent, ppo=broad))
    head = "actor.module.0.module.parameters_head."
    started = Artifact.load(wide / "policy").state  # the parent's floor was 0.15, its deviation 0.2
    assert started[head + "std"].tolist() == pytest.approx([0.4] * 30)
    parts = recipe.build(replace(smoke, init_from=parent, ppo=broad, behaviours=("trot",)))
    recipe.begin(parts, replace(smoke, init_from=parent, ppo=broad, behaviours=("trot",)))
    assert parts.teacher.actor.network.parameters_head.min_std.tolist() == pytest.approx([0.4] * 30)
    assert (parts.teacher.actor.network.mask == 0.0).tolist() == [name == "trot" for name in BEHAVIOURS]
    parts.env.close()
    script, box = replace(smoke.cloning, script="trot:1.2"), replace(smoke.env, course="box")
    alone = recipe.train(replace(smoke, name="trot", behaviours=("trot",), cloning=script, env=box, iterations=1))
    scalars = read_scalars(alone)
    assert scalars["use/trot"][1].tolist() == [1.0]
    assert "success/box_jump" in scalars and "success/tunnel" not in scalars


def test_a_teacher_with_a_faster_canter_says_so_and_goes_on_as_fast_as_it_did(
    recipe: ModuleType, module: Module, smoke: Any, untrained: Path
) -> None:
    """Its manifest, whoever runs it, and a teacher that starts from one with another range."""
    slow = recipe.train(replace(smoke, name="slow", iterations=1))
    sprint = replace(smoke.cloning, script="sprint")
    reward = replace(smoke.reward, sprint=15.0)
    fast = replace(
        smoke, name="fast", init_from=slow, env=replace(smoke.env, fastest_canter=3.2), cloning=sprint, reward=reward
    )
    run = recipe.train(replace(fast, iterations=1))
    assert [Artifact.load(one / "policy").manifest["fastest_canter"] for one in (slow, run)] == [2.0, 3.2]
    assert module("deciders").load_decider(run, untrained).fastest_canter == 3.2
    assert "task/sprint" in read_scalars(run) and "task/sprint" not in read_scalars(slow)
    parts = recipe.build(fast)
    recipe.begin(parts, replace(fast, cloning=replace(sprint, iterations=0)))
    parent = module("tsc_artifacts").load_trained(slow).network
    seen = parts.env.reset()
    with torch.no_grad():
        was, now = (
            teacher.privileged_policy()(seen.clone())["loc"].clamp(max=1.0)[:, 3] for teacher in (parent, parts.teacher)
        )
    skill = torch.full((len(seen),), 3)
    expected, _ = commands_from_parameters(skill, was)
    told, _ = commands_from_parameters(skill, now, command_bounds(fastest_canter=3.2))
    torch.testing.assert_close(told, expected, atol=1e-5, rtol=0.0)
    parts.env.close()


def test_options_of_the_course_reach_it(recipe: ModuleType, smoke: Any) -> None:
    env = replace(smoke.env, goal_radius=0.45, start_spread=2.0, start_after=0.5, misjudgement=0.5)
    reward = replace(smoke.reward, termination=-500.0, heading=0.25)
    parts = recipe.build(replace(smoke, env=env, reward=reward, ppo=replace(smoke.ppo, bounds=0.25)))
    assert parts.env.arena.progress.radius == 0.45
    assert (parts.env.arena.start_spread, parts.env.arena.start_after) == (2.0, 0.5)
    errors = parts.env.arena.misjudgement
    assert errors is not None and errors.kept == math.exp(-0.02 * env.decision_steps / LASTING)
    assert parts.learner.update.loss.bounds_coeff == 0.25 and "loss_bounds" in parts.learner.update.loss.out_keys
    assert parts.env.termination_reward == -500.0 and parts.env.rewards["heading"].weight == 0.25
    parts.env.close()


def test_the_curriculum_by_hand(module: Module) -> None:
    grown, config = module("tsc_curriculum"), module("tsc_config")
    cfg = config.CurriculumConfig(success=0.8, episodes=10, difficulty_step=0.5, practice=2.0)
    curriculum = grown.Curriculum(cfg, 0.0, 1, most=3)
    nothing = torch.zeros(len(OBSTACLES))
    steps = []
    for successes in (8, 7, 9, 10, 10, 10):  # of ten each: up, stays, full difficulty, then one obstacle more at a time
        curriculum.update(nothing, nothing, successes, 10)
        steps.append((curriculum.difficulty, curriculum.obstacles))
    assert steps == [(0.5, 1), (0.5, 1), (1.0, 1), (1.0, 2), (1.0, 3), (1.0, 3)]
    tenths = grown.Curriculum(replace(cfg, difficulty_step=0.1), 0.0, 1, most=3)
    for _ in range(10):
        tenths.update(nothing, nothing, 10, 10)
    assert (tenths.difficulty, tenths.obstacles) == (1.0, 1)
    curriculum.passed, curriculum.failed = torch.ones(len(OBSTACLES)), torch.zeros(len(OBSTACLES))
    curriculum.failed[2] = 3.0  # a success rate of a quarter
    weights = curriculum.start_weights(torch.nn.functional.one_hot(torch.tensor([0, 2]), len(OBSTACLES)))
    assert weights.tolist() == pytest.approx([1.0, 1.0 + 2.0 * 3.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--env.course", "nowhere"), "unknown course 'nowhere'; expected one of full"),
        (("--env.course", "nowhere.toml"), "nowhere.toml: cannot be read"),
        (("--behaviours", "trot", "gallop"), "unknown gallop"),
        (("--env.fastest-canter", "0.5"), "fastest canter: expected more than 0.8 and at most 5 m/s, got 0.5"),
        (("--ppo.rewound", "1"), "--ppo.rewound: expected a share from 0 to less than 1, got 1.0"),
        (("--ppo.rewound", "0.95"), "--ppo.rewound 0.95 of 8 robots is all of them"),
        (("--bbc", "nowhere"), "nowhere"),
        (("--env.num-robot", "3"), "did you mean --env.num-robots"),
    ],
)
def test_bad_options_give_one_clear_line(
    recipe: ModuleType,
    tmp_path: Path,
    untrained: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    arguments = ["smoke", "--runs", str(tmp_path), "--bbc", str(untrained), "--reward.imitation", "0", *options]
    with pytest.raises(SystemExit) as stop, recipe.cli.one_line_errors():
        recipe.train(recipe.cli.from_presets(recipe.PRESETS, arguments))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "smoke_teacher").exists()
