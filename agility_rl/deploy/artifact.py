"""The trained controller as a folder of two files: weights (safetensors) and what they mean (``manifest.json``).

The manifest is the contract between training and robot: what the network sees, in which order and unit; which joint
each output drives, and how. Loading checks all of it, because a wrong joint order or gain is a fall, no exception.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

import agility_rl
from agility_rl.go2 import constants, features

POLICY_FOLDER = "policy"
"""Where a run keeps its artifact."""
MANIFEST_FILE = "manifest.json"
FORMAT = "agility_rl.artifact"
FORMAT_VERSION = 2
"""What is written. Version 1 is read too: it had no limits, no normalisers and no checksum of the manifest itself."""
_PER_JOINT = ("default_pose", "action_scale", "stiffness", "damping")
_LIMITS = ("joint_lower", "joint_upper", "joint_speed", "joint_torque")
_SINCE_2 = ("limits", "normalisers")
REQUIRED = (
    *("kind", "observations", "joint_names", *_PER_JOINT, "control_period", "units", "versions", "data"),
    *_SINCE_2,
)
"""Entries that every manifest has; :func:`build_manifest` fills them."""
CHECKSUM = "manifest_sha256"
"""Entry with the checksum of all others."""


class ArtifactError(ValueError):
    """An artifact that is incomplete, damaged, or made for another robot."""


@dataclass(frozen=True)
class Artifact:
    """Weights of a controller together with their manifest.

    Source: no formula; design section 7, reference notes "what users ask for", entry 4.

    Attributes:
        state: tensors by name, as in ``state_dict``.
        manifest: JSON values; the entries of :data:`REQUIRED`, ``weights`` and whatever the recipe added.
        folder: where it lies.

    Example:
        >>> import tempfile
        >>> manifest = build_manifest("bbc", {"proprioception": [("roll_pitch", 2, "rad", 1.0)]}, control_period=0.02)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Artifact.save(folder, {"actor.bias": torch.zeros(12)}, manifest)
        ...     artifact = Artifact.load(folder, kind="bbc")
        >>> artifact.state["actor.bias"].shape, artifact.manifest["control_period"]
        (torch.Size([12]), 0.02)
    """

    state: dict[str, Tensor]
    manifest: dict[str, Any]
    folder: Path

    @classmethod
    def save(cls, folder: str | Path, state: Mapping[str, Tensor], manifest: Mapping[str, Any]) -> Artifact:
        """Write an artifact; until the last rename the folder still holds the previous one, complete.

        The weights are named after their own checksum, and the manifest names the weights: replacing the manifest is
        the one step that switches from old to new.

        Args:
            folder: created when missing.
            state: tensors by name; moved to the CPU.
            manifest: as :func:`build_manifest` returns.

        Raises:
            ArtifactError: if the manifest lacks an entry, contradicts itself, or a tensor is not finite.
        """
        folder = Path(folder)
        tensors = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in state.items()}
        if not tensors:
            raise ArtifactError("expected at least one tensor, got an empty state")
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                raise ArtifactError(
                    f"tensor {name!r} holds NaN or infinity; a controller with it must not leave training"
                )
        weights = save_tensors(tensors)
        digest = hashlib.sha256(weights).hexdigest()
        complete = json.loads(json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **manifest}))
        complete["weights"] = {
            "file": f"weights-{digest[:16]}.safetensors",
            "sha256": digest,
            "tensors": {name: [str(t.dtype).removeprefix("torch."), list(t.shape)] for name, t in tensors.items()},
        }
        complete[CHECKSUM] = manifest_checksum(complete)
        _check(complete, "the manifest")
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / complete["weights"]["file"], weights)
        _write(folder / MANIFEST_FILE, (json.dumps(complete, indent=2) + "\n").encode())
        for old in (*folder.glob("weights-*.safetensors"), *folder.glob(".weights-*.incoming")):  # of a killed save
            if old.name != complete["weights"]["file"]:
                old.unlink(missing_ok=True)
        return cls(tensors, complete, folder)

    @classmethod
    def load(cls, folder: str | Path, *, kind: str | None = None) -> Artifact:
        """Read an artifact and check it: format, completeness, joint order, checksums, and every tensor's shape.

        Args:
            folder: as given to :meth:`save`, or the run whose ``policy/`` it is.
            kind: refuse an artifact of another kind, such as a teacher where a BBC is expected.

        Raises:
            FileNotFoundError: if there is no manifest or no weights.
            ArtifactError: if anything disagrees; the message says what was expected, what was found, and what to do.
        """
        folder = Path(folder)
        if not (folder / MANIFEST_FILE).is_file() and (folder / POLICY_FOLDER / MANIFEST_FILE).is_file():
            folder = folder / POLICY_FOLDER
        path = folder / MANIFEST_FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"no artifact in {folder}: {MANIFEST_FILE} is missing; give the {POLICY_FOLDER}/ folder of a run, "
                "or the run itself"
            )
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(manifest, dict) and manifest.get("format_version") == 1:
                manifest = {**_implied(), **manifest}
            _check(manifest, str(path))
        except ArtifactError:
            raise
        except (ValueError, TypeError, AttributeError) as error:
            raise ArtifactError(f"{path} is damaged: {error}; export the policy again") from error
        if kind is not None and manifest["kind"] != kind:
            raise ArtifactError(f"{path}: expected an artifact of kind {kind!r}, got {manifest['kind']!r}")
        entry = manifest.get("weights", {})
        name = str(entry.get("file", ""))
        if not name or Path(name).name != name:
            raise ArtifactError(f"{path}: weights must be a file beside the manifest, got {name!r}")
        if not (folder / name).is_file():
            raise FileNotFoundError(
                f"{folder / name} is missing, though {MANIFEST_FILE} names it; copy the whole folder"
            )
        weights = (folder / name).read_bytes()
        if (digest := hashlib.sha256(weights).hexdigest()) != entry.get("sha256"):
            raise ArtifactError(
                f"{folder / name} ({len(weights)} bytes) has SHA-256 {digest[:12]}, "
                f"expected {str(entry.get('sha256'))[:12]}: truncated or altered; copy it again"
            )
        try:
            state = load_tensors(weights)
        except SafetensorError as error:
            raise ArtifactError(f"{folder / name} is no safetensors file: {error}") from error
        found = {key: [str(t.dtype).removeprefix("torch."), list(t.shape)] for key, t in state.items()}
        if found != entry.get("tensors"):
            raise ArtifactError(f"{folder / name}: its tensors differ from those the manifest lists; export it again")
        return cls(state, manifest, folder)

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Tensors below a prefix, without it: the ``state_dict`` of one module.

        Raises:
            ArtifactError: if there are none.
        """
        start = f"{prefix}."
        found = {name.removeprefix(start): tensor for name, tensor in self.state.items() if name.startswith(start)}
        if not found:
            known = sorted({name.split(".")[0] for name in self.state})
            raise ArtifactError(f"{self.folder} has no part {prefix!r}; it has {', '.join(known)}")
        return found

    def fill(self, module: nn.Module) -> None:
        """Load the weights into a module.

        Raises:
            ArtifactError: if they are those of another network; the module may then hold some of them.

        Example:
            >>> Artifact({"weight": torch.ones(1, 2)}, {}, Path("mine")).fill(nn.Linear(2, 1, bias=False))
        """
        try:
            module.load_state_dict(self.state)
        except RuntimeError as error:
            what = f"the weights are not those of the expected network: {' '.join(str(error).split())[:400]}"
            raise ArtifactError(f"{self.folder}: {what}") from error

    def check_layout(self, name: str, layout: Iterable[Sequence[Any]]) -> None:
        """Compare one observation's layout with the layout that the running code would feed.

        Args:
            name: observation, such as ``proprioception``.
            layout: entries ``(name, size, unit, scale, ...)``.

        Raises:
            ArtifactError: at the first entry that differs.
        """
        saved = self.manifest["observations"].get(name)
        if saved is None:
            raise ArtifactError(
                f"{self.folder} expects no observation {name!r}, only {', '.join(self.manifest['observations'])}"
            )
        here = describe_layout(layout)
        for index, (expected, got) in enumerate(zip(saved, here, strict=False)):
            if expected != got:
                raise ArtifactError(
                    f"{name!r} entry {index}: the controller was trained with {expected}, this code gives {got}"
                )
        if len(saved) != len(here):
            raise ArtifactError(
                f"{name!r}: the controller was trained with {len(saved)} entries, this code gives {len(here)}"
            )


