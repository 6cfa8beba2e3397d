"""Stage 4, after the imitation: a student practises on what it perceives itself, by Hybrid-PPO (ours).

Its eyes and its memory stay as they are. Its actor learns what is best for who knows its place no better: a teacher
that knows it to the centimetre cannot show that. Rewards, critic and update are the teacher's (stage 3).

In:  a student (``--student RUN``) and the Basic Behaviour Controller that it was trained on (``--bbc RUN``; found by
     itself where that still lies).
Out: ``runs/NAME/`` with ``config.json``, ``metrics.mcap``, ``checkpoints/``, ``policy/`` (kind ``student``).

    python recipes/tsc_practice.py cpu --student runs/my_student --name practised
    python recipes/tsc_practice.py cpu --resume runs/practised            # goes on exactly where it stopped

Presets: ``smoke`` (seconds), ``cpu`` (two cores), ``gpu``. Ctrl-C ends the iteration and saves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from averaging import moving_average, saved
from course_metrics import judge, set_course
from hardware import HardwareConfig, simulator_options, training_device
from rollouts import Controller
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch.optim.swa_utils import AveragedModel
from torchrl.data import Unbounded
from torchrl.envs import Compose, InitTracker, TensorDictPrimer, TransformedEnv
from training_run import KEPT, Laps, check_began_with, own_options, run
from tsc_artifacts import load_bbc_of, load_trained, refuse_starts_after, trained_bbc
from tsc_config import CPU as TEACHER
from tsc_config import CurriculumConfig, PPOConfig, RewardConfig
from tsc_curriculum import Curriculum
from tsc_ppo import Learner, add_rewards, limit_deviations, make_learner, value_finished, what_happened
from tsc_setup import make_env, rewards
from tsc_student_config import EnvConfig

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs import AgilityEnv
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import features
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.student import NEXT_HIDDEN
from agility_rl.training import cli
from agility_rl.training.precision import Precision, hidden_precision
from agility_rl.training.seeding import Seeds, seed_everything

HEADLINE: tuple[str, ...] = ("time/minutes", "success", "episodes", "falls_per_minute", "reward/task", "kl", "std")
HEADLINE += tuple(f"success/{name}" for name in OBSTACLES)
HEADLINE += tuple(f"use/{name}" for name in BEHAVIOURS)
INHERITED = ("network", "teacher", "bbc", "fastest_canter", "byol", "camera")
"""What practice does not change in the manifest of a student."""


@dataclass(frozen=True)
class Config(HardwareConfig):
    name: str = "practised"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    student: Path = Path("pretrained/student_leaping")
    """Run or artifact folder of the student."""
    bbc: Path | None = None
    """Run or artifact folder of the Basic Behaviour Controller that it was trained on; found by default."""
    iterations: int = 400
    """Roll-outs, each followed by an update."""
    max_minutes: float | None = 60.0
    """Stop and save after this time."""
    checkpoint_every: int = 25
    """Iterations."""
    resume: Path | None = None
    """Run folder to go on with."""
    precision: Precision = "auto"
    """Of the depth encoder's layers; ``auto`` is bfloat16 on hardware that multiplies in it."""
    env: EnvConfig = field(
        default_factory=lambda: EnvConfig(
            num_robots=160,
            randomize=False,
            push_interval=None,
            command_noise=(0.97, 1.03),
            start_spread=2.0,
            goal_radius=0.4,
        )
    )
    """Way-points are reached within 0.4 m, as a teacher's; 0.45 m in the evaluation."""
    ppo: PPOConfig = field(
        default_factory=lambda: replace(
            TEACHER.ppo, rewound=0.0, critic_learning_rate=1e-3, initial_std=0.15, critic_warm_up=12
        )
    )
    """A teacher's, but nobody is rewound: what that brought students is within what chance does
    (docs/student_experiments.md)."""
    reward: RewardConfig = field(default_factory=lambda: replace(TEACHER.reward, imitation=0.0))
    curriculum: CurriculumConfig = field(
        default_factory=lambda: CurriculumConfig(difficulty=1.0, obstacles=6, practice=1.0)
    )
    """Released difficulty at once (method notes, section 5.7)."""


CPU = Config()
GPU = replace(CPU, simulator="warp", max_minutes=None, env=replace(CPU.env, num_robots=1024))
"""``cpu`` with more robots (docs/gpu.md; not tried to its end)."""
SMOKE = replace(
    CPU,
    name="smoke_practice",
    iterations=2,
    max_minutes=None,
    checkpoint_every=1,
    env=replace(CPU.env, num_robots=4),
    ppo=replace(CPU.ppo, steps=4, epochs=1, minibatches=2, hidden=(32, 32), critic_warm_up=1),
)
PRESETS = {"smoke": SMOKE, "cpu": CPU, "gpu": GPU}


@dataclass
class Components:
    """Everything a run is made of."""

    seeds: Seeds
    env: AgilityEnv
    student: RecurrentStudent
    averaged: AveragedModel | None
    curriculum: Curriculum
    learner: Learner
    policy: TensorDictSequential
    artifact: Artifact
    bbc: Controller

    @property
    def generator(self) -> torch.Generator:
        """Source of minibatch order."""
        return self.seeds.generator("batches")

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike; what is frozen comes from its own artifact."""
        parts = {"student": self.student, "curriculum": self.curriculum}
        return parts | ({} if self.averaged is None else {"averaged": self.averaged}) | self.learner.alike

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself."""
        return {"seeds": self.seeds, "env": self.env} | self.learner.own


