"""Is the teacher's recipe slower than a plain PyTorch loop? Both run in turns, on the same course and settings.

The plain loop is Hybrid-PPO written by hand: plain networks of the same sizes, the same minibatches, epochs and losses
as the given preset of ``recipes/tsc_teacher.py`` (those whose teacher reads its place and learns from the chosen
behaviour's parameters), preallocated memory, fused optimisers, float32. Both step the same
kind of environment, which holds the controller; the plain one keeps no statistics of obstacles and leaves curriculum
and moving average out. In neither is a robot put back to where others were before they failed.

    python benchmarks/plain_teacher.py --iterations 10
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import turns
from plain_ppo import History, mlp
from tensordict import TensorDict
from torch import Tensor, nn

from agility_rl import keys
from agility_rl.losses import functional
from agility_rl.training.ppo import MEASURED

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
import tsc_teacher as recipe
from tsc_ppo import OBSERVED

BEHAVIOURS, PARAMETERS = 5, 6
ACTED = (keys.PROPRIOCEPTION, keys.HEADING_ERROR, keys.OBSTACLE, keys.PLACE)
START = 400
"""First iteration; the ramps of the preset's losses are those of that time."""


def like(module: nn.Module) -> nn.Sequential:
    """Plain layers of the sizes of another network's."""
    weights = [layer.weight for layer in module.modules() if isinstance(layer, nn.Linear)]
    return mlp(weights[0].shape[1], *(weight.shape[0] for weight in weights))


