"""Ablations: tiny trainings end in a table, nothing is done twice, and every variant is a valid command."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from agility_rl.record import read_scalars
from agility_rl.training import cli

SHORT = ("--episodes", 1, "--seconds", 2, "--switches", 0)


@pytest.fixture
def ablations(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("ablations")


def test_trainings_end_in_a_table_go_on_where_they_stopped_and_are_not_done_twice(tmp_path: Path, recipe) -> None:
    run = tmp_path / "ablation_none_0"
    started = recipe("bbc_pretrain", "smoke", "--name", run.name, "--runs", tmp_path, "--iterations", 1)
    assert started.returncode == 0, started.stderr
    arguments = ("--preset", "smoke", "--runs", tmp_path, "--variants", "none", "no_labels", *SHORT)
    result = recipe("ablations", *arguments)
    assert result.returncode == 0, result.stdout + result.stderr
    lines = (tmp_path / "ablations.md").read_text().splitlines()
    assert [line.split("|")[1].strip() for line in lines] == ["without", "---", "none", "no labels"]
    found = json.loads((tmp_path / "ablations.json").read_text())["rows"]
    evaluated = json.loads((run / "evaluation.json").read_text())
    assert found["none"][0]["targets"] == sum(target["passed"] for target in evaluated["targets"])
    assert found["none"][0]["falls"] == evaluated["falls"]["estimate"]
    assert read_scalars(run)["time/minutes"][0].tolist() == [1, 2], "the second iteration only"
    nameless = tmp_path / "ablation_no_labels_0"
    assert json.loads((nameless / "config.json").read_text())["config"]["motion"]["label_share"] == 0.0
    assert "loss_skill" in read_scalars(run) and "loss_marginal" not in read_scalars(run)
    assert "loss_skill" not in read_scalars(nameless) and "loss_marginal" in read_scalars(nameless)
    again = recipe("ablations", *arguments)
    assert again.returncode == 0 and "bbc_pretrain" not in again.stdout
    for others, named in ((("--iterations", 1), "iterations"), (("--episodes", 2), "episodes")):
        refused = recipe("ablations", *arguments, *others)
        assert refused.returncode == 2
        assert f"{run} was made with other {named}; choose another --runs" in " ".join(refused.stderr.split())


def test_every_variant_is_a_command_that_the_recipe_takes(
    ablations: ModuleType, module, monkeypatch: pytest.MonkeyPatch
) -> None:
    presets = module("bbc_presets").PRESETS
    for preset, name in itertools.product(("cpu", "half_hour", "paper"), ablations.VARIANTS):
        monkeypatch.setattr("sys.argv", ["bbc_pretrain.py", preset, *ablations.options_of(name, preset)])
        cfg = cli.from_presets(presets, doc="")
        assert (cfg == presets[preset]) == (name == "none") or preset == "paper"
        if name == "task_only":
            assert cfg.imitation.imitation_reward == cfg.imitation.skill_reward == cfg.env.rhythm_weight == 0.0
            kept = [change for change in presets[preset].changes if not change[1].startswith("imitation.")]
            assert list(cfg.changes) == kept and bool(kept) == (preset != "paper")


def test_ctrl_c_waits_for_what_a_recipe_saves(
    ablations: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "saves.py").write_text(
        "import os, pathlib, signal, time\n"
        "time.sleep(0.5)\n"
        "os.kill(os.getppid(), signal.SIGINT)\n"
        "time.sleep(1.0)\n"
        "pathlib.Path(__file__).with_suffix('.saved').touch()\n"
        "raise SystemExit(3)\n"
    )
    monkeypatch.setattr(ablations, "__file__", str(tmp_path / "ablations.py"))
    with pytest.raises(ValueError, match=r"recipes/saves\.py ended with 3"):
        ablations.command("saves")
    assert (tmp_path / "saves.saved").is_file()


def test_several_seeds_have_an_interval(ablations: ModuleType) -> None:
    row = dict.fromkeys(("walk", "pace", "trot", "canter", "jump", "nmi", "falls"), 0.5) | {"like_a_dog": 20}
    text = ablations.table({"none": [row | {"targets": 38}, row | {"targets": 40}]})
    # t(0.975, 1) = 12.706, standard deviation sqrt(2), over sqrt(2): 39 +- 12.7
    assert "| none | 2 | 39.0 ± 12.7 |" in text


def test_an_unknown_variant_is_named(ablations: ModuleType, tmp_path: Path, recipe) -> None:
    result = recipe("ablations", "--variants", "no_dogs", "--runs", tmp_path)
    assert result.returncode == 2 and "no_dogs" in result.stderr and result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
