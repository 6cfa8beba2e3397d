"""The recipe as a user runs it: a table, pictures, one clear message for every broken file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from rich.console import Console

from agility_rl.motion.clip import MotionError, load, save
from agility_rl.motion.gaits import synthesize_gait


@pytest.fixture
def recipe(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("inspect_motion")


@pytest.fixture
def screen() -> Console:
    return Console(width=220, record=True, quiet=False)


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    folder = tmp_path / "clips"
    for name in ("trot", "jump"):
        save(synthesize_gait(name, duration=2.0), folder / f"{name}_0.npz")
    (folder / "LICENSE.txt").write_text("no motion")
    return folder


def test_a_folder_becomes_a_table_figures_and_converted_clips(
    recipe: ModuleType, screen: Console, clips: Path, tmp_path: Path
) -> None:
    config = recipe.Config(paths=(clips,), output=tmp_path / "figures", convert=tmp_path / "converted")
    assert recipe.main(config, screen) == 0
    text = screen.export_text()
    assert "clips/trot_0.npz" in text and "gait generator (synthetic)" in text
    assert "agrees with the name of 2 of 2 clips" in text
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"trot_0.png", "jump_0.png"}
    assert load(tmp_path / "converted" / "trot_0.npz").dt == 0.02
    with pytest.raises(MotionError, match="exists and is not overwritten"):
        recipe.main(config, screen)


def test_a_broken_file_gets_a_line_and_hides_no_other(recipe: ModuleType, screen: Console, clips: Path) -> None:
    (clips / "walk_0.json").write_text('{"FrameDuration": 0.02, "Frames": [[1, 2, 3]]}')
    assert recipe.main(recipe.Config(paths=(clips,), figures=False), screen) == 1
    text = screen.export_text()
    assert "cannot read" in text and "walk_0.json" in text
    assert "2 clips, 4.0 s" in text


def test_without_a_path_the_synthetic_gaits_are_shown(recipe: ModuleType, screen: Console, tmp_path: Path) -> None:
    assert recipe.main(recipe.Config(output=tmp_path / "none", figures=False), screen) == 0
    text = screen.export_text()
    assert "5 of 5 clips named after a behaviour" in text
    assert "no dog moved like this" in text
    assert not (tmp_path / "none").exists()


def test_files_of_one_name_from_two_folders_are_all_written(
    recipe: ModuleType, screen: Console, clips: Path, tmp_path: Path
) -> None:
    paths = (clips / "trot_0.npz", save(synthesize_gait("walk", duration=0.56), tmp_path / "other" / "trot_0.npz"))
    config = recipe.Config(paths=paths, output=tmp_path / "f", convert=tmp_path / "c", window=0.3)
    assert recipe.main(config, screen) == 0
    for folder, suffix in (("f", "png"), ("c", "npz")):
        assert {path.name for path in (tmp_path / folder).iterdir()} == {f"trot_0.{suffix}", f"trot_0-2.{suffix}"}
    (tmp_path / "c" / "trot_0.npz").unlink()
    with pytest.raises(MotionError, match=r"trot_0-2.npz: exists and is not overwritten"):
        recipe.main(config, screen)
    assert not (tmp_path / "c" / "trot_0.npz").exists(), "all or none"


def test_impossible_options_and_empty_folders(recipe: ModuleType, screen: Console, tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="--window of at least"):
        recipe.main(recipe.Config(window=0.0), screen)
    with pytest.raises(MotionError, match="found none in this folder"):
        recipe.main(recipe.Config(paths=(tmp_path,)), screen)


def test_the_command_line_reports_a_missing_path_in_one_line(tmp_path: Path, command) -> None:
    result = command("inspect_motion", tmp_path / "nowhere")
    assert result.returncode == 2
    assert "found nothing; check the path" in result.stderr
    assert "Traceback" not in result.stdout + result.stderr
