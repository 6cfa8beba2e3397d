"""The page of a run that is not evaluated yet, and of a folder that is none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from agility_rl.record import MCAPLogger
from agility_rl.record.plots import new_figure, save_figure
from agility_rl.training.run_folder import start_run


@dataclass(frozen=True)
class Config:
    name: str = "<b>bold</b>"


def test_a_run_without_evaluation_shows_its_learning_curves(tmp_path: Path, module) -> None:
    run = start_run(Config(), tmp_path / "young", recipe="bbc_pretrain")
    logger = MCAPLogger(run.name, run.parent)
    for step in range(3):
        logger.log_metrics({"reward/task": float(step), "kl": 0.01, "time/minutes": 1.0}, step=step)
    logger.close()
    report = module("report")
    report.main(report.Config(run))
    text = (run / "report.html").read_text()
    assert "not evaluated yet" in text and text.count("data:image/png;base64,") == 2
    assert "<b>bold</b>" not in text, "what a run contains is text, never markup"


def test_pictures_of_performances_are_on_the_page(tmp_path: Path, module) -> None:
    run = start_run(Config(), tmp_path / "shown", recipe="bbc_pretrain")
    save_figure(new_figure(1.0, 1.0), run / "figures" / "perform_0.png")
    module("report").main(module("report").Config(run))
    text = (run / "report.html").read_text()
    assert "<h2>Pictures</h2>" in text and "perform 0" in text and text.count("data:image/png;base64,") == 1


def test_an_evaluation_of_earlier_weights_is_said_to_be_one(module) -> None:
    outdated = module("report").outdated
    (note,) = outdated("b" * 64, {"evaluate": {"weights": "b" * 64}, "evaluate_course": {"weights": "a" * 64}})
    assert "an earlier policy of this run was evaluated: run recipes/evaluate_course.py on it again" in note
    assert outdated("b" * 64, {"evaluate": None, "evaluate_course": {}}) == []
    assert outdated(None, {"evaluate": {"weights": "a" * 64}}) == []


def test_a_folder_that_is_no_run(tmp_path: Path, module) -> None:
    report = module("report")
    with pytest.raises(FileNotFoundError, match="expected a run folder"):
        report.main(report.Config(tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_search_of_parameters_is_no_run_of_a_controller(tmp_path: Path, module) -> None:
    (tmp_path / "config.json").write_text('{"recipe": "easi", "config": {}}')
    with pytest.raises(ValueError, match=r"got one of easi.py; its own files say"):
        module("report").page(tmp_path)


def test_a_damaged_evaluation_is_named(tmp_path: Path, command) -> None:
    (tmp_path / "evaluation.json").write_text("{")
    result = command("report", tmp_path)
    assert result.returncode == 2 and "evaluation.json is damaged" in result.stderr
