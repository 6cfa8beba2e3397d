"""What decides on a course when it is evaluated: a teacher, a student with its camera and memory, or a script."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from disturbances import Disturbance
from rollouts import Controller, load_controller
from tensordict import TensorDictBase
from torch import Tensor
from tsc_artifacts import load_bbc_of, load_trained
from tsc_config import Config as TeacherConfig
from tsc_script import read

from agility_rl import behaviours, keys
from agility_rl.behaviours import FASTEST_CANTER
from agility_rl.envs import AgilityEnv
from agility_rl.envs.course import Course
from agility_rl.envs.depth import DepthObservation
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.student import NEXT_HIDDEN

Decide = Callable[[TensorDictBase], TensorDictBase]
"""Observations of a course to decisions under ``action``."""


class Senses:
    """Camera and memory of a student in an environment that decides at every control step.

    A robot looks when its decision is due, so only those images are taken; its memory begins anew with an episode.

    Args:
        env: where the robots live; it needs no camera of its own.
        student: whose memory it is.
        decision_steps: control steps of a decision.
        camera: keyword arguments of :class:`DepthObservation`.
        disturbance: what disturbs the images.
        seed: of the camera's noise and of the disturbance.
    """

    def __init__(
        self,
        env: AgilityEnv,
        student: RecurrentStudent,
        decision_steps: int,
        camera: Mapping[str, Any],
        disturbance: Disturbance,
        seed: int,
    ) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.eyes = DepthObservation(env.simulator, generator, decision_steps, **disturbance.camera(camera))
        self.disturb = disturbance.images(generator)
        self.hidden = student.initial_hidden(env.num_robots)
        self.is_init = torch.ones(env.num_robots, 1, dtype=torch.bool)

    def begin(self, mask: Tensor) -> None:
        """Episodes of the rows of a bool mask ``[N]`` begin."""
        self.eyes.begin(mask)
        self.is_init = self.is_init | mask[:, None]

    def advance(self) -> None:
        """A control step has passed."""
        self.eyes.advance()

    def observe(self, td: TensorDictBase, rows: Tensor) -> TensorDictBase:
        """Add to observations of the M rows of a bool mask what the student reads besides."""
        td[keys.DEPTH], td[keys.IMAGE_AGE] = self.disturb(self.eyes.image()[rows]), self.eyes.age()[rows]
        td[keys.HIDDEN], td["is_init"] = self.hidden[rows], self.is_init[rows]
        return td

    def remember(self, td: TensorDictBase, rows: Tensor) -> None:
        """Keep the memory that the student wrote."""
        self.hidden[rows] = td[NEXT_HIDDEN]
        self.is_init = self.is_init & ~rows[:, None]


@dataclass(frozen=True)
class Decider:
    """What decides, how often, and the Basic Behaviour Controller that it tells."""

    decide: Decide
    decision_steps: int
    controller: Controller
    name: str
    run: Path | None
    weights: str | None
    course: str
    """Course that it was trained on."""
    behaviours: tuple[str, ...]
    """Behaviours that it may choose."""
    student: RecurrentStudent | None = None
    """The network, when it is one that looks and remembers."""
    manifest: Mapping[str, Any] = field(default_factory=dict)
    """Of its artifact."""
    fastest_canter: float = FASTEST_CANTER
    """What the forward speed of its canters ends at [m/s]."""

    @property
    def kind(self) -> str:
        """``teacher``, ``student`` or ``script``."""
        return str(self.manifest.get("kind", "script"))

    def knows(self, course: Course) -> bool:
        """Whether a student that knows where obstacles stand knows it of this course, if there is more than one."""
        known = None if self.student is None else self.student.settings.get("routes")
        stands = [[list(leg) for leg in route] for route in course.legs]
        return known is None or known == stands or all(len(route) == 1 for route in stands)

    def senses(self, env: AgilityEnv, disturbance: Disturbance, seed: int) -> Senses | None:
        """What a student needs besides the observations of an environment."""
        if self.student is None:
            return None
        camera = self.manifest["camera"]["training"]
        return Senses(env, self.student, self.decision_steps, camera, disturbance, seed)


def load_decider(
    path: Path, bbc: Path | None, allowed: Sequence[str] | None = None, kind: str | None = None
) -> Decider:
    """The deterministic deployable teacher or student of a run or artifact folder, with the controller of its training.

    Args:
        path: run or artifact folder.
        bbc: folder of the controller; that of the training by default.
        allowed: behaviours that it may choose; those of the training by default.
        kind: ``teacher`` or ``student``; either by default.

    Raises:
        FileNotFoundError: if something is missing.
        ArtifactError: if it is damaged, something else, or was trained on another controller.
        ValueError: if a behaviour is unknown.
    """
    trained = load_trained(path, kind, allowed)
    network = trained.network
    student = network if isinstance(network, RecurrentStudent) else None
    return Decider(
        network.policy() if isinstance(network, RecurrentStudent) else network.deployable_policy(),
        trained.decision_steps,
        load_bbc_of(trained, bbc),
        trained.run.name,
        trained.run,
        trained.digest,
        trained.course,
        tuple(behaviours.BEHAVIOURS[index] for index in trained.allowed),
        student,
        trained.artifact.manifest,
        trained.fastest_canter,
    )


def load_script(text: str, bbc: Path | None, fastest_canter: float = FASTEST_CANTER) -> Decider:
    """What a script decides.

    Args:
        text: as :func:`tsc_script.read` reads it.
        bbc: folder of the controller; that of the teachers by default.
        fastest_canter: that it may command [m/s].

    Raises:
        ValueError: if it is no script, or there is no such canter.
    """
    script = read(text, fastest_canter=fastest_canter)
    if not script.complete:
        raise ValueError(
            f"--script: {text!r} leaves decisions to a teacher, and there is none; say what it does usually"
        )
    controller = load_controller(bbc or TeacherConfig().bbc)
    label = "script_" + text.replace(":", "_").replace(",", "_").replace("=", "_").replace("/", "_")
    return Decider(
        script.decide,
        1,
        controller,
        label,
        None,
        None,
        "full",
        script.behaviours,
        fastest_canter=fastest_canter,
    )
