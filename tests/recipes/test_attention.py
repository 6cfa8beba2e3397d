"""Attention of students: the obstacle's pixels against single rays, shares by hand, and a whole figure."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from rich.console import Console
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.go2 import camera
from agility_rl.modules import RecurrentStudent

Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("attention")


@pytest.fixture
def scenes(module: Module) -> ModuleType:
    return module("attention_scenes")


def stand(td: TensorDict) -> TensorDict:
    return td.set(keys.ACTION, torch.zeros(*td.shape, 12))


def test_the_pixels_of_the_obstacle_are_those_whose_rays_meet_it(scenes: ModuleType) -> None:
    env = AgilityEnv(2, stand, COURSES["full"], simulator_options={"num_threads": 1}, seed=1)
    env.reset()
    eye = env.simulator.make_camera()
    before = env.simulator.batch.state.copy()
    depth, mask = scenes.obstacle_pixels(env, eye)
    assert np.array_equal(env.simulator.batch.state, before), "the obstacle is back where it was"
    assert torch.equal(eye.render(torch.ones(2, dtype=torch.bool)), depth)
    model, data = env.simulator.model, mujoco.MjData(env.simulator.model)
    trunk, hit = model.body("trunk").id, np.zeros(1, dtype=np.int32)
    for row in range(2):
        for field in ("qpos", "mocap_pos", "mocap_quat"):
            getattr(data, field)[:] = env.simulator.batch.bind(field)[row]
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[trunk].reshape(3, 3)
        origin = data.xpos[trunk] + turn @ np.array(camera.POSITION)
        own = f"{int(env.arena.progress.obstacle[row])}_"
        meets = torch.zeros(58 * 87, dtype=torch.bool)
        for pixel, ray in enumerate(camera.pixel_directions().double().numpy().reshape(-1, 3) @ turn.T):
            distance = mujoco.mj_ray(model, data, origin, ray, None, 1, trunk, hit)
            name = model.body(model.geom_bodyid[hit[0]]).name if distance >= 0.0 else ""
            meets[pixel] = name.startswith(own)
        meets = meets.reshape(58, 87)
        near = depth[row] < camera.DEPTH_FAR - 0.1
        assert mask[row].float().mean() > 0.02
        assert not (mask[row] & ~meets).any(), "only rays that meet it change when it is gone"
        missed = (meets & near & ~mask[row]).sum() / (meets & near).sum()
        assert missed < 0.05, "all but where the floor right behind it is as far"
    env.close()


def test_shares_and_similarity_by_hand(recipe: ModuleType) -> None:
    cam = torch.tensor([[[1.0, 3.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])
    mask = torch.tensor([[[False, True], [True, False]]] * 2)
    share = recipe.share_on(cam, mask)
    assert share[0].item() == pytest.approx(0.75) and math.isnan(share[1].item())
    other = torch.tensor([[[3.0, 1.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]]])
    assert recipe.similarity(cam, other)[0].item() == pytest.approx(0.6)
    assert recipe.interval(share).estimate == pytest.approx(0.75)
    assert recipe.interval(share[1:]) is None


def test_objectives_are_the_students_own_numbers(scenes: ModuleType) -> None:
    torch.manual_seed(0)
    student = RecurrentStudent(hidden=(16, 16), memory=16, encoder_hidden=8)
    context = TensorDict(
        {
            keys.PROPRIOCEPTION: torch.randn(4, 45),
            keys.HISTORY: torch.randn(4, 10, 45),
            keys.HIDDEN: torch.randn(4, 16),
            "is_init": torch.tensor([[True], [False], [False], [False]]),
        },
        [4],
    )
    images, kind = torch.rand(4, 58, 87) - 0.5, torch.tensor([0, 3, 1, 6])
    expected = student.policy()(context.clone().set(keys.DEPTH, images))
    features = student.depth_encoder.module(images)
    behaviour = scenes.objective("behaviour", student, context, kind)(features)
    torch.testing.assert_close(behaviour, expected["logits"].max(-1).values)
    obstacle = scenes.objective("obstacle", student, context, kind)(features)
    torch.testing.assert_close(obstacle, expected[keys.OBSTACLE_LOGITS][torch.arange(4), kind])
    (gradient,) = torch.autograd.grad(obstacle.sum(), features)
    assert bool((gradient.abs().sum(-1) > 0.0).all())
    assert scenes.objective("feature", student, context, kind) is None


def test_a_figure_and_a_number(
    recipe: ModuleType, make_student: Callable[..., Path], untrained: Path, tmp_path: Path
) -> None:
    runs = (make_student("one"), make_student("two", byol=False, seed=1))
    config = recipe.Config(runs, bbc=untrained, course="bar_jump", images=6, robots=3, every=1, num_threads=1)
    console = Console(file=StringIO(), width=200)
    recipe.attend(config, console)
    found = json.loads((runs[0] / "attention.json").read_text())
    assert [run["label"] for run in found["runs"]] == ["with BYOL", "without BYOL"]
    assert found["images"] == {"bar_jump": 6}
    for group in found["groups"].values():
        assert set(group["share"]) == {"none", "rectangles", "noise", "blur", "dropout"}
        assert 0.0 < group["share"]["none"]["estimate"] < 1.0
        assert group["similarity_to_undisturbed"]["none"]["estimate"] == pytest.approx(1.0, abs=1e-5)
    assert (runs[0] / "figures" / "attention.png").stat().st_size > 20_000
    recipe.attend(replace(config, objective="behaviour", obstacle="tunnel", output=tmp_path / "other"), console)
    assert "none of the images shows tunnel" in console.file.getvalue()
    other: Any = json.loads((tmp_path / "other" / "attention.json").read_text())
    assert other["groups"]["with BYOL"]["share"] != found["groups"]["with BYOL"]["share"]
    with pytest.raises(ValueError, match="unknown 'gate'; expected one of bar_jump"):
        recipe.attend(replace(config, obstacle="gate"), console)
    with pytest.raises(ValueError, match=r"only \d+ of 6 moments show an obstacle; lower --least"):
        recipe.attend(replace(config, least=0.99), console)
