"""A robot's own record of itself: what system identification learns from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys, rotations
from agility_rl.collectors.log_formats import GROUPS, RobotLogError, read_columns, write_columns
from agility_rl.go2 import constants, features

MIN_STEPS = 100
"""Fewer rows (2 s) are refused: one stride or two tell no parameters apart. The paper uses 4,000."""
STOP_TOLERANCE = 0.2
"""Joints may often be measured this far beyond their stops [rad]; more means another order, unit or zero."""
LANDING_TOLERANCE, LANDING_SHARE = 0.8, 0.05
"""Joints may be measured this far beyond their stops [rad] in this share of the rows: simulated stops are soft, and a
weak leg that lands is pressed 0.3 rad beyond them, at times 0.5. Another order or unit shows in most rows."""
RATE_TOLERANCE = 0.02
"""Relative deviation of the median period from the control step."""
PERIOD_TOLERANCE = 0.5
"""Relative deviation of a single period; more is a gap, or a row twice."""


@dataclass(frozen=True)
class RobotLog:
    """What a robot measured and did, one row a control step, checked when it is made.

    It holds only what a real robot knows: no trunk position and no trunk velocity. Columns, units and the three file
    types are described in :mod:`agility_rl.collectors.log_formats`. Numbers are kept as float32, but for the time.

    Source: supplement S2 (4,000 steps at 50 Hz, about 80 seconds).

    Attributes:
        time: float64 ``[T]`` [s], increasing.
        joint_position: ``[T, 12]`` [rad].
        joint_velocity: ``[T, 12]`` [rad/s].
        roll_pitch: ``[T, 2]`` [rad].
        angular_velocity: ``[T, 3]`` [rad/s], base frame.
        action: ``[T, 12]`` [action units], held from this row's time to the next.
        start: bool ``[T]``, rows into which no transition leads; the first row always counts as one.
        linear_acceleration: ``[T, 3]`` [m/s^2], base frame, if measured; not part of the state.
        control_dt: period that the rows must have [s].
        name: where it came from; begins every error message.
        min_steps: fewer rows are refused.

    Raises:
        RobotLogError: if a shape differs, a number is not finite, the rate is wrong, rows are missing or doubled, the
            log is too short, a joint lies beyond its stops, or every action is the same; the message names field and
            row (counted from 0).

    Example:
        >>> time = 0.02 * torch.arange(200, dtype=torch.float64)
        >>> log = RobotLog(
        ...     time=time, joint_position=torch.tensor(constants.DEFAULT_POSE).repeat(200, 1),
        ...     joint_velocity=torch.zeros(200, 12), roll_pitch=torch.zeros(200, 2),
        ...     angular_velocity=torch.zeros(200, 3), action=torch.sin(time)[:, None].expand(200, 12).float(),
        ...     start=torch.arange(200) == 100,
        ... )
        >>> log.transitions().shape
        torch.Size([198])
    """

    time: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    roll_pitch: Tensor
    angular_velocity: Tensor
    action: Tensor
    start: Tensor
    linear_acceleration: Tensor | None = None
    control_dt: float = constants.CONTROL_DT
    name: str = "log"
    min_steps: int = MIN_STEPS

    def __post_init__(self) -> None:
        for group in GROUPS:  # NumPy's numbers are float64, those of networks and simulators float32
            if (value := getattr(self, group, None)) is not None:
                object.__setattr__(self, group, value.float())
        object.__setattr__(self, "time", self.time.double())
        self._check_shapes()
        if len(wrong := ((self.start != 0) & (self.start != 1)).nonzero()):
            row = int(wrong[0])
            raise RobotLogError(f"{self.name}: row {row}, start: expected 0 or 1, got {float(self.start[row]):g}")
        object.__setattr__(self, "start", self.start.bool())
        self._check_finite()
        if len(self) < max(self.min_steps, 2):
            raise RobotLogError(f"{self.name} is too short: {len(self)} rows, expected at least {self.min_steps}")
        self._check_time()
        self._check_joints()
        if bool((self.action == self.action[0]).all()):
            raise RobotLogError(f"{self.name}: action is the same in every row; record what the policy commanded")

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def from_columns(
        cls,
        columns: Mapping[str, Tensor],
        *,
        control_dt: float = constants.CONTROL_DT,
        name: str = "log",
        min_steps: int = MIN_STEPS,
    ) -> RobotLog:
        """Make a log from named groups; the orientation is ``roll_pitch`` or ``quaternion``.

        Raises:
            RobotLogError: if a group is missing, a quaternion is not of unit length, or as the class says.
        """
        columns = dict(columns)
        if "quaternion" in columns and "roll_pitch" not in columns:
            columns["roll_pitch"] = _roll_pitch(columns["quaternion"], name)
        needed = ("time", "joint_position", "joint_velocity", "roll_pitch", "angular_velocity", "action")
        for group in needed:
            if group not in columns:
                either = " (or quaternion)" if group == "roll_pitch" else ""
                raise RobotLogError(f"{name} has no {group}{either}; it has {', '.join(sorted(columns)) or 'nothing'}")
        return cls(
            **{group: columns[group] for group in needed},
            start=columns.get("start", torch.zeros(len(columns["time"]))).reshape(-1),
            linear_acceleration=columns.get("linear_acceleration"),
            control_dt=control_dt,
            name=name,
            min_steps=min_steps,
        )

    @classmethod
    def load(
        cls, path: str | Path, *, control_dt: float = constants.CONTROL_DT, min_steps: int = MIN_STEPS
    ) -> RobotLog:
        """Read a log from MCAP, CSV or npz, by the file's ending.

        Raises:
            FileNotFoundError: if there is no such file.
            RobotLogError: if it cannot be read or is no good log.
        """
        return cls.from_columns(read_columns(path), control_dt=control_dt, name=str(path), min_steps=min_steps)

    @classmethod
    def from_rollout(
        cls, rollout: TensorDictBase, row: int = 0, *, control_dt: float, name: str = "rollout"
    ) -> RobotLog:
        """One robot's rows of :func:`agility_rl.collectors.rollout.roll_out`.

        Rows in which the engine diverged are left out; the row after them is a start.

        Raises:
            RobotLogError: as the class says.
        """
        robot = rollout[row]
        valid = robot["collector", "mask"]
        state = robot[keys.MEASUREMENT]
        entries = {
            entry.name: state[:, features.layout_slice(features.MEASUREMENT_LAYOUT, entry.name)][valid].clone()
            for entry in features.MEASUREMENT_LAYOUT
        }
        time = control_dt * torch.arange(len(state), dtype=torch.float64)
        return cls(
            **entries,
            time=time[valid],
            action=robot[keys.ACTION][valid].clone(),
            start=robot["is_init"][..., 0][valid],
            control_dt=control_dt,
            name=name,
        )

    def save(self, path: str | Path) -> Path:
        """Write the log as MCAP, CSV or npz, by the file's ending."""
        columns = {"time": self.time, "start": self.start}
        columns |= {group: getattr(self, group) for group in GROUPS if getattr(self, group, None) is not None}
        return write_columns(path, columns)

    def transitions(self) -> TensorDict:
        """Transitions between consecutive rows, ``[M]``: ``measurement``, ``action``, ``("next", "measurement")``."""
        state = features.measurement(self.roll_pitch, self.angular_velocity, self.joint_position, self.joint_velocity)
        rows = (~self.start[1:]).nonzero()[:, 0]
        return TensorDict(
            {
                keys.MEASUREMENT: state[rows],
                keys.ACTION: self.action[rows],
                "next": TensorDict({keys.MEASUREMENT: state[rows + 1]}, [len(rows)]),
            },
            [len(rows)],
        )

    # -- checks --------------------------------------------------------------------------------------------------------
    def _check_shapes(self) -> None:
        count = len(self.time)
        expected: dict[str, tuple[int, ...]] = {"time": (count,), "start": (count,)}
        expected |= {group: (count, len(names)) for group, names in GROUPS.items() if group != "quaternion"}
        for group, shape in expected.items():
            value = getattr(self, group)
            if value is not None and tuple(value.shape) != shape:
                raise RobotLogError(f"{self.name}: {group} must be {list(shape)}, got {list(value.shape)}")

    def _check_finite(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not isinstance(value, Tensor):
                continue
            bad = (~value.isfinite()).nonzero()
            if len(bad):
                row, *column = bad[0].tolist()
                names = GROUPS.get(field.name, ())
                where = f"{field.name}.{names[column[0]]}" if column else field.name
                number = value[tuple(bad[0])].item()
                raise RobotLogError(f"{self.name}: row {row}, {where} is {number}, expected a finite number")

    def _check_time(self) -> None:
        steps = self.time.diff()
        backwards = (steps <= 0).nonzero()
        if len(backwards):
            row = int(backwards[0]) + 1
            raise RobotLogError(
                f"{self.name}: row {row}, time goes from {self.time[row - 1]:.4f} to {self.time[row]:.4f} s, expected "
                "increasing times"
            )
        median = steps.median().item()
        if abs(median / self.control_dt - 1.0) > RATE_TOLERANCE:
            raise RobotLogError(
                f"{self.name}: time runs at {1 / median:.1f} Hz, expected {1 / self.control_dt:.1f} Hz; resample it "
                "or record at the control rate"
            )
        off = ((steps / self.control_dt - 1.0).abs() > PERIOD_TOLERANCE) & ~self.start[1:]
        if bool(off.any()):
            row = int(off.nonzero()[0]) + 1
            raise RobotLogError(
                f"{self.name}: row {row}, time comes {1e3 * steps[row - 1]:.1f} ms after the row before, expected "
                f"{1e3 * self.control_dt:.1f} ms: rows are missing or doubled; mark wanted interruptions by start = 1"
            )

    def _check_joints(self) -> None:
        lower, upper = torch.tensor(constants.JOINT_LOWER), torch.tensor(constants.JOINT_UPPER)
        excess = torch.maximum(lower - self.joint_position, self.joint_position - upper)
        often = (excess > STOP_TOLERANCE).any(-1).float().mean() > LANDING_SHARE
        beyond = (excess > (STOP_TOLERANCE if often else LANDING_TOLERANCE)).nonzero()
        if len(beyond):
            row, joint = beyond[0].tolist()
            raise RobotLogError(
                f"{self.name}: row {row}, joint_position.{constants.JOINT_NAMES[joint]} is "
                f"{self.joint_position[row, joint]:.3f} rad, beyond its stops {constants.JOINT_LOWER[joint]:.3f} and "
                f"{constants.JOINT_UPPER[joint]:.3f}: joints in another order, another unit, or another zero"
            )


def _roll_pitch(quaternion: Tensor, name: str) -> Tensor:
    norm = torch.linalg.vector_norm(quaternion, dim=-1)
    off = (~((norm - 1.0).abs() < 1e-2)).nonzero()
    if len(off):
        row = int(off[0])
        found = f"{norm[row]:.3f}" if math.isfinite(norm[row]) else "not finite"
        raise RobotLogError(f"{name}: row {row}, quaternion has length {found}, expected 1")
    roll, pitch, _ = rotations.to_euler(quaternion / norm[:, None])
    return torch.stack((roll, pitch), -1)
