"""The world of stage 1: what its options make of starts, rewards and ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import pytest
import torch

from agility_rl.go2.constants import DEFAULT_POSE

Module = Callable[[str], ModuleType]


def test_a_share_of_the_starts_stands(module: Module) -> None:
    world, smoke = module("bbc_world"), module("bbc_presets").SMOKE
    dataset = world.load_dataset(smoke.motion, 0)
    shares = {}
    for share in (0.0, 0.25, 1.0):
        cfg = replace(smoke, env=replace(smoke.env, standing_starts=share))
        starts = world.starts(cfg, dataset, torch.Generator().manual_seed(0), each=40)
        assert torch.bincount(starts["skill"]).tolist() == [40] * 5
        assert starts["past_motion"].shape == (200, smoke.motion.offsets[-1], 49)
        stands = (starts["joint_position"] == torch.tensor(DEFAULT_POSE)).all(-1)
        shares[share] = torch.bincount(starts["skill"][stands], minlength=5).tolist()
    assert shares == {0.0: [0] * 5, 0.25: [10] * 5, 1.0: [40] * 5}
    with pytest.raises(ValueError, match=r"--env.standing-starts: expected a share from 0 to 1, got 2.0"):
        world.starts(replace(smoke, env=replace(smoke.env, standing_starts=2.0)), dataset, torch.Generator())


def test_only_rewards_with_a_weight_are_paid(module: Module) -> None:
    world, published = module("bbc_world"), module("bbc_config").EnvConfig()
    assert "turn_progress" not in (plain := world.rewards(published)) and "velocity_progress" not in plain
    assert plain["collision"].weight == -10.0  # supplement S4
    ours = world.rewards(replace(published, turn_weight=3.0, progress_weight=2.0, jump_weight=5.0))
    assert [ours[name].weight for name in ("turn_progress", "velocity_progress", "jump_height")] == [3.0, 2.0, 5.0]


def test_rough_ground_is_as_rough_and_steep_as_told(module: Module) -> None:
    world, published = module("bbc_world"), module("bbc_config").EnvConfig()
    assert world.make_terrain(published, torch.Generator()) is None
    steep = replace(published, terrain="rough", roughness=0.0, steepness=1.0)
    slopes = world.make_terrain(steep, torch.Generator().manual_seed(0)).heights.diff(dim=0).abs()
    assert slopes.max().item() == pytest.approx(0.4 * 0.1, abs=1e-6)  # the steepest tiles, cells of 0.1 m
