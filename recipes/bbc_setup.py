"""What a run of stage 1 is made of: data, environment, networks, losses, optimisers, and the artifact it writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from averaging import moving_average, saved
from bbc_cloning import Demonstrations
from bbc_config import Config
from bbc_world import load_dataset, make_env
from hardware import training_device
from held_fixed import INFERRED, privileged_loss
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchrl.data import LazyTensorStorage
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR
from torchrl.objectives.value import GAE
from training_run import check_began_with, folder_of, policy_to_start_from

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import MANIFEST_FILE, Artifact, build_manifest
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import NOMINAL, sample_parameters
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
from agility_rl.motion import MotionDataset
from agility_rl.training.ppo import PPOUpdate
from agility_rl.training.precision import hidden_precision
from agility_rl.training.replay import SeededReplay
from agility_rl.training.rollout import Rollout
from agility_rl.training.seeding import Seeds, seed_everything

ANCHORED = "anchored_action"
"""Mean action of the anchor, float32 ``[T, N, 12]``, in collected experience."""
ANCHOR = "anchored_to"
"""Under which the manifest names the anchor's weights."""


@dataclass
class Components:
    """Everything a run is made of."""

    seeds: Seeds
    dataset: MotionDataset
    demonstrations: Demonstrations
    env: LocomotionEnv
    bbc: BasicBehaviourController
    averaged: AveragedModel | None
    anchor: BasicBehaviourController | None
    anchored_to: str | None
    """SHA-256 of the anchor's weights."""
    critic: Critic
    discriminator: Discriminator
    predictor: Predictor
    prior: SkillPrior
    replay: SeededReplay
    rollout: Rollout
    advantage: GAE
    discriminator_loss: DiscriminatorLoss
    predictor_loss: PredictorLoss
    adaptation_loss: AdaptationLoss
    privileged_loss: AdaptationLoss
    estimation_loss: StateEstimationLoss
    policy_optimizer: torch.optim.Optimizer
    imitation_optimizer: torch.optim.Optimizer
    adaptation_optimizer: torch.optim.Optimizer
    ppo: PPOUpdate

    @property
    def generator(self) -> torch.Generator:
        """Source of minibatch order and motion samples."""
        return self.seeds.generator("batches")

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike."""
        names = ["bbc", "critic", "discriminator", "predictor", "prior"]
        names += ["policy_optimizer", "imitation_optimizer", "adaptation_optimizer"]
        names += ["averaged"] if self.averaged is not None else []
        return {name: getattr(self, name) for name in names}

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself."""
        return {name: getattr(self, name) for name in ("seeds", "env", "replay", "rollout")}


