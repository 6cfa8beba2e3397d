"""What ``evaluate.py`` and ``perform.py`` share: load a controller and its motion, drive robots, record them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from identified import SimulatorFile
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import rotations
from agility_rl.behaviours import NUM_BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.networks import load_network
from agility_rl.envs import LocomotionEnv
from agility_rl.go2 import constants, features
from agility_rl.go2.kinematics import forward
from agility_rl.modules import BasicBehaviourController
from agility_rl.motion import MotionClip, MotionDataset, load_clips
from agility_rl.motion.clip import contacts
from agility_rl.motion.gaits import synthetic_dataset_clips

Schedule = Sequence[tuple[int, Tensor, Tensor] | tuple[int, Tensor, Tensor, Tensor]]
"""Pieces of (steps, skill ``[N]``, command ``[N, 5]``), with a shift ``[N, 1]`` where it is not zero."""
STATES_A_SKILL = 2000


@dataclass(frozen=True)
class MotionConfig:
    labelled: Path | None = None
    """Folder of clips named SKILL_N: episodes start from them, and gaits are compared with them."""
    unlabelled: Path | None = None
    """Folder of unlabelled clips."""


@dataclass(frozen=True)
class Motion:
    """Dog motion and where it came from."""

    labelled: list[MotionClip]
    unlabelled: list[MotionClip]
    source: str
    synthetic: bool

    def start_states(self, seed: int) -> TensorDictBase:
        """Frames of the labelled clips to start episodes from, in a form that a LocomotionEnv takes."""
        skill = torch.arange(NUM_BEHAVIOURS).repeat_interleave(STATES_A_SKILL)
        dataset = MotionDataset(self.labelled, self.labelled)
        return dataset.sample_states(skill, torch.Generator().manual_seed(seed)).set("skill", skill)


@dataclass(frozen=True)
class Controller:
    """A trained controller, its artifact, and the configuration of its training (empty for a bare artifact)."""

    bbc: BasicBehaviourController
    artifact: Artifact
    trained: Mapping[str, Any]
    run: Path
    friction_loss: float = field(default=0.0)


@dataclass(frozen=True)
class Recording:
    """What gait analysis needs of ``N`` robots over ``T`` steps, in the heading frame, as dogs are measured."""

    feet: Tensor  # [N, T, 4, 3] relative to the trunk [m]
    sole: Tensor  # bool [N, T, 4], lower than 25 mm, as in motion clips
    pressed: Tensor  # bool [N, T, 4], contact force
    height: Tensor  # [N, T] [m]
    velocity: Tensor  # [N, T, 3] [m/s]
    yaw_rate: Tensor  # [N, T] [rad/s]
    fell: Tensor  # bool [N]

    def stretch(self, rows: Tensor, start: int) -> tuple[Tensor, ...]:
        """Arguments of the gait analysis for some robots from a step on."""
        return tuple(x[rows, start:] for x in (self.feet, self.sole, self.height, self.velocity, self.yaw_rate))


def load_controller(path: Path) -> Controller:
    """Load the controller of a run or artifact folder.

    Raises:
        FileNotFoundError: if there is none.
        ArtifactError: if it is damaged or no BBC.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected the folder of a run or an artifact, found none; check the path")
    run = path.parent if path.name == "policy" else path
    artifact = Artifact.load(path, kind="bbc")
    if "network" not in artifact.manifest:
        raise ArtifactError(f"{artifact.folder}: the manifest lacks 'network'; export the policy with bbc_pretrain.py")
    bbc = load_network(BasicBehaviourController, artifact)
    file = run / "config.json"
    trained = json.loads(file.read_text(encoding="utf-8"))["config"] if file.is_file() else {}
    configured = trained.get("env", {}).get("friction_loss", 0.0)
    friction_loss = artifact.manifest.get("simulation", {}).get("friction_loss", configured)
    return Controller(bbc, artifact, trained, run, friction_loss)