def build_manifest(
    kind: str,
    observations: Mapping[str, Iterable[Sequence[Any]]],
    *,
    control_period: float,
    stiffness: Sequence[float] | float = constants.STIFFNESS,
    damping: Sequence[float] | float = constants.DAMPING,
    default_pose: Sequence[float] | Tensor = constants.DEFAULT_POSE,
    action_scale: Sequence[float] | Tensor = constants.ACTION_SCALE,
    joint_names: Sequence[str] = constants.JOINT_NAMES,
    limits: Mapping[str, Sequence[float]] | None = None,
    data: Sequence[str] = (),
    **extra: Any,
) -> dict[str, Any]:
    """Manifest of a Go2 controller.

    Args:
        kind: ``bbc``, ``teacher``, ``student``.
        observations: layout of every input, entries ``(name, size, unit, scale, ...)`` such as
            :data:`agility_rl.go2.features.PROPRIOCEPTION_LAYOUT`.
        control_period: seconds between two actions.
        stiffness: proportional gains [N·m/rad], one or 12.
        damping: derivative gains [N·m·s/rad], one or 12.
        default_pose: joint angles [rad] of action zero.
        action_scale: radians of one action unit, 12.
        joint_names: order of all joint quantities.
        limits: ``joint_lower``, ``joint_upper`` [rad], ``joint_speed`` [rad/s] and ``joint_torque`` [N·m], 12 each; the
            Go2's by default.
        data: names of the motion data used, and whether they are synthetic.
        **extra: further JSON values (network sizes, commands, training seed).

    Example:
        >>> build_manifest("bbc", {}, control_period=0.02)["joint_names"][0]
        'FL_hip_joint'
    """
    per_joint = {"stiffness": stiffness, "damping": damping, "default_pose": default_pose, "action_scale": action_scale}
    return {
        "kind": kind,
        "observations": {name: describe_layout(layout) for name, layout in observations.items()},
        "joint_names": list(joint_names),
        **{name: _twelve(value) for name, value in per_joint.items()},
        "control_period": float(control_period),
        "units": {
            "default_pose": "rad",
            "action_scale": "rad per action unit",
            "stiffness": "N·m/rad",
            "damping": "N·m·s/rad",
            "control_period": "s",
            "limits": "rad, rad, rad/s, N·m",
            "joint_target": "default_pose + action_scale * action",
        },
        "versions": _versions(),
        "data": list(data),
        **_implied(limits),
        **extra,
    }


