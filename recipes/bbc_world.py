"""The world in which a Basic Behaviour Controller is trained: recorded motion, ground, starts, rewards, robots."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import torch
from bbc_config import Config, EnvConfig, MotionConfig
from hardware import simulator_options
from identified import load_simulator
from tensordict import TensorDict

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import NOMINAL, Randomization
from agility_rl.envs.rewards import (
    LOCOMOTION_REWARDS,
    RewardTerm,
    jump_height_peak,
    jump_height_window,
    lateral_progress,
    low_feet,
    rhythm,
    turn_progress,
    velocity_progress,
)
from agility_rl.envs.terminations import LOCOMOTION_TERMINATIONS, thigh_contact
from agility_rl.motion import MotionClip, MotionDataset, load_clips
from agility_rl.motion.gaits import synthetic_dataset_clips
from agility_rl.motion.stride_patterns import stride_patterns
from agility_rl.simulation import HeightField, ridges, rough_pyramids
from agility_rl.training.seeding import Seeds

SHORTEST = 0.5
"""Seconds of labelled motion below which no gait can be told."""


def make_env(cfg: Config, dataset: MotionDataset, seeds: Seeds) -> LocomotionEnv:
    """Robots that start in the middle of the dogs' motion."""
    reference = starts(dataset, seeds.generator("reference"), named=cfg.motion.label_share != 0.0)
    terrain = make_terrain(cfg.env, torch.Generator().manual_seed(seeds.integer("terrain")))
    randomization = Randomization() if cfg.env.randomize else NOMINAL if cfg.env.action_delay else None
    if randomization is not None and not cfg.env.action_delay_from:
        randomization = replace(randomization, action_delay=(cfg.env.action_delay, cfg.env.action_delay))
    model: dict[str, Any] = {"friction_loss": cfg.env.friction_loss}
    if cfg.env.simulator is not None:
        simulator = load_simulator(cfg.env.simulator)
        randomization = replace(randomization or NOMINAL, draw=simulator.draw)
        model |= simulator.model
    patterns = None
    if cfg.env.rhythm_weight:
        patterns = stride_patterns(dataset.labelled_clips, {"walk": cfg.env.walk_growth})
    env = LocomotionEnv(
        cfg.env.num_robots,
        simulator_options={**simulator_options(cfg, cfg.env.num_threads), **model, "terrain": terrain},
        reference=reference,
        standing_starts=cfg.env.standing_starts,
        rewards=rewards(cfg.env),
        terminations=(*LOCOMOTION_TERMINATIONS, *([thigh_contact] if cfg.env.end_when_sitting else [])),
        randomization=randomization,
        observation_noise=cfg.env.observation_noise,
        push_interval=cfg.env.push_interval,
        episode_length=cfg.env.episode_length,
        resample_period=cfg.env.resample_period,
        patterns=patterns,
        encounters=cfg.env.encounters,
        boxes=cfg.env.boxes,
        motion_offsets=cfg.motion.offsets,
        seed=seeds.integer("environment"),
    )
    set_boxes(env, cfg.env)
    if cfg.env.shares:
        env.set_skill_probabilities(torch.tensor(cfg.env.shares))
    return env


def set_boxes(env: LocomotionEnv, cfg: EnvConfig) -> None:
    """Let boxes that are put in the way from now on be as high as the options say."""
    if env.encounters is not None:
        env.encounters.box_height = (cfg.lowest_box, cfg.highest_box)


def rewards(cfg: EnvConfig) -> dict[str, RewardTerm]:
    """The terms of supplement S4, weighted as the options say, with those of ours that have a weight."""
    terms = dict(LOCOMOTION_REWARDS)
    jump = jump_height_window if cfg.jump_reward == "window" else partial(jump_height_peak, width=cfg.jump_width)
    terms["jump_height"] = RewardTerm(cfg.jump_weight, jump)
    if cfg.progress_weight:
        terms["velocity_progress"] = RewardTerm(cfg.progress_weight, velocity_progress)
    if cfg.turn_weight:
        terms["turn_progress"] = RewardTerm(cfg.turn_weight, turn_progress)
    if cfg.lateral_weight:
        terms["lateral_progress"] = RewardTerm(cfg.lateral_weight, lateral_progress)
    if cfg.rhythm_weight:
        terms["rhythm"] = RewardTerm(cfg.rhythm_weight, rhythm)
    if cfg.low_feet_weight:
        terms["low_feet"] = RewardTerm(-cfg.low_feet_weight, low_feet)
    terms["collision"] = terms["collision"]._replace(weight=cfg.collision_weight)
    return terms


def starts(dataset: MotionDataset, generator: torch.Generator, each: int = 2000, named: bool = True) -> TensorDict:
    """States of dogs in motion to start an episode from, ``each`` of every behaviour; unless ``named``, of any."""
    skills = torch.arange(len(BEHAVIOURS), device=generator.device).repeat_interleave(each)
    states = dataset.sample_states(skills, generator)
    order = slice(None) if named else torch.randperm(len(skills), generator=generator, device=generator.device)
    return states.set("skill", skills[order])


def make_terrain(cfg: EnvConfig, generator: torch.Generator) -> HeightField | None:
    """The height field, or nothing for flat ground."""
    if cfg.terrain == "flat":
        return None
    if cfg.terrain == "ridges":
        return ridges(generator, slope=cfg.steepness)
    return rough_pyramids(generator, noise=cfg.roughness, slope=cfg.steepness)


def load_dataset(cfg: MotionConfig, seed: int) -> MotionDataset:
    """The clips of the given folders, or the synthetic gaits when there are none."""
    if (cfg.labelled is None) != (cfg.unlabelled is None):
        raise ValueError("give both --motion.labelled and --motion.unlabelled, or neither for synthetic gaits")
    if cfg.labelled is None or cfg.unlabelled is None:
        print("no --motion.labelled and --motion.unlabelled: it learns from synthetic gaits, not from a dog")
        labelled, unlabelled = synthetic_dataset_clips(seed)
    else:
        labelled, unlabelled = load_clips(cfg.labelled, label="from name"), load_clips(cfg.unlabelled)
    if cfg.label_share:
        labelled = fewer_labels(labelled, cfg.label_share, sum(clip.duration for clip in (*labelled, *unlabelled)))
    return MotionDataset(
        labelled,
        unlabelled,
        offsets=cfg.offsets,
        mirror=cfg.mirror,
        standing_weight=cfg.standing_weight,
        one_sided=cfg.one_sided,
        turns=cfg.turns,
    )


def fewer_labels(labelled: list[MotionClip], share: float, total: float) -> list[MotionClip]:
    """The same time of every behaviour, as far as there is so much of it: ``share`` of ``total`` seconds in all."""
    if not 0.0 < share <= 1.0:
        raise ValueError(f"--motion.label-share: expected a share from 0 to 1, got {share}")
    kept: list[MotionClip] = []
    for name in BEHAVIOURS:
        left = share * total / len(BEHAVIOURS)
        for clip in sorted((clip for clip in labelled if clip.label == name), key=lambda clip: -clip.duration):
            frames = min(round(left / clip.dt) + 1, clip.num_frames)
            if frames * clip.dt > SHORTEST:
                kept.append(clip.slice(0, frames))
                left -= kept[-1].duration
    return kept
