"""Stage 2a: find the distribution of simulator parameters under which the simulator moves as the robot's log does.

Source: Fu et al. 2025, supplement S2, Algorithm S2, Table S3; method notes, section 6.

In:  a robot log (``--log FILE``) and the policy that made it (``--policy RUN``; without one, the open-loop trot of
     ``record_log.py``). The preset ``cpu`` replays the log; of the policy it takes only the friction of the joints.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap`` (the distribution of every generation), ``checkpoints/``,
     ``result.json``, ``figures/convergence.png``, and the identifiability table on the screen.

    python recipes/record_log.py --log logs/target.mcap --policy runs/my_run --draw
    python recipes/easi.py cpu --log logs/target.mcap --policy runs/my_run --truth logs/target.truth.json
    python recipes/easi.py cpu --resume runs/easi --generations 80      # goes on exactly where it stopped

Presets: ``smoke`` (seconds), ``cpu`` (two cores, ours), ``paper`` (Table S3).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import easi_config
import torch
from easi_config import PRESETS, Config, CriticConfig, check, check_inputs, least_std, replay_window, replayed_at_once
from easi_report import (
    draw_convergence,
    identify,
    load_truth,
    physical,
    print_result,
    relative_error,
    survivor_correlation,
    write_result,
)
from identified import known_fields
from log_policy import Actor, checksum, make_actor
from rich.console import Console
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from training_run import own_options

from agility_rl.collectors import (
    EASICollector,
    EvolutionStrategy,
    ParameterSpace,
    ReplayCollector,
    ResponseMemory,
    RobotLog,
    cut_windows,
    one_thread,
)
from agility_rl.collectors.parameters import Parameter
from agility_rl.collectors.replay import MATCHED
from agility_rl.losses import TransitionDiscriminatorLoss
from agility_rl.modules import TransitionDiscriminator
from agility_rl.record import MCAPLogger, read_scalars
from agility_rl.simulation import Simulator, make_simulator
from agility_rl.training import cli, run_folder
from agility_rl.training.checkpoint import RunCheckpoint
from agility_rl.training.display import Display
from agility_rl.training.seeding import Seeds, seed_everything

HEADLINE = ("time/minutes", "error/mean", "distance", "score/mean", "score/best")


@dataclass
class Components:
    """Everything a search is made of."""

    seeds: Seeds
    real: TensorDict
    space: ParameterSpace
    search: EvolutionStrategy
    simulator: Simulator
    collector: EASICollector | ReplayCollector
    responses: ResponseMemory | None
    critic: TransitionDiscriminator
    loss: TransitionDiscriminatorLoss
    optimizer: torch.optim.Optimizer
    survivors: Tensor
    """``[D, D]``, sum over the generations of their survivors' correlation."""
    truth: Tensor | None
    inputs: dict[str, Any]
    """What the search depends on and the run folder does not hold."""

    def checkpoint(self, folder: Path, progress: dict[str, float]) -> RunCheckpoint:
        """All that a bit-exact continuation needs; a collection begins with a reset, so no simulator is saved."""
        names = ("seeds", "search", "responses", "critic", "optimizer", "survivors")
        parts = {name: part for name in names if (part := getattr(self, name)) is not None}
        return RunCheckpoint(folder, progress=progress, **parts)


