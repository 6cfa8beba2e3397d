"""The command line: presets, flags, one-line errors, signals."""

from __future__ import annotations

import dataclasses
import os
import signal
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from agility_rl.training import cli
from agility_rl.training.cli import from_presets
from agility_rl.training.run_folder import start_run


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
    changes: tuple[tuple[int, str, float], ...] = ()


@dataclass(frozen=True)
class Config:
    ppo: PPO = field(default_factory=PPO)
    run: Run = field(default_factory=Run)
    seed: int = 0
    resume: Path | None = None


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
        (["cpu", "--run.changes", "2", "lr", "nan"], "--run.changes must be finite, got nan"),
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
        "--ppo.clip-epsilon (0.2)",
        "--ppo.fused (False)",
        "--run.hidden ((512, 256))",
    ]
    assert cli.unheeded(PRESETS["cpu"], began, ["cpu"]) == []
    config = dataclasses.replace(began, run=Run(name="x"))
    assert cli.unheeded(config, began, ["cpu", "--resume", "./run.name"]) == [], "a value is no option"


def test_a_resumed_run_keeps_what_the_command_line_leaves_out(tmp_path: Path) -> None:
    start_run(Config(ppo=PPO(epochs=7), seed=4), tmp_path / "mine")
    resume = ["cpu", "--resume", str(tmp_path / "mine")]
    assert from_presets(PRESETS, resume, kept=("seed",)).seed == 4, "the preset says 1"
    assert from_presets(PRESETS, [*resume, "--seed", "1"], kept=("seed",)).seed == 1
    assert from_presets(PRESETS, ["cpu"], kept=("seed",)).seed == 1
    with pytest.raises(FileNotFoundError, match="nothing to resume"):
        from_presets(PRESETS, ["cpu", "--resume", "nowhere"], kept=("seed",))
