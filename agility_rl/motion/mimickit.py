"""Reader of MimicKit pickles for the Go2, through an unpickler that can build nothing but plain containers and numbers.

A file is ``{"loop_mode", "fps", "frames": n x 18}``: root position 3, root rotation vector 3, joints 12. No feet are
stored; the legs come as FL, FR, RL, RR by MimicKit's model of the robot. The reader measures how far the feet slip that
way and with the legs mirrored, and says which fits the path better.

Source: data notes, sections B.1 and C.
"""

from __future__ import annotations

import io
import math
import pickle
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from agility_rl.go2.mirror import mirror_joints
from agility_rl.motion.clip import MotionClip, MotionError, clip_from_joints
from agility_rl.motion.edit import foot_slip, ground

NUM_COLUMNS = 18


class PlainUnpickler(pickle.Unpickler):
    """Unpickler that refuses every class and function: a file cannot make it run code."""

    def find_class(self, module: str, name: str) -> NoReturn:
        """Refuse, whatever is asked for.

        Raises:
            MotionError: always.
        """
        raise MotionError(
            f"the pickle asks for {module}.{name}; only dict, list, str and numbers are read from motion files; "
            "save arrays with .tolist() and their numbers with float()"
        )


def load_plain_pickle(path: str | Path) -> Any:
    """The plain containers and numbers in a pickle file.

    Raises:
        MotionError: if the file asks for any class or function, or is damaged.
    """
    path = Path(path)
    try:
        return PlainUnpickler(io.BytesIO(path.read_bytes())).load()
    except MotionError as error:
        raise MotionError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle raises almost anything
        raise MotionError(f"{path}: expected a pickled motion, the file is damaged or none: {error}") from error


def read_mimickit(path: str | Path) -> MotionClip:
    """Read one MimicKit pickle of the Go2 at its own frame rate.

    Raises:
        MotionError: if it is no plain pickle of that form.
    """
    path = Path(path)
    data = load_plain_pickle(path)
    if not isinstance(data, dict) or not {"fps", "frames"} <= data.keys():
        raise MotionError(f"{path}: expected a dict with 'fps' and 'frames', got {type(data).__name__}")
    rows = data["frames"]
    if not isinstance(rows, list) or len(rows) < 2:
        raise MotionError(f"{path}: expected a list of at least 2 frames, got {_size(rows)}: a clip of zero length")
    for index, row in enumerate(rows):
        if not isinstance(row, list) or len(row) != NUM_COLUMNS:
            raise MotionError(f"{path}: frame {index} expected {NUM_COLUMNS} columns, got {_size(row)}")
    try:
        frames = torch.tensor(rows, dtype=torch.float64)
        rate = float(data["fps"])
    except (TypeError, ValueError) as error:
        raise MotionError(f"{path}: expected numbers in 'frames' and 'fps', got {error}") from error
    if not (math.isfinite(rate) and rate > 0):
        raise MotionError(f"{path}: expected a positive 'fps', got {rate}")
    clip = clip_from_joints(
        path.stem,
        1.0 / rate,
        frames[:, :3],
        quaternion_from_rotation_vector(frames[:, 3:6]),
        frames[:, 6:],
        source="MimicKit",
        notes=("18 columns, joints FL,FR,RL,RR by MimicKit's model; no feet stored to verify them",),
    )
    return _with_slip_note(clip)


def quaternion_from_rotation_vector(vector: Tensor) -> Tensor:
    """Unit quaternions ``[*B, 4]`` of rotation vectors ``[*B, 3]`` [rad].

    Example:
        >>> quaternion_from_rotation_vector(torch.tensor([0.0, 0.0, math.pi / 2])).round(decimals=4)
        tensor([0.7071, 0.0000, 0.0000, 0.7071])
    """
    half = vector / 2
    angle = half.norm(dim=-1, keepdim=True)
    # sinc takes its argument in units of pi and is exact at zero.
    return torch.cat((torch.cos(angle), half * torch.sinc(angle / math.pi)), -1)


def _with_slip_note(clip: MotionClip) -> MotionClip:
    """The clip with a note on how far the feet slip with legs as stored and with left and right exchanged."""
    stored = foot_slip(ground(clip)).mean
    swapped = clip_from_joints(
        clip.name, clip.dt, clip.root_position, clip.root_quaternion, mirror_joints(clip.joint_position)
    )
    mirrored = foot_slip(ground(swapped)).mean
    verdict = "the stored order fits the path" if stored <= mirrored else "left and right look exchanged: doubtful"
    note = f"feet slip {stored:.2f} m/s as stored, {mirrored:.2f} m/s with the legs mirrored: {verdict}"
    return clip.with_notes(note)


def _size(value: object) -> str:
    return str(len(value)) if isinstance(value, list) else type(value).__name__
