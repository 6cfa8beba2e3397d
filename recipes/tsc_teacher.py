"""Stage 3: learn to choose behaviours and their parameters on an agility course, by Hybrid-PPO.

Source: Fu et al. 2025, supplement S2, S5, S6, Algorithm S3, Table S4; method notes, section 5.

In:  a Basic Behaviour Controller (``--bbc RUN``; the pretrained one by default), which stays as it is.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/``.

    python recipes/tsc_teacher.py cpu --name my_teacher
    python recipes/tsc_teacher.py cpu --resume runs/my_teacher            # goes on exactly where it stopped
    python recipes/tsc_teacher.py cpu --init-from runs/my_teacher --env.course box

Presets: ``smoke`` (seconds), ``cpu`` (two cores), ``paper``.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from held_fixed import infer
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tsc_config import PRESETS, Config
from tsc_setup import Components, build, save_policy

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.losses import functional
from agility_rl.record import MCAPLogger
from agility_rl.training import cli
from agility_rl.training.display import Display

HEADLINE = ("time/minutes", "success", "episodes", "curriculum/difficulty", "curriculum/obstacles", "falls_per_minute")
HEADLINE += tuple(f"success/{name}" for name in OBSTACLES)
HEADLINE += tuple(f"use/{name}" for name in BEHAVIOURS)


@torch.no_grad()
def add_rewards(parts: Components, cfg: Config, batch: TensorDictBase) -> dict[str, Tensor]:
    """``r = 2.0 r^T + 0.2 r^I dt`` (Table S4); returns the means of both."""
    rewards = {"task": cfg.reward.task * batch["next", "reward"]}
    if parts.discriminator is not None:
        seen = TensorDict({keys.MOTION: batch["next", keys.MOTION], keys.SKILL: batch["next", keys.SKILL]}, batch.shape)
        style = functional.imitation_reward(parts.discriminator(seen.flatten())[keys.DISCRIMINATOR_LOGIT])
        seconds = parts.env.dt * cfg.env.decision_steps
        rewards["imitation"] = cfg.reward.imitation * seconds * style.reshape(*batch.shape, 1)
    batch["next", "reward"] = torch.stack(tuple(rewards.values())).sum(0)
    return {f"reward/{name}": value.mean() for name, value in rewards.items()}


def judge(parts: Components, batch: TensorDictBase) -> dict[str, Tensor | float]:
    """Success of the episodes that ended, of every obstacle, and what was chosen before it; feeds the curriculum."""
    after, outcome = batch["next"], batch["next", keys.OUTCOME]
    done = after["done"][..., 0]
    episodes, successes = int(done.sum()), int((outcome["success"][..., 0] & done).sum())
    passed = outcome["passed"].flatten(0, 1).sum(0).float()
    failed = (outcome["failed"] | outcome["bypassed"]).flatten(0, 1).sum(0).float()
    parts.curriculum.update(passed, failed, successes, episodes)
    rate = parts.curriculum.passed / (parts.curriculum.passed + parts.curriculum.failed)
    metrics: dict[str, Tensor | float] = {"episodes": float(episodes)}
    if episodes:
        metrics["success"] = successes / episodes
    chosen = torch.nn.functional.one_hot(batch[keys.ACTION, keys.BEHAVIOUR].flatten(), len(BEHAVIOURS)).float()
    before = batch[keys.OBSTACLE].flatten(0, 1)
    present = parts.env.arena.types.any(0).tolist()
    for index, name in enumerate(OBSTACLES):
        if not present[index]:
            continue
        metrics[f"success/{name}"] = rate[index]
        shares = chosen[before[:, index] > 0.5].mean(0)
        metrics |= {f"use_{name}/{b}": share for b, share in zip(BEHAVIOURS, shares, strict=True)}
    metrics |= {f"use/{b}": share for b, share in zip(BEHAVIOURS, chosen.mean(0), strict=True)}
    metrics |= {f"cause/{name}": value.float().sum() for name, value in after[keys.TERMINATIONS].items()}
    seconds = done.numel() * parts.env.dt * parts.env.decision_steps
    metrics["falls_per_minute"] = after["terminated"].sum() * 60.0 / seconds
    metrics["curriculum/difficulty"] = parts.curriculum.difficulty
    metrics["curriculum/obstacles"] = float(parts.curriculum.obstacles)
    return metrics


def update_adaptation(parts: Components, minibatches: int, batch: TensorDictBase) -> dict[str, Tensor]:
    """Fit the history encoder, which stands in for the privileged one (S6)."""
    flat = batch.select(keys.PRIVILEGED, keys.HISTORY).flatten()
    totals: dict[str, Tensor] = {}
    for rows in torch.randperm(flat.numel(), generator=parts.generator).chunk(minibatches):
        totals = dict(parts.adaptation_loss(flat[rows]).items())
        parts.adaptation_optimizer.zero_grad(set_to_none=True)
        totals["loss_adaptation"].backward()
        parts.adaptation_optimizer.step()
    return {name: value.detach() for name, value in totals.items() if value.numel() == 1}


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One iteration of Algorithm S3's first loop; returns metrics by name."""
    clock = time.perf_counter()
    times = {}

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        times[f"time/{name}"], clock = now - clock, now

    curriculum = parts.curriculum
    parts.env.set_curriculum(
        difficulty=curriculum.difficulty,
        obstacles=curriculum.obstacles,
        start_weights=curriculum.start_weights(parts.env.arena.types),
    )
    with_history = cfg.adaptation.every > 0 and iteration % cfg.adaptation.every == cfg.adaptation.every - 1
    policy = parts.teacher.deployable_policy() if with_history else parts.teacher.privileged_policy()
    batch = parts.rollout.collect(policy)
    lap("collect")
    metrics: dict[str, Any] = judge(parts, batch)
    metrics |= add_rewards(parts, cfg, batch)
    weight = functional.linear_ramp(iteration, *cfg.adaptation.privileged_ramp, cfg.adaptation.privileged)
    parts.privileged_loss.privileged = weight  # the loss applies its own coefficient
    if not with_history:
        with torch.no_grad():
            parts.advantage(batch)
        if weight > 0.0:
            infer(parts.teacher.history_encoder, batch)

        def extra(sample: TensorDictBase) -> Tensor:
            return parts.privileged_loss(sample)["loss_privileged"] if weight > 0.0 else torch.zeros(())

        metrics |= parts.ppo(batch, parts.generator, extra)
    lap("policy")
    metrics |= update_adaptation(parts, cfg.adaptation.minibatches, batch)
    lap("adaptation")
    metrics |= {f"task/{name}": value.mean() for name, value in batch["next", keys.REWARD_TERMS].items()}
    metrics["std"] = parts.teacher.actor.network.parameters_head.std.detach().mean()
    return {name: float(value) for name, value in metrics.items()} | times


