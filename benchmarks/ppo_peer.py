"""Is PPO's update slower than that of rsl-rl-lib? Both take the same batch, networks and settings, in turns.

The peer runs in an environment of its own (``peer.py`` says how to make it), which needs nothing of this package:

    python benchmarks/ppo_peer.py --peer build/peer/bin/python

An update is advantages and returns, then epochs of minibatches with a learning rate that follows the divergence. Before
anything is timed, one step over the whole batch is compared: the two must arrive at the same weights.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from peer import Peer, serve
from tensordict import TensorDict
from torch import Tensor, nn

OBSERVED, ACTIONS, STEPS, HIDDEN = 90, 12, 24, (512, 256, 128)
"""What the basic controller's policy sees and does, and the layers of section S6."""
GAMMA, LAMBDA, CLIP, VALUE, ENTROPY, RATE, DIVERGENCE = 0.99, 0.95, 0.2, 1.0, 0.01, 1e-3, 0.01
Weights = dict[str, list[Tensor]]


@dataclass(frozen=True)
class Setting:
    """What an update does: passes, minibatches of a pass, bound of the gradient, number format, ``torch.compile``."""

    epochs: int = 5
    minibatches: int = 4
    max_grad_norm: float = 1.0
    bfloat16: bool = False
    compile: bool = False


CHECKED = Setting(epochs=1, minibatches=1, max_grad_norm=math.inf)
"""One step whose gradient nobody clips: the peer clips actor and critic each by itself, we both together."""
REACHED = "reached.pt"
WARM_UP = 2
"""Updates of each that are not timed: the first compiles."""
Learner = tuple[Callable[[], object], Callable[[], list[Tensor]]]
"""An update, and the weights that it has reached."""


def ours(data: dict[str, Tensor], weights: Weights, setting: Setting) -> Learner:
    """Our update, as ``bbc_pretrain.py`` puts it together."""
    from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
    from torchrl.objectives.value import GAE

    from agility_rl.losses import functional
    from agility_rl.modules import Critic, GaussianActor
    from agility_rl.training.ppo import PPOUpdate

    actor = GaussianActor(OBSERVED, ACTIONS, in_keys=["observation"], hidden=HIDDEN, min_std=1e-6)
    critic = Critic(OBSERVED, in_keys=["observation"], hidden=HIDDEN)
    own = [*actor.network.mean.parameters(), *critic.parameters()]
    fill(own, [*weights["actor"], *weights["critic"]])
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=RATE, fused=True)
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=CLIP,
        entropy_coeff=ENTROPY,
        critic_coeff=VALUE,
        loss_critic_type="l2",
        functional=False,
    )
    advantage = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=None, time_dim=0)

    def divergence(sample: Any) -> Tensor:
        loc, scale = actor.network(sample["observation"])
        return functional.gaussian_kl(sample["loc"], sample["scale"], loc, scale).mean()

    update = PPOUpdate(
        loss,
        optimizer,
        epochs=setting.epochs,
        minibatches=setting.minibatches,
        max_grad_norm=setting.max_grad_norm,
        keep=["loc", "scale"],
        divergence=divergence,
        schedule=KLAdaptiveLR(optimizer, DIVERGENCE),
        precision=torch.bfloat16 if setting.bfloat16 else torch.float32,
        compile=setting.compile,
    )
    names = ("observation", "loc", "scale", "action", "action_log_prob", "state_value")
    generator = torch.Generator().manual_seed(0)

    def run() -> None:
        batch = TensorDict({name: data[name] for name in names}, data["done"].shape[:2])
        with torch.no_grad():
            last = critic(TensorDict({"observation": data["last"]}, data["last"].shape[:1]))["state_value"]
        batch["next"] = TensorDict(
            {"reward": data["reward"], "done": data["done"], "terminated": data["done"]}, batch.batch_size
        )
        batch["next", "state_value"] = torch.cat((data["state_value"][1:], last[None]))
        update(advantage(batch), generator)

    return run, lambda: [weight.detach() for weight in own]


def peers(data: dict[str, Tensor], weights: Weights, setting: Setting) -> Learner:
    """The update of rsl-rl-lib."""
    from rsl_rl.algorithms import PPO
    from rsl_rl.models import MLPModel
    from rsl_rl.storage import RolloutStorage

    seen = TensorDict({"policy": data["last"]}, data["last"].shape[:1])
    groups = {"actor": ["policy"], "critic": ["policy"]}
    gaussian = {"class_name": "rsl_rl.modules.distribution:GaussianDistribution"}
    actor = MLPModel(seen, groups, "actor", ACTIONS, HIDDEN, distribution_cfg=gaussian)
    critic = MLPModel(seen, groups, "critic", 1, HIDDEN)
    own = [*actor.mlp.parameters(), *critic.mlp.parameters()]
    fill(own, [*weights["actor"], *weights["critic"]])
    steps, robots = data["done"].shape[:2]
    storage = RolloutStorage("rl", robots, steps, seen, [ACTIONS])
    storage.observations["policy"].copy_(data["observation"])
    storage.actions.copy_(data["action"])
    storage.rewards.copy_(data["reward"])
    storage.dones.copy_(data["done"])
    storage.values.copy_(data["state_value"])
    storage.actions_log_prob.copy_(data["action_log_prob"][..., None])
    storage.distribution_params = (data["loc"], data["scale"])
    ppo = PPO(
        actor,
        critic,
        storage,
        num_learning_epochs=setting.epochs,
        num_mini_batches=setting.minibatches,
        clip_param=CLIP,
        gamma=GAMMA,
        lam=LAMBDA,
        value_loss_coef=VALUE,
        entropy_coef=ENTROPY,
        learning_rate=RATE,
        max_grad_norm=setting.max_grad_norm,
        use_clipped_value_loss=False,
        schedule="adaptive",
        desired_kl=DIVERGENCE,
        use_mixed_precision=setting.bfloat16,
    )
    ppo.compile("default" if setting.compile else None)

    def run() -> None:
        ppo.compute_returns(seen)
        ppo.update()

    return run, lambda: [weight.detach() for weight in own]


