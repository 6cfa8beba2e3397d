"""Options and presets of the recipe that trains the Task-Specific Controller's teacher.

``paper`` holds Table S4 to the number, and the released code's values where it is silent; ``cpu`` is for two cores.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from hardware import HardwareConfig

from agility_rl.behaviours import FASTEST_CANTER
from agility_rl.envs.agility_rewards import TERMINATION
from agility_rl.training.precision import Precision


@dataclass(frozen=True)
class RobotsConfig:
    num_robots: int = 512
    """Of each process (released: 6144 for teachers, 256 for students; method notes, section 5.9)."""
    randomize: bool = True
    """Friction, mass, centre of mass and one step of action delay (method notes, section 5.11)."""
    push_interval: float | None = 8.0
    """Seconds (method notes, section 5.11)."""
    command_noise: tuple[float, float] = (0.8, 1.2)
    """Factors on every command (method notes, section 5.1)."""
    episode_length: float = 40.0
    """Seconds (method notes, section 5.6)."""
    start_spread: float = 1.0
    """Times as far aside and turned as released (0.1 m, 0.2 rad) that robots start; more covers how they leave an
    obstacle for the next (ours)."""
    start_after: float = 0.0
    """Share of the episodes that start where the obstacle before is left, instead of straight before one (ours)."""
    goal_radius: float = 0.4
    """Distance at which a way-point is reached [m]: 0.4 for teachers, 0.45 for students and in the evaluation (method
    notes, section 5.5)."""
    num_threads: int | None = None
    """Of the simulator on a CPU; all by default. They do not change the result."""


@dataclass(frozen=True)
class EnvConfig(RobotsConfig):
    course: str = "full"
    """Name of a preset course (``full``, ``tunnel``, ``box``, ``hurdles``, ...), or a course file."""
    decision_steps: int = 1
    """Control steps of a decision; 1 decides at 50 Hz (method notes, section 5.1)."""
    fastest_canter: float = FASTEST_CANTER
    """What the forward speed of a commanded canter ends at [m/s]: Table S2's 2.0, or faster (ours), which the
    controller has not practised. Its students and whoever runs it command the same."""
    misjudgement: float = 0.0
    """Factor on errors of the place, the directions, the obstacle and the terrain that it is told, as a student's; 0:
    all is true (ours)."""


@dataclass(frozen=True)
class PPOConfig:
    steps: int = 24
    """Decisions of a roll-out (method notes, section 5.9)."""
    rewound: float = 0.0
    """Share of the robots that begin every roll-out where others were 0.8 to 2.8 s before they failed, or when the
    roll-out began (ours)."""
    epochs: int = 5
    """Passes over a roll-out (method notes, section 3.7)."""
    minibatches: int = 4
    """Of a pass (method notes, section 3.7)."""
    learning_rate: float = 5e-4
    """Table S4."""
    critic_learning_rate: float | None = None
    """The critic's own, which stays; without, it learns at the policy's rate, so hardly where small steps are asked
    for (ours)."""
    max_learning_rate: float = 1e-2
    """How far ``desired_kl`` may raise the rate (method notes, section 3.7)."""
    desired_kl: float | None = 0.01
    """Of the continuous part (method notes, sections 3.7 and 5.2)."""
    clip: float = 0.2
    """Table S4."""
    gamma: float = 0.99
    """Table S4."""
    lmbda: float = 0.95
    """Table S4."""
    continuous: Literal["all", "selected"] = "all"
    """Which continuous dimensions count (``all``: method notes, section 5.2)."""
    entropy: float = 0.01
    """Of both parts (method notes, section 5.2)."""
    bounds: float | None = None
    """Weight of means beyond [-1, 1], where the environment clips the parameters and nothing that is tried makes a
    difference (ours)."""
    value: float = 1.0
    """Weight of the critic's squared error."""
    max_grad_norm: float = 1.0
    """Method notes, section 3.7."""
    precision: Precision = "float32"
    """Of the hidden layers in the update; ``auto`` is bfloat16 on hardware that multiplies in it."""
    compile: bool = False
    """Fuse PPO's loss, and policy and critic of roll-outs, by ``torch.compile``: half a minute once (docs/gpu.md)."""
    averaging: float = 0.0
    """What is saved is a moving average of the teacher's weights with this decay an iteration; 0: the last weights
    (ours)."""
    initial_std: float = 1.0
    """At the start; a teacher of ``--init-from`` that has more begins with this."""
    min_std: float = 0.1
    """Floor. A decision is held for ``decision_steps`` only, so that a small deviation hardly moves the robot."""
    noise_seconds: float | None = None
    """Time in which noise on the parameters falls to 1/e [s]; without, it is drawn anew at every decision (ours)."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Supplement S6."""
    critic_warm_up: int = 0
    """First iterations that leave the policy as it is: a fresh critic would mislead one that copied a script."""


