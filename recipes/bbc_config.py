"""Options of the recipes that train a Basic Behaviour Controller.

The preset ``paper`` (``bbc_presets.py``) holds Table S1 and the supplement to the number, and the released code's
values where those are silent; what is ours says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hardware import HardwareConfig

from agility_rl.behaviours import RESAMPLE_PERIOD
from agility_rl.motion.stride_patterns import FREQUENCY_GROWTH
from agility_rl.training.precision import Precision


@dataclass(frozen=True)
class MotionConfig:
    labelled: Path | None = None
    """Folder of clips named SKILL_N; synthetic gaits when not given."""
    unlabelled: Path | None = None
    """Folder of unlabelled clips."""
    mirror: bool = True
    """Add the left-right mirrored motion."""
    one_sided: tuple[str, ...] = ()
    """Behaviours whose labelled clips are not mirrored."""
    turns: tuple[float, ...] = ()
    """Labelled clips are also bent to both sides, at these shares of the largest turn rate that is commanded."""
    offsets: tuple[int, ...] = (0, 1)
    """Frames that the discriminator sees together, in control steps from the oldest (Table S1: two consecutive)."""
    standing_weight: float = 0.1
    """Sampling weight of unlabelled frames in which the dog stands (1 = as recorded)."""
    label_share: float | None = None
    """Keep so much labelled motion, as a share of all motion (0.01: one per cent), alike of every behaviour and the
    longest clips first; what is cut off is not used at all. All labels when not given. 0: no names are looked at,
    but that episodes start as often in the motion of each, and what needs them must be off."""


@dataclass(frozen=True)
class EnvConfig:
    num_robots: int = 1024
    """Of each process (released: 4096; method notes, section 3.7)."""
    terrain: Literal["flat", "rough", "ridges"] = "flat"
    """``flat``, ``rough`` (method notes 4.5), or ``ridges``: slopes without roughness (ours)."""
    roughness: float = 0.05
    """Half-width of the rough terrain's noise [m] (method notes, section 4.5)."""
    steepness: float = 0.4
    """Slope of its pyramids at difficulty 1; they are drawn at 0, 0.2 and 0.4 of it (method notes, section 4.5). Of
    ridges: the largest; strips have all of it, half of it or none."""
    encounters: float = 0.0
    """Share of the commands on which a bar (before canter and jump) or a ramp lies in the way (ours)."""
    boxes: float = 0.0
    """Share of the jumps that begin before a box (ours)."""
    lowest_box: float = 0.10
    """Height of the lowest box [m]."""
    highest_box: float = 0.30
    """Height of the highest one [m]."""
    low_feet_weight: float = 0.0
    """Weight of a penalty for feet that come to a box lower than its top (ours) [1/m]."""
    shares: tuple[float, ...] = ()
    """How often each of the five behaviours is commanded, in place of the prior (ours)."""
    randomize: bool = True
    """Friction, mass, centre of mass and gains (method notes, section 4.5)."""
    push_interval: float | None = 8.0
    """Seconds (released code)."""
    observation_noise: float = 1.0
    """Factor on the noise of the observations (method notes, section 3.2); 0: none."""
    action_delay: float = 0.0
    """Delay of every action [s]."""
    action_delay_from: int = 0
    """Iteration at which the delay begins, robot by robot with its next episode."""
    jump_reward: Literal["peak", "window"] = "peak"
    """``window`` as released, or ``peak``: the highest trunk of the last 0.9 s."""
    jump_weight: float = 6.0
    """Weight of the reward for the height of jumps (ours; released: 0.2, with ``window``)."""
    jump_width: float = 0.01
    """Width of the kernel of ``peak`` [m^2]."""
    progress_weight: float = 0.0
    """Weight of a reward for the share of the commanded velocity reached (ours); it pays nothing for standing."""
    progress_fade: tuple[int, int] = (100, 100)
    """First iteration and length of its fading: who walks can learn how a dog does."""
    progress_left: float = 0.0
    """Weight that is left of it; without any, a slow walk turns into standing."""
    turn_weight: float = 0.0
    """Weight of a reward for turning as fast as commanded that has a slope everywhere (ours)."""
    lateral_weight: float = 0.0
    """Weight of a reward for going sideways as fast as commanded, and no faster, that has a slope everywhere (ours)."""
    rhythm_weight: float = 0.0
    """Weight of a reward for the stride frequency and the foot phases of the behaviour's labelled clips (ours)."""
    walk_growth: float = FREQUENCY_GROWTH["walk"]
    """Strides that a second shall hold more of for each m/s that the walk is commanded faster [1/m]."""
    walk_emphasis: float = 1.0
    """How many times as much the walk's rhythm is paid as that of others (ours; docs/bbc_experiments.md)."""
    canter_stance: float = 0.0
    """Share of time for which a cantering foot shall stand more than in the labelled clips (ours). Those run at 1.9 to
    3.3 m/s, commands at 0.8 to 2: a robot that has to stand as shortly as they do goes faster than told. Dogs cantering
    at the mean commanded speed stand for 0.06 more than the labelled ones (docs/bbc_experiments.md, The rhythm)."""
    collision_weight: float = -10.0
    """Supplement S4. As the sum is clipped at zero, a beginner who collides learns nothing else; less is faster."""
    episode_length: float = 20.0
    """Seconds until an episode is cut; shorter ones start more often in the middle of a dog's motion."""
    resample_period: float = RESAMPLE_PERIOD
    """Seconds between two commands (supplement S2: six); who is led over a course changes more often."""
    standing_starts: float = 0.0
    """Share of episodes that start from a stand instead of the middle of a dog's motion, as a course does."""
    end_when_sitting: bool = False
    """Contact of a thigh ends the episode too, as in stage 3."""
    friction_loss: float = 0.2
    """Dry friction of the joints [N m]; 0 as in the released simulation is a tenth faster."""
    simulator: Path | None = None
    """Identified simulator to train in: ``result.json`` of ``easi.py``; the rest is as ``randomize`` says."""
    num_threads: int | None = None
    """Of the simulator on a CPU; all by default. They do not change the result."""


