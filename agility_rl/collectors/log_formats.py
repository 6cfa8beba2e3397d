"""The on-disk form of a robot log, in three file types that carry the same named columns.

A log is a table with one row a control step. Columns come in groups:

===================== ======= ============================= ====================================================
group                 columns unit                          meaning
===================== ======= ============================= ====================================================
time                  1       s                             increasing, at any origin (MCAP: from 0 on)
joint_position        12      rad                           columns are the joints' names
joint_velocity        12      rad/s                         columns are the joints' names
roll_pitch            2       rad                           ``roll, pitch``; or a quaternion instead
quaternion            4       1                             ``w, x, y, z``, base to world; or roll_pitch instead
angular_velocity      3       rad/s, base frame             ``x, y, z``, of the gyroscope
linear_acceleration   3       m/s^2, base frame             ``x, y, z``, of the accelerometer; optional
action                12      action units                  (joint target - default pose) / action scale, held from
                                                            this row's time to the next; columns are joints' names
start                 1       0 or 1                        optional; 1 where the robot was put back or the recording
                                                            was interrupted: no transition leads into such a row
===================== ======= ============================= ====================================================

* **CSV**: one header line; columns are named ``time``, ``start``, and ``GROUP.COLUMN``, such as ``roll_pitch.roll`` or
  ``joint_position.FL_hip_joint``.
* **npz**: an array ``[T, columns]`` for every group, ``time`` and ``start`` ``[T]``, and ``joint_names`` [12]; without
  pickled objects.
* **MCAP**: Foxglove ``JointStates`` on ``/joint_states`` (position and velocity by joint name), and one message with
  the group's column names on ``/roll_pitch`` (or ``/quaternion``), ``/angular_velocity``, ``/linear_acceleration``,
  ``/action`` and ``/start``, all at one log time a row.

Joints have the order of :data:`agility_rl.go2.constants.JOINT_NAMES`. Files with another one are refused, not guessed.
"""

from __future__ import annotations

import csv
import os
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap_protobuf.writer import Writer
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.record.messages import DamageError, message_type, read_messages

AXES = ("x", "y", "z")
GROUPS: dict[str, tuple[str, ...]] = {
    "joint_position": constants.JOINT_NAMES,
    "joint_velocity": constants.JOINT_NAMES,
    "roll_pitch": ("roll", "pitch"),
    "quaternion": ("w", *AXES),
    "angular_velocity": AXES,
    "linear_acceleration": AXES,
    "action": constants.JOINT_NAMES,
}
"""Columns of every group of more than one."""

JOINT_STATES = "/joint_states"
SUFFIXES = (".mcap", ".csv", ".npz")


class RobotLogError(ValueError):
    """A robot log that cannot be used; the message says what was expected and found, and in which row or field."""


def read_columns(path: str | Path) -> dict[str, Tensor]:
    """Groups of a log file, only their names checked: ``time`` float64 ``[T]``, the others float32 ``[T, columns]``.

    Raises:
        FileNotFoundError: if there is no such file.
        RobotLogError: if the file is damaged, of another type, or its joints are others or in another order.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise RobotLogError(f"{path}: expected a robot log ending in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise FileNotFoundError(f"no robot log at {path}")
    groups = {".mcap": _read_mcap, ".csv": _read_csv, ".npz": _read_npz}[path.suffix](path)
    if "time" not in groups:
        raise RobotLogError(f"{path} has no time; it has {', '.join(sorted(groups)) or 'nothing'}")
    return {
        name: torch.from_numpy(np.asarray(value, dtype=np.float64 if name == "time" else np.float32))
        for name, value in groups.items()
    }


def write_columns(path: str | Path, groups: Mapping[str, Tensor]) -> Path:
    """Write groups as :func:`read_columns` returns them; the file takes its name when it is complete.

    Raises:
        RobotLogError: if the file type is another, or cannot hold the times.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise RobotLogError(f"{path}: a robot log must end in {', '.join(SUFFIXES)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    staged = path.with_name(f".{path.stem}.incoming{path.suffix}")
    arrays = {name: value.detach().cpu().numpy() for name, value in groups.items()}
    if path.suffix == ".mcap" and (arrays["time"] < 0.0).any():
        raise RobotLogError(
            f"{path}: time begins at {arrays['time'].min():.3f} s, MCAP knows none before 0; shift it, or write .npz"
        )
    {".mcap": _write_mcap, ".csv": _write_csv, ".npz": _write_npz}[path.suffix](staged, arrays)
    os.replace(staged, path)
    return path


def check_names(where: str, found: Sequence[str], expected: Sequence[str]) -> None:
    """Refuse columns that are missing, unknown, or in another order.

    Raises:
        RobotLogError: naming the first column that differs.

    Example:
        >>> check_names("a log: angular_velocity", ["y", "x", "z"], AXES)
        Traceback (most recent call last):
        ...
        agility_rl.collectors.log_formats.RobotLogError: a log: angular_velocity is in another order: column 0 is 'y',
        expected 'x'; convert it before use
    """
    found = list(found)
    if found == list(expected):
        return
    if sorted(found) == sorted(expected):
        index = next(i for i, (a, b) in enumerate(zip(found, expected)) if a != b)
        raise RobotLogError(
            f"{where} is in another order: column {index} is {found[index]!r}, expected {expected[index]!r}; "
            "convert it before use"
        )
    missing, unknown = [n for n in expected if n not in found], [n for n in found if n not in expected]
    if missing:
        raise RobotLogError(f"{where} lacks {missing[0]!r}; it has {len(found)} columns, expected {len(expected)}")
    raise RobotLogError(f"{where} has {unknown[0] if unknown else found[-1]!r} once too often or unexpectedly")


# CSV -----------------------------------------------------------------------------------------------------------------
def _read_csv(path: Path) -> dict[str, Any]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except UnicodeDecodeError as error:
        raise RobotLogError(f"{path} is no text in UTF-8: {error}") from error
    except csv.Error as error:
        raise RobotLogError(f"{path} is no CSV file: {error}; look for a stray quotation mark") from error
    if not rows:
        raise RobotLogError(f"{path} is empty")
    header = [name.strip() for name in rows[0]]
    table = np.empty((len(rows) - 1, len(header)))
    for index, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise RobotLogError(f"{path}: row {index} has {len(row)} values, expected {len(header)} as in the header")
        for column, text in enumerate(row):
            try:
                table[index, column] = float(text)
            except ValueError:
                raise RobotLogError(f"{path}: row {index}, {header[column]}: expected a number, got {text!r}") from None
    members: dict[str, list[int]] = {}
    for column, name in enumerate(header):
        members.setdefault(name.partition(".")[0], []).append(column)
    groups: dict[str, Any] = {}
    for group, columns in members.items():
        if group in GROUPS:
            check_names(f"{path}: {group}", [header[c].partition(".")[2] for c in columns], GROUPS[group])
            groups[group] = table[:, columns]
        elif group in ("time", "start"):
            groups[group] = table[:, columns[0]]
    return groups


def _write_csv(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    header, columns = [], []
    for group, values in arrays.items():
        digits = 17 if group == "time" else 9  # enough to bring every bit of a float64, or float32, back
        names = [f"{group}.{name}" for name in GROUPS[group]] if group in GROUPS else [group]
        header += names
        columns += [[f"{value:.{digits}g}" for value in column] for column in values.reshape(len(values), -1).T]
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *zip(*columns, strict=True)])


