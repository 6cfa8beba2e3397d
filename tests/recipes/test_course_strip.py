"""Pictures of an episode on a course: which moments, what stands around the robot, and that they are drawn."""

from __future__ import annotations

from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import pytest
import torch
from rich.console import Console
from tensordict import TensorDict

from agility_rl.envs import COURSES
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2.constants import DEFAULT_POSE

Module = Callable[[str], ModuleType]


@pytest.fixture
def strip(module: Module) -> ModuleType:
    return module("course_strip")


def passing(rollouts: ModuleType, course: str) -> Any:
    """Straight over the only obstacle of a course at 1 m/s, from 3 m before its middle to 3 m behind it."""
    layout = CourseLayout(COURSES[course], 1, torch.Generator())
    layout.draw(torch.ones(1, dtype=torch.bool))
    along = torch.arange(-3.0, 3.0, 0.02)
    points = torch.stack((along, 0 * along), -1)
    flat = torch.cat([layout.world(torch.tensor([0]), point[None]) for point in points])
    pose = torch.cat(
        (torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor(DEFAULT_POSE), torch.zeros(layout.poses()[2].shape[1]))
    )
    steps = {
        "position": torch.cat((flat, torch.full((len(along), 1), 0.3)), -1),
        "pose": pose.expand(len(along), -1),
        "behaviour": torch.full((len(along),), 2),
    }
    none = torch.zeros(len(OBSTACLES), dtype=torch.int64)
    fields = {"passed": none, "bypassed": none, "failed": none, "cause": "", "layout": layout.state_dict()}
    return rollouts.Episode(steps["position"][0], TensorDict(steps, [len(along)]), **fields)


@pytest.mark.parametrize("course", ["seesaw", "bar_jump"])
def test_it_is_shown_before_on_and_behind(strip: ModuleType, module: Module, course: str) -> None:
    episode = passing(module("course_rollouts"), course)
    layout = module("course_judgement").layout_of(COURSES[course], episode)
    ((name, steps),) = strip.moments(layout, episode)
    reach = layout.kinds[0].half_extents[0] + 0.7
    assert name == course
    assert steps == pytest.approx([(3.0 - reach) / 0.02, 150, (3.0 + reach) / 0.02], abs=1)


def test_the_world_is_the_episodes(strip: ModuleType, module: Module) -> None:
    episode = passing(module("course_rollouts"), "seesaw")
    layout = module("course_judgement").layout_of(COURSES["seesaw"], episode)
    model = strip.world(layout)
    assert model.nq == 3 + episode.steps["pose"].shape[1]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    position, _, _ = layout.poses()
    for piece, place in zip(layout.pieces, position[0].tolist(), strict=True):
        assert data.body(piece.name).xpos.tolist() == pytest.approx(place, abs=1e-6)


def test_it_is_drawn_or_says_why_not(module: Module, tmp_path: Path) -> None:
    recipe, console = module("evaluate_course"), Console(file=StringIO(), width=300)
    episode, file = passing(module("course_rollouts"), "bar_jump"), tmp_path / "strip.png"
    recipe.draw_strip(COURSES["bar_jump"], [episode], file, console)
    said = console.file.getvalue()
    if not file.is_file():  # for want of graphics, and of nothing else
        assert "gl" in said.split("was not rendered: ")[1].split("; try MUJOCO_GL")[0].lower()
    recipe.draw_strip(COURSES["bar_jump"], [], tmp_path / "none.png", console)
    assert "no episode succeeded" in console.file.getvalue() and not (tmp_path / "none.png").exists()