def build(cfg: Config) -> Components:
    """Construct data, environment, networks, losses and optimisers."""
    device, im, ppo = training_device(cfg), cfg.imitation, cfg.ppo
    seeds = seed_everything(cfg.seed, device)
    dataset = load_dataset(cfg.motion, cfg.seed).to(device)
    env = make_env(cfg, dataset, seeds)
    bbc = BasicBehaviourController(ppo.hidden, ppo.initial_std, ppo.min_std).to(device)
    anchor = anchored_to = None
    if im.anchor:
        if cfg.init_from is None:
            raise ValueError("--imitation.anchor holds on to the policy of --init-from RUN; give both or neither")
        anchor = BasicBehaviourController(ppo.hidden, ppo.initial_std, ppo.min_std).to(device).requires_grad_(False)
        start = policy_to_start_from(cfg.init_from, "bbc", ppo.hidden)
        anchored_to = start.manifest["weights"]["sha256"]
        check_began_with(cfg.resume, ANCHOR, anchored_to, cfg.init_from)
        start.fill(anchor)
    critic_keys = [keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.COMMAND, keys.PEAK]
    critic_keys += [keys.HISTORY] if ppo.critic_history else []
    # Who is not told of what lies in the way judges a robot only when it stumbles.
    met = [] if env.encounters is None else [keys.ENCOUNTER]
    critic_keys += met
    width = sum(env.observation_spec[key].shape[1:].numel() for key in critic_keys)
    critic = Critic(width, in_keys=critic_keys, hidden=ppo.hidden).to(device)
    mean, deviation = dataset.statistics()
    height = features.layout_slice(features.MOTION_LAYOUT, "root_height")
    deviation[height].clamp_(min=im.height_deviation)
    normalizer = FeatureNormalizer(mean, deviation)
    weight = torch.ones_like(mean)
    for name in ("angular_velocity", "joint_velocity"):
        weight[features.layout_slice(features.MOTION_LAYOUT, name)] = im.velocity_weight
    normalizer.set_weight(weight)
    discriminator = Discriminator(
        horizon=len(cfg.motion.offsets),
        hidden=im.hidden,
        normalizer=normalizer,
        num_skills=len(BEHAVIOURS) if im.conditional else None,
    ).to(device)
    predictor = Predictor(trunk=discriminator.trunk).to(device)
    adaptation_loss = AdaptationLoss(bbc.history_encoder, bbc.privileged_encoder)
    heads = {"lr": im.encoder_learning_rate, "weight_decay": im.weight_decay}
    policy_optimizer = torch.optim.Adam(
        [*bbc.privileged_encoder.parameters(), *bbc.actor.parameters(), *critic.parameters()],
        lr=ppo.learning_rate,
        fused=True,
    )
    ppo_loss = ClipPPOLoss(
        bbc.trained_actor(),
        critic,
        clip_epsilon=ppo.clip,
        entropy_coeff=ppo.entropy,
        critic_coeff=ppo.value,
        loss_critic_type="l2",
        functional=False,  # there is one set of weights: to put it in and out costs 1 to 2 % of the update
    )
    schedule = None
    if ppo.desired_kl is not None:
        schedule = KLAdaptiveLR(policy_optimizer, ppo.desired_kl, max_lr=ppo.max_learning_rate)

    def divergence(sample: TensorDictBase) -> Tensor:
        bbc.actor.project_std()
        now = bbc.actor[0](bbc.privileged_encoder(sample.exclude("loc", "scale")))
        return functional.gaussian_kl(sample["loc"], sample["scale"], now["loc"], now["scale"]).mean()

    rollout = Rollout(
        env,
        ppo.steps,
        keep=[
            *(
                keys.PROPRIOCEPTION,
                keys.EXPLICIT,
                keys.ESTIMATE,
                keys.PRIVILEGED,
                keys.COMMAND,
                keys.PEAK,
                keys.HISTORY,
            ),
            *(keys.SKILL, keys.SHIFT, keys.ACTION, "action_log_prob", "loc", "scale"),
            *met,
        ],
        keep_next=["reward", keys.MOTION, keys.REWARD_TERMS],
        value=lambda observation: critic(observation.select(*critic_keys))["state_value"],
        compile=ppo.compile,
    )
    return Components(
        seeds=seeds,
        dataset=dataset,
        demonstrations=Demonstrations(
            dataset.labelled_clips, sample_parameters(1, NOMINAL, torch.Generator())[1][0], seeds.generator("cloning")
        ),
        env=env,
        bbc=bbc,
        averaged=moving_average(bbc, ppo.averaging),
        anchor=anchor,
        anchored_to=anchored_to,
        critic=critic,
        discriminator=discriminator,
        predictor=predictor,
        prior=SkillPrior(decay=1.0 - im.prior_weight, temperature=im.prior_temperature).to(device),
        replay=SeededReplay(
            seeds.generator("replay"), storage=LazyTensorStorage(im.replay, device=device), batch_size=im.batch_size
        ),
        rollout=rollout,
        advantage=GAE(gamma=ppo.gamma, lmbda=ppo.lmbda, value_network=None, time_dim=0),
        ppo=PPOUpdate(
            ppo_loss,
            policy_optimizer,
            epochs=ppo.epochs,
            minibatches=ppo.minibatches,
            max_grad_norm=ppo.max_grad_norm,
            keep=["loc", "scale", INFERRED, ANCHORED, keys.SKILL],
            groups=(keys.SKILL, len(BEHAVIOURS)) if ppo.by_behaviour else None,
            divergence=divergence,
            schedule=schedule,
            precision=hidden_precision(ppo.precision, device),
            compile=ppo.compile,
        ),
        discriminator_loss=DiscriminatorLoss(
            discriminator, criterion=im.criterion, gradient_penalty=im.gradient_penalty
        ),
        # Without labels only the marginal entropy keeps Q^c from taking all motion for one behaviour.
        predictor_loss=PredictorLoss(predictor, labelled=None, marginal=1.0)
        if cfg.motion.label_share == 0.0
        else PredictorLoss(predictor),
        adaptation_loss=adaptation_loss,
        privileged_loss=privileged_loss(bbc.privileged_encoder),
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
    )


def provenance(cfg: Config) -> list[str]:
    """What motion the controller has learned from: that of the policy that it started from, and of this run."""
    saved_before = folder_of(cfg) / "policy"  # by the run itself, once the policy of --init-from may be gone
    start = saved_before if (saved_before / MANIFEST_FILE).is_file() else cfg.init_from
    before = [] if start is None else Artifact.load(start, kind="bbc").manifest.get("data", [])
    clips = [clip for clip in (cfg.motion.labelled, cfg.motion.unlabelled) if clip]
    now = ["/".join(clip.resolve().parts[-2:]) for clip in clips] or ["synthetic gaits of agility_rl"]
    return list(dict.fromkeys([*before, *now]))


def save_policy(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the controller as an artifact, and beside it the discriminator, whose judgement stage 3 rewards."""
    data = provenance(cfg)
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=parts.env.dt, data=data)
    manifest |= {"network": parts.bbc.settings, "prior": parts.prior.probabilities.tolist()}
    friction = parts.env.simulator.parameter("friction_loss").mean().item()  # an identified one has its own
    manifest["simulation"] = {"friction_loss": round(friction, 6)}
    manifest |= {} if parts.anchored_to is None else {ANCHOR: parts.anchored_to}
    Artifact.save(folder / "policy", saved(parts.bbc, parts.averaged).state_dict(), manifest)
    layouts = {"motion": features.MOTION_LAYOUT}
    manifest = build_manifest("discriminator", layouts, control_period=parts.env.dt, data=data)
    manifest["network"] = {
        "offsets": list(cfg.motion.offsets),
        "hidden": list(cfg.imitation.hidden),
        "num_skills": len(BEHAVIOURS) if cfg.imitation.conditional else None,
    }
    Artifact.save(folder / "discriminator", parts.discriminator.state_dict(), manifest)