def train(cfg: Config) -> Path:
    """Algorithm S3, the teacher; returns the run folder."""
    if cfg.resume is not None:  # a run goes on with its own options; only how long may change
        own = cli.read_config(cfg.resume, Config)
        cfg = replace(own, resume=cfg.resume, iterations=cfg.iterations, max_minutes=cfg.max_minutes)
    if unknown := sorted(set(cfg.behaviours) - set(BEHAVIOURS)):
        raise ValueError(f"--behaviours: unknown {', '.join(unknown)}; expected some of {', '.join(BEHAVIOURS)}")
    parts = build(cfg)
    folder = cfg.resume or cfg.runs / cfg.name
    folder = cli.start_run(cfg, folder, resume=cfg.resume is not None, recipe="tsc_teacher")
    progress = {"iteration": 0, "minutes": 0.0}
    checkpoint = parts.checkpoint(folder / "checkpoints", progress)
    if cfg.resume is not None:
        checkpoint.load()
    elif cfg.init_from is not None:
        source = cfg.init_from / "policy" if (cfg.init_from / "policy").is_dir() else cfg.init_from
        parts.teacher.load_state_dict(Artifact.load(source, kind="teacher").state)
    logger = MCAPLogger(folder.name, folder.parent, resume=cfg.resume is not None)
    start = time.monotonic() - 60.0 * progress["minutes"]
    with Display("tsc_teacher", cfg.iterations, headline=HEADLINE) as display, cli.interruptible() as interrupted:
        while progress["iteration"] < cfg.iterations and not interrupted():
            metrics = iterate(parts, cfg, int(progress["iteration"]))
            progress["iteration"] += 1
            progress["minutes"] = metrics["time/minutes"] = (time.monotonic() - start) / 60.0
            logger.log_metrics(metrics, step=int(progress["iteration"]))
            display.update(int(progress["iteration"]), metrics)
            if progress["iteration"] % cfg.checkpoint_every == 0:
                checkpoint.save(int(progress["iteration"]))
                save_policy(parts, cfg, folder)
            if cfg.max_minutes is not None and progress["minutes"] >= cfg.max_minutes:
                break
    checkpoint.save(int(progress["iteration"]))
    save_policy(parts, cfg, folder)
    logger.close()
    parts.env.close()
    print(f"saved {folder}")
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        train(cli.from_presets(PRESETS, doc=__doc__))
