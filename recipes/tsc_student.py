"""Stage 4: learn from a teacher to pass the course by depth images and memory, with DAgger and BYOL.

Source: Fu et al. 2025, supplement S2, S3, S6, S8, Algorithm S3 (lines 8 to 12), Eq. (15); method notes, sections 5.8 to
5.11.

In:  a teacher (``--teacher RUN``) and the Basic Behaviour Controller that it was trained on (``--bbc RUN``; found by
     itself where that still lies), which both stay as they are.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/`` (kind ``student``).

    python recipes/tsc_student.py cpu --teacher runs/my_teacher --name my_student
    python recipes/tsc_student.py cpu --teacher runs/my_teacher --name without --no-byol
    python recipes/tsc_student.py cpu --teacher runs/my_teacher --glance.images 20000 --glance.steps 16
    python recipes/tsc_student.py cpu --resume runs/my_student            # goes on exactly where it stopped

Presets: ``smoke`` (seconds), ``cpu`` (two cores), ``gpu``, ``paper``. Ctrl-C ends the iteration and saves.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from course_metrics import judge, set_course
from estimation import learn_to_estimate
from glances import asked, known_terrain, pretrain
from learning_rates import annealed, set_learning_rate
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from training_run import KEPT, Laps, finite, own_options, run
from tsc_artifacts import refuse_starts_after
from tsc_student_config import PRESETS, Config
from tsc_student_setup import (
    Components,
    build,
    load_student,
    resolve,
    save_policy,
    teachers_parts,
)

from agility_rl import keys
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2.camera import dequantize
from agility_rl.training import cli, distributed
from agility_rl.training.seeding import permutation

HEADLINE: tuple[str, ...] = ("time/minutes", "success", "episodes", "falls_per_minute")
HEADLINE += ("loss_behaviour", "loss_parameters", "loss_heading", "loss_obstacle", "loss_place", "loss_latent")
HEADLINE += ("loss_progress", "accuracy_progress", "loss_byol", "spread")
HEADLINE += ("accuracy_behaviour", "accuracy_obstacle", "error_heading", "error_place")
HEADLINE += tuple(f"success/{name}" for name in OBSTACLES)


def imitate(parts: Components, cfg: Config, window: TensorDictBase, iteration: int) -> dict[str, Tensor]:
    """Descend Eq. (15) through the whole window (Algorithm S3, line 11); returns mean losses and accuracies."""
    own = cfg.imitation
    found: list[TensorDictBase] = []
    for _ in range(own.epochs):
        for rows in permutation(window.shape[1], parts.generator).chunk(own.minibatches):
            sample = window[:, rows]
            if own.augment and keys.DEPTH in parts.imitation.in_keys:
                sample[keys.DEPTH] = parts.augmentation.augment(dequantize(sample[keys.DEPTH]))
            losses = parts.imitation(sample)
            total = torch.stack([value for name, value in losses.items() if name.startswith("loss_")]).sum()
            parts.optimizer.zero_grad(set_to_none=True)
            finite(total, "the imitation", iteration).backward()
            parameters = distributed.optimized(parts.optimizer)
            distributed.average_gradients(parameters)
            norm = torch.nn.utils.clip_grad_norm_(parameters, own.max_grad_norm)
            parts.optimizer.step()
            found.append(losses.detach().set("grad_norm", norm))
    return {name: torch.stack([losses[name] for losses in found]).mean() for name in found[0].keys()}  # noqa: SIM118


def represent(parts: Components, iteration: int, images: Tensor) -> dict[str, Tensor]:
    """One step of BYOL on stored images ``[M, 58, 87]``, each seen disturbed in two ways (method notes, 5.10)."""
    byol = parts.representation
    assert byol is not None
    views = {f"view_{n}": {keys.DEPTH: parts.augmentation.augment(dequantize(images))} for n in (1, 2)}
    losses = byol.loss(TensorDict(views, [len(images)]))
    byol.optimizer.zero_grad(set_to_none=True)
    finite(losses["loss_byol"], "BYOL", iteration).backward()
    distributed.average_gradients(distributed.optimized(byol.optimizer))
    byol.optimizer.step()
    byol.average.step()
    return dict(losses.detach().items())


def represent_window(parts: Components, cfg: Config, window: TensorDictBase, iteration: int) -> dict[str, Tensor]:
    """BYOL on images drawn from a window; returns the means."""
    images, own = window[keys.DEPTH].flatten(0, 1), cfg.representation
    chosen = permutation(len(images), parts.generator)[: own.images]
    found = [represent(parts, iteration, images[rows]) for rows in chosen.chunk(own.minibatches)]
    return {name: torch.stack([losses[name] for losses in found]).mean() for name in found[0]}


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One iteration of Algorithm S3's second loop; returns metrics by name."""
    lap = Laps()
    own, byol = cfg.imitation, parts.representation
    rate = annealed(own.learning_rate, own.final_learning_rate, iteration, own.decay)
    set_learning_rate(parts.optimizer, rate)
    if byol is not None:
        rates = (cfg.representation.learning_rate, cfg.representation.final_learning_rate)
        set_learning_rate(byol.optimizer, annealed(*rates, iteration, own.decay))
    set_course(parts.env, parts.curriculum)
    metrics: dict[str, Tensor | float] = {}
    if iteration == 0 and parts.glances is not None and cfg.glance.images > 0 and cfg.init_from is None:
        also = None if byol is None else partial(represent, parts, iteration)
        metrics |= pretrain(parts.glances, parts.env, parts.teacher, cfg.glance, cfg.bits, also)
        lap("pretrain")
    parts.collector.led = round(parts.env.num_robots * annealed(own.led, 0.0, iteration, own.led_until))
    window = parts.collector.collect()
    if keys.SCANDOTS in window.keys():  # noqa: SIM118
        window[keys.LABEL, keys.TERRAIN_LATENT] = known_terrain(parts.teacher, window)
    lap("collect")
    metrics |= judge(parts.env, parts.curriculum, window)
    metrics |= imitate(parts, cfg, window, iteration)
    lap("imitation")
    if parts.glances is not None and cfg.glance.steps:
        rates = (cfg.glance.learning_rate, cfg.glance.final_learning_rate)
        set_learning_rate(parts.glances.optimizer, annealed(*rates, iteration, own.decay))
        seen = window[:: cfg.glance.every]
        parts.glances.images.extend(asked(seen, seen[keys.LABEL, keys.TERRAIN_LATENT]).flatten())
        metrics |= parts.glances.learn(cfg.glance.steps, iteration)
        lap("glances")
    if byol is not None:
        metrics |= represent_window(parts, cfg, window, iteration)
        lap("byol")
    metrics["reward"] = window["next", "reward"].mean()
    metrics["learning_rate"] = rate
    metrics["time/images_per_second"] = window.numel() / sum(lap.metrics.values())
    return {name: float(value) for name, value in metrics.items()} | lap.metrics


