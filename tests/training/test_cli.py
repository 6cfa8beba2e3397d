"""The command line: presets, flags, one-line errors, and the run folder."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import agility_rl
from agility_rl.training import cli
from agility_rl.training.cli import abandon_run, from_json, from_presets, read_config, start_run, to_json, versions


@dataclass(frozen=True)
class PPO:
    epochs: int = 5
    """Passes over a batch."""
    clip_epsilon: float = 0.2
    fused: bool = False


@dataclass(frozen=True)
class Run:
    name: str | None = None
    init_from: Path | None = None
    hidden: tuple[int, ...] = (512, 256)


@dataclass(frozen=True)
class Config:
    ppo: PPO = field(default_factory=PPO)
    run: Run = field(default_factory=Run)
    seed: int = 0


PRESETS = {"paper": Config(), "cpu": Config(ppo=PPO(epochs=3), seed=1)}


def test_flags_override_the_preset() -> None:
    assert from_presets(PRESETS, ["cpu"]) == PRESETS["cpu"]
    arguments = [
        "paper",
        "--ppo.clip-epsilon",
        "0.1",
        "--ppo.fused",
        "--run.init-from=runs/bbc",
        "--run.hidden",
        "8",
        "4",
    ]
    config = from_presets(PRESETS, arguments)
    assert config.ppo == PPO(5, 0.1, True)
    assert config.run == Run(None, Path("runs/bbc"), (8, 4))
    assert from_presets(PRESETS, ["cpu", "--ppo.clip_epsilon", "0.3"]).ppo.clip_epsilon == 0.3
    assert from_presets({"on": Config(ppo=PPO(fused=True))}, ["on", "--ppo.no-fused"]).ppo.fused is False
    assert from_presets(PRESETS, ["paper", "--seed", "-1"]).seed == -1


def test_a_default_preset() -> None:
    assert from_presets(PRESETS, ["--seed", "4"], default="cpu") == dataclasses.replace(PRESETS["cpu"], seed=4)
    assert from_presets(PRESETS, [], default="cpu") == PRESETS["cpu"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cpu", "--ppo.clip_epsilonn", "1"], "unknown option --ppo.clip-epsilonn; did you mean --ppo.clip-epsilon?"),
        (["cpu", "--epochs", "1"], "unknown option --epochs; did you mean --ppo.epochs?"),
        (["cpu", "--qqqqq=1"], "unknown option --qqqqq; nothing known resembles it"),
        (["cpuu"], "unknown preset 'cpuu'; did you mean 'cpu'?".replace("'cpu'?", "cpu?")),
        ([], "expected a preset first, one of paper, cpu; got nothing"),
        (["--seed", "1"], "expected a preset first, one of paper, cpu; got --seed"),
        (["cpu", "--ppo.clip-epsilon", "nan"], "--ppo.clip-epsilon must be finite, got nan"),
        (["cpu", "--ppo.clip-epsilon=inf"], "--ppo.clip-epsilon must be finite, got inf"),
    ],
)
def test_mistakes_end_in_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        from_presets(PRESETS, arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.startswith(f"error: {message}") and error.count("\n") == 1


def test_a_wrong_value_names_its_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        from_presets(PRESETS, ["cpu", "--ppo.epochs", "many"])
    captured = capsys.readouterr()
    assert stop.value.code == 2 and "--ppo.epochs" in captured.err + captured.out


@pytest.mark.parametrize("arguments", [["--help"], ["cpu", "--help"]])
def test_help_shows_documentation_and_presets(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        from_presets(PRESETS, arguments, doc="Pretrains.")
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert "Passes over a batch." in text and "Presets: paper, cpu" in text and "Pretrains." in text


def test_presets_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\['PPO', 'Run'\]"):
        from_presets({"a": PPO(), "b": Run()}, ["a"])


def test_the_commit_is_that_of_the_package_and_of_no_checkout_around_it(tmp_path: Path) -> None:
    package = tmp_path / "site-packages" / "agility_rl"
    shutil.copytree(Path(agility_rl.__file__).parent, package)
    script = "from agility_rl.training.cli import versions; print('commit' in versions())"

    def told() -> str:
        environment = os.environ | {"PYTHONPATH": str(package.parent)}
        command = [sys.executable, "-c", script]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=True)
        return done.stdout.strip()

    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for arguments in (("init", "-q"), ("commit", "-q", "--allow-empty", "-m", "mine")):
        subprocess.run([*git, *arguments], check=True)
    assert told() == "False"
    for arguments in (("add", "."), ("commit", "-q", "-m", "a fork")):
        subprocess.run([*git, *arguments], check=True)
    assert told() == "True"


def test_a_run_folder_is_never_overwritten(tmp_path: Path) -> None:
    config = dataclasses.replace(PRESETS["cpu"], run=Run("x", Path("runs/bbc"), (3,)))
    folder = start_run(config, tmp_path / "runs" / "demo", recipe="bbc_pretrain")
    record = json.loads((folder / "config.json").read_text())
    assert record["config"]["run"] == {"name": "x", "init_from": "runs/bbc", "hidden": [3]}
    assert record["recipe"] == "bbc_pretrain" and record["versions"]["torch"] == versions()["torch"]
    assert read_config(folder, Config) == config
    with pytest.raises(FileExistsError, match="already holds a run; choose another name, or continue it with --resume"):
        start_run(config, folder)
    for number in (1, 2):
        start_run(config, folder, resume=True)
        assert (folder / f"config.resumed-{number}.json").is_file()
    with pytest.raises(FileNotFoundError, match="nothing to resume"):
        start_run(config, tmp_path / "none", resume=True)


def test_a_run_that_cannot_begin_leaves_its_name_free(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "mine"
    start_run(PRESETS["cpu"], run)
    (run / "checkpoints").mkdir()
    abandon_run(run)
    assert not run.exists() and run.parent.exists()
    start_run(PRESETS["cpu"], run)
    (run / "notes.txt").write_text("mine")
    abandon_run(run)
    assert [path.name for path in run.iterdir()] == ["notes.txt"]


def test_json_round_trip_and_unknown_fields() -> None:
    config = Config(run=Run(init_from=Path("a/b")))
    assert from_json(Config, json.loads(json.dumps(to_json(config)))) == config
    with pytest.raises(ValueError, match=r"config: ppo: unknown field 'epoch' in PPO; did you mean epochs\?"):
        from_json(Config, {"ppo": {"epoch": 3}})


def test_a_damaged_configuration_is_named(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"config": {')
    with pytest.raises(ValueError, match="is damaged"):
        read_config(tmp_path, Config)
    (tmp_path / "config.json").write_text('{"config": {}, "config_version": 99}')
    with pytest.raises(ValueError, match="configuration version 99, expected 1"):
        read_config(tmp_path, Config)


def test_every_signal_to_end_lets_the_present_iteration_finish() -> None:
    before = {number: signal.signal(number, signal.SIG_DFL) for number in cli.STOPS}  # whoever started the tests
    try:
        for number in cli.STOPS:
            with cli.interruptible() as interrupted:
                assert not interrupted()
                os.kill(os.getpid(), number)
                assert interrupted()
                with pytest.raises(KeyboardInterrupt):
                    os.kill(os.getpid(), number)
            assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_who_was_started_by_nohup_outlives_its_terminal() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with cli.interruptible() as interrupted:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupted()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_options_that_a_resumed_run_does_not_heed_are_named() -> None:
    """Those that were given and differ from its own; what the preset says otherwise was not asked for."""
    began = Config(ppo=PPO(epochs=7), seed=4)
    given = ["cpu", "--ppo.clip_epsilon=0.1", "--ppo.fused", "--seed", "4", "--run.hidden", "8", "4"]
    assert cli.unheeded(from_presets(PRESETS, given), began, given) == [
        "--ppo.clip_epsilon (0.2)",
        "--ppo.fused (False)",
        "--run.hidden ((512, 256))",
    ]
    assert cli.unheeded(PRESETS["cpu"], began, ["cpu"]) == []
