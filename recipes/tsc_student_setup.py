"""What a run of stage 4 is made of: teacher, course with a camera, student, losses, optimisers, and the artifact."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from glances import Glances
from hardware import simulator_options, training_device
from rollouts import Controller
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import SoftUpdate
from training_run import check_began_with
from tsc_artifacts import Trained, load_bbc_of, load_trained, trained_bbc
from tsc_curriculum import Curriculum
from tsc_setup import make_env
from tsc_student_config import AugmentationConfig, Config

from agility_rl import keys
from agility_rl.collectors import DAggerCollector
from agility_rl.deploy.artifact import Artifact, ArtifactError, build_manifest
from agility_rl.deploy.task import describe_camera, fastest_canter
from agility_rl.envs import AgilityEnv
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import features
from agility_rl.losses import BYOLLoss, StudentLoss
from agility_rl.modules import BYOL, DepthAugmentation, RecurrentStudent, Teacher
from agility_rl.modules.teacher import rescale_canter
from agility_rl.training import distributed
from agility_rl.training.precision import hidden_precision
from agility_rl.training.seeding import Seeds, seed_everything


@dataclass
class Representation:
    """BYOL around the student's encoder.

    Attributes:
        loss: online and target network.
        average: moves the target.
        optimizer: of the online network, and with it of the encoder.
    """

    loss: BYOLLoss
    average: SoftUpdate
    optimizer: torch.optim.Optimizer

    def begin(self) -> None:
        """Let the target be the online network, whatever has been loaded into that."""
        self.loss.target_network_params.data.copy_(self.loss.network_params.data)


@dataclass
class Components:
    """Everything a run is made of."""

    seeds: Seeds
    env: AgilityEnv
    teacher: Teacher
    teacher_artifact: Artifact
    student: RecurrentStudent
    collector: DAggerCollector
    curriculum: Curriculum
    augmentation: DepthAugmentation
    imitation: StudentLoss
    optimizer: torch.optim.Optimizer
    representation: Representation | None
    glances: Glances | None
    bbc: Controller

    @property
    def generator(self) -> torch.Generator:
        """Source of minibatch order."""
        return self.seeds.generator("batches")

    @property
    def alike(self) -> dict[str, Any]:
        """What every process holds alike; what is frozen comes from its own artifact."""
        parts = {name: getattr(self, name) for name in ("student", "curriculum", "optimizer")}
        if self.representation is not None:
            parts |= {"byol": self.representation.loss, "byol_optimizer": self.representation.optimizer}
        if self.glances is not None:
            parts |= {"glance": self.glances.head, "glance_optimizer": self.glances.optimizer}
        return parts

    @property
    def own(self) -> dict[str, Any]:
        """What each process has for itself."""
        own = {name: getattr(self, name) for name in ("seeds", "env", "collector")}
        return own if self.glances is None else own | {"images": self.glances.images}


def resolve(cfg: Config) -> tuple[Config, Trained]:
    """The teacher, and the options that follow from it.

    Raises:
        ArtifactError: if it is no teacher, or not the one that a resumed run began with.
    """
    trained = load_trained(cfg.teacher, "teacher")
    check_began_with(cfg.resume, "teacher", trained.digest, cfg.teacher)
    course = cfg.env.course or trained.course
    return replace(cfg, bbc=cfg.bbc or trained_bbc(trained), env=replace(cfg.env, course=course)), trained


def build(cfg: Config, trained: Trained) -> Components:
    """Construct course, student, losses and optimisers, from options that :func:`resolve` has completed."""
    device = training_device(cfg)
    seeds = seed_everything(cfg.seed, device)
    teacher = trained.network.to(device)
    assert isinstance(teacher, Teacher) and cfg.env.course is not None
    teacher.requires_grad_(False)
    controller = load_bbc_of(trained, cfg.bbc)
    env = make_env(
        cfg.env,
        controller,
        cfg.env.course,
        trained.decision_steps,
        simulator_options(cfg, cfg.env.num_threads),
        fastest_canter=trained.fastest_canter,
        depth=asdict(cfg.camera),
        seed=seeds.integer("environment"),
    )
    student = RecurrentStudent.from_teacher(
        teacher,
        memory=cfg.memory,
        encoder_channels=cfg.encoder_channels,
        encoder_hidden=cfg.encoder_hidden,
        encoder_features=cfg.encoder_features,
        glance_hidden=cfg.glance_hidden,
        heading_gate=cfg.heading_gate,
        period=env.dt * env.decision_steps,
        way_points=[[list(point) for point in kind.way_points] for kind in OBSTACLES.values()],
        routes=[[list(leg) for leg in route] for route in env.arena.layout.course.legs],
        solids=[kind.solids() for kind in OBSTACLES.values()],
        stock=env.arena.layout.course.stock,
        estimator_history=cfg.estimator_history,
    ).to(device)
    own_points = [slot.obstacle for slot in env.arena.layout.course.slots if slot.goals != slot.kind.way_points]
    if teacher.settings["num_place"] and own_points:
        env.close()
        raise ValueError(
            f"course {cfg.env.course}: its {own_points[0]} has way-points of its own, and a student that knows its "
            "place knows those of the type only; give --env.course one without, or a teacher without place"
        )
    for name in frozen_parts(cfg):
        getattr(student, name).requires_grad_(False)
    # A tenth to a third less time for the convolutions on a CPU.
    student.depth_encoder.to(memory_format=torch.channels_last)
    student.depth_encoder.module.precision = hidden_precision(cfg.precision, device)
    apart = cfg.glance.steps > 0
    augmentation = make_augmentation(cfg.augmentation, seeds.generator("augmentation"))
    glances = None
    if apart or (cfg.glance.images > 0 and cfg.init_from is None):
        glances = Glances.of(student, env.arena.layout.course, cfg.glance, augmentation, seeds.generator("batches"))
    imitation, place = cfg.imitation, cfg.imitation.place if teacher.settings["num_place"] else None
    return Components(
        seeds=seeds,
        env=env,
        teacher=teacher,
        teacher_artifact=trained.artifact,
        student=student,
        collector=DAggerCollector(
            env,
            student.policy(assisted=True),
            applied(teacher.privileged_policy()),
            imitation.steps,
            initial_hidden=student.initial_hidden(env.num_robots),
            bits=cfg.bits,
            keep=(
                *(keys.HEADING_ERROR, keys.OBSTACLE),
                *([] if place is None else [keys.PLACE, keys.PROGRESS]),
                *([keys.SCANDOTS] if apart or imitation.latent is not None else []),
                *([keys.PLACE, keys.PROGRESS] if apart else []),
            ),
            keep_written=[keys.DEPTH_FEATURE, *([] if place is None else [keys.SCAN_MATCH])] if apart else [],
            keep_next=("reward", keys.OUTCOME, keys.TERMINATIONS),
        ),
        curriculum=Curriculum.start(cfg.curriculum, env),
        augmentation=augmentation,
        imitation=StudentLoss(
            student.policy(assisted=True, sequence=True, seen=apart),
            behaviour=imitation.behaviour,
            continuous=imitation.continuous,
            heading=imitation.heading,
            obstacle=imitation.obstacle,
            place=place,
            progress=None if place is None else imitation.progress,
            latent=imitation.latent,
            compared=imitation.compared,
            heading_weights=imitation.heading_weights,
        ),
        optimizer=torch.optim.Adam(imitated(student, glances if apart else None), lr=imitation.learning_rate),
        representation=make_representation(cfg, student) if cfg.byol else None,
        glances=glances,
        bbc=controller,
    )


def frozen_parts(cfg: Config) -> tuple[str, ...]:
    """What imitation leaves alone: the estimator, since it shall not bend what says what can be measured."""
    return ("estimator",) if cfg.imitation.actor else ("estimator", "history_encoder", "actor")


def teachers_parts(cfg: Config) -> tuple[str, ...]:
    """What of these is the teacher's."""
    return tuple(name for name in frozen_parts(cfg) if name != "estimator" or not cfg.estimator_history)