@dataclass(frozen=True)
class PPOConfig:
    steps: int = 24
    """Control steps of a roll-out (method notes, section 3.7)."""
    epochs: int = 5
    """Passes over a roll-out (method notes, section 3.7)."""
    minibatches: int = 8
    """Of a pass (released: 4; method notes, section 3.7)."""
    learning_rate: float = 1e-3
    """Table S1."""
    max_learning_rate: float = 1e-2
    """How far ``desired_kl`` may raise the rate (method notes, section 3.7)."""
    desired_kl: float | None = 0.01
    """Released code; ``None`` keeps the learning rate."""
    clip: float = 0.2
    """Table S1."""
    gamma: float = 0.99
    """Table S1."""
    lmbda: float = 0.95
    """Table S1."""
    entropy: float = 0.01
    """Weight of the entropy beside a surrogate of weight 1. ``paper`` halves the released 2, 5, 0.01 and 0.1 of
    surrogate, value, entropy and privileged encoder, and the norm of their gradient (method notes, section 3.7)."""
    value: float = 1.0
    """Weight of the critic's squared error, which is not clipped (released: clipped)."""
    max_grad_norm: float = 1.0
    """Method notes, section 3.7."""
    precision: Precision = "float32"
    """Of the hidden layers in the update; ``auto`` is bfloat16 on hardware that multiplies in it."""
    compile: bool = False
    """Fuse PPO's loss, and policy and critic of roll-outs, by ``torch.compile``: half a minute once (docs/gpu.md)."""
    averaging: float = 0.0
    """Decay an iteration of the weights' moving average, which is saved (ours; docs/bbc_experiments.md); 0: none."""
    by_behaviour: bool = False
    """Normalise advantages within each behaviour (ours); over all of them, one that is paid more is learned at the
    others' expense."""
    symmetry: float = 0.0
    """Weight of acting in a mirror as the mirror image does (squared distance of the mean actions; ours): without it a
    controller turns better to one side."""
    symmetric: tuple[str, ...] = ("walk", "pace", "trot")
    """Behaviours that are held to that. Gaits with a leading leg are not: between one and its image lies another."""
    initial_std: float = 1.0
    """Deviation of an action at the start (method notes, section 3.1)."""
    min_std: float = 0.1
    """Least deviation of an action, alike for all joints (ours; released: 0.094, 0.091 and 0.085 of the three)."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Supplement S6."""
    critic_warm_up: int = 0
    """First iterations that leave the policy as it is: a fresh critic would mislead one that is already good."""
    critic_history: bool = True
    """The critic reads the history too (released code)."""