def build(cfg: Config) -> Components:
    """Construct course, student, critic and optimiser."""
    device = training_device(cfg)
    seeds = seed_everything(cfg.seed, device)
    trained = load_trained(cfg.student, "student")
    check_began_with(cfg.resume, "practised_from", trained.digest, cfg.student)
    student = trained.network.to(device).requires_grad_(False)
    assert isinstance(student, RecurrentStudent)
    student.actor.requires_grad_(True)
    student.actor.network.parameters_head.min_std.fill_(cfg.ppo.min_std)
    student.depth_encoder.to(memory_format=torch.channels_last)
    student.depth_encoder.module.precision = hidden_precision(cfg.precision, device)
    controller = load_bbc_of(trained, cfg.bbc)
    env = make_env(
        cfg.env,
        controller,
        cfg.env.course or trained.course,
        trained.decision_steps,
        simulator_options(cfg, cfg.env.num_threads),
        fastest_canter=trained.fastest_canter,
        depth=trained.artifact.manifest["camera"]["training"],
        seed=seeds.integer("environment"),
        rewards=rewards(cfg.reward),
        termination_reward=cfg.reward.termination,
    )
    course = env.arena.layout.course
    memory = TensorDictPrimer({NEXT_HIDDEN: Unbounded((student.memory.size,), device=device)}, expand_specs=True)
    known, stands = student.settings.get("routes"), [[list(leg) for leg in route] for route in course.legs]
    if known is not None and known != stands:
        env.close()
        raise ValueError(
            f"--env.course {course.name}: {trained.artifact.folder} knows a course whose obstacles stand elsewhere; it "
            f"can practise on {trained.course}"
        )
    student.heading_gate = math.inf  # it perceives all headings itself, also those it was helped with
    recall = TensorDictModule(torch.nn.Identity(), in_keys=[NEXT_HIDDEN], out_keys=[keys.HIDDEN])
    return Components(
        seeds=seeds,
        env=env,
        student=student,
        averaged=moving_average(student, cfg.ppo.averaging),
        curriculum=Curriculum.start(cfg.curriculum, env),
        learner=make_learner(
            cfg.ppo,
            env,
            student.actor,
            student.actor,
            seeds,
            stepped=TransformedEnv(env, Compose(InitTracker(), memory)),
            carried=(NEXT_HIDDEN, "is_init"),
            keep=student.actor.in_keys,
        ),
        policy=TensorDictSequential(recall, *student.policy(assisted=True)),
        artifact=trained.artifact,
        bbc=controller,
    )


def begin(parts: Components, cfg: Config) -> None:
    """A new run starts with the student as it is, but for how far it tries something else."""
    limit_deviations(parts.student.actor, cfg.ppo)


def iterate(parts: Components, cfg: Config, iteration: int) -> dict[str, float]:
    """One roll-out of the student and one update of its actor; returns metrics by name."""
    lap = Laps()
    set_course(parts.env, parts.curriculum)
    batch = parts.learner.collect(parts.policy)
    lap("collect")
    metrics: dict[str, Any] = judge(parts.env, parts.curriculum, batch[:, parts.learner.num_rewound :])
    metrics |= add_rewards(None, cfg.reward.task, batch)
    value_finished(batch, cfg.reward.finished)
    with torch.no_grad():
        parts.learner.advantage(batch)
    metrics |= parts.learner.update(batch, parts.generator, critic_only=iteration < cfg.ppo.critic_warm_up)
    if parts.averaged is not None:
        parts.averaged.update_parameters(parts.student)
    metrics |= what_happened(batch, parts.student.actor)
    lap("policy")
    return {name: float(value) for name, value in metrics.items()} | lap.metrics


def save_policy(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the student as an artifact, with what is needed to run it elsewhere."""
    before = parts.artifact.manifest
    manifest = build_manifest(
        "student",
        features.CONTROLLER_LAYOUTS,
        control_period=parts.env.dt * parts.env.decision_steps,
        data=before["data"],
    )
    manifest |= {name: before[name] for name in INHERITED if name in before}
    manifest["course"] = cfg.env.course or before.get("course", "full")
    manifest["practised_from"] = before["weights"]["sha256"]
    Artifact.save(folder / "policy", saved(parts.student, parts.averaged).state_dict(), manifest)


def train(cfg: Config) -> Path:
    """Practise; returns the run folder."""
    cfg = own_options(cfg)
    if cfg.reward.imitation:
        raise ValueError(
            f"--reward.imitation: practice pays for the task alone; expected 0, not {cfg.reward.imitation}"
        )
    if not cfg.ppo.min_std <= cfg.ppo.initial_std:
        raise ValueError(
            f"expected --ppo.min-std of at most --ppo.initial-std, got {cfg.ppo.min_std} and {cfg.ppo.initial_std}"
        )
    trained = load_trained(cfg.student, "student")
    refuse_starts_after(cfg.env.start_after, trained)
    cfg = replace(cfg, bbc=cfg.bbc or trained_bbc(trained))
    return run(
        "tsc_practice",
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
