"""The recipe of stage 1, run as a user would, on a few robots and the synthetic gaits."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.deploy.artifact import Artifact
from agility_rl.record.mcap_logger import read_hparams, read_scalars
from agility_rl.training.checkpoint import RunCheckpoint

RECIPE = Path(__file__).parents[2] / "recipes" / "bbc_pretrain.py"
ONE_THREAD = os.environ | {"OMP_NUM_THREADS": "1"}
"""Tests run side by side; their processes must not fight for the cores."""


Command = Callable[..., subprocess.CompletedProcess[str]]
EVERYTHING = (
    *("--env.encounters", "0.8", "--env.resample-period", "0.2", "--env.lateral-weight", "2", "--ppo.symmetry", "1"),
    *("--env.boxes", "0.5", "--env.shares", "1", "1", "1", "1", "2"),
    *("--env.rhythm-weight", "1.0", "--env.randomize", "--env.push-interval", "0.1", "--env.observation-noise", "1"),
    *("--env.action-delay", "0.01", "--env.action-delay-from", "5", "--env.progress-fade", "2", "4"),
    *("--imitation.information-ramp", "2", "4", "--adaptation.privileged-ramp", "3", "2", "--adaptation.every", "3"),
    *("--changes", "5", "ppo.entropy", "0.002", "6", "env.jump-weight", "9.0", "3", "env.standing-starts", "0.5"),
    *("6", "env.progress-left", "7.0", "5", "env.canter-stance", "0.1", "4", "env.walk-emphasis", "2.0"),
    "--ppo.by-behaviour",
)
"""Whatever is random, and ramps and changes on both sides of the middle of eight iterations."""


def run(folder: Path, *options: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(RECIPE), "smoke", "--runs", str(folder), *options]
    return subprocess.run(command, capture_output=True, text=True, check=check, timeout=300, env=ONE_THREAD)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight iterations without interruption."""
    folder = tmp_path_factory.mktemp("runs")
    run(folder, "--name", "whole", "--iterations", "8", *EVERYTHING)
    return folder


def test_smoke_run_writes_everything_the_next_stage_needs(finished: Path) -> None:
    whole = finished / "whole"
    artifact = Artifact.load(whole / "policy", kind="bbc")
    assert artifact.manifest["control_period"] == 0.02
    assert artifact.manifest["data"] == ["synthetic gaits of agility_rl"]
    assert sum(artifact.manifest["prior"]) == pytest.approx(1.0)
    record = json.loads((whole / "config.json").read_text())
    assert record["config"]["seed"] == 0 and "torchrl" in record["versions"]
    scalars = read_scalars(whole)
    for name in ("reward/imitation", "share/task", "error/speed", "accuracy_expert", "recovery/trot", "prior/walk"):
        assert scalars[name][0].tolist() == list(range(1, 9))
    assert bool(scalars["loss_critic"][1].isfinite().all())
    shares = sum(scalars[f"share/{name}"][1] for name in ("imitation", "skill", "shift", "task"))
    torch.testing.assert_close(shares, torch.ones_like(shares))
    settings = read_hparams(whole)
    assert settings["iterations"] == 8 and settings["ppo"]["clip"] == 0.2


def test_resume_equals_an_uninterrupted_run_bit_for_bit(finished: Path) -> None:
    told = run(finished, "--name", "halves", "--iterations", "4", *EVERYTHING).stdout
    assert "changes during the run (--changes): ppo.entropy 0.002 from 5, env.jump-weight 9 from 6" in told
    run(finished, "--resume", str(finished / "halves"), "--iterations", "8")
    whole, halves = (Artifact.load(finished / name / "policy").state for name in ("whole", "halves"))
    assert whole.keys() == halves.keys()
    different = [name for name, tensor in whole.items() if not torch.equal(tensor, halves[name])]
    assert not different
    for name in ("reward/imitation", "loss_critic", "loss_discriminator", "prior/jump", "task/rhythm", "error/speed"):
        expected, got = (read_scalars(finished / run_name)[name][1] for run_name in ("whole", "halves"))
        assert torch.equal(expected, got), name


