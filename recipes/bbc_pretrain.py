"""Stage 1: learn a Basic Behaviour Controller from dog motion by semi-supervised InfoGAIL and PPO.

Source: Fu et al. 2025, supplement S2, Algorithm S1, Tables S1 and S2.

In:  labelled and unlabelled clips (``--motion.labelled DIR --motion.unlabelled DIR``); without them, synthetic gaits.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/``, ``discriminator/``; with
     ``--trials.start``, as in ``cpu``, also ``trials/``, the best of which ``policy/`` then is.

    python recipes/bbc_pretrain.py cpu --motion.labelled DIR --motion.unlabelled DIR --name my_run
    python recipes/bbc_pretrain.py cpu --resume runs/my_run          # goes on exactly where it stopped
    python recipes/bbc_pretrain.py cpu --init-from runs/my_run       # new run that starts from a policy

Presets: ``smoke`` (seconds), ``quickstart`` (about five minutes), ``half_hour`` and ``cpu`` (under an hour) on two
cores, ``polish`` (goes on from ``--init-from``, see ``bbc_distill.py``), ``paper``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from bbc_changes import at, check
from bbc_cloning import clone_behaviour
from bbc_config import Config, ImitationConfig
from bbc_penalties import asymmetry, distance_to_anchor, hold
from bbc_presets import PRESETS
from bbc_setup import Components, build, save_policy
from bbc_trials import due, hold_trial, show_best
from bbc_world import set_boxes
from held_fixed import fit, infer
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from training_run import KEPT, Laps, folder_of, own_options, policy_to_start_from, run

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2 import features
from agility_rl.losses import functional
from agility_rl.training import cli, distributed
from agility_rl.training.compilation import compiled
from agility_rl.training.distributed import optimized

VELOCITY = features.layout_slice(features.EXPLICIT_LAYOUT, "linear_velocity")
TURN_RATE = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "angular_velocity")
HEADLINE: tuple[str, ...] = (
    *("time/minutes", "share/imitation", "share/skill", "share/shift", "share/task", "accuracy_expert"),
    *("accuracy_policy", "kl", "falls_per_minute", "error/speed", "error/turn_rate"),
    *(f"{group}/{name}" for group in ("style", "recovery", "prior") for name in BEHAVIOURS),
)


def update_imitation(parts: Components, cfg: ImitationConfig, iteration: int) -> dict[str, Tensor]:
    """One iteration of Algorithm S1 lines 5, 6 and 9: discriminator, predictor and skill prior."""
    parts.predictor_loss.information = functional.linear_ramp(iteration, *cfg.information_ramp, cfg.information)
    totals: dict[str, Tensor] = {}
    for _ in range(cfg.minibatches):
        policy = parts.replay.sample()
        labelled = parts.dataset.sample_labelled(cfg.labelled_batch_size, parts.generator)
        unlabelled = parts.dataset.sample_unlabelled(cfg.batch_size, parts.generator)
        batch = TensorDict({"policy": policy, "labelled": labelled, "unlabelled": unlabelled})
        batch["expert"] = expert_batch(parts, cfg, policy, unlabelled)
        discriminated, predicted = parts.discriminator_loss(batch), parts.predictor_loss(batch)
        found = dict(discriminated.items()) | dict(predicted.items())
        parts.imitation_optimizer.zero_grad(set_to_none=True)
        torch.stack([value for name, value in found.items() if name.startswith("loss_")]).sum().backward()
        distributed.average_gradients(optimized(parts.imitation_optimizer))
        parts.imitation_optimizer.step()
        parts.prior.update(distributed.average(recorded_shares(parts, cfg, predicted)))
        for name, value in found.items():
            if value.numel() == 1:
                totals[name] = totals.get(name, torch.zeros(())) + value.detach() / cfg.minibatches
    return totals


@torch.no_grad()
def recorded_shares(parts: Components, cfg: ImitationConfig, predicted: TensorDictBase) -> Tensor:
    """``[5]``, how often Q^c finds each behaviour in unlabelled motion as it was recorded (Algorithm S1, line 9)."""
    if parts.dataset.as_recorded:
        return predicted["unlabelled_skill_probability"]
    recorded = parts.dataset.sample_unlabelled(cfg.batch_size, parts.generator, as_recorded=True)
    return parts.predictor(recorded)[keys.SKILL_LOGITS].softmax(-1).mean(0)


def warm_up_predictor(parts: Components, cfg: ImitationConfig) -> None:
    """Teach Q^c the labels; the shared trunk then already tells the behaviours apart."""
    network = parts.predictor
    optimizer = torch.optim.Adam(network.parameters(), lr=cfg.encoder_learning_rate, weight_decay=cfg.weight_decay)
    for _ in range(cfg.warm_up):
        labelled = parts.dataset.sample_labelled(cfg.labelled_batch_size, parts.generator)
        loss = torch.nn.functional.cross_entropy(network(labelled)[keys.SKILL_LOGITS], labelled[keys.SKILL])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


@torch.no_grad()
def expert_batch(
    parts: Components, cfg: ImitationConfig, policy: TensorDictBase, unlabelled: TensorDictBase
) -> TensorDictBase:
    """Expert motion for the discriminator: unlabelled, and as much labelled motion as asked for, of those skills that
    the unlabelled motion shows less often than the policy, so that no skill looks like an expert's by its number."""
    count = round(cfg.labelled_share * cfg.batch_size)
    if count == 0 and not cfg.conditional:
        return unlabelled
    rest = unlabelled[: cfg.batch_size - count].clone(recurse=False)
    logits = parts.predictor(rest.clone(recurse=False))[keys.SKILL_LOGITS]
    rest[keys.SKILL] = torch.multinomial(logits.softmax(-1), 1, generator=parts.generator)[:, 0]
    wanted, there = (torch.bincount(td[keys.SKILL], minlength=len(BEHAVIOURS)).float() for td in (policy, rest))
    missing = (wanted * cfg.batch_size / policy.numel() - there).clamp(min=0.0) + 1e-3  # never nothing at all
    labelled = parts.dataset.sample_labelled(count, parts.generator, missing / missing.sum())
    return torch.cat((labelled.select(keys.MOTION, keys.SKILL), rest.select(keys.MOTION, keys.SKILL)))


