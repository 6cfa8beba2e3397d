"""Stage 1: learn a Basic Behaviour Controller from dog motion by semi-supervised InfoGAIL and PPO.

Source: Fu et al. 2025, supplement S2, Algorithm S1, Tables S1 and S2.

In:  labelled and unlabelled clips (``--motion.labelled DIR --motion.unlabelled DIR``); without them, synthetic gaits.
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/``.

    python recipes/bbc_pretrain.py cpu --motion.labelled DIR --motion.unlabelled DIR --name my_run
    python recipes/bbc_pretrain.py cpu --resume runs/my_run          # goes on exactly where it stopped
    python recipes/bbc_pretrain.py cpu --init-from runs/my_run       # new run that starts from a policy

Presets: ``smoke`` (seconds), ``quickstart`` (about five minutes), ``cpu`` (under an hour on two cores), ``paper``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
from torchrl.objectives.value import GAE

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import Randomization
from agility_rl.envs.rewards import LOCOMOTION_REWARDS, RewardTerm, jump_height_peak, jump_height_window
from agility_rl.envs.terminations import LOCOMOTION_TERMINATIONS, thigh_contact
from agility_rl.go2 import features
from agility_rl.losses import AdaptationLoss, DiscriminatorLoss, PredictorLoss, StateEstimationLoss, functional
from agility_rl.modules import (
    BasicBehaviourController,
    Critic,
    Discriminator,
    FeatureNormalizer,
    Predictor,
    SkillPrior,
)
from agility_rl.motion import MotionDataset, load_clips
from agility_rl.motion.gaits import synthetic_dataset_clips
from agility_rl.record import MCAPLogger
from agility_rl.simulation import rough_pyramids
from agility_rl.training import cli
from agility_rl.training.checkpoint import RunCheckpoint
from agility_rl.training.display import Display
from agility_rl.training.rollout import Rollout
from agility_rl.training.seeding import Seeds, seed_everything


@dataclass(frozen=True)
class MotionConfig:
    labelled: Path | None = None
    """Folder of clips named SKILL_N; synthetic gaits when not given."""
    unlabelled: Path | None = None
    """Folder of unlabelled clips."""
    mirror: bool = True
    """Add the left-right mirrored motion."""
    standing_weight: float = 0.1
    """Sampling weight of unlabelled frames in which the dog stands (1 = as recorded)."""


@dataclass(frozen=True)
class EnvConfig:
    num_robots: int = 1024
    terrain: str = "flat"
    """``flat`` or ``rough`` (method notes 4.5)."""
    randomize: bool = True
    push_interval: float | None = 8.0
    """Seconds (released code)."""
    observation_noise: float = 1.0
    action_delay: float = 0.0
    """Upper end of the random delay of actions [s]."""
    jump_reward: str = "peak"
    """``window`` as released, or ``peak``: the highest trunk of the last 0.9 s."""
    jump_weight: float = 6.0
    collision_weight: float = -10.0
    """Supplement S4. As the sum is clipped at zero, a beginner who collides learns nothing else; less is faster."""
    end_when_sitting: bool = False
    """Contact of a thigh ends the episode too, as in stage 3."""
    friction_loss: float = 0.2
    """Dry friction of the joints [N m]; 0 as in the released simulation is a tenth faster."""
    num_threads: int | None = None


@dataclass(frozen=True)
class PPOConfig:
    steps: int = 24
    epochs: int = 5
    minibatches: int = 8
    learning_rate: float = 1e-3
    """Table S1."""
    max_learning_rate: float = 1e-2
    desired_kl: float | None = 0.01
    """Released code; ``None`` keeps the learning rate."""
    clip: float = 0.2
    """Table S1."""
    gamma: float = 0.99
    """Table S1."""
    lmbda: float = 0.95
    """Table S1."""
    entropy: float = 0.01
    value: float = 1.0
    max_grad_norm: float = 1.0
    initial_std: float = 1.0
    min_std: float = 0.1
    hidden: tuple[int, ...] = (512, 256, 128)
    """Supplement S6."""
    critic_history: bool = True
    """The critic reads the history too (released code)."""


@dataclass(frozen=True)
class ImitationConfig:
    criterion: str = "least_squares"
    conditional: bool = False
    """Tell the discriminator the skill (ours; the paper's does not know it)."""
    labelled_share: float = 0.0
    """Share of labelled motion in the discriminator's expert batch."""
    minibatches: int = 80
    batch_size: int = 1228
    labelled_batch_size: int = 1228
    replay: int = 1_000_000
    """Policy frames kept (released code)."""
    discriminator_learning_rate: float = 5e-4
    """Table S1."""
    encoder_learning_rate: float = 1e-3
    """Table S1: class and shift heads."""
    weight_decay: float = 1e-3
    gradient_penalty: float = 0.1
    information: float = 1.0
    information_ramp: tuple[int, int] = (200, 10_000)
    """First iteration and length of the ramp of the information-maximisation term (released code)."""
    prior_weight: float = 1e-3
    """Table S1: moving average weight, 1 - beta."""
    prior_temperature: float | None = 0.25
    """Skills are drawn from softmax(prior / temperature) (released code); ``None``: from the prior itself."""
    imitation_reward: float = 0.2
    """Table S1 (released code: 1.0)."""
    skill_reward: float = 0.2
    skill_floor: float | None = None
    """Lift log Q^c to [0, 1] above this floor, so that no reward punishes being alive; ``None`` as published."""
    shift_reward: float = 0.01
    task_reward: float = 0.2
    """Table S1."""
    hidden: tuple[int, ...] = (512, 256)


@dataclass(frozen=True)
class AdaptationConfig:
    learning_rate: float = 1e-4
    every: int = 20
    """Iterations between roll-outs that use the history encoder (released code)."""
    minibatches: int = 8
    privileged: float = 0.1
    """Weight of pulling the privileged encoder towards the history encoder (released code)."""
    privileged_ramp: tuple[int, int] = (1000, 2000)


@dataclass(frozen=True)
class Config:
    name: str = "bbc"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    seed: int = 0
    iterations: int = 200_000
    max_minutes: float | None = None
    """Stop and save after this time."""
    checkpoint_every: int = 50
    resume: Path | None = None
    """Run folder to go on with."""
    init_from: Path | None = None
    """Run or artifact folder whose policy to start from."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)


PAPER = Config(
    motion=MotionConfig(mirror=False, standing_weight=1.0),
    env=EnvConfig(num_robots=4096, terrain="rough", action_delay=0.02, jump_reward="window", jump_weight=0.2),
    ppo=PPOConfig(minibatches=4),
)
CPU = Config(
    iterations=1000,
    max_minutes=58.0,
    env=EnvConfig(friction_loss=0.0, collision_weight=-2.0, end_when_sitting=True),
    ppo=PPOConfig(epochs=3, minibatches=6, max_learning_rate=2e-3, entropy=0.0005, initial_std=0.5, critic_history=False),
    imitation=ImitationConfig(
        conditional=True,
        labelled_share=0.5,
        minibatches=8,
        batch_size=1024,
        labelled_batch_size=512,
        replay=400_000,
        discriminator_learning_rate=3e-4,
        encoder_learning_rate=3e-4,
        gradient_penalty=5.0,
        information=0.3,
        information_ramp=(50, 300),
        prior_weight=2e-3,
        imitation_reward=1.0,
        skill_floor=-4.0,
    ),
    adaptation=AdaptationConfig(learning_rate=1e-3, every=20, minibatches=4, privileged_ramp=(100, 200)),
)
QUICKSTART = replace(CPU, name="quickstart", iterations=110, max_minutes=5.0, env=replace(CPU.env, num_robots=512))
SMOKE = replace(
    CPU,
    name="smoke",
    iterations=2,
    checkpoint_every=1,
    env=replace(CPU.env, num_robots=16),
    ppo=replace(CPU.ppo, steps=8, epochs=1, minibatches=2, hidden=(32, 32)),
    imitation=replace(
        CPU.imitation, minibatches=2, batch_size=32, labelled_batch_size=32, replay=2048, hidden=(32, 32)
    ),
    adaptation=replace(CPU.adaptation, every=2),
)
HEADLINE = ("time/minutes", "reward/imitation", "reward/task", "accuracy_expert", "accuracy_policy", "kl")
HEADLINE += ("falls_per_minute", *(f"style/{name}" for name in BEHAVIOURS), *(f"recovery/{name}" for name in BEHAVIOURS))
PRESETS = {"smoke": SMOKE, "quickstart": QUICKSTART, "cpu": CPU, "paper": PAPER}


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
        loss = (
            discriminated["loss_discriminator"]
            + discriminated["loss_gradient_penalty"]
            + discriminated["loss_regularization"]
            + predicted["loss_skill"]
            + predicted["loss_shift"]
            + predicted["loss_information"]
        )
        parts.imitation_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parts.imitation_optimizer.step()
        parts.prior.update(predicted["unlabelled_skill_probability"])
        for name, value in (*discriminated.items(), *predicted.items()):
            if value.numel() == 1:
                totals[name] = totals.get(name, torch.zeros(())) + value.detach() / cfg.minibatches
    return totals


@torch.no_grad()
def expert_batch(
    parts: Components, cfg: ImitationConfig, policy: TensorDictBase, unlabelled: TensorDictBase
) -> TensorDictBase:
    """Expert motion for the discriminator: unlabelled, with a share of labelled motion in the policy's own skills."""
    count = round(cfg.labelled_share * cfg.batch_size)
    shares = torch.bincount(policy[keys.SKILL], minlength=len(BEHAVIOURS)).float()
    labelled = parts.dataset.sample_labelled(count, parts.generator, shares / shares.sum())
    rest = unlabelled[: cfg.batch_size - count].clone(recurse=False)
    logits = parts.predictor(rest.clone(recurse=False))[keys.SKILL_LOGITS]
    rest[keys.SKILL] = torch.multinomial(logits.softmax(-1), 1, generator=parts.generator)[:, 0]
    return torch.cat((labelled.select(keys.MOTION, keys.SKILL), rest.select(keys.MOTION, keys.SKILL)))


@torch.no_grad()
def add_rewards(parts: Components, cfg: ImitationConfig, batch: TensorDictBase, dt: float) -> dict[str, Tensor]:
    """Equation (11): imitation, skill and shift reward of every step beside the task reward; returns their means."""
    seen = TensorDict(
        {keys.MOTION: batch["next", keys.MOTION], keys.SKILL: batch[keys.SKILL]}, batch.batch_size
    ).flatten()
    parts.predictor(parts.discriminator(seen))
    shape = (*batch.batch_size, 1)
    skill, shift = batch[keys.SKILL].flatten(), batch[keys.SHIFT].flatten(0, 1)
    told = functional.skill_reward(seen[keys.SKILL_LOGITS], skill)
    if cfg.skill_floor is not None:
        told = 1.0 - told.clamp(min=cfg.skill_floor) / cfg.skill_floor
    rewards = {
        "imitation": cfg.imitation_reward * dt * functional.imitation_reward(seen[keys.DISCRIMINATOR_LOGIT]),
        "skill": cfg.skill_reward * dt * told,
        "shift": cfg.shift_reward * dt * functional.shift_reward(seen[keys.SHIFT_ESTIMATE], shift),
        "task": cfg.task_reward * batch["next", "reward"].flatten(0, 1),
    }
    batch["next", "reward"] = torch.stack(tuple(rewards.values())).sum(0).reshape(shape)
    metrics = {f"reward/{name}": value.mean() for name, value in rewards.items()}
    recovered = (seen[keys.SKILL_LOGITS].argmax(-1) == skill).float()
    style = functional.imitation_reward(seen[keys.DISCRIMINATOR_LOGIT])[:, 0]
    for index, name in enumerate(BEHAVIOURS):
        chosen = skill == index
        metrics[f"recovery/{name}"] = recovered[chosen].mean()
        metrics[f"style/{name}"] = style[chosen].mean()
    return metrics


def update_policy(parts: Components, cfg: PPOConfig, batch: TensorDictBase, privileged: float) -> dict[str, Tensor]:
    """PPO with generalised advantages (Table S1) and a learning rate that follows the KL divergence."""
    with torch.no_grad():
        parts.advantage(batch)
    batch["advantage"] = (batch["advantage"] - batch["advantage"].mean()) / (batch["advantage"].std() + 1e-8)
    loss_fn = parts.ppo_loss
    history = [keys.HISTORY] if privileged > 0.0 else []
    flat = batch.select(*loss_fn.in_keys, "advantage", "value_target", "loc", "scale", *history, strict=False).flatten()
    parameters = [*loss_fn.parameters()]
    size = flat.numel() // cfg.minibatches
    totals: dict[str, Tensor] = {}
    for _ in range(cfg.epochs):
        order = torch.randperm(flat.numel(), generator=parts.generator)
        for rows in order.split(size)[: cfg.minibatches]:
            sample = flat[rows]
            result = loss_fn(sample)
            loss = result["loss_objective"] + result["loss_critic"] + result["loss_entropy"]
            if privileged > 0.0:
                loss = loss + privileged * parts.adaptation_loss(sample)["loss_privileged"]
            parts.policy_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, cfg.max_grad_norm)
            parts.policy_optimizer.step()
        parts.bbc.actor.project_std()
        with torch.no_grad():
            now = parts.bbc.actor[0](parts.bbc.privileged_encoder(sample.exclude("loc", "scale")))
        kl = functional.gaussian_kl(sample["loc"], sample["scale"], now["loc"], now["scale"]).mean()
        if parts.kl_schedule is not None:
            parts.kl_schedule.step(kl)
    totals = {name: value.detach() for name, value in result.items() if value.numel() == 1}
    return totals | {"kl": kl, "learning_rate": torch.tensor(parts.policy_optimizer.param_groups[0]["lr"])}


