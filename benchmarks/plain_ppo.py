"""Is the recipe slower than a plain PyTorch loop? Both run in turns, with the same robots and settings.

The plain loop is semi-supervised InfoGAIL with PPO written by hand: no TorchRL and no TensorDict, plain networks of the
same sizes, the same minibatches, epochs and losses as the given preset of ``recipes/bbc_pretrain.py``, preallocated
memory, fused optimisers. Motion is drawn from pools of ready samples, which is the least that a loop can do.

    python benchmarks/plain_ppo.py --preset cpu --iterations 10
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import turns
from plain_locomotion import PlainLocomotion
from torch import Tensor, nn
from torch.nn import functional as F

from agility_rl import keys
from agility_rl.go2 import features
from agility_rl.training.ppo import MEASURED

NUM_SKILLS = 5
PHASES = ("collect", "imitation", "policy", "adaptation")
CRITIC = (keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.COMMAND, keys.PEAK)
STORED = (*CRITIC, keys.SKILL, keys.SHIFT)


def mlp(*sizes: int, activation: type[nn.Module] = nn.ELU, last: bool = False) -> nn.Sequential:
    """Linear layers with an activation between them, and after the last one if asked."""
    layers: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        layers += [nn.Linear(size_in, size_out), activation()]
    return nn.Sequential(*(layers if last else layers[:-1]))


class History(nn.Module):
    """The history encoder: a linear layer a frame, two convolutions over time, a linear layer."""

    def __init__(self) -> None:
        super().__init__()
        self.frame = mlp(features.NUM_PROPRIOCEPTION, 30, last=True)
        self.time = nn.Sequential(nn.Conv1d(30, 20, 4, 2), nn.ELU(), nn.Conv1d(20, 10, 2, 1), nn.ELU(), nn.Flatten())
        self.out = mlp(30, 29, last=True)

    def forward(self, history: Tensor) -> Tensor:
        return self.out(self.time(self.frame(history).transpose(1, 2)))


class Plain:
    """Networks, memory and one training iteration, by hand."""

    def __init__(self, cfg: Any, env: Any, dataset: Any, bfloat16: bool = False) -> None:
        self.cfg, self.robots, self.bfloat16 = cfg, PlainLocomotion(env), bfloat16
        self.n, self.steps = cfg.env.num_robots, cfg.ppo.steps
        self.generator = torch.Generator().manual_seed(cfg.seed)
        im, ppo = cfg.imitation, cfg.ppo
        p, hidden = features.NUM_PROPRIOCEPTION, ppo.hidden
        self.estimator, self.history = mlp(p, 128, 64, 4), History()
        self.privileged = mlp(29, 64, 29, last=True)
        self.actor = mlp(p + 4 + 29 + 11 + 1, *hidden, 12)
        self.std = nn.Parameter(torch.full((12,), ppo.initial_std))
        self.critic = mlp(p + 4 + 29 + 11 + 1 + (10 * p if ppo.critic_history else 0), *hidden, 1)
        self.trunk = mlp(len(cfg.motion.offsets) * features.NUM_MOTION, *im.hidden, activation=nn.ReLU, last=True)
        self.real, self.embedding = nn.Linear(im.hidden[-1], 1), nn.Embedding(NUM_SKILLS, im.hidden[-1])
        self.skill, self.shift = nn.Linear(im.hidden[-1], NUM_SKILLS), nn.Linear(im.hidden[-1], 1)
        self.policy_parameters = [*self.privileged.parameters(), *self.actor.parameters(), self.std]
        self.policy_parameters += [*self.critic.parameters()]
        judge = [*self.trunk.parameters(), *self.real.parameters(), *self.embedding.parameters()]
        heads = [*self.skill.parameters(), *self.shift.parameters()]
        self.policy_optimizer = torch.optim.Adam(self.policy_parameters, lr=ppo.learning_rate, fused=True)
        self.imitation_optimizer = torch.optim.Adam(
            [
                {"params": judge, "lr": im.discriminator_learning_rate},
                {"params": heads, "lr": im.encoder_learning_rate},
            ],
            weight_decay=im.weight_decay,
            fused=True,
        )
        adapted = [*self.estimator.parameters(), *self.history.parameters()]
        self.adaptation_optimizer = torch.optim.Adam(adapted, lr=cfg.adaptation.learning_rate, fused=True)

        self.mean, self.deviation = dataset.statistics()
        self.deviation = self.deviation.clamp(min=1e-4)
        height = features.layout_slice(features.MOTION_LAYOUT, "root_height")
        self.deviation[height] = self.deviation[height].clamp(min=im.height_deviation)
        self.weight = torch.ones_like(self.mean)
        for name in ("angular_velocity", "joint_velocity"):
            self.weight[features.layout_slice(features.MOTION_LAYOUT, name)] = im.velocity_weight
        self.unlabelled = dataset.sample_unlabelled(50_000, self.generator)[keys.MOTION]
        self.recorded = dataset.sample_unlabelled(50_000, self.generator, as_recorded=True)[keys.MOTION]
        labelled = dataset.sample_labelled(50_000, self.generator)
        order = labelled[keys.SKILL].argsort()
        self.labelled, self.labels = labelled[keys.MOTION][order], labelled[keys.SKILL][order]
        self.label_count = torch.bincount(self.labels, minlength=NUM_SKILLS)
        self.label_start = self.label_count.cumsum(0) - self.label_count
        self.prior = torch.full((NUM_SKILLS,), 1.0 / NUM_SKILLS)
        self.replay_motion = torch.zeros(im.replay, len(cfg.motion.offsets), features.NUM_MOTION)
        self.replay_skill, self.replay_shift = torch.zeros(im.replay, dtype=torch.int64), torch.zeros(im.replay, 1)
        self.replay_size = self.replay_next = 0
        self.memory: dict[str, Tensor] = {}
        self.now = self.robots.reset(torch.ones(self.n, dtype=torch.bool))

    # -- networks ----------------------------------------------------------------------------------------------------
    def act(self, seen: dict[str, Tensor], estimate: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
        inputs = (seen[keys.PROPRIOCEPTION], estimate, latent, seen[keys.COMMAND], seen[keys.PEAK])
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bfloat16):
            loc = self.actor(torch.cat(inputs, -1))
        return loc.float(), self.std.clamp(min=self.cfg.ppo.min_std).expand(loc.shape)

    def value(self, seen: dict[str, Tensor]) -> Tensor:
        inputs = [seen[name] for name in CRITIC]
        inputs += [seen[keys.HISTORY].flatten(1)] if self.cfg.ppo.critic_history else []
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bfloat16):
            return self.critic(torch.cat(inputs, -1))[:, 0].float()

    def normalize(self, motion: Tensor) -> Tensor:
        return ((motion - self.mean) / self.deviation).clamp(-10.0, 10.0) * self.weight

    def judge(self, trunk: Tensor, skill: Tensor) -> Tensor:
        logit = self.real(trunk)[:, 0]
        return logit + (self.embedding(skill) * trunk).sum(-1) if self.cfg.imitation.conditional else logit

    # -- one iteration -----------------------------------------------------------------------------------------------
    @torch.no_grad()
    def collect(self, with_history: bool, stored: tuple[str, ...]) -> dict[str, Tensor]:
        prior, temperature = self.prior, self.cfg.imitation.prior_temperature
        self.robots.env.set_skill_probabilities(prior if temperature is None else (prior / temperature).softmax(0))
        last_done = torch.zeros(self.n, dtype=torch.bool)
        for step in range(self.steps):
            seen = self.now
            estimate = self.estimator(seen[keys.PROPRIOCEPTION])
            latent = self.history(seen[keys.HISTORY]) if with_history else self.privileged(seen[keys.PRIVILEGED])
            loc, scale = self.act(seen, estimate, latent)
            action = loc + scale * torch.randn(loc.shape, generator=self.generator)
            after, reward, terminated, truncated = self.robots.step(action)
            done = terminated | truncated
            row = {name: seen[name] for name in stored} | {"estimate": estimate, "loc": loc, "scale": scale}
            row |= {"action": action, "log_prob": log_prob(loc, scale, action), "value": self.value(seen)}
            row |= {"next_motion": after[keys.MOTION], "reward": reward, "terminated": terminated, "done": done}
            row |= {"next_value": torch.zeros(self.n), "paid": self.speed_share()}
            for name, entry in row.items():
                if name not in self.memory:
                    self.memory[name] = torch.empty((self.steps, *entry.shape), dtype=entry.dtype)
                self.memory[name][step] = entry
            if step:
                self.memory["next_value"][step - 1] += row["value"].masked_fill(last_done, 0.0)
            if done.any():
                self.memory["next_value"][step, done] = self.value({name: x[done] for name, x in after.items()})
                after = self.robots.reset(done)
            self.now, last_done = after, done
        self.memory["next_value"][-1] += self.value(self.now).masked_fill(last_done, 0.0)
        return self.memory

    def speed_share(self) -> Tensor:
        if "velocity_progress" not in self.robots.terms:
            return torch.ones(self.n)
        weight = self.robots.env.rewards["velocity_progress"].weight
        return (self.robots.terms["velocity_progress"] / weight).clamp(0.0, 1.0)

    def remember(self, batch: dict[str, Tensor]) -> None:
        motion = batch["next_motion"].flatten(0, 1)
        rows = (self.replay_next + torch.arange(len(motion))) % len(self.replay_skill)
        self.replay_motion[rows] = motion
        self.replay_skill[rows], self.replay_shift[rows] = batch[keys.SKILL].flatten(), batch[keys.SHIFT].flatten(0, 1)
        self.replay_next = (self.replay_next + len(motion)) % len(self.replay_skill)
        self.replay_size = min(self.replay_size + len(motion), len(self.replay_skill))

    def update_imitation(self, iteration: int) -> None:
        im = self.cfg.imitation
        information = ramp(iteration, im.information_ramp, im.information)
        for _ in range(im.minibatches):
            rows = self.integers(self.replay_size, im.batch_size)
            policy, skill, shift = self.replay_motion[rows], self.replay_skill[rows], self.replay_shift[rows]
            unlabelled = self.unlabelled[self.integers(len(self.unlabelled), im.batch_size)]
            rows = self.integers(len(self.labelled), im.labelled_batch_size)
            labelled, label = self.labelled[rows], self.labels[rows]
            expert, expert_skill = self.expert(unlabelled, skill)
            seen = self.normalize(expert).requires_grad_()
            real = self.judge(self.trunk(seen.flatten(1)), expert_skill)
            slope = torch.autograd.grad(real.sum(), seen, create_graph=True)[0].square().sum((1, 2)).mean()
            trunk = self.trunk(self.normalize(policy).flatten(1))
            loss = 0.5 * ((real - 1.0).square().mean() + (self.judge(trunk, skill) + 1.0).square().mean())
            loss = loss + im.gradient_penalty * slope + 0.05 * self.real.weight.square().sum()
            weights = (*(layer.weight for layer in self.trunk if isinstance(layer, nn.Linear)), self.real.weight)
            loss = loss + 1e-4 * sum(weight.square().sum() for weight in (*weights, self.embedding.weight))
            loss = loss + (self.shift(trunk) - shift).abs().mean()
            loss = loss + F.cross_entropy(self.skill(self.trunk(self.normalize(labelled).flatten(1))), label)
            log_q = self.skill(self.trunk(self.normalize(unlabelled).flatten(1))).log_softmax(-1)
            q = log_q.exp()
            loss = loss - information * (q * log_q).sum(-1).mean()
            self.imitation_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.imitation_optimizer.step()
            with torch.no_grad():
                recorded = self.recorded[self.integers(len(self.recorded), im.batch_size)]
                told = self.skill(self.trunk(self.normalize(recorded).flatten(1))).softmax(-1)
                self.prior.lerp_(told.mean(0), im.prior_weight)

    @torch.no_grad()
    def expert(self, unlabelled: Tensor, policy_skill: Tensor) -> tuple[Tensor, Tensor]:
        """Expert batch: a share of labelled motion in the policy's skills, the rest unlabelled with drawn skills."""
        im = self.cfg.imitation
        count = round(im.labelled_share * im.batch_size)
        shares = torch.bincount(policy_skill, minlength=NUM_SKILLS).float()
        skill = (
            torch.multinomial(shares, count, replacement=True, generator=self.generator) if count else shares[:0].long()
        )
        offset = (torch.rand(count, generator=self.generator) * self.label_count[skill]).long()
        rest = unlabelled[: im.batch_size - count]
        q = self.skill(self.trunk(self.normalize(rest).flatten(1))).softmax(-1)
        drawn = torch.multinomial(q, 1, generator=self.generator)[:, 0]
        return torch.cat((self.labelled[self.label_start[skill] + offset], rest)), torch.cat((skill, drawn))

    @torch.no_grad()
    def add_rewards(self, batch: dict[str, Tensor]) -> None:
        im, dt = self.cfg.imitation, self.robots.env.dt
        skill = batch[keys.SKILL].flatten()
        trunk = self.trunk(self.normalize(batch["next_motion"].flatten(0, 1)).flatten(1))
        imitation = (1.0 - 0.25 * (self.judge(trunk, skill) - 1.0).square()).clamp(min=0.0)
        known = self.skill(trunk).log_softmax(-1).gather(1, skill[:, None])[:, 0]
        if im.skill_floor is not None:
            known = 1.0 - known.clamp(min=im.skill_floor) / im.skill_floor
        near = -(self.shift(trunk) - batch[keys.SHIFT].flatten(0, 1)).abs()[:, 0]
        paid = 1.0 - im.gate * (1.0 - batch["paid"].flatten())
        style = dt * (paid * (im.imitation_reward * imitation + im.skill_reward * known) + im.shift_reward * near)
        batch["reward"] = im.task_reward * batch["reward"] + style.view(self.steps, self.n)

    def update_policy(self, batch: dict[str, Tensor], pull: float) -> None:
        ppo = self.cfg.ppo
        advantage, later = torch.empty_like(batch["value"]), torch.zeros(self.n)
        for step in reversed(range(self.steps)):
            bootstrap = batch["next_value"][step].masked_fill(batch["terminated"][step], 0.0)
            error = batch["reward"][step] + ppo.gamma * bootstrap - batch["value"][step]
            later = error + ppo.gamma * ppo.lmbda * later.masked_fill(batch["done"][step], 0.0)
            advantage[step] = later
        names = (*CRITIC, *((keys.HISTORY,) if ppo.critic_history else ()))
        flat = {name: batch[name].flatten(0, 1) for name in (*names, "estimate", "loc", "scale", "action", "log_prob")}
        flat["target"] = (advantage + batch["value"]).flatten()
        flat["advantage"], group = advantage.flatten(), batch[keys.SKILL].flatten() * ppo.by_behaviour
        for own in (group == index for index in group.unique()):
            deviation, mean = torch.std_mean(flat["advantage"][own])
            flat["advantage"][own] = (flat["advantage"][own] - mean) / (deviation + 1e-8)
        if pull > 0.0:
            with torch.no_grad():
                flat["inferred"] = self.history(batch[keys.HISTORY].flatten(0, 1))
        count = self.steps * self.n
        for _ in range(ppo.epochs):
            for rows in torch.randperm(count, generator=self.generator).split(count // ppo.minibatches)[
                : ppo.minibatches
            ]:
                seen = {name: x[rows] for name, x in flat.items()}
                latent = self.privileged(seen[keys.PRIVILEGED])
                loc, scale = self.act(seen, seen["estimate"], latent)
                ratio = (log_prob(loc, scale, seen["action"]) - seen["log_prob"]).exp()
                clipped = ratio.clamp(1.0 - ppo.clip, 1.0 + ppo.clip)
                loss = -torch.min(ratio * seen["advantage"], clipped * seen["advantage"]).mean()
                loss = loss - ppo.entropy * scale.log().sum(-1).mean()
                loss = loss + ppo.value * (self.value(seen) - seen["target"]).square().mean()
                if pull > 0.0:
                    loss = loss + pull * (latent - seen["inferred"]).norm(dim=-1).mean()
                self.policy_optimizer.zero_grad(set_to_none=True)
                loss.backward()
                nn.utils.clip_grad_norm_(self.policy_parameters, ppo.max_grad_norm)
                self.policy_optimizer.step()
            if ppo.desired_kl is not None:
                self.adapt_learning_rate({name: x[:MEASURED] for name, x in seen.items()})

    @torch.no_grad()
    def adapt_learning_rate(self, seen: dict[str, Tensor]) -> None:
        ppo, group = self.cfg.ppo, self.policy_optimizer.param_groups[0]
        loc, scale = self.act(seen, seen["estimate"], self.privileged(seen[keys.PRIVILEGED]))
        apart = ((seen["scale"] / scale).square() + ((seen["loc"] - loc) / scale).square() - 1.0) / 2.0
        kl = float((apart - (seen["scale"] / scale).log()).sum(-1).mean())
        if kl > 2.0 * ppo.desired_kl:
            group["lr"] = max(group["lr"] / 1.5, 1e-5)
        elif 0.0 < kl < 0.5 * ppo.desired_kl:
            group["lr"] = min(group["lr"] * 1.5, ppo.max_learning_rate)

    def update_adaptation(self, batch: dict[str, Tensor]) -> None:
        names = (keys.PROPRIOCEPTION, keys.EXPLICIT, keys.HISTORY, keys.PRIVILEGED)
        flat = {name: batch[name].flatten(0, 1) for name in names}
        order = torch.randperm(self.steps * self.n, generator=self.generator)
        for rows in order.chunk(self.cfg.adaptation.minibatches):
            error = self.estimator(flat[keys.PROPRIOCEPTION][rows]) - flat[keys.EXPLICIT][rows]
            with torch.no_grad():
                truth = self.privileged(flat[keys.PRIVILEGED][rows])
            loss = error.square().mean() + (self.history(flat[keys.HISTORY][rows]) - truth).norm(dim=-1).mean()
            self.adaptation_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.adaptation_optimizer.step()

    def iterate(self, iteration: int) -> dict[str, float]:
        """One iteration; returns the seconds of each phase."""
        adaptation, marks = self.cfg.adaptation, [time.perf_counter()]
        with_history = adaptation.every > 0 and iteration % adaptation.every == adaptation.every - 1
        pull = ramp(iteration, adaptation.privileged_ramp, adaptation.privileged)
        batch = self.collect(with_history, (*STORED, keys.HISTORY))
        marks.append(time.perf_counter())
        self.remember(batch)
        self.update_imitation(iteration)
        marks.append(time.perf_counter())
        self.add_rewards(batch)
        if not with_history:
            self.update_policy(batch, pull)
        marks.append(time.perf_counter())
        self.update_adaptation(batch)
        marks.append(time.perf_counter())
        return {phase: marks[i + 1] - marks[i] for i, phase in enumerate(PHASES)}

    def integers(self, high: int, count: int) -> Tensor:
        return torch.randint(high, (count,), generator=self.generator)