def manifest_checksum(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest's entries, its own checksum left out; spaces and order in the file do not count.

    Example:
        >>> manifest_checksum({"a": 1, "b": 2}) == manifest_checksum({"b": 2, "a": 1, "manifest_sha256": "x"})
        True
    """
    rest = {name: value for name, value in manifest.items() if name != CHECKSUM}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def describe_layout(layout: Iterable[Sequence[Any]]) -> list[dict[str, Any]]:
    """Layout entries ``(name, size, unit, scale, ...)`` as JSON values.

    Example:
        >>> describe_layout([("roll_pitch", 2, "rad", 1.0)])
        [{'name': 'roll_pitch', 'size': 2, 'unit': 'rad', 'scale': 1.0}]
    """
    return [
        {"name": entry[0], "size": int(entry[1]), "unit": entry[2], "scale": float(entry[3]) if len(entry) > 3 else 1.0}
        for entry in layout
    ]


def _implied(limits: Mapping[str, Sequence[float]] | None = None) -> dict[str, Any]:
    """Entries that version 1 left to the code: limits of the robot, and how inputs are normalised."""
    robot = {
        "joint_lower": constants.JOINT_LOWER,
        "joint_upper": constants.JOINT_UPPER,
        "joint_speed": constants.VELOCITY_LIMIT,
        "joint_torque": constants.TORQUE_LIMIT,
    }
    return {
        "limits": {name: list(value) for name, value in {**robot, **(limits or {})}.items()},
        "normalisers": {
            "method": "each entry times its scale in observations, then clipped",
            "clip": features.OBSERVATION_LIMIT,
            "history": features.HISTORY,
            "contact_force": features.FOOT_CONTACT_FORCE,
            "peak_window": features.PEAK_WINDOW,
        },
    }


def _twelve(value: Sequence[float] | Tensor | float) -> list[float]:
    numbers = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(numbers, int | float):
        return [float(numbers)] * len(constants.JOINT_NAMES)
    return [float(number) for number in numbers]


def _check(manifest: Any, where: str) -> None:
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ArtifactError(f"{where} describes no {FORMAT}")
    version = manifest.get("format_version")
    if version not in (1, FORMAT_VERSION):
        raise ArtifactError(
            f"{where} has format version {version}, expected 1 or {FORMAT_VERSION}; it was made with "
            f"{manifest.get('versions', {})}; use that version of agility_rl, or export it again with this one"
        )
    if missing := [name for name in REQUIRED if name not in manifest]:
        raise ArtifactError(f"{where} lacks {', '.join(missing)}; make it with build_manifest")
    _check_joints(manifest, where)
    if not 0.0 < manifest["control_period"] <= 1.0:
        raise ArtifactError(f"{where}: control_period must be in (0, 1] s, got {manifest['control_period']}")
    for name, value in _implied()["normalisers"].items():
        if (found := manifest["normalisers"].get(name)) != value:
            raise ArtifactError(f"{where}: the controller was trained with {name} {found}, this code has {value}")
    if version != 1 and manifest.get(CHECKSUM) != (digest := manifest_checksum(manifest)):
        raise ArtifactError(
            f"{where} was altered: its entries have the checksum {digest[:12]}, expected "
            f"{str(manifest.get(CHECKSUM))[:12]}; copy it again, or export the policy again"
        )


def _check_joints(manifest: Mapping[str, Any], where: str) -> None:
    """Order of the joints, and numbers for each of them that a robot can have."""
    expected, joints = list(constants.JOINT_NAMES), manifest["joint_names"]
    if joints != expected:
        kind = "the same joints in another order" if sorted(joints) == sorted(expected) else "other joints"
        raise ArtifactError(f"{where} names {kind}: expected {expected}, got {joints}; convert it before use")
    if missing := [name for name in _LIMITS if name not in manifest["limits"]]:
        raise ArtifactError(f"{where}: limits lack {', '.join(missing)}; make it with build_manifest")
    entries = {name: manifest[name] for name in _PER_JOINT} | {name: manifest["limits"][name] for name in _LIMITS}
    for name, numbers in entries.items():
        if len(numbers) != len(expected) or not bool(torch.tensor(numbers, dtype=torch.float64).isfinite().all()):
            raise ArtifactError(f"{where}: {name} must be {len(expected)} finite numbers, got {numbers}")
    for name in ("action_scale", "stiffness", "joint_speed", "joint_torque"):
        if not all(number > 0.0 for number in entries[name]):
            raise ArtifactError(f"{where}: {name} must be positive, got {entries[name]}")
    if any(number < 0.0 for number in entries["damping"]):
        raise ArtifactError(f"{where}: damping must not be negative, got {entries['damping']}")
    bounds = zip(entries["joint_lower"], entries["default_pose"], entries["joint_upper"], expected)
    for lower, pose, upper, joint in bounds:
        if not lower <= pose <= upper:
            raise ArtifactError(f"{where}: default_pose of {joint} is {pose}, outside its stops {lower} and {upper}")


def _versions() -> dict[str, str]:
    found = {"agility_rl": agility_rl.__version__, "python": platform.python_version()}
    return found | {package: importlib.metadata.version(package) for package in ("torch", "safetensors")}


def _write(path: Path, content: bytes) -> None:
    """Replace a file in one step that survives a power cut."""
    staged = path.with_name(f".{path.name}.incoming")
    with open(staged, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(staged, path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
