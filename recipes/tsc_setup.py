"""What a run of stage 3 is made of: course, frozen controller, networks, losses, optimisers, and the artifact."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from averaging import moving_average, saved
from hardware import simulator_options, training_device
from held_fixed import INFERRED, privileged_loss
from rollouts import Controller, load_controller
from tensordict import TensorDictBase
from torch.optim.swa_utils import AveragedModel
from torchrl.envs.utils import ExplorationType, set_exploration_type
from training_run import check_began_with
from tsc_config import Config, RewardConfig, RobotsConfig
from tsc_curriculum import Curriculum
from tsc_ppo import Learner, make_learner

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, skill_index
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs import COURSES, AgilityEnv, Course, load_course
from agility_rl.envs.agility import COURSE_RANDOMIZATION
from agility_rl.envs.agility_rewards import AGILITY_REWARDS, AgilityTerm, goal_velocity, sprint
from agility_rl.envs.arena import NUM_PLACE
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import constants, features
from agility_rl.losses import AdaptationLoss, ImitationReward
from agility_rl.modules import Discriminator, FeatureNormalizer, Teacher
from agility_rl.training.seeding import Seeds, seed_everything


@dataclass
class Components:
    """Everything a run is made of."""

    seeds: Seeds
    env: AgilityEnv
    teacher: Teacher
    averaged: AveragedModel | None
    imitation: ImitationReward | None
    curriculum: Curriculum
    learner: Learner
    adaptation_loss: AdaptationLoss
    privileged_loss: AdaptationLoss
    adaptation_optimizer: torch.optim.Optimizer
    bbc: Controller

    @property
    def generator(self) -> torch.Generator:
        """Source of minibatch order."""
        return self.seeds.generator("batches")

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike; what is frozen comes from its own artifact."""
        names = ["teacher", "curriculum", "adaptation_optimizer"]
        names += ["averaged"] if self.averaged is not None else []
        return {name: getattr(self, name) for name in names} | self.learner.alike

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself."""
        return {"seeds": self.seeds, "env": self.env} | self.learner.own


def build(cfg: Config) -> Components:
    """Construct course, environment, networks, losses and optimisers."""
    device, ppo = training_device(cfg), cfg.ppo
    seeds = seed_everything(cfg.seed, device)
    controller = load_controller(cfg.bbc)
    check_began_with(cfg.resume, "bbc", controller.artifact.manifest["weights"]["sha256"], cfg.bbc)
    discriminator, offsets = load_discriminator(controller.run, cfg.reward.imitation > 0.0)
    imitation = None
    if discriminator is not None:
        seconds = constants.CONTROL_DT * cfg.env.decision_steps
        imitation = ImitationReward(discriminator.to(device), cfg.reward.imitation * seconds)
    env = make_env(
        cfg.env,
        controller,
        cfg.env.course,
        cfg.env.decision_steps,
        simulator_options(cfg, cfg.env.num_threads),
        fastest_canter=cfg.env.fastest_canter,
        misjudgement=cfg.env.misjudgement,
        seed=seeds.integer("environment"),
        motion_offsets=offsets,
        rewards=rewards(cfg.reward),
        termination_reward=cfg.reward.termination,
    )
    allowed = None if set(cfg.behaviours) == set(BEHAVIOURS) else sorted(skill_index(name) for name in cfg.behaviours)
    num_place = NUM_PLACE if cfg.place else 0
    teacher = Teacher(len(OBSTACLES), ppo.hidden, ppo.initial_std, ppo.min_std, allowed, num_place).to(device)
    teacher.estimator.load_state_dict(controller.bbc.estimator.state_dict())  # method notes, section 5.3
    return Components(
        seeds=seeds,
        env=env,
        teacher=teacher,
        averaged=moving_average(teacher, ppo.averaging),
        imitation=imitation,
        curriculum=Curriculum.start(cfg.curriculum, env),
        learner=make_learner(
            ppo,
            env,
            teacher.trained_actor(),
            teacher.actor,
            seeds,
            keep=[keys.ESTIMATE],
            keep_in_minibatches=[INFERRED],
        ),
        adaptation_loss=AdaptationLoss(teacher.history_encoder, teacher.privileged_encoder),
        privileged_loss=privileged_loss(teacher.privileged_encoder),
        adaptation_optimizer=torch.optim.Adam(
            teacher.history_encoder.parameters(), lr=cfg.adaptation.learning_rate, fused=True
        ),
        bbc=controller,
    )


def make_env(
    robots: RobotsConfig,
    controller: Controller,
    course: str,
    decision_steps: int,
    engine: Mapping[str, Any],
    **options: Any,
) -> AgilityEnv:
    """A course for training, with the frozen controller in it, on the engine's device."""
    controller.bbc.to(engine.get("device", "cpu"))
    return AgilityEnv(
        robots.num_robots,
        frozen(controller),
        course_of(course),
        simulator_options={**engine, "friction_loss": controller.friction_loss},
        decision_steps=decision_steps,
        command_noise=robots.command_noise,
        randomization=COURSE_RANDOMIZATION if robots.randomize else None,
        episode_length=robots.episode_length,
        goal_radius=robots.goal_radius,
        start_spread=robots.start_spread,
        start_after=robots.start_after,
        push_interval=robots.push_interval,
        **options,
    )