class Plain:
    """Networks, memory and one training iteration, by hand."""

    def __init__(self, parts: Any, cfg: Any) -> None:
        self.env, self.cfg = parts.env, cfg
        self.discriminator = None if parts.imitation is None else parts.imitation.discriminator
        teacher, ppo = parts.teacher, cfg.ppo
        self.scandots, self.privileged = like(teacher.scandots_encoder), like(teacher.privileged_encoder)
        self.estimator, self.history = like(teacher.estimator), History()
        width = sum(self.env.observation_spec[key].shape[-1] for key in ACTED) + 32 + 4 + 29
        self.trunk = mlp(width, *ppo.hidden, last=True)
        self.choice = nn.Linear(ppo.hidden[-1], BEHAVIOURS)
        self.mean = nn.Linear(ppo.hidden[-1], BEHAVIOURS * PARAMETERS)
        self.std = nn.Parameter(torch.full((BEHAVIOURS, PARAMETERS), ppo.initial_std))
        seen = sum(self.env.observation_spec[key].shape[1:].numel() for key in OBSERVED)
        self.critic = mlp(seen, *ppo.hidden, 1)
        actor = [self.scandots, self.privileged, self.trunk, self.choice, self.mean]
        self.acting = [self.std, *(weight for part in actor for weight in part.parameters())]
        groups = [
            {"params": self.acting},
            {"params": list(self.critic.parameters()), "lr": ppo.critic_learning_rate or ppo.learning_rate},
        ]
        self.optimizer = torch.optim.Adam(groups, lr=ppo.learning_rate, fused=True)
        self.adaptation = torch.optim.Adam(self.history.parameters(), lr=cfg.adaptation.learning_rate, fused=True)
        self.generator, self.noise = torch.Generator().manual_seed(0), torch.zeros(())
        self.decay = 0.0
        if ppo.noise_seconds is not None:
            self.decay = float(torch.tensor(-self.env.dt * cfg.env.decision_steps / ppo.noise_seconds).exp())
        self.memory: dict[str, Tensor] = {}
        self.now: Any = None

    def act(self, seen: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        terrain = self.scandots(seen[keys.SCANDOTS]).tanh()
        acted = [seen[key] for key in ACTED]
        features = self.trunk(
            torch.cat((*acted, terrain, seen["estimate"], self.privileged(seen[keys.PRIVILEGED])), -1)
        )
        mean = self.mean(features).unflatten(-1, (BEHAVIOURS, PARAMETERS))
        return self.choice(features), mean, self.std.clamp(min=self.cfg.ppo.min_std).expand_as(mean)

    def value(self, seen: dict[str, Tensor]) -> Tensor:
        return self.critic(torch.cat([seen[key].flatten(1) for key in OBSERVED], -1))[:, 0]

    @torch.no_grad()
    def collect(self) -> dict[str, Tensor]:
        steps, n = self.cfg.ppo.steps, self.env.num_robots
        now = self.env.reset() if self.now is None else self.now
        for step in range(steps):
            seen = {key: now[key] for key in OBSERVED}
            seen["estimate"] = self.estimator(seen[keys.PROPRIOCEPTION])
            logits, mean, std = self.act(seen)
            fresh = torch.randn(mean.shape, generator=self.generator)
            self.noise = self.decay * self.noise + (1.0 - self.decay**2) ** 0.5 * fresh
            parameters = mean + std * self.noise
            behaviour = torch.multinomial(logits.softmax(-1), 1, generator=self.generator)[:, 0]
            action = TensorDict({"behaviour": behaviour, "parameters": parameters}, [n])
            full, upcoming = self.env.step_and_maybe_reset(TensorDict({keys.ACTION: action}, [n]))
            after, value = full["next"], self.value(seen)
            row = seen | {"logits": logits, "loc": mean, "scale": std, "choice": behaviour, "parameters": parameters}
            row |= {"value": value, "reward": after["reward"][:, 0], "done": after["done"][:, 0]}
            row |= {"terminated": after["terminated"][:, 0], "next_value": torch.zeros(n)}
            row |= {"motion": after[keys.MOTION], "skill": after[keys.SKILL]}
            for name, entry in row.items():
                if name not in self.memory:
                    self.memory[name] = torch.empty((steps, *entry.shape), dtype=entry.dtype)
                self.memory[name][step] = entry
            if step:
                self.memory["next_value"][step - 1] += value.masked_fill(self.memory["done"][step - 1], 0.0)
            if (done := row["done"]).any():
                self.memory["next_value"][step, done] = self.value({key: after[key][done] for key in OBSERVED})
            now = upcoming
        last = self.value({key: now[key] for key in OBSERVED})
        self.memory["next_value"][-1] += last.masked_fill(self.memory["done"][-1], 0.0)
        self.now = now
        return self.memory

    @torch.no_grad()
    def add_rewards(self, batch: dict[str, Tensor]) -> None:
        batch["reward"] = self.cfg.reward.task * batch["reward"]
        if self.discriminator is not None:
            seen = TensorDict({keys.MOTION: batch["motion"].flatten(0, 1), keys.SKILL: batch["skill"].flatten()})
            style = functional.imitation_reward(self.discriminator(seen)[keys.DISCRIMINATOR_LOGIT])
            seconds = self.env.dt * self.cfg.env.decision_steps
            batch["reward"] += self.cfg.reward.imitation * seconds * style.view_as(batch["reward"])

    def update(self, batch: dict[str, Tensor]) -> None:
        ppo = self.cfg.ppo
        advantage, later = torch.empty_like(batch["value"]), torch.zeros(self.env.num_robots)
        for step in reversed(range(ppo.steps)):
            bootstrap = batch["next_value"][step].masked_fill(batch["terminated"][step], 0.0)
            error = batch["reward"][step] + ppo.gamma * bootstrap - batch["value"][step]
            later = error + ppo.gamma * ppo.lmbda * later.masked_fill(batch["done"][step], 0.0)
            advantage[step] = later
        names = (*OBSERVED, "estimate", "logits", "loc", "scale", "choice", "parameters")
        flat = {name: batch[name].flatten(0, 1) for name in names}
        flat["target"] = (advantage + batch["value"]).flatten()
        deviation, mean = torch.std_mean(advantage)
        flat["advantage"] = ((advantage - mean) / (deviation + 1e-8)).flatten()
        chosen = flat["choice"][:, None, None].expand(-1, 1, PARAMETERS)
        flat["old_choice"] = flat["logits"].log_softmax(-1).gather(1, flat["choice"][:, None])[:, 0]
        flat["old_continuous"] = density(flat["loc"], flat["scale"], flat["parameters"]).gather(1, chosen[..., 0])[:, 0]
        count = len(flat["target"])
        for _ in range(ppo.epochs):
            order = torch.randperm(count, generator=self.generator)
            for rows in order.split(count // ppo.minibatches)[: ppo.minibatches]:
                seen = {name: entry[rows] for name, entry in flat.items()}
                self.descend(seen)
            self.adapt({name: entry[:MEASURED] for name, entry in seen.items()})

    def descend(self, seen: dict[str, Tensor]) -> None:
        ppo = self.cfg.ppo
        logits, mean, std = self.act(seen)
        log, choice = logits.log_softmax(-1), seen["choice"][:, None]
        one = log.gather(1, choice)[:, 0] - seen["old_choice"]
        other = density(mean, std, seen["parameters"]).gather(1, choice)[:, 0] - seen["old_continuous"]
        loss = ppo.value * (self.value(seen) - seen["target"]).square().mean()
        for ratio in (one.exp(), other.exp()):
            clipped = ratio.clamp(1.0 - ppo.clip, 1.0 + ppo.clip)
            loss = loss - torch.min(ratio * seen["advantage"], clipped * seen["advantage"]).mean()
        entropy = -(log.exp() * log).sum(-1) + std.log().mean(-1).gather(1, choice)[:, 0]
        loss = loss - ppo.entropy * entropy.mean()
        if ppo.bounds is not None:
            beyond = (mean.abs() - 1.0).clamp(min=0.0).square().sum(-1)
            loss = loss + ppo.bounds * beyond.gather(1, choice).mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_([*self.acting, *self.critic.parameters()], ppo.max_grad_norm)
        self.optimizer.step()

    @torch.no_grad()
    def adapt(self, seen: dict[str, Tensor]) -> None:
        ppo, group = self.cfg.ppo, self.optimizer.param_groups[0]
        if ppo.desired_kl is None:
            return
        _, mean, std = self.act(seen)
        apart = ((seen["scale"] / std).square() + ((seen["loc"] - mean) / std).square() - 1.0) / 2.0
        kl = float((apart - (seen["scale"] / std).log()).sum(-1).gather(1, seen["choice"][:, None]).mean())
        if kl > 2.0 * ppo.desired_kl:
            group["lr"] = max(group["lr"] / 1.5, 1e-5)
        elif 0.0 < kl < 0.5 * ppo.desired_kl:
            group["lr"] = min(group["lr"] * 1.5, ppo.max_learning_rate)

    def adapt_history(self, batch: dict[str, Tensor]) -> None:
        history, privileged = batch[keys.HISTORY].flatten(0, 1), batch[keys.PRIVILEGED].flatten(0, 1)
        for rows in torch.randperm(len(history), generator=self.generator).chunk(self.cfg.adaptation.minibatches):
            with torch.no_grad():
                truth = self.privileged(privileged[rows])
            loss = (self.history(history[rows]) - truth).norm(dim=-1).mean()
            self.adaptation.zero_grad(set_to_none=True)
            loss.backward()
            self.adaptation.step()

    def iterate(self) -> dict[str, float]:
        """One iteration; returns the seconds of each phase."""
        marks = [time.perf_counter()]
        batch = self.collect()
        marks.append(time.perf_counter())
        self.add_rewards(batch)
        self.update(batch)
        marks.append(time.perf_counter())
        self.adapt_history(batch)
        marks.append(time.perf_counter())
        return {name: marks[i + 1] - marks[i] for i, name in enumerate(("collect", "policy", "adaptation"))}


def density(mean: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Log-density of each block's Gaussian, up to a constant."""
    return -(((action - mean) / std).square() / 2.0 + std.log()).sum(-1)


def main() -> None:
    """Run both loops in turns and print the time of each phase."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    alike = [name for name, cfg in recipe.PRESETS.items() if cfg.ppo.continuous == "selected" and cfg.place]
    parser.add_argument(
        "--preset", default="cpu", choices=alike, help="preset of tsc_teacher.py whose settings both loops take"
    )
    parser.add_argument("--iterations", type=int, default=10, help="timed iterations of each loop, run in turns")
    parser.add_argument("--warmup", type=int, default=2, help="iterations of each loop before the timing")
    parser.add_argument("--robots", type=int, help="another number of robots")
    args = parser.parse_args()
    cfg = recipe.PRESETS[args.preset]
    cfg = replace(cfg, env=replace(cfg.env, num_robots=args.robots or cfg.env.num_robots))
    cfg = replace(cfg, adaptation=replace(cfg.adaptation, every=0), ppo=replace(cfg.ppo, rewound=0.0))
    parts, plain = recipe.build(cfg), Plain(recipe.build(cfg), cfg)
    runs = {
        "recipe": lambda number: recipe.iterate(parts, cfg, START + number),
        "plain": lambda number: plain.iterate(),
    }
    numbers = range(args.warmup + args.iterations)
    found = turns.phases_in_turns(runs, ("collect", "policy", "adaptation"), numbers, args.warmup)
    threads, load = torch.get_num_threads(), os.getloadavg()[0]
    print(f"{cfg.env.num_robots} robots x {cfg.ppo.steps} decisions, {threads} torch threads, load {load:.1f}")
    turns.print_phases(found, cfg.env.num_robots * cfg.ppo.steps)


if __name__ == "__main__":
    main()
