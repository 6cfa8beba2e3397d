"""Options and presets of the recipe that trains the Task-Specific Controller's student.

``paper`` holds what supplement S2, S3, S6 and Algorithm S3 say, and the released code's values where they are silent
(method notes, sections 5.1, 5.5, 5.8 to 5.11); ``cpu`` is for two cores.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from hardware import HardwareConfig
from tsc_config import CurriculumConfig, RobotsConfig

from agility_rl.go2 import camera
from agility_rl.modules.student import HEADING_GATE
from agility_rl.training.precision import Precision


@dataclass(frozen=True)
class EnvConfig(RobotsConfig):
    num_robots: int = 256
    """Method notes, section 5.9."""
    course: str | None = None
    """Preset course or course file; the teacher's by default."""
    goal_radius: float = 0.45
    """Distance at which a way-point is reached [m] (method notes, section 5.5)."""


@dataclass(frozen=True)
class CameraConfig:
    frame_steps: int = 1
    """Control steps between two frames; 1 is 50 Hz (supplement S3)."""
    latency: tuple[int, int] = (1, 1)
    """Fewest and most control steps by which images are late: one frame (method notes, section 5.8)."""
    pitch: float = camera.PITCH_JITTER
    """Half-width of the mounting angle [rad]: 5 degrees (method notes, section 5.8)."""
    offset_noise: float = camera.OFFSET_NOISE
    """Half-width of an image's common error [m]: 0.05 (method notes, section 5.8)."""
    pixel_noise: float = camera.PIXEL_NOISE
    """Half-width of its pixels' errors [m], times U(0, 1) for each image: 0.05 (method notes, section 5.8)."""


@dataclass(frozen=True)
class AugmentationConfig:
    rectangle: float = 0.1
    """Probability for an image (method notes, section 5.10, as all of these)."""
    white_noise: float = 0.1
    """Probability for an image."""
    white_noise_std: float = 0.02
    """Deviation of its pixels, of images in [-0.5, 0.5]."""
    dropout: float = 0.05
    """Probability for an image."""
    dropout_share: float = 0.05
    """Share of its pixels."""
    blur: float = 0.1
    """Probability for an image."""
    blur_std: tuple[float, float] = (0.5, 1.5)
    """Range of its deviation [pixels]."""


@dataclass(frozen=True)
class ImitationConfig:
    steps: int = 24
    """Of a window, through which the gradient passes (method notes, section 5.9)."""
    epochs: int = 1
    """Passes over a window."""
    minibatches: int = 1
    """Of robots; one gradient step an iteration (method notes, section 5.9)."""
    learning_rate: float = 1e-3
    """At first (method notes, section 5.9)."""
    final_learning_rate: float = 1e-5
    """At the end (method notes, section 5.9)."""
    decay: int = 20_000
    """Iterations over which the learning rates fall linearly (method notes, section 5.9)."""
    max_grad_norm: float = 1.0
    """Method notes, section 5.9."""
    behaviour: float = 1.0
    """Coefficient of the cross-entropy of the behaviour."""
    continuous: float = 1.0
    """Coefficient of the distance of the parameters."""
    heading: float = 1.0
    """Coefficient of the errors of the headings."""
    obstacle: float = 1.0
    """Coefficients of the four terms of Eq. (15): all 1 (method notes, section 5.9)."""
    place: float = 0.25
    """Coefficient of the place, for students of a teacher that reads it (ours)."""
    progress: float = 0.5
    """Coefficient of the progress on the course, for the same students (ours)."""
    latent: float | None = None
    """Coefficient of the distance to the teacher's terrain latent (ours); without, only what the actor makes of it
    counts (method notes, section 5.9)."""
    heading_weights: tuple[float, float] = (2.0, 0.5)
    """Of the errors to the current and the next way-point (method notes, section 5.9)."""
    compared: Literal["all", "selected"] = "all"
    """Whose parameters are compared: of all behaviours (method notes, section 5.9), or of the teacher's choice."""
    actor: bool = True
    """Whether actor and history encoder learn on (method notes, section 5.9). Without, they stay the teacher's, and
    gradients pass through them to what is perceived (docs/student_experiments.md, "The actor")."""
    led: float = 0.0
    """Share of the robots that do what the teacher says, at first; it falls to 0 (ours; Ross et al. 2011)."""
    led_until: int = 150
    """Iteration from which the student acts alone."""
    augment: bool = True
    """Whether the images of the imitation are disturbed too (method notes, section 5.10)."""