def rewards(cfg: RewardConfig) -> dict[str, AgilityTerm]:
    """The terms of the environment, weighted as the options say."""
    terms = dict(AGILITY_REWARDS)
    terms["goal_velocity"] = AgilityTerm(cfg.goal_velocity, partial(goal_velocity, least=cfg.least_speed))
    if cfg.sprint:
        terms["sprint"] = AgilityTerm(cfg.sprint, partial(sprint, beyond=cfg.sprint_beyond))
    for name in ("heading", "reach_goal"):
        terms[name] = terms[name]._replace(weight=getattr(cfg, name))
    return terms


def frozen(controller: Controller) -> Callable[[TensorDictBase], TensorDictBase]:
    """The Basic Behaviour Controller as an environment calls it: deterministic, from what the robot measures."""
    policy = controller.bbc.deployable_policy()

    def act(observation: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(observation)

    return act


def course_of(name: str) -> Course:
    """A preset course, or one of a file.

    Raises:
        ValueError: if there is neither.
    """
    if name in COURSES:
        return COURSES[name]
    if Path(name).suffix:
        return load_course(name)
    raise ValueError(f"unknown course {name!r}; expected one of {', '.join(COURSES)}, or a .toml or .json file")


def load_discriminator(run: Path, wanted: bool) -> tuple[Discriminator | None, tuple[int, ...]]:
    """The discriminator that ``bbc_pretrain.py`` left beside its policy, and which frames it looks at."""
    folder = run / "discriminator"
    if not wanted or not folder.is_dir():
        if wanted:
            print(f"{run} holds no discriminator: there is no imitation reward")
        return None, features.MOTION_OFFSETS
    artifact = Artifact.load(folder, kind="discriminator")
    network = artifact.manifest["network"]
    size = features.NUM_MOTION
    discriminator = Discriminator(
        horizon=len(network["offsets"]),
        hidden=network["hidden"],
        normalizer=FeatureNormalizer(torch.zeros(size), torch.ones(size)),
        num_skills=network["num_skills"],
    )
    artifact.fill(discriminator)
    return discriminator.requires_grad_(False), tuple(network["offsets"])


def save_policy(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the teacher as an artifact, with what is needed to run it elsewhere."""
    manifest = build_manifest(
        "teacher",
        features.CONTROLLER_LAYOUTS,
        control_period=parts.env.dt * cfg.env.decision_steps,
        data=parts.bbc.artifact.manifest.get("data", []),
    )
    manifest["network"] = parts.teacher.settings
    manifest["bbc"] = parts.bbc.artifact.manifest["weights"]["sha256"]
    manifest["course"] = cfg.env.course
    manifest["fastest_canter"] = cfg.env.fastest_canter
    Artifact.save(folder / "policy", saved(parts.teacher, parts.averaged).state_dict(), manifest)