def update_adaptation(parts: Components, cfg: AdaptationConfig, batch: TensorDictBase) -> dict[str, Tensor]:
    """Fit the state estimator and the history encoder, which stand in for what the robot cannot measure (S6)."""
    flat = batch.select(keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.HISTORY).flatten()
    totals: dict[str, Tensor] = {}
    for rows in torch.randperm(flat.numel(), generator=parts.generator).chunk(cfg.minibatches):
        sample = flat[rows]
        totals = dict(parts.estimation_loss(sample).items()) | dict(parts.adaptation_loss(sample).items())
        loss = totals["loss_estimation"] + totals["loss_adaptation"]
        parts.adaptation_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parts.adaptation_optimizer.step()
    return {name: value.detach() for name, value in totals.items() if value.numel() == 1}


@dataclass
class Components:
    """Everything a run is made of."""

    seeds: Seeds
    dataset: MotionDataset
    env: LocomotionEnv
    bbc: BasicBehaviourController
    critic: Critic
    discriminator: Discriminator
    predictor: Predictor
    prior: SkillPrior
    replay: TensorDictReplayBuffer
    rollout: Rollout
    advantage: GAE
    ppo_loss: ClipPPOLoss
    discriminator_loss: DiscriminatorLoss
    predictor_loss: PredictorLoss
    adaptation_loss: AdaptationLoss
    estimation_loss: StateEstimationLoss
    policy_optimizer: torch.optim.Optimizer
    imitation_optimizer: torch.optim.Optimizer
    adaptation_optimizer: torch.optim.Optimizer
    kl_schedule: KLAdaptiveLR | None

    @property
    def generator(self) -> torch.Generator:
        """Source of minibatch order and motion samples."""
        return self.seeds.generator("batches")

    def checkpoint(self, folder: Path, progress: dict[str, float]) -> RunCheckpoint:
        """All that a bit-exact continuation needs."""
        names = ("seeds", "env", "bbc", "critic", "discriminator", "predictor", "prior", "replay", "rollout")
        names += ("policy_optimizer", "imitation_optimizer", "adaptation_optimizer")
        return RunCheckpoint(folder, progress=progress, **{name: getattr(self, name) for name in names})