@pytest.mark.slow
def test_a_compiled_run_is_resumed_bit_for_bit(tmp_path: Path) -> None:
    """Every second roll-out of ``smoke`` is the history encoder's."""
    for name, iterations in (("whole", "4"), ("halves", "2")):
        run(tmp_path, "--name", name, "--iterations", iterations, "--ppo.compile")
    run(tmp_path, "--resume", str(tmp_path / "halves"), "--iterations", "4")
    whole, halves = (Artifact.load(tmp_path / name / "policy").state for name in ("whole", "halves"))
    assert not [name for name, tensor in whole.items() if not torch.equal(tensor, halves[name])]


def test_init_from_starts_with_the_given_policy(finished: Path) -> None:
    run(finished, "--name", "child", "--iterations", "1", "--init-from", str(finished / "whole"))
    assert Artifact.load(finished / "child" / "policy").manifest["network"]["hidden"] == [32, 32]
    other = ("--init-from", str(finished / "whole"), "--ppo.hidden", "16", "8")
    refused = run(finished, "--name", "other", *other, check=False)
    assert refused.returncode == 2 and "[32, 32], this run builds [16, 8]; give --ppo.hidden 32 32" in refused.stderr
    assert not (finished / "other").exists()


def test_a_run_goes_on_as_far_as_it_was_to_go_and_says_where_it_ended(finished: Path) -> None:
    options = ("--name", "short", "--iterations", "3", "--max-minutes", "1e-6")
    said = run(finished, *options).stdout
    assert f"saved {finished / 'short'} after 1 of 3 iterations, by --max-minutes" in said
    said = run(finished, "--resume", str(finished / "short"), "--max-minutes", "None").stdout
    assert said.endswith(f"saved {finished / 'short'}\n"), "and nothing left"
    assert RunCheckpoint(finished / "short" / "checkpoints", counters={}).steps()[-1] == 3


def test_a_run_holds_on_to_the_policy_that_it_began_with(finished: Path) -> None:
    shutil.copytree(finished / "whole" / "policy", finished / "start" / "policy")
    start = ("--init-from", str(finished / "start"), "--imitation.anchor", "1")
    run(finished, "--name", "anchored", "--iterations", "1", *start)
    began = Artifact.load(finished / "start").manifest["weights"]["sha256"]
    assert Artifact.load(finished / "anchored").manifest["anchored_to"] == began
    run(finished, "--resume", str(finished / "anchored"), "--iterations", "2")
    trained_on = {name: value + 1.0 for name, value in Artifact.load(finished / "start").state.items()}
    Artifact.save(finished / "start" / "policy", trained_on, Artifact.load(finished / "start").manifest)
    refused = run(finished, "--resume", str(finished / "anchored"), "--iterations", "3", check=False)
    assert refused.returncode == 2 and f"began with another policy (anchored_to {began[:12]})" in refused.stderr


def test_a_policy_says_what_its_start_has_learned_from_too(finished: Path) -> None:
    whole = Artifact.load(finished / "whole")
    Artifact.save(finished / "of_dogs" / "policy", whole.state, {**whole.manifest, "data": ["dogs/labelled"]})
    said = run(finished, "--name", "heir", "--iterations", "1", "--init-from", str(finished / "of_dogs")).stdout
    assert "it learns from synthetic gaits, not from a dog" in said
    shutil.rmtree(finished / "of_dogs")
    run(finished, "--resume", str(finished / "heir"), "--iterations", "2")
    manifest = Artifact.load(finished / "heir").manifest
    assert manifest["data"] == ["dogs/labelled", "synthetic gaits of agility_rl"]


