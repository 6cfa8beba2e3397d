"""A performance: an episode that reads back, and a clear word where nothing can be drawn."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from agility_rl.record import read_episode
from agility_rl.record.episode import read_metadata


def test_it_records_an_episode_and_never_overwrites_one(untrained: Path, recipe, module) -> None:
    arguments = (untrained, "--behaviours", "trot", "jump", "--seconds", 0.4)
    # No graphics at all: the recipe must say so and do the rest.
    result = recipe("perform", *arguments, "--speed", 9.0, MUJOCO_GL="off")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "this machine cannot render" in result.stdout
    path = untrained / "episodes" / "perform_0.mcap"
    episode = read_episode(path)
    assert episode["root_position"].shape == (40, 3)
    assert episode["command/velocity_x"][0] == pytest.approx(1.5), "a speed is kept inside the range of Table S2"
    assert episode["command/jump_height"][-1] == pytest.approx(0.5)
    assert read_metadata(path)["pieces"] == [["trot", 0, 20], ["jump", 20, 20]]
    assert (untrained / "episodes" / "agility_rl.layout.json").is_file()
    drawn = recipe("picture_strip", path, untrained / "strip.png", "--frames", 3, MUJOCO_GL="egl")
    if drawn.returncode:  # for want of graphics, and of nothing else
        assert "gl" in drawn.stderr.lower(), drawn.stderr
    else:
        assert (untrained / "strip.png").stat().st_size > 20_000
    perform = module("perform")
    again = perform.Config(untrained, behaviours=("trot",), seconds=0.1, strip=False)
    assert perform.main(again, Console()).name == "perform_1.mcap"


def test_unknown_behaviours_and_folders_are_named(untrained: Path, module) -> None:
    perform = module("perform")
    with pytest.raises(ValueError, match="'gallop' is no behaviour"):
        perform.main(perform.Config(untrained, behaviours=("gallop",)), Console())
    assert not (untrained / "episodes").exists()
    with pytest.raises(FileNotFoundError, match="check the path"):
        perform.main(perform.Config(untrained / "nowhere"), Console())


def test_a_command_stays_inside_the_range_of_its_behaviour(module) -> None:
    perform = module("perform")
    assert perform.command_for(0, 9.0, -9.0)[0].tolist() == pytest.approx([0.6, 0.0, -1.0, 0.0, 0.295])
    assert perform.command_for(4, None, 0.0)[0].tolist() == pytest.approx([1.3, 0.0, 0.0, 0.5, 0.0])
