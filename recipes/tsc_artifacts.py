"""Trained Task-Specific Controllers on disk: teachers and students, whom they tell, and the camera they look by."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rollouts import Controller, load_controller
from tsc_config import Config as TeacherConfig

from agility_rl import behaviours, keys
from agility_rl.deploy.artifact import MANIFEST_FILE, Artifact, ArtifactError
from agility_rl.deploy.networks import load_network
from agility_rl.deploy.task import check_camera, fastest_canter
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import constants, features
from agility_rl.modules import RecurrentStudent, Teacher

NETWORKS: dict[str, Callable[..., Teacher | RecurrentStudent]] = {"teacher": Teacher, "student": RecurrentStudent}
RECIPES = {"teacher": "tsc_teacher.py", "student": "tsc_student.py"}


@dataclass(frozen=True)
class Trained:
    """A teacher or a student with its artifact.

    Attributes:
        network: what was trained.
        artifact: where it comes from.
        run: folder of its run.
        allowed: indices of the behaviours that it may choose.
    """

    network: Teacher | RecurrentStudent
    artifact: Artifact
    run: Path
    allowed: tuple[int, ...]

    @property
    def kind(self) -> str:
        """``teacher`` or ``student``."""
        return str(self.artifact.manifest["kind"])

    @property
    def digest(self) -> str:
        """SHA-256 of its weights."""
        return str(self.artifact.manifest["weights"]["sha256"])

    @property
    def decision_steps(self) -> int:
        """Control steps of a decision."""
        return round(self.artifact.manifest["control_period"] / constants.CONTROL_DT)

    @property
    def fastest_canter(self) -> float:
        """What the forward speed of its canters ends at [m/s]."""
        return fastest_canter(self.artifact)

    @property
    def course(self) -> str:
        """Course of its training."""
        return str(self.artifact.manifest.get("course", "full"))


def load_trained(path: Path, kind: str | None = None, allowed: Sequence[str] | None = None) -> Trained:
    """The teacher or student of a run or artifact folder.

    Args:
        path: run or artifact folder.
        kind: ``teacher`` or ``student``; either by default.
        allowed: behaviours that it may choose; those of its training by default.

    Raises:
        FileNotFoundError: if something is missing.
        ArtifactError: if it is damaged, something else, or looks by another camera.
        ValueError: if a behaviour is unknown.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected the folder of a run or an artifact, found none; check the path")
    run = path.parent if path.name == "policy" else path
    artifact = Artifact.load(path)
    manifest = artifact.manifest
    expected = NETWORKS if kind is None else (kind,)
    if manifest["kind"] not in expected or "network" not in manifest:
        wanted = " or ".join(f"a {name} of {RECIPES[name]}" for name in expected)
        advice = "; a BBC decides nothing: give it as --bbc, with a teacher or with --script BEHAVIOUR:SPEED"
        raise ArtifactError(
            f"{artifact.folder}: expected {wanted}, got an artifact of kind {manifest['kind']!r}"
            + (advice if manifest["kind"] == "bbc" else "")
        )
    artifact.check_layout(keys.PROPRIOCEPTION, features.PROPRIOCEPTION_LAYOUT)
    if manifest["kind"] == "student":
        check_camera(artifact)
    network = dict(manifest["network"])
    if (types := network.get("num_obstacles")) != len(OBSTACLES):
        raise ArtifactError(f"{artifact.folder}: knows {types} types of obstacles, expected {len(OBSTACLES)}")
    known = network.get("allowed") or range(behaviours.NUM_BEHAVIOURS)
    if allowed is not None:
        network["allowed"] = sorted(behaviours.skill_index(name) for name in allowed)
        if not allowed or not set(network["allowed"]) <= set(known):
            names = ", ".join(behaviours.BEHAVIOURS[index] for index in known)
            raise ValueError(f"--behaviours: expected some of those that it was trained with, {names}; got {allowed}")
    module = load_network(NETWORKS[manifest["kind"]], artifact, network)
    return Trained(module, artifact, run, tuple(network.get("allowed") or known))


def load_bbc_of(trained: Trained, bbc: Path | None) -> Controller:
    """The Basic Behaviour Controller that a teacher or student was trained on.

    Args:
        trained: it.
        bbc: folder of the controller; that of the training by default.

    Raises:
        ArtifactError: if it is another one.
    """
    controller = load_controller(bbc or trained_bbc(trained))
    digest, expected = controller.artifact.manifest["weights"]["sha256"], trained.artifact.manifest.get("bbc")
    if expected != digest:
        raise ArtifactError(
            f"{controller.artifact.folder} holds the BBC {digest[:12]}, but {trained.artifact.folder} was trained on "
            f"{str(expected)[:12]}; give that one as --bbc"
        )
    return controller


def trained_bbc(trained: Trained) -> Path:
    """Where the controller of its training is: where its run's configuration says, else beside it, else the default's.

    Raises:
        ValueError: if the configuration is damaged.
    """
    file = trained.run / "config.json"
    if file.is_file():
        try:
            told = json.loads(file.read_text(encoding="utf-8"))["config"].get("bbc")
        except (json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{file} is damaged or no run's configuration: {error}; give the BBC as --bbc") from error
        if told is not None:  # who learns from images alone has no robots
            return Path(told)
    expected = trained.artifact.manifest.get("bbc")
    for manifest in sorted(trained.run.resolve().parent.glob(f"*/{MANIFEST_FILE}")):
        try:
            found = json.loads(manifest.read_text(encoding="utf-8"))
            if found["kind"] == "bbc" and found["weights"]["sha256"] == expected:
                return manifest.parent
        except (json.JSONDecodeError, KeyError, TypeError):
            continue  # somebody else's manifest
    return TeacherConfig().bbc


def refuse_starts_after(start_after: float, trained: Trained) -> None:
    """Students that count their way believe that they begin before the next obstacle, not behind the one before.

    Raises:
        ValueError: if robots shall start where such a student does not expect it.
    """
    if start_after and trained.network.settings["num_place"]:
        raise ValueError(
            f"--env.start-after {start_after:g}: a student that knows its place expects to start before an obstacle"
        )