@dataclass(frozen=True)
class RepresentationConfig:
    hidden: int = 1024
    """Hidden units of projector and predictor (method notes, section 5.10)."""
    out_features: int = 64
    """Sizes of projector and predictor (method notes, section 5.10)."""
    learning_rate: float = 3e-4
    """At first (method notes, section 5.10)."""
    final_learning_rate: float = 1e-5
    """Method notes, section 5.10; falls as that of the imitation does."""
    decay: float = 0.99
    """Of the moving average, after every minibatch (method notes, section 5.10)."""
    images: int = 6144
    """Of an iteration: all of 256 robots x 24 steps (method notes, section 5.10)."""
    minibatches: int = 6
    """Method notes, section 5.10."""


@dataclass(frozen=True)
class GlanceConfig:
    """What single images are asked for (ours): the teacher's terrain latent, the obstacle ahead, the place."""

    steps: int = 0
    """Gradient steps of an iteration by which the encoder learns so, and so only: the imitation then trains memory and
    actor on features. 0: the encoder learns within the imitation (method notes, section 5.9)."""
    images: int = 0
    """To collect on the course, where the teacher walks, before the imitation begins; 0 for no pre-training. A run that
    starts from another student does without."""
    every: int = 4
    """Decisions between two images of a robot that are kept."""
    epochs: int = 4
    """Of the pre-training."""
    pretrain_learning_rate: float = 1e-3
    """Of the pre-training; falls along half a cosine to 0."""
    batch: int = 128
    """Images of a gradient step."""
    learning_rate: float = 1e-3
    """During the imitation, at first."""
    final_learning_rate: float = 1e-4
    """During the imitation; falls as that of the imitation does."""
    kept: int = 40_000
    """Newest images, of which the steps draw."""
    held_out: float = 0.1
    """Share of the robots whose images measure the pre-training and do not train."""


@dataclass(frozen=True)
class EstimationConfig:
    """How an estimator that reads the history learns (ours)."""

    robots: int = 128
    """That the teacher leads over the course, without cameras."""
    decisions: int = 1000
    """Of each robot."""
    epochs: int = 10
    """Passes over them."""
    batch: int = 512
    """Decisions of a gradient step."""
    learning_rate: float = 2e-3
    """Falls to 0, epoch by epoch."""