@torch.no_grad()
def add_rewards(parts: Components, cfg: ImitationConfig, batch: TensorDictBase, dt: float) -> dict[str, Tensor]:
    """Equation (11): imitation, skill and shift reward of every step beside the task reward; returns their means."""
    shape = (*batch.batch_size, 1)
    skill, shift = batch[keys.SKILL].flatten(), batch[keys.SHIFT].flatten(0, 1)
    features = parts.discriminator.trunk(batch["next", keys.MOTION].flatten(0, 1))  # once: the two share it
    logit, (skill_logits, shown_shift) = parts.discriminator.judge(features, skill), parts.predictor.predict(features)
    told = functional.skill_reward(skill_logits, skill)
    if cfg.skill_floor is not None:
        told = 1.0 - told.clamp(min=cfg.skill_floor) / cfg.skill_floor
    paid = dt * (1.0 - cfg.gate * (1.0 - speed_share(parts, batch).flatten(0, 1).clamp(0.0, 1.0)))
    style = functional.imitation_reward(logit)
    rewards = {
        "imitation": cfg.imitation_reward * paid * style,
        "skill": cfg.skill_reward * paid * told,
        "shift": cfg.shift_reward * dt * functional.shift_reward(shown_shift, shift),
        "task": cfg.task_reward * batch["next", "reward"].flatten(0, 1),
    }
    batch["next", "reward"] = torch.stack(tuple(rewards.values())).sum(0).reshape(shape)
    metrics = {f"reward/{name}": value.mean() for name, value in rewards.items()}
    whole = torch.stack([value.abs().mean() for value in rewards.values()]).sum().clamp(min=1e-12)
    metrics |= {f"share/{name}": value.abs().mean() / whole for name, value in rewards.items()}
    recovered = (skill_logits.argmax(-1) == skill).float()
    for index, name in enumerate(BEHAVIOURS):
        chosen = skill == index
        metrics[f"recovery/{name}"] = recovered[chosen].mean()
        metrics[f"style/{name}"] = style[chosen, 0].mean()
    return metrics