def test_a_run_that_lost_its_checkpoints_keeps_its_policy(finished: Path) -> None:
    shutil.copytree(finished / "whole", finished / "bare")
    shutil.rmtree(finished / "bare" / "checkpoints")
    result = run(finished, "--resume", str(finished / "bare"), "--iterations", "9", check=False)
    assert result.returncode == 2 and "has a policy and no checkpoint" in result.stderr
    weights = [Artifact.load(finished / name).manifest["weights"] for name in ("whole", "bare")]
    assert weights[0] == weights[1]


def test_a_run_is_never_overwritten(finished: Path, command: Command) -> None:
    before = (finished / "whole" / "config.json").read_bytes()
    result = command("bbc_pretrain", "smoke", "--runs", finished, "--name", "whole")
    assert result.returncode != 0
    assert "already holds a run" in result.stderr and "Traceback" not in result.stderr
    assert (finished / "whole" / "config.json").read_bytes() == before


def test_ctrl_c_saves_what_a_resume_goes_on_from(tmp_path: Path) -> None:
    command = [sys.executable, str(RECIPE), "smoke", "--runs", str(tmp_path), "--name", "cut", "--iterations", "100000"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ONE_THREAD
    ) as process:
        deadline = time.monotonic() + 240.0
        try:
            while not (tmp_path / "cut" / "policy").is_dir():  # written with the first checkpoint
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.2)
            process.send_signal(signal.SIGINT)
            output, errors = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    assert "saved" in output and "stopping after this iteration" in errors
    done = len(read_scalars(tmp_path / "cut")["reward/task"][0])
    run(tmp_path, "--resume", str(tmp_path / "cut"), "--iterations", str(done + 1))
    assert read_scalars(tmp_path / "cut")["reward/task"][0].tolist() == list(range(1, done + 2))


@pytest.mark.parametrize("moment", ["before its first checkpoint", "later"])
def test_a_killed_run_goes_on(tmp_path: Path, moment: str) -> None:
    folder = tmp_path / "cut"
    every, wanted = ("100000", folder / "metrics.mcap") if moment != "later" else ("1", folder / "policy")
    command = [sys.executable, str(RECIPE), "smoke", "--runs", str(tmp_path), "--name", "cut"]
    with subprocess.Popen(
        [*command, "--iterations", "100000", "--checkpoint-every", every],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ONE_THREAD,
    ) as process:
        deadline = time.monotonic() + 240.0
        try:
            while not wanted.exists():
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.02)
        finally:
            process.kill()
    assert process.returncode == -signal.SIGKILL
    steps = RunCheckpoint(folder / "checkpoints", counters={}).steps()
    assert bool(steps) == (moment == "later")
    done = steps[-1] if steps else 0
    run(tmp_path, "--resume", str(folder), "--iterations", str(done + 2))
    assert read_scalars(folder)["reward/task"][0].tolist() == list(range(1, done + 3))
    assert (folder / "policy" / "manifest.json").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--ppo.epoks", "3"), "did you mean --ppo.epochs"),
        (("--motion.labelled", "nowhere", "--motion.unlabelled", "nowhere"), "nowhere"),
        (("--motion.labelled", "nowhere"), "give both"),
        (("--env.terrain", "lava"), "flat"),
        (("--iterations", "0"), "--iterations: expected at least 1, got 0"),
        (("--motion.label-share", "0"), "expected --imitation.conditional, --imitation.labelled-share"),
        (("--resume", "nowhere"), "nothing to resume"),
        (("--checkpoint-every", "0"), "--checkpoint-every: expected at least 1, got 0"),
        (("--ppo.minibatches", "0"), "expected epochs and minibatches of at least 1, got 1 and 0"),
        (("--ppo.steps", "0"), "num_steps must be at least 1, got 0"),
    ],
)
def test_bad_options_give_one_clear_line(
    tmp_path: Path, command: Command, options: tuple[str, ...], message: str
) -> None:
    result = command("bbc_pretrain", "smoke", "--runs", tmp_path, *options)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_a_truncated_checkpoint_is_refused_and_left_alone(tmp_path: Path, command: Command) -> None:
    run(tmp_path, "--name", "broken", "--iterations", "1")
    newest = sorted((tmp_path / "broken" / "checkpoints").glob("*.torchrl"))[-1]
    newest.write_bytes(newest.read_bytes()[:1000])
    result = command("bbc_pretrain", "smoke", "--resume", tmp_path / "broken")
    assert result.returncode == 2
    assert "damaged" in result.stderr and "Traceback" not in result.stderr
    assert newest.stat().st_size == 1000
    assert RunCheckpoint(newest.parent, counters={}).steps() == (1,)