@dataclass(frozen=True)
class RewardConfig:
    task: float = 2.0
    """Table S4."""
    imitation: float = 0.2
    """Table S4, times the time step; needs the discriminator of the BBC's run."""
    goal_velocity: float = 0.4
    """Weight of speed towards the way-point (method notes, section 5.6)."""
    least_speed: float = 0.0
    """Speed up to which that is paid [m/s], where the obstacle's own (0.4 for most) is smaller (ours)."""
    sprint: float = 0.0
    """Weight of each m/s towards the way-point beyond :attr:`sprint_beyond` (ours); 0: there is no such term."""
    sprint_beyond: float = 2.0
    """[m/s]; Table S2's fastest command."""
    heading: float = 2.0
    """Weight of looking at the way-point (method notes, section 5.6). Who stands and looks earns it all: with the
    published weights 5/6 of what a robot earns that moves on, and falls."""
    reach_goal: float = 5.0
    """Weight of being at a way-point, for the two control steps until the next one counts (section 5.6)."""
    termination: float = TERMINATION
    """Weight of a failure, for one control step (section 5.6). The rest of the course is lost besides."""
    finished: float | None = None
    """What a finished course is worth beyond its last reward; None asks the critic, as for a time limit (section 5.6).
    No robot is ever seen beyond the finish, so that what the critic says there feeds on itself and grows (ours)."""


@dataclass(frozen=True)
class CloningConfig:
    iterations: int = 0
    """Roll-outs in which the teacher copies a script before it learns by itself (ours; 0: not at all)."""
    script: str = "trot:1.2"
    """BEHAVIOUR:SPEED, and OBSTACLE=BEHAVIOUR:SPEED after commas, as ``evaluate_course.py --script`` takes it, or
    ``guide`` or ``leap``, which know where robots stand (``--place`` lets the teacher know too), for all obstacles or
    as ``OBSTACLE=leap`` for one. With ``own`` in place of the first, a teacher of ``--init-from`` is corrected before
    those and keeps the rest; ``own/trot:0.6`` corrects it only while the way-point is more than 0.5 rad aside.
    ``sprint`` corrects it behind obstacles, where it canters as fast as it may."""
    scripted: float = 0.5
    """Share of the robots that the script drives meanwhile; the teacher sees where its own choices lead with the
    rest, and is told there too what the script would do."""
    smoothing: float = 0.1
    """Share of the label that is spread over all behaviours, so that PPO goes on trying each."""
    learning_rate: float = 1e-3
    """Of the copying."""
    epochs: int = 4
    """Passes over a roll-out."""
    minibatches: int = 8
    """Of a pass."""


@dataclass(frozen=True)
class AdaptationConfig:
    learning_rate: float = 1e-4
    """Of history encoder and estimator (method notes, section 3.7)."""
    every: int = 20
    """Iterations between roll-outs that use the history encoder (released code)."""
    minibatches: int = 8
    """Steps by which both learn from every roll-out (ours)."""
    privileged: float = 0.1
    """Weight of pulling the privileged encoder towards the history encoder (method notes, section 3.7)."""
    privileged_ramp: tuple[int, int] = (500, 1000)
    """First iteration and length (method notes, section 5.9)."""


