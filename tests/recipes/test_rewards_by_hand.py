"""What the trainings of controllers and teachers pay, summed by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs.agility_rewards import AGILITY_REWARDS
from agility_rl.go2 import features
from agility_rl.modules import Discriminator, FeatureNormalizer

Module = Callable[[str], ModuleType]


def style_of(logit: Tensor) -> Tensor:
    """r^I of Eq. (11), Eq. (2)."""
    return torch.clamp(1.0 - (logit - 1.0) ** 2 / 4.0, min=0.0)


@pytest.mark.parametrize("floor", [None, -1.55])
def test_equation_11(module: Module, floor: float | None) -> None:
    recipe, setup, smoke = module("bbc_pretrain"), module("bbc_setup"), module("bbc_presets").SMOKE
    parts = setup.build(smoke)
    batch = parts.rollout.collect(parts.bbc.privileged_policy()).clone()
    weights = {"imitation_reward": 0.7, "skill_reward": 0.3, "shift_reward": 0.2, "task_reward": 0.6}
    paid = batch.clone()
    recipe.add_rewards(parts, replace(smoke.imitation, gate=0.0, skill_floor=floor, **weights), paid, 0.02)
    with torch.no_grad():
        motion, skill = batch["next", "motion"].flatten(0, 1), batch["skill"].flatten()
        features_of = parts.discriminator.trunk(motion)
        logit = parts.discriminator.judge(features_of, skill)
        skills, shown = parts.predictor.predict(features_of)
    told = skills.log_softmax(-1)[torch.arange(len(skill)), skill][:, None]
    if floor is not None:
        assert (told < floor).any() and (told > floor).any(), "both sides of the floor"
        told = torch.where(told < floor, 0.0, 1.0 + told / -floor)
    shift = (shown - batch["shift"].flatten(0, 1)).abs().mean(-1, keepdim=True)
    task = batch["next", "reward"].flatten(0, 1)
    expected = 0.02 * (0.7 * style_of(logit) + 0.3 * told - 0.2 * shift) + 0.6 * task
    torch.testing.assert_close(paid["next", "reward"].flatten(0, 1), expected)
    parts.env.close()


def test_table_s4(module: Module, untrained: Path, tmp_path: Path) -> None:
    recipe, ppo, setup = module("tsc_teacher"), module("tsc_ppo"), module("tsc_setup")
    generator = torch.Generator().manual_seed(0)
    normal = FeatureNormalizer(torch.zeros(features.NUM_MOTION), torch.ones(features.NUM_MOTION))
    network = Discriminator(horizon=2, hidden=(8,), normalizer=normal, num_skills=5)
    with torch.no_grad():
        for weight in network.parameters():
            weight.copy_(0.3 * torch.randn(weight.shape, generator=generator))
    manifest = build_manifest("discriminator", {"motion": features.MOTION_LAYOUT}, control_period=0.02)
    manifest["network"] = {"offsets": [0, 1], "hidden": [8], "num_skills": 5}
    Artifact.save(untrained / "discriminator", network.state_dict(), manifest)
    cfg = recipe.PRESETS["smoke"]
    cfg = replace(cfg, runs=tmp_path, bbc=untrained, env=replace(cfg.env, num_threads=1, decision_steps=3))
    parts = setup.build(replace(cfg, reward=replace(cfg.reward, imitation=0.2)))
    shape = (4, 6)
    after = TensorDict(
        {
            "motion": torch.randn(*shape, 2, features.NUM_MOTION, generator=generator),
            "skill": torch.randint(5, shape, generator=generator),
            "reward": torch.randn(*shape, 1, generator=generator),
        },
        shape,
    )
    batch = TensorDict({"next": after.clone()}, shape)
    ppo.add_rewards(parts.imitation, 2.0, batch)
    with torch.no_grad():
        logit = network(after.clone())["discriminator_logit"]
    assert (style_of(logit) > 0.0).any()
    expected = 2.0 * after["reward"] + 0.2 * 3 * 0.02 * style_of(logit).reshape(*shape, 1)
    torch.testing.assert_close(batch["next", "reward"], expected)
    parts.env.close()


def test_the_options_of_speed_reach_the_terms(module: Module) -> None:
    cfg = replace(
        module("tsc_config").RewardConfig(), goal_velocity=2.0, least_speed=1.2, sprint=0.5, sprint_beyond=3.0
    )
    terms = module("tsc_setup").rewards(cfg)
    assert (terms["goal_velocity"].weight, terms["goal_velocity"].function.keywords) == (2.0, {"least": 1.2})
    assert (terms["sprint"].weight, terms["sprint"].function.keywords) == (0.5, {"beyond": 3.0})
    assert "sprint" not in module("tsc_setup").rewards(replace(cfg, sprint=0.0))
    assert terms["collision"] == AGILITY_REWARDS["collision"]