def imitated(student: RecurrentStudent, glances: Glances | None) -> list[nn.Parameter]:
    """What the imitation trains: everything but what is frozen, and what learns from glances."""
    own = set() if glances is None else {id(weight) for weight in distributed.optimized(glances.optimizer)}
    return [weight for weight in student.parameters() if weight.requires_grad and id(weight) not in own]


def make_augmentation(cfg: AugmentationConfig, generator: torch.Generator) -> DepthAugmentation:
    """What disturbs the images of a training."""
    return DepthAugmentation(generator, **asdict(cfg))


def make_representation(cfg: Config, student: RecurrentStudent) -> Representation:
    """BYOL around the encoder of a student."""
    own = cfg.representation
    features = student.settings["encoder_features"]
    byol = BYOL(student.depth_encoder, features, hidden=own.hidden, out_features=own.out_features)
    loss = BYOLLoss(byol.to(next(student.parameters()).device))
    parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
    return Representation(loss, SoftUpdate(loss, eps=own.decay), torch.optim.Adam(parameters, lr=own.learning_rate))


def applied(policy: TensorDictSequential) -> TensorDictSequential:
    """A policy that says the parameters of its decisions as the environment applies them, clipped to [-1, 1].

    A teacher's mean may lie far beyond, since nothing there makes a difference to it: half of its forward speeds did.
    To copy those numbers is no use to a student, and takes most of what it can learn.
    """
    parameters = (keys.ACTION, keys.PARAMETERS)
    clip = TensorDictModule(partial(torch.clamp, min=-1.0, max=1.0), in_keys=[parameters], out_keys=[parameters])
    return TensorDictSequential(*policy, clip)


