"""The Task-Specific Controller at run time: a student that looks, remembers, and decides what the robot does next."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn

from agility_rl import behaviours, keys
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.commander import BehaviourCommand, Perception
from agility_rl.deploy.depth import DepthPreprocessor, DepthSource
from agility_rl.deploy.networks import load_network
from agility_rl.deploy.onnx import onnx_session
from agility_rl.go2 import camera, features
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.placed_memory import memory_parts
from agility_rl.modules.student import PERCEIVED_HEADING, PERCEIVED_OBSTACLE, PERCEIVED_PLACE

StudentNet = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]
"""Depth [1, 58, 87], its age [1, 1] in s, proprioception [1, 45], history [1, 10, 45] and memory [1, H] to logits
[1, 5], parameters [1, 5, 6], heading errors [1, 2], obstacle logits [1, K] and the memory of the next step [1, H]."""

INPUTS = (keys.DEPTH, keys.IMAGE_AGE, keys.PROPRIOCEPTION, keys.HISTORY, keys.HIDDEN)
OUTPUTS = ("logits", "parameters", "heading", "obstacle", "memory")


class StudentNetwork(nn.Module):
    """One step of a student as one plain network, without TensorDicts: for the robot.

    Computes what ``student.policy()`` does with deterministic actions; the memory goes in and comes out, and an episode
    begins with zeros.

    Source: supplement S6.

    Args:
        student: trained student, whose modules are shared, not copied.

    Example:
        >>> student = RecurrentStudent(memory=16, hidden=(8,))
        >>> network = StudentNetwork(student)
        >>> outputs = network(*example_inputs(16))
        >>> [tuple(output.shape) for output in outputs]
        [(1, 5), (1, 5, 6), (1, 2), (1, 7), (1, 16)]
    """

    def __init__(self, student: RecurrentStudent) -> None:
        super().__init__()
        self.encoder: nn.Module = student.depth_encoder.module
        self.memory: Any = student.memory
        self.estimator: nn.Module = student.estimator.module
        self.history_encoder: nn.Module = student.history_encoder.module
        self.actor = student.actor.network
        self.measured, self.order = student.measured, list(student.actor[0].in_keys)
        self.estimated = list(student.estimator.in_keys)

    def forward(
        self, depth: Tensor, age: Tensor, proprioception: Tensor, history: Tensor, hidden: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Logits, parameters, heading errors [rad], obstacle logits, memory."""
        known = dict(zip(INPUTS[:-1], (depth, age, proprioception, history), strict=True))
        known[keys.ESTIMATE] = self.estimator(*(known[name] for name in self.estimated))
        latent, heading, obstacle, after, *places = self.memory.step(
            self.encoder(depth), *(known[name] for name in self.measured), hidden
        )
        inputs = {
            **known,
            PERCEIVED_HEADING: heading,
            PERCEIVED_OBSTACLE: nn.functional.one_hot(obstacle.argmax(-1), obstacle.shape[-1]).to(obstacle.dtype),
            keys.TERRAIN_LATENT: latent,
            keys.LATENT: self.history_encoder(history),
        }
        if places:
            inputs[PERCEIVED_PLACE] = places[0]
        logits, parameters, _ = self.actor(*(inputs[name] for name in self.order))
        return logits, parameters, heading, obstacle, after