@dataclass(frozen=True)
class ImitationConfig:
    criterion: Literal["least_squares", "logistic", "wasserstein"] = "least_squares"
    """Of the discriminator: least squares, or an alternative that the release has too (method notes, section 3.4)."""
    conditional: bool = False
    """Tell the discriminator the skill (ours; the paper's does not know it)."""
    labelled_share: float = 0.0
    """Share of labelled motion in the discriminator's expert batch."""
    minibatches: int = 80
    """Of an iteration (method notes, section 3.3)."""
    batch_size: int = 1228
    """Frames of the policy, and of unlabelled motion, in a minibatch (method notes, section 3.3)."""
    labelled_batch_size: int = 1228
    """Frames of labelled motion in it (method notes, section 3.3)."""
    replay: int = 1_000_000
    """Policy frames kept (released code)."""
    discriminator_learning_rate: float = 5e-4
    """Table S1."""
    encoder_learning_rate: float = 1e-3
    """Table S1. It is the rate of class and shift heads; the trunk that they share has the discriminator's (ours;
    released: three optimisers, each of which moves the trunk too)."""
    weight_decay: float = 1e-3
    """Of discriminator and predictor (method notes, section 3.4)."""
    gradient_penalty: float = 0.1
    """Coefficient of the squared slope at unlabelled motion (method notes, section 3.4)."""
    cloning: int = 0
    """Steps in which the actor copies the labelled clips before anything else."""
    cloning_weight: float = 0.0
    """Weight of copying them in every minibatch of PPO afterwards, so that a behaviour that is hard to find again is
    not forgotten while the robot learns not to fall."""
    cloning_fade: tuple[int, int] = (0, 500)
    """First iteration and length of its fading away."""
    anchor: float = 0.0
    """Weight of staying near the policy of ``--init-from`` (squared distance of the mean actions): PPO then mends falls
    and leaves good gaits alone, which a discriminator that starts anew would not."""
    anchor_jump: float = 1.0
    """Factor on the anchor while a jump is commanded: a start that has never seen a box is no example before one."""
    anchor_turn_rate: float | None = None
    """Commanded turn rate [rad/s] beyond which the anchor lets go: a start that goes straight is no example there."""
    warm_up: int = 0
    """Steps in which the predictor learns the labels before anything else, so that its first rewards mean something."""
    information: float = 1.0
    """Coefficient of the information-maximisation term (method notes, section 3.4)."""
    information_ramp: tuple[int, int] = (200, 10_000)
    """First iteration and length of the ramp of the information-maximisation term (released code)."""
    prior_weight: float = 1e-3
    """Table S1: moving average weight, 1 - beta."""
    prior_temperature: float | None = None
    """Skills are drawn from the prior itself (Algorithm S1, line 3), or from softmax(prior / temperature), which the
    released code does with 0.25."""
    imitation_reward: float = 0.2
    """Table S1 (released code: 1.0)."""
    skill_reward: float = 0.2
    """Weight of log Q^c(c) (released code; method notes, section 3.6)."""
    skill_floor: float | None = None
    """Lift log Q^c to [0, 1] above this floor, so that no reward punishes being alive; ``None`` as published."""
    gate: float = 0.0
    """Share of imitation and skill reward that is paid only in proportion to ``velocity_progress`` (needs a weight for
    it): a standing robot is no bad imitation of a slow dog, and would be content."""
    shift_reward: float = 0.01
    """Weight of the predicted shift (released code; method notes, section 3.6)."""
    task_reward: float = 0.2
    """Table S1."""
    height_deviation: float = 0.0
    """Least standard deviation by which the discriminator's trunk height is normalised [m]. The dogs' is 0.018, the
    robot's PD controller sags by 0.05: the height alone then tells a beginner from a dog."""
    velocity_weight: float = 1.0
    """Weight of joint and turning velocities in what discriminator and predictor see. A dog's are smooth; a robot's
    jump at every contact and exploring action, by which it is told apart however well it walks."""
    hidden: tuple[int, ...] = (512, 256)
    """Layers that discriminator and predictor share (method notes, section 3.1)."""


@dataclass(frozen=True)
class AdaptationConfig:
    learning_rate: float = 1e-4
    """Of history encoder and estimator (method notes, section 3.7)."""
    every: int = 20
    """Iterations between roll-outs that use the history encoder (released code)."""
    minibatches: int = 8
    """Steps by which history encoder and estimator learn from every roll-out (ours; released: 20 from each
    ``every``-th one for the encoder)."""
    privileged: float = 0.1
    """Weight of pulling the privileged encoder towards the history encoder (released code)."""
    privileged_ramp: tuple[int, int] = (1000, 2000)
    """First iteration and length of the ramp of that weight (method notes, section 3.7)."""


@dataclass(frozen=True)
class TrialsConfig:
    start: int | None = None
    """Iteration after which the controller is first measured as ``evaluate.py`` does; what the run shows is then the
    best one that was, not the last. Never when not given. Ours (docs/bbc_experiments.md, Trials)."""
    every: int = 25
    """Iterations between two trials, of which one takes about as long as ten iterations."""
    episodes: int = 100
    """Episodes of each behaviour."""
    seconds: float = 20.0
    """Length of an episode."""
    switches: int = 10
    """Trials of each of the 20 ordered switches between behaviours."""


@dataclass(frozen=True)
class Config(HardwareConfig):
    name: str = "bbc"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    iterations: int = 200_000
    """Released code: 200,000 take four days (method notes, section 3.7)."""
    max_minutes: float | None = None
    """Stop and save after this time."""
    checkpoint_every: int = 50
    """Iterations."""
    resume: Path | None = None
    """Run folder to go on with."""
    init_from: Path | None = None
    """Run or artifact folder whose policy to start from."""
    changes: tuple[tuple[int, str, float], ...] = ()
    """Options that take another value from an iteration on: ``300 ppo.entropy 0.001 500 env.jump-weight 12 ...``."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    adaptation: AdaptationConfig = field(default_factory=AdaptationConfig)
    trials: TrialsConfig = field(default_factory=TrialsConfig)
