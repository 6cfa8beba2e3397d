"""The controller of ``play.py`` and ``deploy.py``, and who decides where a person does not: a student, or nobody."""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from agility_rl.deploy import Artifact, BehaviourCommand, DeployedBBC, DeployedStudent, Operator
from agility_rl.deploy.behaviour import onnx_network, torch_network
from agility_rl.deploy.commander import Commander
from agility_rl.deploy.depth import DepthSource
from agility_rl.deploy.task import onnx_student, torch_student


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    task: Path | None = None
    """Run or artifact folder of a student (tsc_student.py), which then decides by depth images; the controller must be
    the one that it was trained on."""
    backend: Literal["torch", "onnx"] = "torch"
    """What computes the networks; onnx needs exported artifacts and onnxruntime."""

    def controller(self, folder: Path) -> DeployedBBC:
        """The Basic Behaviour Controller, ready to run.

        Raises:
            ArtifactError: if the folder has none, or none that the backend can compute.
        """
        artifact = Artifact.load(folder, kind="bbc")
        network = onnx_network(artifact) if self.backend == "onnx" else torch_network(artifact)
        return DeployedBBC(network, artifact)

    def commander(self, bbc: DeployedBBC, eyes: DepthSource, otherwise: BehaviourCommand, now: float) -> Commander:
        """The student, or a constant command.

        Raises:
            ArtifactError: if it is no student, or was trained on another controller.
        """
        if self.task is None:
            return Operator(otherwise, now)
        artifact = Artifact.load(self.task, kind="student")
        network = onnx_student(artifact) if self.backend == "onnx" else torch_student(artifact)
        weights = bbc.manifest["weights"]["sha256"]
        return DeployedStudent(network, artifact, eyes, period=bbc.period, bbc_weights=weights)


def standing() -> BehaviourCommand:
    """What a robot does that nobody tells anything."""
    return BehaviourCommand.of("walk", velocity_x=0.0)


def load_camera(text: str) -> Any:
    """A camera of the user's own: ``MODULE:NAME``, called without arguments; files beside the working folder count.

    Raises:
        ValueError: if there is no such module or name, it does not come up, or what it gives has no ``latest()``.
    """
    module, _, name = text.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        camera = getattr(importlib.import_module(module), name)()
    except (ImportError, AttributeError, TypeError, ValueError, RuntimeError) as error:  # drivers raise the last
        raise ValueError(f"--camera: expected MODULE:NAME of a class or function, got {text!r}: {error}") from error
    finally:
        sys.path.pop(0)
    if not callable(getattr(camera, "latest", None)):
        raise ValueError(f"--camera: {text} made {type(camera).__name__}, expected something with latest()")
    return camera