class DeployedStudent:
    """A :class:`~agility_rl.deploy.commander.Commander` that decides by depth images.

    It looks at the newest image when a decision is due and keeps to the decision until the next one, at the rate that
    it was trained with. Its memory and history begin anew with :meth:`reset`. How old the newest image is, it reports
    to the safety checks by :meth:`sources`; an image that cannot be used raises, which ends in damping.

    Source: supplement, sections S3 and S6; commands from parameters: Table S2 (a canter may be faster, as its manifest
    says) and method notes, section 5.1.

    Args:
        network: :func:`torch_student` or :func:`onnx_student`.
        artifact: of the same student.
        eyes: where images come from.
        period: control step of the behaviour controller [s].
        bbc_weights: SHA-256 of its weights; another than the student was trained with is refused.

    Attributes:
        heading: ``[2]``, perceived heading errors to the way-point and the next one [rad].
        obstacle: index of the perceived type of obstacle.

    Raises:
        ArtifactError: if it was trained with another behaviour controller.
        ValueError: if it commands canters that there are none of.

    Example:
        >>> import tempfile
        >>> from agility_rl.deploy.artifact import build_manifest
        >>> from agility_rl.deploy.depth import StillImage
        >>> from agility_rl.deploy.transport import RobotState
        >>> student = RecurrentStudent(memory=16, hidden=(8,), encoder_hidden=8)
        >>> manifest = build_manifest("student", features.CONTROLLER_LAYOUTS, control_period=0.1,
        ...     network=student.settings, camera=describe_camera(), bbc="abc")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     artifact = Artifact.save(folder, student.state_dict(), manifest)
        >>> task = DeployedStudent(torch_student(artifact), artifact, StillImage(2.0), period=0.02, bbc_weights="abc")
        >>> task.steps, task.decide(Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))).name in (
        ...     behaviours.BEHAVIOURS)
        (5, True)
    """

    def __init__(
        self, network: StudentNet, artifact: Artifact, eyes: DepthSource, *, period: float, bbc_weights: str
    ) -> None:
        expected = str(artifact.manifest.get("bbc"))
        if expected != bbc_weights:
            raise ArtifactError(
                f"{artifact.folder} was trained on the BBC {expected[:12]}, but the robot runs {bbc_weights[:12]}; "
                "give the artifact of that one"
            )
        self.network = network
        self.eyes, self.steps = eyes, max(1, round(artifact.manifest["control_period"] / period))
        self._bounds = behaviours.command_bounds(fastest_canter=fastest_canter(artifact))
        self._memory_size = memory_size(artifact)
        self._preprocess = DepthPreprocessor()
        with torch.inference_mode():
            for _ in range(10):  # the first calls allocate
                network(*example_inputs(self._memory_size))
        self.reset()

    def reset(self) -> None:
        """Forget everything: the robot is about to start."""
        self.heading, self.obstacle = torch.zeros(2), 0
        self._hidden = torch.zeros(1, self._memory_size)
        self._history: Tensor | None = None
        self._command: BehaviourCommand | None = None
        self._count = 0

    @torch.inference_mode()
    def decide(self, perception: Perception) -> BehaviourCommand:
        """The command of this control step; a new one when a decision is due.

        Raises:
            RuntimeError: if no image has arrived yet.
            ValueError: if the image cannot be used (:class:`~agility_rl.deploy.depth.DepthPreprocessor`).
        """
        present = perception.proprioception
        if self._history is None:
            self._history = present.expand(features.HISTORY, -1).clone()
        else:
            self._history = torch.cat((self._history[1:], present[None]))
        if self._command is None or self._count % self.steps == 0:
            self._command = self._look(perception)
        self._count += 1
        return self._command

    def _look(self, perception: Perception) -> BehaviourCommand:
        frame = self.eyes.latest()
        if frame is None:
            raise RuntimeError("the student has to decide and no depth image has arrived; is the camera running?")
        assert self._history is not None
        depth = self._preprocess(frame.image)[None]
        age = torch.tensor([[max(0.0, perception.time - frame.time)]])
        logits, parameters, heading, obstacle, self._hidden = self.network(
            depth, age, perception.proprioception[None], self._history[None], self._hidden
        )
        self.heading, self.obstacle = heading[0], int(obstacle[0].argmax())
        skill = logits.argmax(-1)
        command, shift = behaviours.commands_from_parameters(skill, parameters[:, int(skill)], self._bounds)
        return BehaviourCommand(int(skill), command[0], float(shift[0]))

    def sources(self) -> Mapping[str, float]:
        """When the newest image was taken [s]."""
        frame = self.eyes.latest()
        return {"depth": -math.inf if frame is None else frame.time}