def build(cfg: Config) -> Components:
    """Construct data, environment, networks, losses and optimisers."""
    seeds, im, ppo = seed_everything(cfg.seed), cfg.imitation, cfg.ppo
    dataset = load_motion(cfg.motion, cfg.seed)
    terms = dict(LOCOMOTION_REWARDS)
    jump = {"peak": jump_height_peak, "window": jump_height_window}[cfg.env.jump_reward]
    terms["jump_height"] = RewardTerm(cfg.env.jump_weight, jump)
    terms["collision"] = terms["collision"]._replace(weight=cfg.env.collision_weight)
    skills = torch.arange(len(BEHAVIOURS)).repeat_interleave(2000)
    reference = dataset.sample_states(skills, seeds.generator("reference"))
    env = LocomotionEnv(
        cfg.env.num_robots,
        simulator_options={
            "num_threads": cfg.env.num_threads,
            "friction_loss": cfg.env.friction_loss,
            "terrain": rough_pyramids(seeds.generator("terrain")) if cfg.env.terrain == "rough" else None,
        },
        reference=reference.set("skill", skills),
        rewards=terms,
        terminations=(*LOCOMOTION_TERMINATIONS, *([thigh_contact] if cfg.env.end_when_sitting else [])),
        randomization=Randomization(action_delay=(0.0, cfg.env.action_delay)) if cfg.env.randomize else None,
        observation_noise=cfg.env.observation_noise,
        push_interval=cfg.env.push_interval,
        seed=seeds.integer("environment"),
    )
    bbc = BasicBehaviourController(ppo.hidden, ppo.initial_std, ppo.min_std)
    critic_keys = [keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.COMMAND, keys.PEAK]
    critic_keys += [keys.HISTORY] if ppo.critic_history else []
    width = sum(env.observation_spec[key].shape[1:].numel() for key in critic_keys)
    critic = Critic(width, in_keys=critic_keys, hidden=ppo.hidden)
    discriminator = Discriminator(
        hidden=im.hidden,
        normalizer=FeatureNormalizer(*dataset.statistics()),
        num_skills=len(BEHAVIOURS) if im.conditional else None,
    )
    predictor = Predictor(trunk=discriminator.trunk)
    adaptation_loss = AdaptationLoss(bbc.history_encoder, bbc.privileged_encoder)
    heads = {"lr": im.encoder_learning_rate, "weight_decay": im.weight_decay}
    policy_optimizer = torch.optim.Adam(
        [*bbc.privileged_encoder.parameters(), *bbc.actor.parameters(), *critic.parameters()],
        lr=ppo.learning_rate,
        fused=True,
    )
    rollout = Rollout(
        env,
        ppo.steps,
        keep=[
            *(keys.PROPRIOCEPTION, keys.EXPLICIT, keys.ESTIMATE, keys.PRIVILEGED, keys.COMMAND, keys.PEAK, keys.HISTORY),
            *(keys.SKILL, keys.SHIFT, keys.ACTION, "action_log_prob", "loc", "scale"),
        ],
        keep_next=["reward", keys.MOTION, keys.REWARD_TERMS],
        value=lambda observation: critic(observation.select(*critic_keys))["state_value"],
    )
    return Components(
        seeds=seeds,
        dataset=dataset,
        env=env,
        bbc=bbc,
        critic=critic,
        discriminator=discriminator,
        predictor=predictor,
        prior=SkillPrior(decay=1.0 - im.prior_weight, temperature=im.prior_temperature),
        replay=TensorDictReplayBuffer(
            storage=LazyTensorStorage(im.replay), batch_size=im.batch_size, generator=seeds.generator("replay")
        ),
        rollout=rollout,
        advantage=GAE(gamma=ppo.gamma, lmbda=ppo.lmbda, value_network=None, time_dim=0),
        ppo_loss=ClipPPOLoss(
            bbc.trained_actor(),
            critic,
            clip_epsilon=ppo.clip,
            entropy_coeff=ppo.entropy,
            critic_coeff=ppo.value,
            loss_critic_type="l2",
        ),
        discriminator_loss=DiscriminatorLoss(
            discriminator, criterion=im.criterion, gradient_penalty=im.gradient_penalty
        ),
        predictor_loss=PredictorLoss(predictor),
        adaptation_loss=adaptation_loss,
        estimation_loss=StateEstimationLoss(bbc.estimator),
        policy_optimizer=policy_optimizer,
        imitation_optimizer=torch.optim.Adam(
            [
                {"params": discriminator.parameters(), "lr": im.discriminator_learning_rate},
                {"params": [*predictor.skill_head.parameters(), *predictor.shift_head.parameters()], **heads},
            ],
            weight_decay=im.weight_decay,
            fused=True,
        ),
        adaptation_optimizer=torch.optim.Adam(
            [*bbc.estimator.parameters(), *bbc.history_encoder.parameters()],
            lr=cfg.adaptation.learning_rate,
            fused=True,
        ),
        kl_schedule=None
        if ppo.desired_kl is None
        else KLAdaptiveLR(policy_optimizer, ppo.desired_kl, max_lr=ppo.max_learning_rate),
    )


