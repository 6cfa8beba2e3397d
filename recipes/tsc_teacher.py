"""Stage 3: learn to choose behaviours and their parameters on an agility course, by Hybrid-PPO.

Source: Fu et al. 2025, supplement S2, S5, S6, Algorithm S3, Table S4; method notes, section 5.

In:  a Basic Behaviour Controller (``--bbc RUN``; the pretrained one for courses by default), which stays as it is.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/``.

    python recipes/tsc_teacher.py cpu --name my_teacher
    python recipes/tsc_teacher.py cpu --resume runs/my_teacher            # goes on exactly where it stopped
    python recipes/tsc_teacher.py cpu --init-from runs/my_teacher --env.course box

Presets: ``smoke`` (seconds), ``cpu`` (two cores), ``gpu``, ``paper``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from course_metrics import judge, set_course
from held_fixed import fit, infer
from tensordict import TensorDictBase
from torch import Tensor
from training_run import KEPT, Laps, own_options, policy_to_start_from, run
from tsc_cloning import clone
from tsc_config import PRESETS, Config
from tsc_ppo import add_rewards, limit_deviations, value_finished, what_happened
from tsc_script import read
from tsc_setup import Components, build, save_policy

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import ArtifactError
from agility_rl.deploy.task import fastest_canter
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.losses import functional
from agility_rl.modules.teacher import rescale_canter, widen_place
from agility_rl.training import cli
from agility_rl.training.compilation import compiled

HEADLINE: tuple[str, ...] = (
    "time/minutes",
    "success",
    "episodes",
    "curriculum/difficulty",
    "curriculum/obstacles",
    "falls_per_minute",
)
HEADLINE += tuple(f"success/{name}" for name in OBSTACLES)
HEADLINE += tuple(f"use/{name}" for name in BEHAVIOURS)


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One iteration of Algorithm S3's first loop; returns metrics by name."""
    lap = Laps()
    set_course(parts.env, parts.curriculum)
    with_history = cfg.adaptation.every > 0 and iteration % cfg.adaptation.every == cfg.adaptation.every - 1
    # Compiled, the history encoder's convolutions would round otherwise in a run that is resumed.
    taught = compiled(parts.teacher.privileged_policy(), cfg.ppo.compile)
    batch = parts.learner.collect(parts.teacher.deployable_policy() if with_history else taught)
    lap("collect")
    metrics: dict[str, Any] = judge(parts.env, parts.curriculum, batch[:, parts.learner.num_rewound :])
    metrics |= add_rewards(parts.imitation, cfg.reward.task, batch)
    value_finished(batch, cfg.reward.finished)
    weight = functional.linear_ramp(iteration, *cfg.adaptation.privileged_ramp, cfg.adaptation.privileged)
    parts.privileged_loss.privileged = weight  # the loss applies its own coefficient
    if not with_history:
        with torch.no_grad():
            parts.learner.advantage(batch)
        if weight > 0.0:
            infer(parts.teacher.history_encoder, batch)

        def extra(sample: TensorDictBase) -> Tensor:
            return parts.privileged_loss(sample)["loss_privileged"] if weight > 0.0 else torch.zeros(())

        metrics |= parts.learner.update(batch, parts.generator, extra, critic_only=iteration < cfg.ppo.critic_warm_up)
    lap("policy")
    optimizer, minibatches = parts.adaptation_optimizer, cfg.adaptation.minibatches
    metrics |= fit((parts.adaptation_loss,), optimizer, batch, minibatches, parts.generator)
    lap("adaptation")
    if parts.averaged is not None:
        parts.averaged.update_parameters(parts.teacher)
    metrics |= what_happened(batch, parts.teacher.actor)
    return {name: float(value) for name, value in metrics.items()} | lap.metrics


def begin(parts: Components, cfg: Config) -> None:
    """Where a new run starts from: another run's teacher, a copied script, or the one corrected by the other."""
    if cfg.init_from is not None:
        start = policy_to_start_from(cfg.init_from, "teacher", cfg.ppo.hidden)
        read_place, place = start.manifest.get("network", {}).get("num_place", 0), parts.teacher.settings["num_place"]
        if read_place > place:
            raise ArtifactError(f"{start.folder} reads its place, this run's teacher does not; give --place")
        if read_place < place:  # who did not read its place goes on as it was
            start = replace(start, state=widen_place(start.state, place - read_place))
        if (had := fastest_canter(start)) != cfg.env.fastest_canter:  # it canters as fast as it did
            start = replace(start, state=rescale_canter(start.state, had, cfg.env.fastest_canter))
            if had > cfg.env.fastest_canter:
                print(
                    f"{start.folder} canters at up to {had} m/s; what is faster than --env.fastest-canter "
                    f"{cfg.env.fastest_canter} becomes that"
                )
        start.fill(parts.teacher)
        limit_deviations(parts.teacher.actor, cfg.ppo)
    if copies(cfg):
        set_course(parts.env, parts.curriculum)
        clone(parts, cfg.cloning, cfg.env.fastest_canter)


def copies(cfg: Config) -> bool:
    """Whether a new run copies its script: one that starts from a teacher does so where the script says ``own``."""
    complete = read(cfg.cloning.script, "--cloning.script", cfg.env.fastest_canter).complete
    return cfg.cloning.iterations > 0 and complete == (cfg.init_from is None)


def train(cfg: Config) -> Path:
    """Algorithm S3, the teacher; returns the run folder."""
    cfg = own_options(cfg)
    if unknown := sorted(set(cfg.behaviours) - set(BEHAVIOURS)):
        raise ValueError(f"--behaviours: unknown {', '.join(unknown)}; expected some of {', '.join(BEHAVIOURS)}")
    script = read(cfg.cloning.script, "--cloning.script", cfg.env.fastest_canter)
    if not script.complete and cfg.init_from is None and cfg.resume is None:
        raise ValueError(
            f"--cloning.script {cfg.cloning.script} keeps what a teacher does; give it by --init-from, or a script "
            "that says what it does usually"
        )
    if script.complete and cfg.cloning.iterations > 0 and cfg.init_from is not None and cfg.resume is None:
        print(f"--cloning.script {cfg.cloning.script} is not copied: {cfg.init_from} is started from")
    if copies(cfg) and (forbidden := sorted(set(script.behaviours) - set(cfg.behaviours))):
        raise ValueError(
            f"--cloning.script {cfg.cloning.script} chooses {', '.join(forbidden)}, which --behaviours leaves out; "
            "give another script, or --cloning.iterations 0"
        )
    return run(
        "tsc_teacher",
        cfg,
        build,
        begin=begin,
        iterate=iterate,
        save_policy=save_policy,
        headline=HEADLINE,
    )


if __name__ == "__main__":
    with cli.one_line_errors():
        train(cli.from_presets(PRESETS, doc=__doc__, kept=KEPT))