def log_prob(loc: Tensor, scale: Tensor, action: Tensor) -> Tensor:
    """Log-density of a diagonal Gaussian, up to a constant."""
    return -(((action - loc) / scale).square() / 2.0 + scale.log()).sum(-1)


def ramp(step: int, window: tuple[int, int], final: float) -> float:
    """Linear rise from 0 at ``window[0]`` to ``final`` after ``window[1]`` more steps."""
    return final * min(max((step - window[0]) / window[1], 0.0), 1.0)


def load_recipe() -> ModuleType:
    """``recipes/bbc_pretrain.py`` as a module."""
    path = Path(__file__).parents[1] / "recipes" / "bbc_pretrain.py"
    specification = importlib.util.spec_from_file_location("bbc_pretrain", path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.path.insert(0, str(path.parent))
    sys.modules["bbc_pretrain"] = module
    specification.loader.exec_module(module)
    return module


def main() -> None:
    """Run both loops in turns and print the time of each phase."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="cpu", help="preset of bbc_pretrain.py whose settings both loops take")
    parser.add_argument("--iterations", type=int, default=10, help="timed iterations of each loop, run in turns")
    parser.add_argument("--warmup", type=int, default=2, help="iterations of each loop before the timing")
    parser.add_argument("--start", type=int, default=400, help="first iteration; by then all ramps are over")
    parser.add_argument("--robots", type=int, help="another number of robots")
    parser.add_argument("--bfloat16", action="store_true", help="plain loop: autocast actor and critic")
    parser.add_argument("--compile", action="store_true", help="recipe: --ppo.compile")
    parser.add_argument("--only", choices=("plain", "recipe"), help="run one of the two")
    parser.add_argument("--labelled", type=Path, help="folder of labelled clips; synthetic gaits without it")
    parser.add_argument("--unlabelled", type=Path, help="folder of unlabelled clips")
    options = parser.parse_args()
    recipe = load_recipe()
    cfg = recipe.PRESETS[options.preset]
    cfg = replace(cfg, motion=replace(cfg.motion, labelled=options.labelled, unlabelled=options.unlabelled))
    cfg = replace(cfg, ppo=replace(cfg.ppo, compile=options.compile))
    if options.robots:
        cfg = replace(cfg, env=replace(cfg.env, num_robots=options.robots))

    runs: dict[str, Any] = {}
    if options.only != "plain":
        parts = recipe.build(cfg)
        runs["recipe"] = lambda iteration: recipe.iterate(parts, cfg, iteration)
    if options.only != "recipe":
        own = recipe.build(cfg)
        runs["plain"] = Plain(cfg, own.env, own.dataset, options.bfloat16).iterate
    numbers = range(options.start, options.start + options.warmup + options.iterations)
    found = turns.phases_in_turns(runs, PHASES, numbers, options.warmup)
    threads, load = torch.get_num_threads(), os.getloadavg()[0]
    print(f"{cfg.env.num_robots} robots x {cfg.ppo.steps} steps, {threads} torch threads, load {load:.1f}")
    turns.print_phases(found, cfg.env.num_robots * cfg.ppo.steps)


if __name__ == "__main__":
    main()