def test_options_change_at_their_iterations(module: Callable[[str], ModuleType]) -> None:
    config, changes = module("bbc_config"), module("bbc_changes")
    cfg = config.Config(changes=((2, "ppo.entropy", 0.1), (4, "ppo.entropy", 0.2), (3, "env.jump-weight", 9.0)))
    assert [changes.at(cfg, iteration).ppo.entropy for iteration in range(6)] == [0.01, 0.01, 0.1, 0.1, 0.2, 0.2]
    assert [changes.at(cfg, iteration).env.jump_weight for iteration in (2, 3)] == [6.0, 9.0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--changes", "3", "ppo.gamma", "0.5"), "ppo.gamma cannot change in a run, only ppo.entropy"),
        (("--ppo.symmetric", "walk", "hop"), "--ppo.symmetric: unknown hop; expected some of walk, pace"),
        (("--env.resample-period", "0"), "resample_period must be at least a control step, 0.02 s, got 0.0"),
        (("--env.standing-starts", "2"), "--env.standing-starts: expected a share from 0 to 1, got 2.0"),
        (
            ("--changes", "3", "env.standing-starts", "-1"),
            "--env.standing-starts: expected a share from 0 to 1",
        ),
        (("--changes", "3", "env.canter-stance", "3"), "--env.canter-stance: expected a share of time, got 3.0"),
        (("--env.walk-emphasis", "-1"), "--env.walk-emphasis: expected a factor of at least 0, got -1.0"),
        (("--trials.start", "1", "--trials.every", "0"), "--trials.every: expected at least 1, got 0"),
        (("--trials.seconds", "1.5"), "--trials.seconds: expected at least 2, got 1.5"),
        (("--env.boxes", "-1"), "--env.boxes: expected a share from 0 to 1, got -1.0"),
        (("--changes", "3", "env.highest-box", "2"), "--env.highest-box: expected a height of boxes [m], got 2.0"),
        (("--env.lowest-box", "0.4"), "--env.lowest-box: expected at most --env.highest-box, 0.3, got 0.4"),
        (("--env.shares", "1", "0"), "--env.shares: expected 5 numbers, none below 0, got (1.0, 0.0)"),
        (("--env.encounters", "1.5"), "encounters: expected a share from 0 to 1, got 1.5"),
    ],
)
def test_impossible_options_are_refused(
    tmp_path: Path, command: Command, options: tuple[str, ...], message: str
) -> None:
    result = command("bbc_pretrain", "smoke", "--runs", tmp_path, "--name", "odd", *options)
    assert result.returncode != 0 and "Traceback" not in result.stderr
    assert message in result.stderr
    assert not (tmp_path / "odd").exists()