def load_student(parts: Components, path: Path, kept: tuple[str, ...]) -> bool:
    """Start from another run's student, but for the parts that are kept: those that stay this run's teacher's.

    Returns:
        Whether it brings an estimator such as this run's student has. If not, that stays as it is.

    Raises:
        ArtifactError: if it is none, or has other sizes.
    """
    trained = load_trained(path, "student")
    # A student is told what to do and draws nothing: what its teacher's deviations were makes no difference. How often
    # it decides is this run's: it only counts its way by it; and what obstacles are made of, and how many of each type
    # there are, is no matter of weights. An estimator of another kind stays behind.
    ignored = ("initial_std", "min_std", "period", "solids", "stock", "estimator_history")
    own, wanted = trained.network.settings, parts.student.settings
    differ = [name for name in wanted if name not in ignored and own.get(name) != wanted[name]]
    if differ:
        has, builds = ({name: sizes.get(name) for name in differ} for sizes in (own, wanted))
        raise ArtifactError(
            f"{trained.artifact.folder}: the student has {has}, this run builds {builds}; give the same --memory, "
            "--encoder-channels, --encoder-hidden, --encoder-features, --glance-hidden, --heading-gate and "
            "--env.course, and a teacher of the same sizes"
        )
    weights, fastest = trained.network.state_dict(), fastest_canter(parts.teacher_artifact)
    if trained.fastest_canter != fastest:  # it canters as fast as it did
        weights = rescale_canter(weights, trained.fastest_canter, fastest)
    inherits = bool(own["estimator_history"] == wanted["estimator_history"])
    kept = kept if inherits else (*kept, "estimator")
    own_state = parts.student.state_dict()
    own_parts = {name: value for name, value in own_state.items() if name.split(".")[0] in kept}
    others = {name: value for name, value in weights.items() if name.split(".")[0] not in kept}
    parts.student.load_state_dict(others | own_parts)
    return inherits


def save_policy(parts: Components, cfg: Config, folder: Path) -> None:
    """Write the student as an artifact, with what is needed to run it elsewhere."""
    manifest = build_manifest(
        "student",
        features.CONTROLLER_LAYOUTS,
        control_period=parts.env.dt * parts.env.decision_steps,
        data=parts.teacher_artifact.manifest["data"],
    )
    manifest["network"] = parts.student.settings
    manifest["teacher"] = parts.teacher_artifact.manifest["weights"]["sha256"]
    manifest["bbc"] = parts.bbc.artifact.manifest["weights"]["sha256"]
    manifest["course"] = cfg.env.course
    manifest["fastest_canter"] = fastest_canter(parts.teacher_artifact)
    manifest["byol"] = cfg.byol
    manifest["camera"] = describe_camera() | {"training": asdict(cfg.camera)}
    Artifact.save(folder / "policy", parts.student.state_dict(), manifest)
