"""One motion clip on the Go2 and what can be done to it alone: check, cut, resample, mirror, ground, store.

Joints FL, FR, RL, RR x (hip, thigh, calf), feet FL, FR, RL, RR, quaternions ``(w, x, y, z)``, world z up, SI units.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.go2.features import CONTACT_HEIGHT

CONTROL_DT = 0.02
"""Seconds between two frames once a clip is resampled to the control rate."""

_SHAPES: dict[str, tuple[int, ...]] = {
    "root_position": (3,),
    "root_quaternion": (4,),
    "joint_position": (12,),
    "root_linear_velocity": (3,),
    "root_angular_velocity": (3,),
    "joint_velocity": (12,),
    "foot_position": (4, 3),
    "foot_contact": (4,),
}


class MotionError(ValueError):
    """A motion file or clip that cannot be used; the message says what was expected, what was found, and where."""


@dataclass(frozen=True)
class MotionClip:
    """A motion of the Go2, ``T`` frames apart by ``dt``.

    Attributes:
        name: where it came from, usually the file's stem.
        dt: seconds between two frames.
        root_position: float32 ``[T, 3]`` [m], world.
        root_quaternion: float32 ``[T, 4]``, base to world.
        joint_position: float32 ``[T, 12]`` [rad].
        root_linear_velocity: float32 ``[T, 3]`` [m/s], world.
        root_angular_velocity: float32 ``[T, 3]`` [rad/s], world.
        joint_velocity: float32 ``[T, 12]`` [rad/s].
        foot_position: float32 ``[T, 4, 3]`` [m], centres of the foot spheres, world.
        foot_contact: bool ``[T, 4]``, sole lower than 25 mm.
        label: behaviour name, or None for unlabelled motion.
        weight: how often its frames are drawn relative to those of other clips.
        source: format or generator that it came from.
        synthetic: True if no animal moved like that.
        notes: what the reader found and changed.

    Raises:
        MotionError: if shapes disagree, a number is not finite, or there are fewer than two frames.

    Example:
        >>> standing = torch.tensor(constants.DEFAULT_POSE).expand(51, 12)
        >>> level = torch.tensor([1.0, 0, 0, 0]).expand(51, 4)
        >>> clip = clip_from_joints("stand", 0.02, torch.tensor([0, 0, 0.2884]).expand(51, 3), level, standing)
        >>> clip.duration, clip.foot_contact.all()
        (1.0, tensor(True))
    """

    name: str
    dt: float
    root_position: Tensor
    root_quaternion: Tensor
    joint_position: Tensor
    root_linear_velocity: Tensor
    root_angular_velocity: Tensor
    joint_velocity: Tensor
    foot_position: Tensor
    foot_contact: Tensor
    label: str | None = None
    weight: float = 1.0
    source: str = ""
    synthetic: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        validate(self)

    @property
    def num_frames(self) -> int:
        """Number of frames ``T``."""
        return int(self.root_position.shape[0])

    @property
    def duration(self) -> float:
        """Seconds from the first to the last frame."""
        return (self.num_frames - 1) * self.dt

    def with_notes(self, *notes: str) -> MotionClip:
        """The same clip with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def slice(self, start: int, stop: int | None = None) -> MotionClip:
        """Frames ``start`` to ``stop`` (exclusive) as a clip of their own."""
        part = slice(start, stop)
        return replace(self, **{name: getattr(self, name)[part] for name in _SHAPES})


def validate(clip: MotionClip) -> None:
    """Check shapes, finiteness, unit quaternions, length, time step and weight.

    Raises:
        MotionError: naming the clip, the field, and the first bad frame.
    """
    where = f"clip {clip.name!r}"
    if not (math.isfinite(clip.dt) and clip.dt > 0):
        raise MotionError(f"{where}: expected a positive time step in seconds, got {clip.dt}")
    if not (math.isfinite(clip.weight) and clip.weight >= 0):
        raise MotionError(f"{where}: expected a weight >= 0, got {clip.weight}")
    frames = clip.root_position.shape[0] if clip.root_position.ndim else 0
    if frames < 2:
        raise MotionError(f"{where}: expected at least 2 frames, got {frames}; a clip this short holds no motion")
    for name, tail in _SHAPES.items():
        value = getattr(clip, name)
        if tuple(value.shape) != (frames, *tail):
            raise MotionError(f"{where}: {name} expected shape {(frames, *tail)}, got {tuple(value.shape)}")
        finite = torch.isfinite(value).flatten(1).all(-1)
        if not bool(finite.all()):
            first = int((~finite).nonzero()[0])
            raise MotionError(f"{where}: {name} holds NaN or infinity, first in frame {first} of {frames}")
    norm = clip.root_quaternion.norm(dim=-1)
    if bool(((norm - 1).abs() > 1e-3).any()):
        first = int(((norm - 1).abs() > 1e-3).nonzero()[0])
        raise MotionError(f"{where}: root_quaternion expected length 1, got {norm[first]:.4f} in frame {first}")