def test_a_gated_reward_is_paid_in_proportion_to_the_speed(module: Callable[[str], ModuleType]) -> None:
    recipe, setup, presets = module("bbc_pretrain"), module("bbc_setup"), module("bbc_presets")
    parts = setup.build(presets.SMOKE)
    batch = parts.rollout.collect(parts.bbc.privileged_policy()).clone()
    share = recipe.speed_share(parts, batch)
    # the same number by hand: "explicit" shows half the velocity of each state, the mean follows it over half a second
    command, velocity, done = batch["command"][..., :2], 2.0 * batch["explicit"][..., 1:3], batch["next", "done"]
    mean, expected = velocity[0], []
    for step in range(len(velocity) - 1):
        mean = mean + 0.02 / 0.5 * (velocity[step + 1] - mean)
        wanted = command[step].norm(dim=-1)
        along = (command[step] * mean).sum(-1) / wanted.clamp(min=1e-6)
        expected.append((1.0 - (along - wanted).abs() / wanted.clamp(min=0.1)).clamp(min=-1.0))
        mean = torch.where(done[step], velocity[step + 1], mean)
    going_on = ~done[:-1, :, 0]
    torch.testing.assert_close(share[:-1, :, 0][going_on], torch.stack(expected)[going_on], atol=1e-4, rtol=1e-4)

    def style_and_skill(gate: float) -> torch.Tensor:
        rewarded = batch.clone()
        cfg = replace(presets.SMOKE.imitation, gate=gate, task_reward=0.0, shift_reward=0.0)
        recipe.add_rewards(parts, cfg, rewarded, parts.env.dt)
        return rewarded["next", "reward"]

    torch.testing.assert_close(style_and_skill(1.0), style_and_skill(0.0) * share.clamp(0.0, 1.0))
    parts.env.rewards.pop("velocity_progress")
    assert torch.equal(style_and_skill(1.0), style_and_skill(0.0))
    parts.env.close()


def run_two(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Two processes on one machine, as a user starts them."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone"]
    command = [*launcher, str(RECIPE), "smoke", "--runs", str(folder), *options]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300, env=ONE_THREAD)


def test_what_is_saved_is_the_moving_average_of_weights(module: Callable[[str], ModuleType], tmp_path: Path) -> None:
    recipe, setup, presets = module("bbc_pretrain"), module("bbc_setup"), module("bbc_presets")
    assert presets.CPU.ppo.averaging > 0.0 and presets.PAPER.ppo.averaging == 0.0
    cfg = replace(presets.SMOKE, ppo=replace(presets.SMOKE.ppo, averaging=0.75))
    parts = setup.build(cfg)
    recipe.begin(parts, cfg)
    setup.save_policy(parts, cfg, tmp_path / "start")  # nothing to average yet
    history = [{name: tensor.clone() for name, tensor in parts.bbc.state_dict().items()}]
    for iteration in range(3):
        recipe.iterate(parts, cfg, iteration)
        history.append({name: tensor.clone() for name, tensor in parts.bbc.state_dict().items()})
    setup.save_policy(parts, cfg, tmp_path / "end")
    parts.env.close()
    start, end = (Artifact.load(tmp_path / name / "policy").state for name in ("start", "end"))
    for name, first in history[0].items():
        assert torch.equal(start[name], first)
        one, two, three = (state[name] for state in history[1:])
        torch.testing.assert_close(end[name], 0.75 * (0.75 * one + 0.25 * two) + 0.25 * three)
    moved = [name for name, last in history[-1].items() if not torch.equal(end[name], last)]
    assert any("actor" in name for name in moved)


