"""The world of stage 1: what its options make of starts, rewards and ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs.rewards import jump_height_peak, jump_height_window
from agility_rl.envs.terminations import thigh_contact
from agility_rl.motion import synthesize_gait
from agility_rl.training.seeding import Seeds

Module = Callable[[str], ModuleType]


def test_only_rewards_with_a_weight_are_paid(module: Module) -> None:
    world, published = module("bbc_world"), module("bbc_config").EnvConfig()
    assert "turn_progress" not in (plain := world.rewards(published)) and "velocity_progress" not in plain
    assert plain["collision"].weight == -10.0  # supplement S4
    assert "lateral_progress" not in plain and "low_feet" not in plain
    assert world.rewards(replace(published, low_feet_weight=6.0))["low_feet"].weight == -6.0
    weights = {"turn_weight": 3.0, "progress_weight": 2.0, "jump_weight": 5.0, "lateral_weight": 4.0}
    ours, names = world.rewards(replace(published, **weights)), ("turn", "velocity", "lateral")
    assert [ours[f"{name}_progress"].weight for name in names] == [3.0, 2.0, 4.0]
    assert ours["jump_height"].weight == 5.0
    narrow = world.rewards(replace(published, collision_weight=-2.0, jump_reward="peak", jump_width=0.03))
    assert narrow["collision"].weight == -2.0
    assert narrow["jump_height"].function.func is jump_height_peak
    assert narrow["jump_height"].function.keywords == {"width": 0.03}
    assert world.rewards(replace(published, jump_reward="window"))["jump_height"].function is jump_height_window


@pytest.mark.parametrize("ends", [False, True])
def test_who_sits_ends_an_episode_where_told(module: Module, ends: bool) -> None:
    world, smoke = module("bbc_world"), module("bbc_presets").SMOKE
    options = replace(smoke.env, num_robots=4, num_threads=1, rhythm_weight=0.0, end_when_sitting=ends)
    env = world.make_env(replace(smoke, env=options), world.load_dataset(smoke.motion, 0), Seeds(0))
    assert (thigh_contact in env.terminations) is ends
    env.close()


def test_shares_and_delay_hold_from_the_first_episode_on(module: Module) -> None:
    world, smoke = module("bbc_world"), module("bbc_presets").SMOKE
    options = replace(smoke.env, num_robots=16, num_threads=1, rhythm_weight=0.0, action_delay=0.01)
    for begins, delay in ((0, 0.01), (5, 0.0)):
        cfg = replace(smoke, env=replace(options, shares=(0.0, 0.0, 0.0, 0.0, 1.0), action_delay_from=begins))
        env = world.make_env(cfg, world.load_dataset(cfg.motion, 0), Seeds(0))
        assert (env.reset()["skill"] == BEHAVIOURS.index("jump")).all()
        torch.testing.assert_close(env.simulator.parameter("action_delay"), torch.full((16, 1), delay))
        env.close()


def test_rough_ground_is_as_rough_and_steep_as_told(module: Module) -> None:
    world, published = module("bbc_world"), module("bbc_config").EnvConfig()
    assert world.make_terrain(published, torch.Generator()) is None
    steep = replace(published, terrain="rough", roughness=0.0, steepness=1.0)
    slopes = world.make_terrain(steep, torch.Generator().manual_seed(0)).heights.diff(dim=0).abs()
    assert slopes.max().item() == pytest.approx(0.4 * 0.1, abs=1e-6)  # the steepest tiles, cells of 0.1 m


def test_fewer_labels_are_alike_of_every_behaviour_and_of_the_longest_clips(module: Module) -> None:
    world = module("bbc_world")
    clips = [synthesize_gait(name, duration=length) for name in BEHAVIOURS for length in (0.8, 4.0, 2.0)]
    total = 100.0
    for share, each in ((0.05, 1.0), (0.25, 5.0), (1.0, 6.8)):
        kept = world.fewer_labels(clips, share, total)
        for name in BEHAVIOURS:
            own = [clip for clip in kept if clip.label == name]
            assert sum(clip.duration for clip in own) == pytest.approx(each, abs=0.07)
            assert [clip.duration for clip in own] == sorted((clip.duration for clip in own), reverse=True)
    assert not world.fewer_labels(clips, 0.02, total), "0.4 s of a behaviour show no gait"
    smoke = module("bbc_presets").SMOKE
    whole, part = (world.load_dataset(replace(smoke.motion, label_share=share), 0) for share in (None, 0.02))
    assert 0 < sum(c.duration for c in part.labelled_clips) < 0.6 * sum(c.duration for c in whole.labelled_clips)
    nameless, named = (
        world.starts(part, torch.Generator().manual_seed(0), each=20, named=named) for named in (False, True)
    )
    assert torch.equal(nameless["joint_position"], named["joint_position"])
    assert torch.equal(nameless["skill"].bincount(), named["skill"].bincount())
    assert (nameless["skill"] == named["skill"]).float().mean() < 0.5
    with pytest.raises(ValueError, match=r"--motion.label-share: expected a share from 0 to 1, got 0"):
        world.fewer_labels(clips, 0.0, total)


@pytest.mark.parametrize("randomize", [False, True])
def test_an_identified_simulator_leaves_the_rest_to_the_randomisation(
    module: Module, tmp_path: Path, randomize: bool
) -> None:
    record, world, smoke = module("record_log"), module("bbc_world"), module("bbc_presets").SMOKE
    log = record.main(record.Config(log=tmp_path / "t.csv", steps=100, truth=record.Truth(calf_stiffness=0.7)))
    options = replace(smoke.env, num_robots=8, num_threads=1, randomize=randomize, rhythm_weight=0.0)
    cfg = replace(smoke, env=replace(options, simulator=log.with_suffix(".truth.json")))
    env = world.make_env(cfg, world.load_dataset(cfg.motion, 0), Seeds(0))
    env.reset()
    stiffness, friction = env.simulator.parameter("stiffness"), env.simulator.parameter("ground_friction")
    torch.testing.assert_close(stiffness[:, 2], torch.full((8,), 0.7 * 40.0))  # supplement S2 searches gains alone
    torch.testing.assert_close(stiffness[:, 0], torch.full((8,), 40.0))
    assert len(friction.unique()) == (8 if randomize else 1)
    env.close()
