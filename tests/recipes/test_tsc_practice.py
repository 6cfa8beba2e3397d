"""A student's practice on a few robots, called in this process."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.modules.student import NEXT_HIDDEN, PERCEIVED_PLACE
from agility_rl.record.mcap_logger import read_scalars

Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("tsc_practice")


@pytest.fixture
def smoke(recipe: ModuleType, untrained: Path, make_student: Callable[..., Path], tmp_path: Path) -> Any:
    cfg = recipe.PRESETS["smoke"]
    student, env = make_student(fastest_canter=2.5), replace(cfg.env, num_threads=1)
    return replace(cfg, runs=tmp_path, student=student, bbc=untrained, env=env, precision="float32")


def test_a_run_changes_the_actor_and_nothing_else(recipe: ModuleType, smoke: Any) -> None:
    run = recipe.train(replace(smoke, iterations=3))
    before, after = (Artifact.load(path / "policy", kind="student") for path in (smoke.student, run))
    moved = {name.split(".")[0] for name in before.state if not torch.equal(before.state[name], after.state[name])}
    assert moved == {"actor"}
    for name in recipe.INHERITED:
        assert after.manifest[name] == before.manifest[name], name
    assert after.manifest["practised_from"] == before.manifest["weights"]["sha256"]
    assert after.manifest["course"] == "bar_jump" and after.manifest["control_period"] == pytest.approx(0.04)
    scalars = read_scalars(run)
    for name in ("reward/task", "kl", "loss_critic", "success/bar_jump", "use/trot", "task/heading", "std"):
        assert bool(scalars[name][1].isfinite().all()), name
    assert "success/tunnel" not in scalars
    assert read_scalars(run)["kl_continuous"][1][0].abs() < 1e-3, "the first iteration leaves the policy as it is"


def test_its_run_says_which_controller_it_found(
    recipe: ModuleType, module: Module, smoke: Any, untrained: Path
) -> None:
    (smoke.student / "config.json").write_text(json.dumps({"config": {"bbc": str(untrained)}}), encoding="utf-8")
    run = recipe.train(replace(smoke, bbc=None, iterations=1))
    assert module("deciders").load_decider(run, None).controller.run == untrained


def test_resume_equals_an_uninterrupted_run_bit_for_bit(recipe: ModuleType, smoke: Any) -> None:
    whole = recipe.train(replace(smoke, name="whole", iterations=4))
    halves = recipe.train(replace(smoke, name="halves", iterations=2))
    recipe.train(replace(smoke, resume=halves, iterations=4))
    one, other = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in one if not torch.equal(one[name], other[name])]
    for name in ("reward/task", "loss_critic", "use/jump"):
        assert torch.equal(read_scalars(whole)[name][1], read_scalars(halves)[name][1]), name
    before = Artifact.load(smoke.student)
    moved = {name: value + 0.1 for name, value in before.state.items()}
    Artifact.save(before.folder, moved, {k: v for k, v in before.manifest.items() if k != "weights"})
    with pytest.raises(ArtifactError, match=r"began with another policy \(practised_from .{12}\) than .* holds now"):
        recipe.train(replace(smoke, resume=halves, iterations=5))


@pytest.mark.usefixtures("failures")
def test_where_it_failed_it_goes_on_with_what_it_remembered(recipe: ModuleType, smoke: Any) -> None:
    """Images, memory and course are those of the robot that failed later, and so is what is perceived."""
    smoke = replace(
        smoke,
        ppo=replace(smoke.ppo, steps=30, rewound=0.25),
        env=replace(smoke.env, push_interval=0.4, command_noise=(1.0, 1.0)),
    )
    parts = recipe.build(smoke)
    rollout, one = parts.learner.rollout, parts.learner.rewind
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        batch = parts.learner.collect(parts.policy).clone()
    assert one.kept is not None and rollout.carrier is not None
    one.begin(rollout)
    begun = rollout.carrier[:1].clone()
    moments = (batch[keys.HISTORY] == begun[keys.HISTORY]).flatten(2).all(-1).nonzero()
    step, robot = moments[0].tolist()
    assert step % one.apart == 0 and robot > 0 and not torch.equal(batch[keys.HISTORY][step, 0], begun[keys.HISTORY][0])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = parts.policy(rollout.carrier.clone())
    for key in (PERCEIVED_PLACE, keys.TERRAIN_LATENT, "loc"):
        torch.testing.assert_close(seen[key][0], batch[key][step, robot])
    parts.env.close()

    whole = recipe.train(replace(smoke, name="whole", iterations=4))
    halves = recipe.train(replace(smoke, name="halves", iterations=2))
    recipe.train(replace(smoke, resume=halves, iterations=4))
    before, after = (Artifact.load(run / "policy").state for run in (whole, halves))
    assert not [name for name in before if not torch.equal(before[name], after[name])]


def test_its_deviations_are_those_of_its_options(recipe: ModuleType, smoke: Any) -> None:
    cfg = replace(smoke, ppo=replace(smoke.ppo, min_std=0.03, initial_std=0.05))
    parts = recipe.build(cfg)
    recipe.begin(parts, cfg)
    head = parts.student.actor.network.parameters_head
    assert head.min_std.tolist() == pytest.approx([0.03] * 30) and head.std.tolist() == pytest.approx([0.05] * 30)
    parts.env.close()
    with pytest.raises(ValueError, match=r"--ppo.min-std of at most --ppo.initial-std, got 0.2 and 0.15"):
        recipe.train(replace(smoke, ppo=replace(smoke.ppo, min_std=0.2)))
    with pytest.raises(ValueError, match=r"--env.start-after 0.5: a student that knows its place"):
        recipe.train(replace(smoke, env=replace(smoke.env, start_after=0.5)))


def test_it_perceives_as_when_it_walks_by_itself(recipe: ModuleType, smoke: Any) -> None:
    """What a roll-out stores is what a plain loop sees, whose memory begins anew where an episode ends."""
    short = replace(smoke.env, episode_length=0.2)  # five decisions
    cfg = replace(smoke, env=short, ppo=replace(smoke.ppo, steps=12, noise_seconds=None))
    parts, plain = recipe.build(cfg), recipe.build(cfg)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        batch = parts.learner.collect(parts.policy).clone()
    student, env, n = plain.student, plain.env, plain.env.num_robots
    policy, td = student.policy(assisted=True), env.reset()
    hidden, first, ends = student.initial_hidden(n), torch.ones(n, 1, dtype=torch.bool), 0
    for step in range(12):
        td.update({keys.HIDDEN: hidden, "is_init": first})
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = policy(td)
        for key in (PERCEIVED_PLACE, keys.TERRAIN_LATENT, "loc", (keys.ACTION, keys.BEHAVIOUR)):
            assert torch.equal(batch[key][step], td[key]), (key, step)
        hidden = td[NEXT_HIDDEN]
        full, td = env.step_and_maybe_reset(td)
        first = full["next", "done"]
        ends += int(first.sum())
    assert ends >= 2 * n
    for one in (parts, plain):
        one.env.close()


def test_it_refuses_what_it_cannot_practise(
    command: Callable[..., Any], smoke: Any, untrained_teacher: Path, tmp_path: Path
) -> None:
    def refused(*options: object) -> str:
        result = command("tsc_practice", "smoke", "--runs", tmp_path / "runs", "--bbc", smoke.bbc, *options)
        assert result.returncode != 0 and "Traceback" not in result.stderr
        return " ".join((result.stderr + result.stdout).split())

    assert "expected a student of tsc_student.py, got an artifact of kind 'teacher'" in refused(
        "--student", untrained_teacher
    )
    assert "whose obstacles stand elsewhere; it can practise on bar_jump" in refused(
        "--student", smoke.student, "--env.course", "full"
    )
    assert "--reward.imitation: practice pays for the task alone; expected 0, not 0.2" in refused(
        "--student", smoke.student, "--reward.imitation", 0.2
    )
    assert not list((tmp_path / "runs").glob("*"))