@one_thread()
def build(cfg: Config) -> Components:
    """Read the log, construct simulations, search and critic."""
    path = check(cfg)
    seeds, search = seed_everything(cfg.seed), cfg.search
    log = RobotLog.load(path)
    linear = {"scale": "linear"} if search.scale == "linear" else {}
    actor = make_actor(cfg.policy, cfg.behaviours, cfg.command_seconds)
    recording = {
        "policy": actor.name,
        "behaviours": list(cfg.behaviours),
        "command_seconds": cfg.command_seconds,
        "friction_loss": actor.friction_loss if cfg.friction_loss is None else cfg.friction_loss,
        "noise": cfg.noise,
        "latency": cfg.latency,
    }
    space = ParameterSpace(
        [Parameter.named(name, span=search.span, **linear) for name in search.parameters], base=known_fields(recording)
    )
    truth = None
    if cfg.truth is not None:
        truth, recorded = load_truth(cfg.truth, space)
        for name, value in recording.items():
            if recorded.get(name) != value:
                print(f"warning: the log was recorded with {name} {recorded.get(name)}, the search has {value}")
    at_once = replayed_at_once(cfg) if cfg.collection == "replay" else 1
    simulator = make_simulator(
        num_simulations=at_once * cfg.num_robots, num_threads=cfg.num_threads, friction_loss=recording["friction_loss"]
    )
    low, high = torch.zeros(len(space)), torch.ones(len(space))
    lower, upper = (low, high) if search.bounded else space.limits
    collector = make_collector(cfg, simulator, space, actor, log, seeds)
    real = collector.real if isinstance(collector, ReplayCollector) else log.transitions()
    critic = TransitionDiscriminator.from_transitions(
        real,
        clip=cfg.critic.clip,
        hidden=cfg.critic.hidden,
        difference=cfg.critic.difference,
        matched_key=MATCHED if cfg.critic.matched else None,
    )
    loss = TransitionDiscriminatorLoss(
        critic, weight_clip=cfg.critic.weight_clip, gradient_penalty=cfg.critic.gradient_penalty
    )
    optimizer: torch.optim.Optimizer = torch.optim.RMSprop(critic.parameters(), lr=cfg.critic.learning_rate)
    if cfg.critic.optimizer == "adam":
        optimizer = torch.optim.Adam(critic.parameters(), lr=cfg.critic.learning_rate, betas=(0.5, 0.9))
    return Components(
        seeds=seeds,
        real=real,
        space=space,
        search=EvolutionStrategy(
            low,
            high,
            population=cfg.num_robots,
            survival_rate=search.survival_rate,
            covariance=search.covariance,
            centre=search.centre,
            min_std=least_std(cfg),
            averaged=search.averaged,
            lower=lower,
            upper=upper,
            generator=seeds.generator("search"),
        ),
        simulator=simulator,
        collector=collector,
        responses=None if search.response is None else ResponseMemory(share=search.response),
        critic=critic,
        loss=loss,
        optimizer=optimizer,
        survivors=torch.zeros(len(space), len(space), dtype=torch.float64),
        truth=truth,
        inputs={"log": checksum(path), **recording},
    )