def clip_from_joints(
    name: str,
    dt: float,
    root_position: Tensor,
    root_quaternion: Tensor,
    joint_position: Tensor,
    *,
    label: str | None = None,
    weight: float = 1.0,
    source: str = "",
    synthetic: bool = False,
    notes: tuple[str, ...] = (),
) -> MotionClip:
    """A clip from root pose and joint angles alone: velocities by central differences, feet by forward kinematics.

    Source: velocities from the stored poses, not from stored velocities, because the released loader turns those twice
    (method notes, section 4.6).

    Args:
        name: clip name.
        dt: seconds between two frames.
        root_position: ``[T, 3]`` [m].
        root_quaternion: ``[T, 4]``, any sign and length.
        joint_position: ``[T, 12]`` [rad].
        label: behaviour name or None.
        weight: sampling weight.
        source: format name.
        synthetic: True for generated motion.
        notes: findings of the reader.

    Raises:
        MotionError: if the result is no valid clip.

    Example:
        >>> standing = torch.tensor(constants.DEFAULT_POSE).expand(3, 12)
        >>> level = torch.tensor([1.0, 0, 0, 0]).expand(3, 4)
        >>> moving = torch.tensor([[0.0, 0, 0.29], [0.02, 0, 0.29], [0.04, 0, 0.29]])
        >>> clip_from_joints("walk", 0.02, moving, level, standing).root_linear_velocity[1]
        tensor([1., 0., 0.])
    """
    if joint_position.ndim != 2 or joint_position.shape[0] < 2:
        raise MotionError(
            f"clip {name!r}: expected at least 2 frames, got joints of shape {tuple(joint_position.shape)}"
        )
    root_quaternion = torch.nn.functional.normalize(root_quaternion.float(), dim=-1)
    root_quaternion = _continuous(root_quaternion)
    root_position, joint_position = root_position.float(), joint_position.float()
    feet = root_position[:, None] + rotations.rotate(root_quaternion[:, None], kinematics.forward(joint_position))
    return MotionClip(
        name=name,
        dt=float(dt),
        root_position=root_position.contiguous(),
        root_quaternion=root_quaternion.contiguous(),
        joint_position=joint_position.contiguous(),
        root_linear_velocity=central_difference(root_position, dt),
        root_angular_velocity=_angular_velocity(root_quaternion, dt),
        joint_velocity=central_difference(joint_position, dt),
        foot_position=feet,
        foot_contact=contacts(feet),
        label=label,
        weight=weight,
        source=source,
        synthetic=synthetic,
        notes=notes,
    )


def contacts(foot_position: Tensor) -> Tensor:
    """Which soles are lower than 25 mm, bool ``[*B, 4]``, from world foot centres ``[*B, 4, 3]``.

    Source: method notes, section 4.6.
    """
    return foot_position[..., 2] - constants.FOOT_RADIUS < CONTACT_HEIGHT


def central_difference(value: Tensor, dt: float) -> Tensor:
    """Time derivative ``[T, D]`` by central differences, one-sided at both ends.

    Example:
        >>> central_difference(torch.tensor([[0.0], [1.0], [4.0]]), 1.0).flatten()
        tensor([1., 2., 3.])
    """
    inner = (value[2:] - value[:-2]) / (2 * dt)
    return torch.cat(((value[1:2] - value[:1]) / dt, inner, (value[-1:] - value[-2:-1]) / dt))


def _angular_velocity(quaternion: Tensor, dt: float) -> Tensor:
    """World angular velocity ``[T, 3]`` of a sequence of orientations ``[T, 4]``."""
    inner = rotations.difference(quaternion[:-2], quaternion[2:]) / (2 * dt)
    first = rotations.difference(quaternion[:1], quaternion[1:2]) / dt
    last = rotations.difference(quaternion[-2:-1], quaternion[-1:]) / dt
    return torch.cat((first, inner, last))


def _continuous(quaternion: Tensor) -> Tensor:
    """The same orientations with signs chosen so that neighbours lie on the same half sphere."""
    flips = (quaternion[1:] * quaternion[:-1]).sum(-1) < 0
    odd = torch.cat((flips.new_zeros(1), flips)).cumsum(0) % 2 == 1
    return torch.where(odd[:, None], -quaternion, quaternion)


def save(clip: MotionClip, path: str | Path) -> Path:
    """Write a clip as ``.npz`` without pickled objects; :func:`load` reads it back.

    Returns:
        The path written, which ends in ``.npz``.
    """
    path = Path(path)
    path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")  # walk_0.3 has no suffix
    arrays = {name: getattr(clip, name).numpy() for name in _SHAPES}
    scalars = {
        f.name: np.asarray(getattr(clip, f.name) or "") for f in fields(clip) if f.name in ("name", "label", "source")
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        allow_pickle=False,
        **arrays,
        **scalars,
        dt=np.float64(clip.dt),
        weight=np.float64(clip.weight),
        synthetic=np.bool_(clip.synthetic),
        notes=np.asarray(clip.notes, dtype=np.str_),
    )
    return path


def load(path: str | Path) -> MotionClip:
    """Read a clip that :func:`save` wrote.

    Raises:
        MotionError: if a field is missing or the file is no such archive.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            data = {key: archive[key] for key in archive.files}
    except OSError as error:
        raise MotionError(f"{path}: expected an .npz archive of a clip, got: {error}") from error
    except (ValueError, EOFError, TypeError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise MotionError(
            f"{path}: expected an .npz archive of a clip, written by save(); it is damaged, or something else"
        ) from error
    missing = sorted({*_SHAPES, "name", "dt"} - data.keys())
    if missing:
        raise MotionError(f"{path}: expected the arrays of a clip, {', '.join(missing)} missing; write it with save()")
    try:
        arrays = {name: torch.from_numpy(data[name]) for name in _SHAPES}
        return MotionClip(
            name=str(data["name"]),
            dt=float(data["dt"]),
            label=str(data.get("label", "")) or None,
            weight=float(data.get("weight", 1.0)),
            source=str(data.get("source", "npz")),
            synthetic=bool(data.get("synthetic", False)),
            notes=tuple(str(note) for note in data.get("notes", ())),
            **{name: array.float() if array.is_floating_point() else array for name, array in arrays.items()},
        )
    except TypeError as error:
        raise MotionError(f"{path}: expected numbers in the arrays of a clip, got {error}") from error