def tracking_error(batch: TensorDictBase) -> dict[str, Tensor]:
    """Mean distance of the velocity from the commanded one [m/s], and of the turn rate [rad/s], at every instant."""
    velocity = batch[keys.EXPLICIT][..., VELOCITY] / features.LINEAR_VELOCITY_SCALE
    turn_rate = batch[keys.PROPRIOCEPTION][..., TURN_RATE] / features.ANGULAR_VELOCITY_SCALE
    wanted = batch[keys.COMMAND]
    return {
        "error/speed": (wanted[..., :2] - velocity[..., :2]).norm(dim=-1).mean(),
        "error/turn_rate": (wanted[..., 2] - turn_rate[..., 2]).abs().mean(),
    }


def speed_share(parts: Components, batch: TensorDictBase) -> Tensor:
    """``velocity_progress`` of every step without its weight; 1 where nobody asks for it."""
    term = parts.env.rewards.get("velocity_progress")
    if term is None or not term.weight:
        return torch.ones_like(batch["next", "reward"])
    return batch["next", keys.REWARD_TERMS, "velocity_progress"] / (term.weight * parts.env.dt)


def begin(parts: Components, cfg: Config) -> None:
    """Where a new run starts from: labels for Q^c, and another run's policy or the labelled clips."""
    if cfg.changes:  # a preset's too, which then hold instead of what the command line asked for
        later = ", ".join(f"{option} {value:g} from {start}" for start, option, value in cfg.changes)
        print(f"changes during the run (--changes): {later}")
    warm_up_predictor(parts, cfg.imitation)
    if cfg.init_from:
        policy_to_start_from(cfg.init_from, "bbc", cfg.ppo.hidden).fill(parts.bbc)
    elif cfg.imitation.cloning:
        error = clone_behaviour(parts.bbc, parts.demonstrations, cfg.imitation.cloning)
        print(f"cloned {len(parts.dataset.labelled_clips)} labelled clips: squared action error {error:.3f}")


def train(cfg: Config) -> Path:
    """Algorithm S1; returns the run folder."""
    cfg = own_options(cfg)
    check(cfg)
    return run(
        "bbc_pretrain",
        cfg,
        build,
        begin=begin,
        iterate=iterate,
        save_policy=save_shown,
        headline=HEADLINE,
    )