def make_collector(
    cfg: Config, simulator: Simulator, space: ParameterSpace, actor: Actor, log: RobotLog, seeds: Seeds
) -> EASICollector | ReplayCollector:
    """What individuals do: roll out the policy, or replay the log.

    Raises:
        ValueError: if windows do not fit into the log.
    """
    generator = seeds.generator("collector")
    if cfg.collection == "policy":
        return EASICollector(
            simulator,
            space,
            actor.policy,
            generator=generator,
            num_steps=cfg.trajectory_length,
            noise=cfg.noise,
            latency=cfg.latency,
        )
    steps, skip = replay_window(cfg)
    windows = cut_windows(log, steps, skip=skip, noise=cfg.noise, latency=cfg.latency)
    return ReplayCollector(simulator, space, windows, num_windows=cfg.trajectory_length // steps, generator=generator)


@one_thread()
def update_critic(parts: Components, cfg: CriticConfig, transitions: TensorDictBase) -> dict[str, Tensor]:
    """Algorithm S2, lines 9 to 12: K steps down equation (13); returns the last losses."""
    generator = parts.seeds.generator("batches")
    losses = TensorDict()
    if cfg.matched:
        parts.critic.rescale(transitions)
    for _ in range(cfg.updates):
        policy = parts.collector.sample(transitions, generator, cfg.batch_per_robot)
        rows = torch.randint(len(parts.real), (len(policy),), generator=generator)
        parts.loss.clip_weights()
        losses = parts.loss(TensorDict({"expert": parts.real[rows], "policy": policy}))
        total = sum(value for name, value in losses.items() if name.startswith("loss_"))
        parts.optimizer.zero_grad(set_to_none=True)
        total.backward()
        parts.optimizer.step()
    return {name: value.detach() for name, value in losses.items()}


def evolve(parts: Components, cfg: Config) -> dict[str, float]:
    """One generation of Algorithm S2; returns metrics by name."""
    clock = time.perf_counter()
    individuals = parts.search.ask()
    transitions = parts.collector.collect(individuals)
    collected = time.perf_counter()
    metrics: dict[str, Any] = update_critic(parts, cfg.critic, transitions)
    scores = parts.collector.score(parts.critic, transitions)
    parts.search.tell(individuals, scores, next_mean(parts, individuals, transitions))
    with one_thread():
        parts.survivors += survivor_correlation(parts.search, individuals, scores)
    metrics |= {"score/mean": scores[scores.isfinite()].mean(), "score/best": scores.max()}
    mean, std = physical(parts.search, parts.space)
    metrics |= {f"mean/{name}": value for name, value in zip(parts.space.names, mean)}
    metrics |= {f"std/{name}": value for name, value in zip(parts.space.names, std)}
    if parts.truth is not None:
        error = relative_error(mean, parts.truth, parts.space)
        metrics |= {f"error/{name}": value for name, value in zip(parts.space.names, error)}
        metrics["error/mean"] = error.mean()
    if ("next", "fallen") in transitions.keys(include_nested=True):  # who replays the log is never put back
        metrics["falls_per_minute"] = transitions["next", "fallen"].float().mean() * 60.0 / parts.simulator.control_dt
    metrics["unusable_transitions"] = (~transitions["collector", "mask"]).float().mean()
    metrics |= {"time/collect": collected - clock, "time/critic": time.perf_counter() - collected}
    return {name: float(value) for name, value in metrics.items()}


def next_mean(parts: Components, individuals: Tensor, transitions: TensorDictBase) -> Tensor | None:
    """Where the critic likes the windows' linear responses best; the survivors' mean (``None``) without any."""
    if parts.responses is None:
        return None
    parts.responses.remember(individuals, transitions, parts.search.mean)
    # The first generation fills the whole range, and in that nothing is linear.
    return parts.responses.climb(parts.critic, parts.search) if parts.search.generation else None


def train(cfg: Config, console: Console | None = None) -> Path:
    """Algorithm S2; returns the run folder."""
    console = console or cli.console(120)
    cfg = own_options(cfg, easi_config.KEPT)
    parts = build(cfg)
    if cfg.resume is not None:
        check_inputs(cfg.resume, parts.inputs)
    folder = cfg.resume or cfg.runs / cfg.name
    folder = run_folder.start_run(cfg, folder, resume=cfg.resume is not None, recipe="easi", inputs=parts.inputs)
    progress = {"generation": 0, "minutes": 0.0}
    checkpoint = parts.checkpoint(folder / "checkpoints", progress)
    if cfg.resume is not None and checkpoint.steps():
        checkpoint.load()
    elif cfg.resume is not None:
        print(f"{folder} has no checkpoint yet: it begins anew, with the same numbers")
    logger = MCAPLogger(folder.name, folder.parent, resume=cfg.resume is not None)
    start = time.monotonic() - 60.0 * progress["minutes"]
    display = Display("easi", cfg.generations, headline=HEADLINE, lines_every=1, console=console)
    with display, cli.interruptible() as interrupted:
        while progress["generation"] < cfg.generations and not interrupted():
            metrics = evolve(parts, cfg)
            progress["generation"] += 1
            progress["minutes"] = metrics["time/minutes"] = (time.monotonic() - start) / 60.0
            logger.log_metrics(metrics, step=progress["generation"])
            display.update(int(progress["generation"]), metrics)
            if progress["generation"] % cfg.checkpoint_every == 0:
                logger.flush()  # first: what a checkpoint goes on from is in the log, whenever the search is killed
                checkpoint.save(int(progress["generation"]))
            if cfg.max_minutes is not None and progress["minutes"] >= cfg.max_minutes:
                break
    checkpoint.save(int(progress["generation"]))
    logger.close()
    parts.simulator.close()
    if parts.search.generation:
        found = identify(parts.search, parts.space, parts.survivors / parts.search.generation)
        print_result(console, parts.search, parts.space, found, parts.truth)
        model = {"friction_loss": parts.inputs["friction_loss"]}
        write_result(folder, parts.search, parts.space, found, parts.truth, model)
        draw_convergence(folder / "figures" / "convergence.png", read_scalars(folder), parts.space, parts.truth)
    console.print(f"saved {folder}", markup=False)
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        train(cli.from_presets(PRESETS, doc=__doc__, kept=easi_config.KEPT))