@dataclass(frozen=True)
class Config(HardwareConfig):
    name: str = "student"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    teacher: Path = Path("pretrained/teacher_leaping")
    """Run or artifact folder of the teacher; the student decides as often, on the same behaviours."""
    bbc: Path | None = None
    """Run or artifact folder of the Basic Behaviour Controller that the teacher was trained on; found by default."""
    iterations: int = 15_000
    """Released code (method notes, section 5.9)."""
    max_minutes: float | None = None
    """Stop and save after this time."""
    checkpoint_every: int = 100
    """Iterations."""
    resume: Path | None = None
    """Run folder to go on with."""
    init_from: Path | None = None
    """Run or artifact folder whose student to start from."""
    byol: bool = True
    """Train the encoder by BYOL too (supplement S2, S8)."""
    bits: Literal[8, 16] = 8
    """How images are stored."""
    precision: Precision = "float32"
    """Of the depth encoder's layers; ``auto`` is bfloat16 on hardware that multiplies in it."""
    memory: int = 512
    """Units of the GRU (supplement S6)."""
    encoder_channels: tuple[int, ...] = (32, 64)
    """Of the depth encoder's convolutions: two (method notes, section 5.9), or more (ours), with a max-pool between.
    Of two, most of a student's weights and of its encoder's time are in proportion to the second number."""
    encoder_hidden: int = 128
    """Units of the depth encoder's hidden linear layer (method notes, section 5.9)."""
    encoder_features: int = 32
    """Numbers that it makes of an image (supplement S6). They have to tell terrain latent, obstacle, place and
    progress."""
    glance_hidden: tuple[int, ...] = (128,)
    """Units of the layers that read from those, and an expected place, where the obstacle is (ours)."""
    heading_gate: float = HEADING_GATE
    """Heading errors beyond this are given, not predicted, in training [rad]: 0.6 (method notes, section 5.9)."""
    estimator_history: bool = False
    """Whether the state estimator reads the history, and learns before the imitation where the teacher walks (ours);
    else it is the teacher's. A student that infers its place counts its way by it."""
    env: EnvConfig = field(default_factory=EnvConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    representation: RepresentationConfig = field(default_factory=RepresentationConfig)
    glance: GlanceConfig = field(default_factory=GlanceConfig)
    estimation: EstimationConfig = field(default_factory=EstimationConfig)
    curriculum: CurriculumConfig = field(
        default_factory=lambda: CurriculumConfig(difficulty=1.0, obstacles=6, practice=0.0)
    )
    """Released difficulty at once (method notes, section 5.7)."""


PAPER = Config()
CPU = Config(
    iterations=330,
    max_minutes=150.0,
    checkpoint_every=25,
    byol=False,
    precision="auto",
    memory=256,
    encoder_channels=(16, 32, 64, 96),
    encoder_features=128,
    glance_hidden=(256, 256, 256),
    heading_gate=4.0,
    estimator_history=True,
    env=EnvConfig(num_robots=64, randomize=False, push_interval=None, command_noise=(0.97, 1.03), start_spread=3.0),
    imitation=ImitationConfig(
        steps=48,
        epochs=4,
        minibatches=4,
        decay=330,
        behaviour=0.0,  # the actor is the teacher's, so that memory and encoder alone learn
        continuous=0.0,
        actor=False,
        place=0.5,
        latent=2.0,
        compared="selected",
        led=0.8,
        led_until=117,
    ),
    representation=RepresentationConfig(images=384, minibatches=1),
    glance=GlanceConfig(
        images=480_000,
        every=1,
        epochs=8,
        steps=8,
        learning_rate=3e-4,
        final_learning_rate=1e-5,
        kept=60_000,
    ),
    curriculum=CurriculumConfig(difficulty=1.0, obstacles=6, practice=1.0),
)
GPU = replace(CPU, simulator="warp", max_minutes=None, env=replace(CPU.env, num_robots=1024))
"""``cpu`` with more robots (docs/gpu.md; not tried to its end)."""
SMOKE = replace(
    CPU,
    name="smoke_student",
    iterations=2,
    checkpoint_every=1,
    byol=True,
    memory=16,
    encoder_channels=(4, 8),
    encoder_hidden=8,
    encoder_features=8,
    glance_hidden=(8, 8),
    env=replace(CPU.env, num_robots=4),
    imitation=replace(CPU.imitation, steps=4, epochs=1, minibatches=2, behaviour=1.0, continuous=1.0, actor=True),
    representation=replace(CPU.representation, images=8, hidden=16),
    glance=GlanceConfig(images=8, every=1, epochs=1, batch=4, held_out=0.25, kept=16),
    estimation=EstimationConfig(robots=2, decisions=4, epochs=1, batch=4),
)
PRESETS = {"smoke": SMOKE, "cpu": CPU, "gpu": GPU, "paper": PAPER}