def load_motion(config: MotionConfig, trained: Mapping[str, Any], seed: int) -> Motion:
    """The clips of the given folders, else of those that the run was trained on, else synthetic gaits.

    Raises:
        ValueError: if only unlabelled clips are given, or clips cannot be read.
    """
    labelled, unlabelled = config.labelled, config.unlabelled
    known = {name: Path(value) for name, value in trained.get("motion", {}).items() if isinstance(value, str)}
    if labelled is None and unlabelled is not None:
        raise ValueError("--motion.unlabelled needs --motion.labelled too: episodes start from labelled clips")
    trained_on = known.get("labelled") if labelled is None else None
    if trained_on is not None and not trained_on.is_dir():
        print(f"{trained_on}, the labelled motion of the training, is gone: synthetic gaits take its place")
    elif trained_on is not None:
        labelled, unlabelled = trained_on, known.get("unlabelled")
        if unlabelled is not None and not unlabelled.exists():
            print(f"{unlabelled}, the unlabelled motion of the training, is gone: the prior is compared with nothing")
            unlabelled = None
    if labelled is None:
        return Motion(*synthetic_dataset_clips(seed), "synthetic gaits of agility_rl: no dog moved like this", True)
    rest = [] if unlabelled is None else load_clips(unlabelled)
    return Motion(load_clips(labelled, label="from name"), rest, "/".join(labelled.resolve().parts[-2:]), False)


def make_env(
    num_robots: int,
    controller: Controller,
    reference: TensorDictBase | None,
    simulator: SimulatorFile | None = None,
    **options: Any,
) -> LocomotionEnv:
    """Robots whose commands only the caller changes and whose episodes only a fall ends.

    They live in the simulator that is given, else in a nominal one with the friction of the training.
    """
    model = {"num_threads": options.pop("num_threads", None), "friction_loss": controller.friction_loss}
    if simulator is not None:
        model |= simulator.model
        options["randomization"] = simulator.randomization
    return LocomotionEnv(
        num_robots,
        simulator_options=model,
        reference=reference,
        episode_length=1e6,
        resample_period=None,
        **options,
    )


def drive(bbc: BasicBehaviourController, env: LocomotionEnv, schedule: Schedule) -> Iterator[TensorDictBase]:
    """Reset, then drive every robot through a schedule; yields what the environment wrote after each step.

    The policy is deterministic and sees only what the robot measures. A fallen robot stays where it lies.
    """
    policy = bbc.deployable_policy()
    env.set_commands(*schedule[0][1:])
    td = env.reset()
    for steps, *told in schedule:
        env.set_commands(*told)
        for _ in range(steps):
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                td = env.step(policy(td))["next"]
            yield td


def recorded_step(
    position: Tensor,
    turn: Tensor,
    velocity: Tensor,
    turn_rate: Tensor,
    joint_position: Tensor,
    foot_force: Tensor,
) -> tuple[Tensor, ...]:
    """Steps of a :class:`Recording`, ``[N, ...]`` each, of states; the turn rate is in the base frame."""
    heading = rotations.heading(turn)
    feet = rotations.rotate(turn[:, None], forward(joint_position))
    return (
        rotations.rotate_inverse(heading[:, None], feet),
        contacts(feet + position[:, None]),
        foot_force > features.FOOT_CONTACT_FORCE,
        position[:, 2],
        rotations.rotate_inverse(heading, velocity),
        rotations.rotate(turn, turn_rate)[:, 2],
    )


def record(bbc: BasicBehaviourController, env: LocomotionEnv, schedule: Schedule) -> Recording:
    """Drive robots and keep only what gait analysis needs."""
    rows: list[tuple[Tensor, ...]] = []
    fell = torch.zeros(env.num_robots, dtype=torch.bool)
    simulator = env.simulator
    for td in drive(bbc, env, schedule):
        fell |= td["terminated"][:, 0]
        rows.append(
            recorded_step(
                simulator.root_position,
                simulator.root_quaternion,
                simulator.root_linear_velocity,
                simulator.root_angular_velocity,
                simulator.joint_position,
                simulator.contact_force[:, list(constants.FOOT_GROUPS)],
            )
        )
    return Recording(*[torch.stack(column, 1) for column in zip(*rows, strict=True)] + [fell])


def join(parts: Sequence[Recording]) -> Recording:
    """Recordings of several batches of robots as one."""
    return Recording(*(torch.cat([getattr(part, entry.name) for part in parts]) for entry in fields(Recording)))
