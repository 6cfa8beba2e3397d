"""The folder of a run: written once, read again, and what it was made with."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import agility_rl
from agility_rl.training.run_folder import (
    abandon_run,
    abandoned_by_errors,
    from_json,
    read_config,
    read_json,
    start_run,
    to_json,
    versions,
    write_json,
)


@dataclass(frozen=True)
class Run:
    name: str | None = None
    init_from: Path | None = None
    hidden: tuple[int, ...] = (512, 256)


@dataclass(frozen=True)
class Config:
    run: Run = field(default_factory=Run)
    seed: int = 0
    resume: Path | None = None


def test_the_commit_is_that_of_the_package_and_of_no_checkout_around_it(tmp_path: Path) -> None:
    package = tmp_path / "site-packages" / "agility_rl"
    shutil.copytree(Path(agility_rl.__file__).parent, package)
    script = "from agility_rl.training.run_folder import versions; print('commit' in versions())"

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


def test_json_that_is_missing_is_none_and_damaged_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    assert read_json(file) is None
    write_json(file, {"cells": [1, None]})
    assert read_json(file) == {"cells": [1, None]}
    file.write_text(file.read_text()[:-3])
    with pytest.raises(ValueError, match=r"found\.json is damaged: .*; make it again"):
        read_json(file)


def test_a_run_folder_is_never_overwritten(tmp_path: Path) -> None:
    config = Config(Run("x", Path("runs/bbc"), (3,)), seed=1)
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


def test_only_what_can_be_resumed_is_offered_to_be(tmp_path: Path) -> None:
    start_run(Run(), tmp_path)
    with pytest.raises(FileExistsError, match=r"already holds a run; choose another name$"):
        start_run(Run(), tmp_path)


def test_a_run_that_cannot_begin_leaves_its_name_free(tmp_path: Path) -> None:
    run = tmp_path / "runs" / "mine"
    start_run(Config(), run)
    (run / "checkpoints").mkdir()
    abandon_run(run)
    assert not run.exists() and run.parent.exists()
    start_run(Config(), run)
    (run / "notes.txt").write_text("mine")
    abandon_run(run)
    assert [path.name for path in run.iterdir()] == ["notes.txt"]


def test_a_run_that_fails_leaves_its_name_free(tmp_path: Path) -> None:
    run = tmp_path / "mine"
    start_run(Config(), run)
    with abandoned_by_errors(run):
        pass
    assert (run / "config.json").is_file()
    with pytest.raises(KeyboardInterrupt), abandoned_by_errors(run):
        raise KeyboardInterrupt
    assert not run.exists()


def test_json_round_trip_and_unknown_fields() -> None:
    config = Config(run=Run(init_from=Path("a/b")))
    assert from_json(Config, json.loads(json.dumps(to_json(config)))) == config
    with pytest.raises(ValueError, match=r"config: run: unknown field 'nam' in Run; did you mean name\?"):
        from_json(Config, {"run": {"nam": 3}})


def test_a_damaged_configuration_is_named(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"config": {')
    with pytest.raises(ValueError, match="is damaged"):
        read_config(tmp_path, Config)
    (tmp_path / "config.json").write_text('{"config": {}, "config_version": 99}')
    with pytest.raises(ValueError, match="configuration version 99, expected 1"):
        read_config(tmp_path, Config)
