"""Fine-tuning in an identified simulator, on a few robots and the synthetic gaits."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.deploy.artifact import Artifact

Module = Callable[[str], ModuleType]


@pytest.fixture
def truth(module: Module, tmp_path: Path) -> Path:
    record = module("record_log")
    log = record.main(record.Config(log=tmp_path / "t.csv", steps=200, truth=record.Truth(calf_stiffness=0.7)))
    return log.with_suffix(".truth.json")


def test_it_trains_in_the_simulator_and_compares(
    module: Module, untrained: Path, truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finetune = module("bbc_finetune")
    cfg = replace(
        finetune.PRESETS["smoke"], runs=tmp_path, init_from=untrained, simulator=truth, target=truth, num_threads=1
    )
    run = finetune.main(cfg)
    before, after = (Artifact.load(folder / "policy").state for folder in (untrained, run))
    changed = [name for name in before if name.startswith("actor") and not torch.equal(before[name], after[name])]
    assert changed, "the third iteration trains the policy"
    comparison = json.loads((run / "comparison.json").read_text())
    assert set(comparison) == {"identified", "target"} and set(comparison["target"]) == {"before", "after"}
    assert comparison["target"]["before"] != comparison["target"]["after"]
    assert comparison["target"]["after"] == comparison["identified"]["after"]  # here both are the same simulator
    assert "in the target simulator" in capsys.readouterr().out
    settings = json.loads((run / "config.json").read_text())["config"]
    assert settings["imitation"]["cloning"] == 0 and settings["ppo"]["hidden"] == [16, 16]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give --init-from RUN"),
        (("--init-from", "{run}"), "and --simulator RUN"),
        (("--init-from", "{run}", "--simulator", "nowhere"), "nowhere"),
        (("--init-from", "{run}", "--simulator", "{run}", "--target", "nowhere.json"), "nowhere.json"),
        (("--init-from", "{run}", "--simulator", "{run}", "--training", "gpu"), "--training must be one of smoke"),
        (("--init-from", "{run}", "--simulator", "{run}", "--seconds", "1"), "expected --seconds at least 1 s longer"),
        (("--init-from", "{run}", "--simulator", "{run}", "--iterations", "0"), "--iterations: expected at least 1"),
    ],
)
def test_bad_options_give_one_clear_line(
    module: Module,
    untrained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    finetune = module("bbc_finetune")
    arguments = ["smoke", "--runs", str(tmp_path), *(option.format(run=untrained) for option in options)]
    with pytest.raises(SystemExit) as stop, finetune.cli.one_line_errors():
        finetune.main(finetune.cli.from_presets(finetune.PRESETS, arguments))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "finetune").exists()