def test_two_processes_train_one_policy_and_resume_bit_for_bit(tmp_path: Path) -> None:
    trials = ("--trials.start", "4", "--trials.episodes", "1", "--trials.seconds", "2", "--trials.switches", "0")
    printed = run_two(tmp_path, "--name", "whole", "--iterations", "4", *trials).stdout
    assert printed.count("saved") == 1, "one of them writes"
    assert read_scalars(tmp_path / "whole")["trial/targets"][0].tolist() == [4], "one of them measures"
    assert Artifact.load(tmp_path / "whole" / "policy").manifest["trial"]["iteration"] == 4
    assert read_scalars(tmp_path / "whole")["reward/task"][0].tolist() == [1, 2, 3, 4]
    run_two(tmp_path, "--name", "halves", "--iterations", "2", *trials)
    assert (tmp_path / "halves" / "checkpoints" / "process-1").is_dir()
    run_two(tmp_path, "--resume", str(tmp_path / "halves"), "--iterations", "4")
    whole, halves = (Artifact.load(tmp_path / name / "policy").state for name in ("whole", "halves"))
    assert not [name for name, tensor in whole.items() if not torch.equal(tensor, halves[name])]
    # One goes on with what belonged to the first; the second of two that follow begins with robots of its own.
    run(tmp_path, "--resume", str(tmp_path / "halves"), "--iterations", "5")
    run_two(tmp_path, "--resume", str(tmp_path / "halves"), "--iterations", "6")
    assert read_scalars(tmp_path / "halves")["reward/task"][0].tolist() == [1, 2, 3, 4, 5, 6]


def test_the_paper_preset_is_table_s1_and_the_supplement(module: Callable[[str], ModuleType]) -> None:
    paper = module("bbc_presets").PRESETS["paper"]
    ppo, imitation = paper.ppo, paper.imitation
    assert (ppo.learning_rate, ppo.gamma, ppo.lmbda, ppo.clip) == (1e-3, 0.99, 0.95, 0.2)
    assert (imitation.discriminator_learning_rate, imitation.encoder_learning_rate) == (5e-4, 1e-3)
    assert len(paper.motion.offsets) == 2 and paper.motion.offsets[1] - paper.motion.offsets[0] == 1
    assert (imitation.prior_weight, imitation.imitation_reward, imitation.task_reward) == (1e-3, 0.2, 0.2)
    assert ppo.hidden == (512, 256, 128)  # section S6
    # Method notes, section 3.7: 2 surrogate + 5 value - 0.01 entropy + 0.1 privileged, their gradient at most 1 long.
    weights = (1.0, ppo.value, ppo.entropy, paper.adaptation.privileged, ppo.max_grad_norm)
    assert [2.0 * weight for weight in weights] == [2.0, 5.0, 0.01, 0.1, 1.0]
    assert paper.env.friction_loss == 0.0  # section 4.1
    assert imitation.prior_temperature is None, "Algorithm S1, line 3: skills are drawn from the prior"
    assert imitation.criterion == "least_squares" and not imitation.conditional  # Eq. (10)
    assert paper.env.terrain == "rough" and paper.env.randomize and paper.env.push_interval  # section S2
    ours = (paper.env.rhythm_weight, paper.env.progress_weight, paper.env.turn_weight, paper.env.lateral_weight)
    assert ours == (0.0, 0.0, 0.0, 0.0) and paper.motion.turns == () and paper.ppo.symmetry == 0.0
    assert imitation.cloning == imitation.warm_up == imitation.gate == 0


def test_speed_and_turn_rate_errors_by_hand(module: Callable[[str], ModuleType]) -> None:
    command = torch.zeros(1, 2, 11)
    command[..., :3] = torch.tensor([[1.0, 0.0, 0.5], [0.5, 0.0, 0.0]])
    explicit, proprioception = torch.zeros(1, 2, 4), torch.zeros(1, 2, 45)
    explicit[0, :, 1:3] = 0.5 * torch.tensor([[1.0, 0.0], [0.2, 0.4]])  # scale of linear velocities
    proprioception[0, :, 4] = 0.25 * torch.tensor([0.1, -0.2])  # scale of angular velocities; x, y, z from 2 on
    names = ("command", "explicit", "proprioception")
    batch = dict(zip(names, (command, explicit, proprioception), strict=True))
    found = module("bbc_pretrain").tracking_error(batch)
    assert found["error/speed"].item() == pytest.approx(0.25)  # 0 and a distance of (0.3, -0.4)
    assert found["error/turn_rate"].item() == pytest.approx(0.3)  # 0.4 and 0.2