# npz -----------------------------------------------------------------------------------------------------------------
def _read_npz(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise RobotLogError(f"{path} is damaged or no npz file: {reason}") from error
    if "joint_names" not in arrays:
        raise RobotLogError(f"{path} has no joint_names; without them the order of its joints cannot be checked")
    check_names(f"{path}: joint_names", [str(name) for name in arrays["joint_names"].flat], constants.JOINT_NAMES)
    known = {name: value for name, value in arrays.items() if name in GROUPS or name in ("time", "start")}
    for name, value in known.items():
        if value.ndim < (2 if name in GROUPS else 1):
            raise RobotLogError(f"{path}: {name} must have a row for each control step, got the shape {value.shape}")
        if not np.issubdtype(value.dtype, np.number) and value.dtype != np.bool_:
            raise RobotLogError(f"{path}: {name} must hold numbers, got {value.dtype}")
    return known


def _write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    contents: dict[str, Any] = {"joint_names": np.array(constants.JOINT_NAMES), **arrays}
    np.savez(path, **contents)


# MCAP ----------------------------------------------------------------------------------------------------------------
def _read_mcap(path: Path) -> dict[str, Any]:
    rows: dict[str, dict[int, list[float]]] = {}
    try:
        for topic, _, time, value in read_messages(path):
            group = topic[1:]
            if topic == JOINT_STATES:
                check_names(f"{path}: {topic} at {time * 1e-9:.3f} s", [j.name for j in value.joints], GROUPS["action"])
                for name in ("position", "velocity"):
                    if value.joints[0].HasField(name):
                        rows.setdefault(f"joint_{name}", {})[time] = [getattr(joint, name) for joint in value.joints]
            elif group in GROUPS:
                names = [field.name for field in value.DESCRIPTOR.fields]
                check_names(f"{path}: {topic}", names, GROUPS[group])
                rows.setdefault(group, {})[time] = [getattr(value, name) for name in names]
            elif group == "start":
                rows.setdefault(group, {})[time] = [float(value.value)]
    except DamageError as error:
        raise RobotLogError(str(error)) from error
    if "joint_position" not in rows:
        raise RobotLogError(
            f"{path} has no joint positions on {JOINT_STATES}; it has {', '.join(rows) or 'nothing: truncated?'}"
        )
    times = list(rows["joint_position"])
    groups: dict[str, Any] = {"time": np.array(times, dtype=np.float64) * 1e-9}
    for name, messages in rows.items():
        for index, time in enumerate(times):
            if time not in messages:
                raise RobotLogError(f"{path}: row {index} (at {time * 1e-9:.3f} s) has no {name}")
        table = np.array([messages[time] for time in times])
        groups[name] = table[:, 0] if name == "start" else table
    return groups


def _write_mcap(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    kinds = {
        name: message_type(name.title().replace("_", ""), dict.fromkeys(columns, "double"))
        for name, columns in GROUPS.items()
        if name in arrays and not name.startswith("joint_")
    }
    start = message_type("Start", {"value": "bool"})
    with open(path, "wb") as file:
        writer = Writer(file)
        for index, seconds in enumerate(arrays["time"]):
            time = round(float(seconds) * 1e9)
            joints = JointStates()
            joints.timestamp.FromNanoseconds(time)
            for joint, name in enumerate(constants.JOINT_NAMES):
                position, velocity = arrays["joint_position"][index, joint], arrays["joint_velocity"][index, joint]
                joints.joints.add(name=name, position=float(position), velocity=float(velocity))
            messages = {JOINT_STATES: joints}
            for name, kind in kinds.items():
                messages[f"/{name}"] = kind(**dict(zip(GROUPS[name], arrays[name][index].tolist(), strict=True)))
            if "start" in arrays:
                messages["/start"] = start(value=bool(arrays["start"][index]))
            for topic, message in messages.items():
                writer.write_message(topic, message, log_time=time, publish_time=time)
        writer.finish()