def save_shown(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the controller that the run shows: the best that was tried, else the one of the moment."""
    save_policy(parts, cfg, folder)
    show_best(folder)


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One iteration of Algorithm S1; returns metrics by name."""
    lap = Laps()
    cfg = at(cfg, iteration)
    parts.ppo.loss.entropy_coeff.fill_(cfg.ppo.entropy)
    if parts.ppo.schedule is not None:
        parts.ppo.schedule.target_kl = cfg.ppo.desired_kl
    jump = parts.env.rewards["jump_height"]
    parts.env.rewards["jump_height"] = jump._replace(weight=cfg.env.jump_weight)
    if term := parts.env.rewards.get("velocity_progress"):
        fading = cfg.env.progress_weight - cfg.env.progress_left
        faded = functional.linear_ramp(iteration, *cfg.env.progress_fade, fading)
        parts.env.rewards["velocity_progress"] = term._replace(weight=cfg.env.progress_weight - faded)
    parts.env.standing_starts = cfg.env.standing_starts
    if parts.env.rhythm is not None:
        parts.env.rhythm.longer_stance[BEHAVIOURS.index("canter")] = cfg.env.canter_stance
        parts.env.rhythm.emphasis[BEHAVIOURS.index("walk")] = cfg.env.walk_emphasis
    with_history = cfg.adaptation.every > 0 and iteration % cfg.adaptation.every == cfg.adaptation.every - 1
    set_boxes(parts.env, cfg.env)
    shares = torch.tensor(cfg.env.shares) if cfg.env.shares else parts.prior.sampling_probabilities
    parts.env.set_skill_probabilities(shares)
    if parts.env.randomization is not None:
        delay = cfg.env.action_delay if iteration >= cfg.env.action_delay_from else 0.0
        parts.env.randomization = replace(parts.env.randomization, action_delay=(delay, delay))
    # Compiled, the history encoder's convolutions would round otherwise in a run that is resumed.
    taught = compiled(parts.bbc.privileged_policy(), cfg.ppo.compile)
    batch = parts.rollout.collect(parts.bbc.deployable_policy() if with_history else taught)
    lap("collect")
    seen = TensorDict(
        {keys.MOTION: batch["next", keys.MOTION], keys.SKILL: batch[keys.SKILL], keys.SHIFT: batch[keys.SHIFT]},
        batch.batch_size,
    )
    parts.replay.extend(seen.flatten())
    metrics = update_imitation(parts, cfg.imitation, iteration)
    lap("imitation")
    metrics |= add_rewards(parts, cfg.imitation, batch, parts.env.dt)
    weight = functional.linear_ramp(iteration, *cfg.adaptation.privileged_ramp, cfg.adaptation.privileged)
    parts.privileged_loss.privileged = weight  # the loss applies its own coefficient
    if not with_history:
        with torch.no_grad():
            parts.advantage(batch)
        if weight > 0.0:
            infer(parts.bbc.history_encoder, batch)
        if parts.anchor is not None:
            hold(parts, batch)
        symmetric = torch.tensor([name in cfg.ppo.symmetric for name in BEHAVIOURS], device=parts.env.device)
        kept = cfg.imitation.cloning_weight
        kept -= functional.linear_ramp(iteration, *cfg.imitation.cloning_fade, kept)

        def extra(sample: TensorDictBase) -> Tensor:
            loss = parts.privileged_loss(sample)["loss_privileged"] if weight > 0.0 else torch.zeros(())
            if kept > 0.0:
                loss = loss + kept * parts.demonstrations.error(parts.bbc)
            if parts.anchor is not None:
                away = distance_to_anchor(parts, sample, cfg.imitation.anchor_turn_rate, cfg.imitation.anchor_jump)
                loss = loss + cfg.imitation.anchor * away
            if cfg.ppo.symmetry:
                loss = loss + cfg.ppo.symmetry * asymmetry(parts, sample, symmetric)
            return loss

        metrics |= parts.ppo(batch, parts.generator, extra, critic_only=iteration < cfg.ppo.critic_warm_up)
    lap("policy")
    stand_ins = (parts.estimation_loss, parts.adaptation_loss)
    metrics |= fit(stand_ins, parts.adaptation_optimizer, batch, cfg.adaptation.minibatches, parts.generator)
    lap("adaptation")
    if parts.averaged is not None:
        parts.averaged.update_parameters(parts.bbc)
    metrics |= {f"task/{name}": value.mean() for name, value in batch["next", keys.REWARD_TERMS].items()}
    metrics |= {f"prior/{name}": p for name, p in zip(BEHAVIOURS, parts.prior.probabilities, strict=True)}
    metrics |= tracking_error(batch)
    metrics["falls_per_minute"] = batch["next", "terminated"].float().mean() * 60.0 / parts.env.dt
    numbers = {name: float(value) for name, value in metrics.items()}
    if due(cfg, iteration + 1):
        numbers |= hold_trial(cfg, folder_of(cfg), iteration + 1, partial(save_policy, parts, cfg))
        lap("trial")
    return numbers | lap.metrics


if __name__ == "__main__":
    with cli.one_line_errors():
        train(cli.from_presets(PRESETS, doc=__doc__, kept=KEPT))
