"""What a batch of experience on a course says about success, obstacles and choices: shared by teacher and student."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from tsc_curriculum import Curriculum

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs import AgilityEnv
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.training import distributed


def judge(env: AgilityEnv, curriculum: Curriculum, batch: TensorDictBase) -> dict[str, Tensor | float]:
    """Success of the episodes that ended, of every obstacle, and what was chosen before it; feeds the curriculum."""
    after, outcome = batch["next"], batch["next", keys.OUTCOME]
    done = after["done"][..., 0]
    episodes, successes = int(done.sum()), int((outcome["success"][..., 0] & done).sum())
    passed = outcome["passed"].flatten(0, 1).sum(0).float()
    failed = (outcome["failed"] | outcome["bypassed"]).flatten(0, 1).sum(0).float()
    counts = distributed.total(torch.tensor([successes, episodes]))
    passed, failed = (distributed.total(number).cpu() for number in (passed, failed))
    curriculum.update(passed, failed, int(counts[0]), int(counts[1]))
    rate = curriculum.passed / (curriculum.passed + curriculum.failed)
    metrics: dict[str, Tensor | float] = {"episodes": float(episodes)}
    if episodes:
        metrics["success"] = successes / episodes
    chosen = torch.nn.functional.one_hot(batch[keys.ACTION, keys.BEHAVIOUR].flatten(), len(BEHAVIOURS)).float()
    before = batch[keys.OBSTACLE].flatten(0, 1)
    present = env.arena.types.any(0).tolist()
    for index, name in enumerate(OBSTACLES):
        if not present[index]:
            continue
        metrics[f"success/{name}"] = rate[index]
        shares = chosen[before[:, index] > 0.5].mean(0)
        metrics |= {f"use_{name}/{b}": share for b, share in zip(BEHAVIOURS, shares, strict=True)}
    metrics |= {f"use/{b}": share for b, share in zip(BEHAVIOURS, chosen.mean(0), strict=True)}
    metrics |= {f"cause/{name}": value.float().sum() for name, value in after[keys.TERMINATIONS].items()}
    seconds = done.numel() * env.dt * env.decision_steps
    metrics["falls_per_minute"] = after["terminated"].sum() * 60.0 / seconds
    metrics["curriculum/difficulty"] = curriculum.difficulty
    metrics["curriculum/obstacles"] = float(curriculum.obstacles)
    return metrics


def set_course(env: AgilityEnv, curriculum: Curriculum) -> None:
    """What later episodes draw, as the curriculum has it."""
    env.set_curriculum(
        difficulty=curriculum.difficulty,
        obstacles=curriculum.obstacles,
        start_weights=curriculum.start_weights(env.arena.types),
    )
