"""Figures of a controller beside the dogs: drawn as a user does, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.motion import synthesize_gait
from agility_rl.record import MCAPLogger


@pytest.fixture
def figures(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("gait_figures")


def test_all_figures_are_drawn_of_a_run_with_its_log(untrained: Path, recipe) -> None:
    logger = MCAPLogger(untrained.name, untrained.parent)
    for step in range(3):
        logger.log_metrics({f"prior/{name}": 0.2 + 0.01 * step for name in BEHAVIOURS}, step=step)
    logger.close()
    result = recipe("gait_figures", untrained, "--settle", 0.1, "--stay", 0.1, "--robots", 1)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "motion: synthetic gaits of agility_rl: no dog moved like this" in result.stdout
    pictures = {path.name: path.stat().st_size for path in (untrained / "figures").iterdir()}
    assert set(pictures) == {"footfalls.png", "transitions.png", "shift.png", "prior.png"}
    assert min(pictures.values()) > 5000


def test_what_cannot_be_drawn_is_one_line(untrained: Path, recipe) -> None:
    for arguments, message in (
        ((untrained, "--robots", 0), "--robots of at least 1"),
        ((untrained / "nowhere",), "check the path"),
    ):
        result = recipe("gait_figures", *arguments)
        assert result.returncode == 2 and message in result.stderr and result.stderr.count("\n") == 1
    assert not (untrained / "figures").exists()


def test_commands_are_the_middle_of_their_ranges_or_the_nearest_speed(figures: ModuleType) -> None:
    skill = torch.tensor([2, 4, 3])
    told = figures.command(skill)
    torch.testing.assert_close(told[0], torch.tensor([1.0, 0.0, 0.0, 0.0, 0.295]))
    torch.testing.assert_close(told[1, 3], torch.tensor(0.5))
    clamped = figures.command(skill, torch.tensor([0.7, 9.0, 0.1]))
    torch.testing.assert_close(clamped[:, 0], torch.tensor([0.7, 1.8, 0.8]))
    assert torch.equal(clamped[:, 1:], told[:, 1:])


def test_the_longest_clip_of_a_behaviour_is_shown(figures: ModuleType) -> None:
    clips = [synthesize_gait(name, duration=length) for name in reversed(BEHAVIOURS) for length in (1.0, 3.0, 2.0)]
    chosen = figures.examples(clips)
    assert [clip.label for clip in chosen] == list(BEHAVIOURS)
    assert all(clip.duration == pytest.approx(3.0, abs=0.05) for clip in chosen)


def test_every_robot_is_told_its_shift_and_the_fallen_do_not_count(
    figures: ModuleType, untrained: Path, module, monkeypatch: pytest.MonkeyPatch
) -> None:
    rollouts, told = module("rollouts"), []
    controller = rollouts.load_controller(untrained)
    motion = rollouts.load_motion(rollouts.MotionConfig(), {}, 0)
    make = rollouts.make_env

    def watched(*arguments, **options):
        env = make(*arguments, **options)
        command = env.set_commands
        env.set_commands = lambda *given: (told.append(given), command(*given))[1]
        return env

    monkeypatch.setattr(figures, "make_env", watched)
    measure, fell = figures.drive, torch.zeros(90, dtype=torch.bool)
    fell[[0, 7]] = True  # whoever else falls

    def driven(*arguments):
        recording = measure(*arguments)
        return replace(recording, fell=fell)

    monkeypatch.setattr(figures, "drive", driven)
    config = figures.Config(untrained, settle=0.1, robots=2)
    effect = figures.shift_effect(controller, motion.start_states(0), config)
    assert effect.shape == (5, 9, 2, 4)
    skill, _, shift = told[-1]
    assert torch.equal(skill.unflatten(0, (5, 9, 2))[:, 0, 0], torch.arange(5))
    torch.testing.assert_close(shift.unflatten(0, (5, 9, 2))[2, :, 1, 0], torch.linspace(-1.0, 1.0, 9))
    assert torch.equal(effect.isnan().all(-1).flatten(), fell)
    assert torch.equal(effect[..., 1:3].isnan().any(-1).flatten(), fell), "speed and height of all others are numbers"
    assert figures.shifts(effect).axes[1].get_title() == "speed [m/s]"
