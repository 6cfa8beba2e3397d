"""One door for every motion format: what a file is, is read off its extension and first columns.

Formats: 61-column and 19-column JSON (``.json``, ``.txt``), MimicKit pickle (``.pkl``), our archive (``.npz``), BVH of
the MANN dog (``.bvh``), keypoint tables of the same recordings (``*_joint_pos.txt``, ``.csv``).
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.motion import clip as clips
from agility_rl.motion.clip import CONTROL_DT, MotionClip, MotionError
from agility_rl.motion.edit import ground, resample
from agility_rl.motion.gait_analysis import classify_gait, measure_clip
from agility_rl.motion.motion_json import read_frames
from agility_rl.motion.sixty_one import read_sixty_one

FROM_NAME = "from name"
"""Label that stands for the behaviour a file is named after, as in ``trot_0.json``."""

FROM_GAIT = "from gait"
"""Label that stands for the behaviour the feet show; a clip that shows none of the five stays unlabelled."""

_EXTENSIONS = (".json", ".txt", ".csv", ".pkl", ".npz", ".bvh")
_NOT_MOTION = re.compile(r"licen[cs]e|readme|_info(\.|$)|_pose\.txt$|sha256", re.IGNORECASE)


def label_from_name(path: str | Path) -> str:
    """Behaviour that a file is named after: the letters before its first underscore, digit or dot.

    Raises:
        MotionError: if that word is none of the five behaviours.

    Example:
        >>> label_from_name("clips/canter_3.json")
        'canter'
    """
    word = re.split(r"[_\d.]", Path(path).name)[0].lower()
    if word not in BEHAVIOURS:
        raise MotionError(
            f"{path}: label {word!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)} before the first "
            f"underscore or digit of the name, or give the label explicitly"
        )
    return word


def load_clip(
    path: str | Path,
    *,
    label: str | None = None,
    dt: float | None = CONTROL_DT,
    grounding: float | None = 1.0,
) -> MotionClip:
    """Read one motion file of any supported format, at 50 Hz and with the feet on the floor.

    Args:
        path: motion file.
        label: behaviour name, ``"from name"``, ``"from gait"``, or None for unlabelled motion; with None an
            ``.npz`` keeps its own.
        dt: seconds between two frames of the result; None keeps the file's.
        grounding: seconds of the window in which the floor is found; None leaves the height as stored.

    Raises:
        MotionError: if the file is missing, damaged, of no known format or leg order, or the label is no behaviour.

    Example:
        >>> import tempfile
        >>> from agility_rl.motion import synthesize_gait
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = clips.save(synthesize_gait("trot"), f"{folder}/trot_0.npz")
        ...     load_clip(path, label="from name").label
        'trot'
    """
    path = Path(path)
    if not path.is_file():
        raise MotionError(f"{path}: expected a motion file, found {'a folder' if path.is_dir() else 'nothing'}")
    if label == FROM_NAME:
        label = label_from_name(path)
    elif label not in (None, FROM_GAIT, *BEHAVIOURS):
        raise MotionError(f"{path}: label {label!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)}")
    clip = _read(path)
    if label in BEHAVIOURS:
        clip = replace(clip, label=label)
    if dt is not None:
        clip = resample(clip, dt)
    if grounding is not None:
        clip = ground(clip, grounding)
    if label == FROM_GAIT:
        try:
            gait = classify_gait(measure_clip(clip))
        except ValueError as error:
            raise MotionError(f"{path}: {error}") from error
        clip = replace(clip, label=gait if gait in BEHAVIOURS else None)
        clip = clip.with_notes(f"the feet show {gait}")
    return clip


def load_clips(
    path: str | Path,
    *,
    label: str | None = None,
    dt: float | None = CONTROL_DT,
    grounding: float | None = 1.0,
) -> list[MotionClip]:
    """Read a file, or every motion file of a folder and its subfolders, sorted by path.

    Licences, readmes and pose tables that double the keypoint tables are passed over.

    Raises:
        MotionError: if the folder is missing or holds no motion, or if one file cannot be read.

    Example:
        >>> load_clips("no/such/folder")
        Traceback (most recent call last):
        ...
        agility_rl.motion.clip.MotionError: no/such/folder: expected a motion file or a folder of them, found ...
    """
    path = Path(path)
    if not path.exists():
        raise MotionError(f"{path}: expected a motion file or a folder of them, found nothing; check the path")
    if path.is_file():
        return [load_clip(path, label=label, dt=dt, grounding=grounding)]
    return [load_clip(file, label=label, dt=dt, grounding=grounding) for file in motion_files(path)]


def motion_files(folder: Path) -> list[Path]:
    """Every motion file of a folder and its subfolders, sorted by path; licences, readmes and the like passed over.

    Raises:
        MotionError: if there is none.
    """
    files = sorted((file for file in folder.rglob("*") if _is_motion(file)), key=_natural)
    if not files:
        raise MotionError(f"{folder}: expected motion files ({', '.join(_EXTENSIONS)}), found none in this folder")
    return files


def _is_motion(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in _EXTENSIONS and not _NOT_MOTION.search(path.name)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts ``2.json`` before ``10.json``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.as_posix())]


def _read(path: Path) -> MotionClip:
    """The clip in a file as it stands there; each reader is imported when a file needs it."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return clips.load(path)
    if suffix == ".pkl":
        from agility_rl.motion.mimickit import read_mimickit

        return read_mimickit(path)
    if suffix == ".bvh":
        from agility_rl.motion.bvh import read_bvh_clip

        return read_bvh_clip(path)
    if suffix not in _EXTENSIONS:
        raise MotionError(f"{path}: no known motion format; expected one of {', '.join(_EXTENSIONS)}")
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        start = file.read(64).lstrip()
    if suffix != ".json" and not start.startswith("{"):
        from agility_rl.motion.keypoints import read_keypoint_clip

        return read_keypoint_clip(path)
    frame_duration, frames = read_frames(path)
    if frames.shape[1] == 61:
        return read_sixty_one(path, frame_duration, frames)
    from agility_rl.motion.nineteen import read_nineteen

    return read_nineteen(path, frame_duration, frames)