def load_motion(cfg: MotionConfig, seed: int) -> MotionDataset:
    """The clips of the given folders, or the synthetic gaits when there are none."""
    if (cfg.labelled is None) != (cfg.unlabelled is None):
        raise ValueError("give both --motion.labelled and --motion.unlabelled, or neither for synthetic gaits")
    if cfg.labelled is None or cfg.unlabelled is None:
        labelled, unlabelled = synthetic_dataset_clips(seed)
    else:
        labelled, unlabelled = load_clips(cfg.labelled, label="from name"), load_clips(cfg.unlabelled)
    return MotionDataset(labelled, unlabelled, mirror=cfg.mirror, standing_weight=cfg.standing_weight)


def train(cfg: Config) -> Path:
    """Algorithm S1."""
    folder = cli.start_run(cfg, cfg.resume or cfg.runs / cfg.name, resume=cfg.resume is not None, recipe="bbc_pretrain")
    parts = build(cfg)
    progress = {"iteration": 0, "minutes": 0.0}
    checkpoint = parts.checkpoint(folder / "checkpoints", progress)
    if cfg.resume:
        checkpoint.load()
    elif cfg.init_from:
        parts.bbc.load_state_dict(Artifact.load(policy_folder(cfg.init_from), kind="bbc").state)
    logger = MCAPLogger(folder.name, folder.parent, resume=cfg.resume is not None)
    start = time.monotonic() - 60.0 * progress["minutes"]
    with Display("bbc_pretrain", cfg.iterations, headline=HEADLINE) as display:
        try:
            while progress["iteration"] < cfg.iterations:
                metrics = iterate(parts, cfg, progress["iteration"])
                progress["iteration"] += 1
                progress["minutes"] = (time.monotonic() - start) / 60.0
                metrics["time/minutes"] = progress["minutes"]
                logger.log_metrics(metrics, step=progress["iteration"])
                display.update(progress["iteration"], metrics)
                if progress["iteration"] % cfg.checkpoint_every == 0:
                    checkpoint.save(progress["iteration"])
                    save_policy(parts, cfg, folder)
                if cfg.max_minutes is not None and progress["minutes"] >= cfg.max_minutes:
                    break
        except KeyboardInterrupt:
            display.note("interrupted; the checkpoint of the last full iteration is being saved")
    checkpoint.save(progress["iteration"])
    save_policy(parts, cfg, folder)
    logger.close()
    parts.env.close()
    return folder


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One iteration of Algorithm S1; returns metrics by name."""
    clock = time.perf_counter()
    times = {}

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        times[f"time/{name}"], clock = now - clock, now

    with_history = cfg.adaptation.every > 0 and iteration % cfg.adaptation.every == cfg.adaptation.every - 1
    parts.env.set_skill_probabilities(parts.prior.sampling_probabilities)
    policy = parts.bbc.deployable_policy() if with_history else parts.bbc.privileged_policy()
    batch = parts.rollout.collect(policy)
    lap("collect")
    seen = TensorDict({keys.MOTION: batch["next", keys.MOTION], keys.SKILL: batch[keys.SKILL], keys.SHIFT: batch[keys.SHIFT]}, batch.batch_size)
    parts.replay.extend(seen.flatten())
    metrics = update_imitation(parts, cfg.imitation, iteration)
    lap("imitation")
    metrics |= add_rewards(parts, cfg.imitation, batch, parts.env.dt)
    weight = functional.linear_ramp(iteration, *cfg.adaptation.privileged_ramp, cfg.adaptation.privileged)
    if not with_history:
        metrics |= update_policy(parts, cfg.ppo, batch, weight)
    lap("policy")
    metrics |= update_adaptation(parts, cfg.adaptation, batch)
    lap("adaptation")
    metrics |= {f"task/{name}": value.mean() for name, value in batch["next", keys.REWARD_TERMS].items()}
    metrics |= {f"prior/{name}": p for name, p in zip(BEHAVIOURS, parts.prior.probabilities, strict=True)}
    metrics["falls_per_minute"] = batch["next", "terminated"].float().mean() * 60.0 / parts.env.dt
    return {name: float(value) for name, value in metrics.items()} | times


def save_policy(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the controller as an artifact, with what is needed to run it elsewhere."""
    synthetic = cfg.motion.labelled is None
    manifest = build_manifest(
        "bbc",
        {"proprioception": features.PROPRIOCEPTION_LAYOUT, "explicit": features.EXPLICIT_LAYOUT},
        control_period=parts.env.dt,
        data=["synthetic gaits of agility_rl"] if synthetic else ["/".join(folder.resolve().parts[-2:]) for folder in (cfg.motion.labelled, cfg.motion.unlabelled) if folder],
    )
    manifest["network"] = parts.bbc.settings
    manifest["prior"] = parts.prior.probabilities.tolist()
    Artifact.save(folder / "policy", parts.bbc.state_dict(), manifest)


def policy_folder(path: Path) -> Path:
    """The artifact in a run folder, or the folder itself."""
    return path / "policy" if (path / "policy").is_dir() else path


if __name__ == "__main__":
    train(cli.from_presets(PRESETS, doc=__doc__))