def check(cfg: Config) -> None:
    """Refuse impossible options before anything is loaded."""
    own, glance = cfg.imitation, cfg.glance
    if min(own.steps, own.epochs, own.minibatches, own.decay, cfg.representation.minibatches) < 1:
        raise ValueError("expected imitation.steps, epochs, minibatches, decay and representation.minibatches above 0")
    if not 0.0 <= own.led <= 1.0 or own.led_until < 1:
        raise ValueError(
            f"--imitation.led: expected a share from 0 to 1 and led-until above 0, got {own.led} and {own.led_until}"
        )
    if cfg.bits not in (8, 16):
        raise ValueError(f"--bits: images are stored in 8 or 16 bits, got {cfg.bits}")
    images = min(cfg.representation.images, cfg.env.num_robots * own.steps)
    largest = max(1, -(-images // cfg.representation.minibatches))
    smallest = images % largest or largest  # the last one has what is left
    if cfg.byol and smallest < 2:
        raise ValueError(f"--representation: a minibatch of BYOL needs 2 images or more, got {smallest}")
    if min(glance.every, glance.epochs, glance.batch, glance.kept) < 1 or min(glance.steps, glance.images) < 0:
        raise ValueError("--glance: expected every, epochs, batch and kept above 0, steps and images of at least 0")
    estimation = cfg.estimation
    if estimation.robots < 2 or min(estimation.decisions, estimation.epochs, estimation.batch) < 1:
        raise ValueError("--estimation: expected two robots or more, and decisions, epochs and batch above 0")
    if glance.images and (cfg.env.num_robots < 2 or not 0 < glance.held_out < 1):
        raise ValueError("--glance.images: expected two robots or more, and held-out within (0, 1)")


def begin(parts: Components, cfg: Config) -> None:
    """Start from another run's student, if one is given; an estimator of its own, unless that has one, learns first."""
    inherits = cfg.init_from is not None and load_student(parts, cfg.init_from, teachers_parts(cfg))
    if parts.representation is not None:
        parts.representation.begin()
    if cfg.estimator_history and not inherits:
        learn_to_estimate(parts, cfg)


def train(cfg: Config) -> Path:
    """Algorithm S3, the student; returns the run folder."""
    cfg = own_options(cfg)
    check(cfg)
    cfg, trained = resolve(cfg)
    refuse_starts_after(cfg.env.start_after, trained)
    return run(
        "tsc_student",
        cfg,
        lambda cfg: build(cfg, trained),
        begin=begin,
        iterate=iterate,
        save_policy=save_policy,
        headline=HEADLINE,
    )


if __name__ == "__main__":
    with cli.one_line_errors():
        train(cli.from_presets(PRESETS, doc=__doc__, kept=KEPT))