@dataclass(frozen=True)
class CurriculumConfig:
    success: float = 0.8
    """Success rate at which a robot meets harder courses (method notes, section 5.7)."""
    episodes: int = 500
    """Finished episodes over which it is measured."""
    difficulty: float = 0.0
    """Share of the range of heights at the start; 1 is the released difficulty at once."""
    difficulty_step: float = 0.1
    """By which share it grows (ours; released: 0.01 m, method notes 5.7)."""
    obstacles: int = 1
    """Obstacles of an episode at the start; one more whenever the difficulty is full. 6 or more: all at once."""
    practice: float = 1.0
    """How much more often an episode starts before an obstacle that fails: weight 1 + this * failure / success."""


@dataclass(frozen=True)
class Config(HardwareConfig):
    name: str = "teacher"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    bbc: Path = Path("pretrained/bbc_leaping")
    """Run or artifact folder of the Basic Behaviour Controller."""
    iterations: int = 30_000
    """Released code (method notes, section 5.9)."""
    max_minutes: float | None = None
    """Stop and save after this time."""
    checkpoint_every: int = 50
    """Iterations."""
    resume: Path | None = None
    """Run folder to go on with."""
    init_from: Path | None = None
    """Run or artifact folder whose teacher to start from."""
    behaviours: tuple[str, ...] = ("walk", "pace", "trot", "canter", "jump")
    """Behaviours that it may choose; the others are never drawn."""
    place: bool = False
    """Let it read its way-points and its obstacle in metres (ours); as published it knows directions only. A teacher of
    ``--init-from`` that did without begins as it is."""
    env: EnvConfig = field(default_factory=EnvConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)


PAPER = Config(
    env=EnvConfig(num_robots=6144),
    curriculum=CurriculumConfig(difficulty=1.0, obstacles=6, practice=0.0),
)
CPU = Config(
    iterations=3000,
    max_minutes=60.0,
    place=True,
    env=EnvConfig(
        num_robots=256,
        decision_steps=2,
        randomize=False,
        push_interval=None,
        command_noise=(0.97, 1.03),
        start_spread=1.5,
        start_after=0.5,
        goal_radius=0.45,
    ),
    ppo=PPOConfig(
        steps=40,
        rewound=0.4,
        minibatches=4,
        learning_rate=1e-4,
        critic_learning_rate=3e-4,
        max_learning_rate=2e-3,
        gamma=0.99,
        entropy=0.001,
        continuous="selected",
        precision="auto",
        averaging=0.98,
        initial_std=0.2,
        min_std=0.15,
        noise_seconds=0.12,
        hidden=(256, 128, 64),
        critic_warm_up=30,
    ),
    reward=RewardConfig(task=1.0, goal_velocity=2.0, least_speed=1.2, heading=0.5, reach_goal=30.0, finished=12.0),
    cloning=CloningConfig(iterations=40, script="leap", smoothing=0.02),
    adaptation=AdaptationConfig(learning_rate=1e-3, minibatches=4),
    curriculum=CurriculumConfig(difficulty=1.0, obstacles=6, practice=2.0),
)
GPU = replace(CPU, simulator="warp", iterations=1321, max_minutes=None, env=replace(CPU.env, num_robots=4096))
"""``cpu`` with more robots; as many iterations as that has made teachers with (docs/gpu.md; not tried to its end)."""
SMOKE = replace(
    CPU,
    name="smoke_teacher",
    iterations=2,
    checkpoint_every=1,
    env=replace(CPU.env, num_robots=8),
    ppo=replace(CPU.ppo, steps=4, epochs=1, minibatches=2, hidden=(32, 32), critic_warm_up=1),
    adaptation=replace(CPU.adaptation, every=2, minibatches=2),
    cloning=replace(CPU.cloning, iterations=1, epochs=1, minibatches=2),
    curriculum=replace(CPU.curriculum, episodes=1),
)
PRESETS = {"smoke": SMOKE, "cpu": CPU, "gpu": GPU, "paper": PAPER}