def memory_size(artifact: Artifact) -> int:
    """Numbers that a student remembers: the units of its GRU and, if it infers a place, all that it knows of that."""
    network = artifact.manifest["network"]
    units = int(network["memory"])
    if not network.get("num_place"):
        return units
    points = network["way_points"]
    return sum(memory_parts(units, sum(map(len, network["routes"])), len(points[0]), len(points)))


def fastest_canter(artifact: Artifact) -> float:
    """What the forward speed of its canters ends at [m/s]: Table S2's, unless the manifest says otherwise.

    Raises:
        ArtifactError: if the manifest says what is no number.
    """
    said = artifact.manifest.get("fastest_canter", behaviours.FASTEST_CANTER)
    if isinstance(said, bool) or not isinstance(said, int | float):
        raise ArtifactError(f"{artifact.folder}: expected fastest_canter in m/s in the manifest, got {said!r}")
    return float(said)


def example_inputs(memory: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Zeros in the shapes that the network of a student with so large a memory takes."""
    size = features.NUM_PROPRIOCEPTION
    image = torch.zeros(1, camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)
    history = torch.zeros(1, features.HISTORY, size)
    return image, torch.zeros(1, 1), torch.zeros(1, size), history, torch.zeros(1, memory)


def torch_student(artifact: Artifact) -> StudentNetwork:
    """The network of an artifact, by PyTorch.

    Raises:
        ArtifactError: if it is no student, its images were others, or the weights are not those of its network.
    """
    check_student(artifact)
    student = load_network(RecurrentStudent, artifact)
    return StudentNetwork(student.eval().requires_grad_(False))


def onnx_student(artifact: Artifact) -> StudentNet:
    """The network of an artifact, by onnxruntime on one thread.

    Raises:
        ArtifactError: if it is no student, or has no ONNX file that was checked at the export.
        ImportError: if onnxruntime is not installed.
    """
    check_student(artifact)
    return cast(StudentNet, onnx_session(artifact, INPUTS, OUTPUTS))


def check_student(artifact: Artifact) -> None:
    """Refuse what is no student of this code's camera and observations.

    Raises:
        ArtifactError: naming what differs.
    """
    manifest = artifact.manifest
    if manifest["kind"] != "student" or "network" not in manifest:
        raise ArtifactError(
            f"{artifact.folder}: expected a student of tsc_student.py, got an artifact of kind {manifest['kind']!r}; "
            "a teacher needs what only a simulation knows"
        )
    artifact.check_layout(keys.PROPRIOCEPTION, features.PROPRIOCEPTION_LAYOUT)
    check_camera(artifact)


def describe_camera() -> dict[str, Any]:
    """The camera and what becomes of its images, for the manifest of a student.

    Example:
        >>> describe_camera()["image"]
        [58, 87]
    """
    return {
        "sensor": [camera.SENSOR_HEIGHT, camera.SENSOR_WIDTH],
        "downsampling": camera.DOWNSAMPLING,
        "crop": [camera.CROP_TOP, camera.CROP_BOTTOM, camera.CROP_LEFT, camera.CROP_RIGHT],
        "image": [camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH],
        "horizontal_field": camera.HORIZONTAL_FIELD,
        "position": list(camera.POSITION),
        "depth_range": [camera.DEPTH_NEAR, camera.DEPTH_FAR],
        "normalised": "(clip(z, near, far) - near) / (far - near) - 0.5",
        "units": "rows and columns; rad; m in the trunk's frame",
    }


def check_camera(artifact: Artifact) -> None:
    """Refuse a student whose images were others.

    Raises:
        ArtifactError: at the first number that differs.
    """
    saved = artifact.manifest.get("camera", {})
    for name, here in describe_camera().items():
        if saved.get(name) != here:
            raise ArtifactError(
                f"{artifact.folder}: the student was trained with images of {name} {saved.get(name)}, this code's "
                f"camera has {here}; use the release that wrote it, or train the student again"
            )