@torch.no_grad()
def fill(parameters: list[nn.Parameter], weights: list[Tensor]) -> None:
    """Copy weights into parameters of the same order."""
    for parameter, weight in zip(parameters, weights, strict=True):
        parameter.copy_(weight)


def experience(robots: int) -> tuple[dict[str, Tensor], Weights]:
    """A batch that a random policy might have collected, and the weights of actor and critic."""
    generator = torch.Generator().manual_seed(0)

    def network(outputs: int) -> tuple[nn.Sequential, list[Tensor]]:
        sizes, layers = (OBSERVED, *HIDDEN, outputs), []
        for size_in, size_out in itertools.pairwise(sizes):
            layers += [nn.Linear(size_in, size_out), nn.ELU()]
        chain = nn.Sequential(*layers[:-1])
        fill(list(chain.parameters()), [torch.randn(p.shape, generator=generator) * 0.05 for p in chain.parameters()])
        return chain, [parameter.detach() for parameter in chain.parameters()]

    (actor, actor_weights), (critic, critic_weights) = network(ACTIONS), network(1)
    seen = torch.randn(STEPS + 1, robots, OBSERVED, generator=generator)
    with torch.no_grad():
        loc, value = actor(seen[:-1]), critic(seen[:-1])
    scale = torch.ones_like(loc)
    action = torch.normal(loc, scale, generator=generator)
    density = -((action - loc).square() / 2.0 + 0.5 * math.log(2.0 * math.pi)).sum(-1)
    data = {"observation": seen[:-1].contiguous(), "last": seen[-1].contiguous()}
    data |= {"loc": loc, "scale": scale, "action": action, "action_log_prob": density, "state_value": value}
    data["reward"] = torch.randn(STEPS, robots, 1, generator=generator)
    data["done"] = torch.rand(STEPS, robots, 1, generator=generator) < 0.01
    return data, {"actor": actor_weights, "critic": critic_weights}


def serve_peer(folder: Path) -> None:
    """The peer's process: an update by a setting; the weights that it has reached lie in the folder."""
    data, weights = torch.load(folder / "experience.pt", weights_only=True)
    learners: dict[Setting, Learner] = {}

    def work(**setting: Any) -> Callable[[], object]:
        wanted = Setting(**setting)
        if wanted not in learners:
            learners[wanted] = peers(data, weights, wanted)
        run, reached = learners[wanted]

        def update() -> None:
            run()
            if wanted == CHECKED:
                torch.save(reached(), folder / REACHED)

        return update

    serve(work)


def compare(data: dict[str, Tensor], weights: Weights, peer: Peer, folder: Path) -> None:
    """Take one step with both; print how far they are apart."""
    peer.ask(**vars(CHECKED))
    run, reached = ours(data, weights, CHECKED)
    run()
    theirs = torch.load(folder / REACHED, weights_only=True)
    start = [*weights["actor"], *weights["critic"]]
    moved = max(float((a - b).abs().max()) for a, b in zip(reached(), start, strict=True))
    apart = max(float((a - b).abs().mean()) for a, b in zip(reached(), theirs, strict=True))
    print(f"one step: weights move by {moved:.1e}, ours and the peer's are {apart:.1e} apart in the mean")


def main() -> None:
    """Compare one step, then time both in turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, help="Python of an environment with rsl-rl-lib")
    parser.add_argument("--robots", type=int, default=512, help=f"robots of a batch, {STEPS} steps each")
    parser.add_argument("--rounds", type=int, default=10, help="turns of each")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve_peer(options.serve)
        return
    data, weights = experience(options.robots)
    with tempfile.TemporaryDirectory() as folder:
        torch.save((data, weights), Path(folder) / "experience.pt")
        peer = Peer(options.peer, Path(__file__), "--serve", folder)
        compare(data, weights, peer, Path(folder))
        size = f"{STEPS} steps x {options.robots} robots, {Setting.epochs} epochs of {Setting.minibatches} minibatches"
        print(f"{size}, {torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f}; median of an update [s]")
        for bfloat16, compiled in itertools.product((False, True), (False, True)):
            setting = Setting(bfloat16=bfloat16, compile=compiled)
            run, _ = ours(data, weights, setting)
            times: list[tuple[float, float]] = []
            for _ in range(options.rounds + WARM_UP):
                began = time.perf_counter()
                run()
                times.append((time.perf_counter() - began, peer.ask(**vars(setting))))
            own, other = (statistics.median(column) for column in zip(*times[WARM_UP:], strict=True))
            ratio = statistics.median(b / a for a, b in times[WARM_UP:])
            name = ("bfloat16" if bfloat16 else "float32") + compiled * ", compiled"
            print(f"{name:20} ours {own:.3f}, rsl-rl-lib {other:.3f}: ours is {ratio:.2f} times as fast")
        peer.close()


if __name__ == "__main__":
    main()
