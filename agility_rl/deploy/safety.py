"""What must not happen to a robot: limits as data, each check a plain function that returns a reason or ``None``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants

VENDOR_TORQUE_LIMIT = (23.7, 23.7, 45.43) * 4
"""Largest joint torques that the vendor states [N m]; policies are trained with less."""
CLOCK_TOLERANCE = 0.5
"""What arrives while a control step is held up may be so much younger than its beginning [s]."""
UNIT_TOLERANCE = 0.05
"""How far the length of an orientation may be from 1."""


@dataclass(frozen=True)
class SafetyLimits:
    """Where a controller gives up and lets the robot sink down.

    Attributes:
        state_age: oldest state that may be acted on [s]. Reference notes, section 4: "> 20-50 ms" is stale.
        source_age: oldest word of a commander's sources [s] by name. Depth: ten images at 50 Hz (supplement S3);
            operator: the robot covers a metre in it at 2 m/s (others allow 3 s: reference notes, section 4).
        tilt: largest angle between the trunk's and the world's upright [rad]; jumps in simulation lean by up to 1.07.
        stop_tolerance: how far a joint may be measured beyond its stops [rad]; more means another joint, unit or zero.
            Landing jumps press the simulator's soft stops by up to 0.18.
        joint_lower: stops [rad], ``[12]``.
        joint_upper: stops [rad], ``[12]``.
        joint_speed: [rad/s], ``[12]``: the vendor's.
        joint_torque: [N m], ``[12]``: the vendor's, which is above what the policy was trained with.
        commanded_torque: how many times the torque limit a command may ask for, before the motors cut it; jumps ask
            for up to 2.2.
        sustained: control steps for which speed or torque must be too high: an impact is shorter.
        missed_deadlines: control steps missed in a row.
    """

    state_age: float = 0.05
    source_age: Mapping[str, float] = field(default_factory=lambda: {"operator": 0.5, "depth": 0.2})
    tilt: float = 1.2
    stop_tolerance: float = 0.25
    joint_lower: Sequence[float] = constants.JOINT_LOWER
    joint_upper: Sequence[float] = constants.JOINT_UPPER
    joint_speed: Sequence[float] = constants.VELOCITY_LIMIT
    joint_torque: Sequence[float] = VENDOR_TORQUE_LIMIT
    commanded_torque: float = 4.0
    sustained: int = 5
    missed_deadlines: int = 5

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name.startswith("joint_"):
                if len(value) != constants.NUM_JOINTS:
                    raise ValueError(f"{entry.name} must have {constants.NUM_JOINTS} entries, got {len(value)}")
            elif not isinstance(value, Mapping) and not value > 0:
                raise ValueError(f"{entry.name} must be positive, got {value}")

    @classmethod
    def from_manifest(cls, manifest: Mapping[str, Any], **changes: Any) -> SafetyLimits:
        """Limits of the robot that a manifest describes; keyword arguments replace single ones."""
        limits = manifest["limits"]
        known = {
            "joint_lower": limits["joint_lower"],
            "joint_upper": limits["joint_upper"],
            "joint_speed": limits["joint_speed"],
        }
        return cls(**{**known, **changes})


@dataclass(frozen=True)
class Fault:
    """Why the controller gave up.

    Attributes:
        check: name of the check, such as ``stale state``.
        reason: what was found and what was expected.
    """

    check: str
    reason: str

    def __str__(self) -> str:
        return f"{self.check}: {self.reason}"


# Checks --------------------------------------------------------------------------------------------------------------
def stale(age: float | None, limit: float) -> str | None:
    """Older than allowed, never heard, or from the future: then another clock dated it, and its age is unknown.

    What is dated infinity never grows old.

    Example:
        >>> stale(0.3, 0.05)
        'is 300 ms old, expected at most 50 ms'
    """
    if age is None:
        return "never arrived"
    if -math.inf < age < -CLOCK_TOLERANCE:
        return f"is dated {-age:.3g} s ahead, expected a time of time.monotonic()"
    return None if age <= limit else f"is {1e3 * age:.0f} ms old, expected at most {1e3 * limit:.0f} ms"


def not_finite(**values: Tensor | None) -> str | None:
    """A number is NaN or infinite.

    Example:
        >>> not_finite(joint_position=torch.tensor([0.0, float("nan")]))
        'joint_position[1] is nan'
    """
    for name, value in values.items():
        if value is not None and not bool(value.isfinite().all()):
            index = int((~value.isfinite()).nonzero()[0])
            return f"{name}[{index}] is {float(value[index])}"
    return None


def joint_order(found: Sequence[str], expected: Sequence[str]) -> str | None:
    """The other side calls its joints otherwise.

    Example:
        >>> joint_order(("hip", "calf"), ("hip", "thigh"))
        "joint 1 is 'calf', expected 'thigh'"
    """
    if len(found) != len(expected):
        return f"there are {len(found)} joints, expected {len(expected)}"
    for index, (have, want) in enumerate(zip(found, expected, strict=True)):
        if have != want:
            return f"joint {index} is {have!r}, expected {want!r}"
    return None


def beyond_stops(position: Tensor, lower: Tensor, upper: Tensor, tolerance: float) -> str | None:
    """A joint is measured where it cannot be: it is another joint, in another unit, or has lost its zero.

    Example:
        >>> beyond_stops(torch.tensor([0.0, 3.0]), torch.zeros(2), torch.ones(2), 0.1)
        'joint 1 is at 3.00 rad, its stops are 0.00 and 1.00'
    """
    outside = (position < lower - tolerance) | (position > upper + tolerance)
    if not bool(outside.any()):
        return None
    index = int(outside.nonzero()[0])
    return f"joint {index} is at {position[index]:.2f} rad, its stops are {lower[index]:.2f} and {upper[index]:.2f}"


def too_large(value: Tensor, limit: Tensor, unit: str) -> str | None:
    """A joint's speed or torque is above its limit.

    Example:
        >>> too_large(torch.tensor([1.0, -9.0]), torch.tensor([8.0, 8.0]), "rad/s")
        'joint 1 has -9.0 rad/s, expected at most 8.0'
    """
    over = value.abs() > limit
    if not bool(over.any()):
        return None
    index = int(over.nonzero()[0])
    return f"joint {index} has {value[index]:.1f} {unit}, expected at most {limit[index]:.1f}"


def no_orientation(quaternion: Tensor) -> str | None:
    """No unit quaternion ``[4]``: the sensor has not spoken yet, and taken for an orientation that would be upright.

    Example:
        >>> no_orientation(torch.zeros(4))
        'the quaternion has length 0.00, expected 1'
    """
    length = float(torch.linalg.vector_norm(quaternion))
    return None if abs(length - 1.0) <= UNIT_TOLERANCE else f"the quaternion has length {length:.2f}, expected 1"


def tilted(quaternion: Tensor, limit: float) -> str | None:
    """The trunk leans more than allowed, in any direction.

    Example:
        >>> tilted(torch.tensor([0.0, 1.0, 0.0, 0.0]), 1.0)
        'the trunk leans by 3.14 rad, expected at most 1.00'
    """
    upright = rotations.rotate(quaternion, torch.tensor([0.0, 0.0, 1.0]))[2]
    lean = float(torch.acos(upright.clamp(-1.0, 1.0)))
    return None if lean <= limit else f"the trunk leans by {lean:.2f} rad, expected at most {limit:.2f}"


def commanded(others: Sequence[str]) -> str | None:
    """Somebody else commands the same robot.

    Example:
        >>> commanded(("another controller",))
        'another controller commands this robot too; stop one of the two'
    """
    return f"{', '.join(others)} commands this robot too; stop one of the two" if others else None


def late(missed: int, limit: int) -> str | None:
    """Too many control steps in a row were missed.

    Example:
        >>> late(5, 5)
        '5 control steps in a row were missed, expected fewer than 5'
    """
    return f"{missed} control steps in a row were missed, expected fewer than {limit}" if missed >= limit else None


def pd_torque(command: JointCommand, state: RobotState) -> Tensor:
    """Torque ``[12]`` [N m] that a command asks for in a state, before the motors cut it."""
    position = command.stiffness * (command.position - state.joint_position)
    return command.torque + position + command.damping * (command.velocity - state.joint_velocity)


class Safety:
    """All checks in order; the first fault counts.

    Args:
        limits: where to give up.
        joint_names: order in which the controller thinks.
        torque_limit: ``[12]`` [N m], unit of :attr:`SafetyLimits.commanded_torque`.

    Example:
        >>> safety = Safety(SafetyLimits())
        >>> str(safety.check_state(RobotState.standing(time=0.0), now=1.0))
        'stale state: the state is 1000 ms old, expected at most 50 ms'
    """

    def __init__(
        self,
        limits: SafetyLimits,
        joint_names: Sequence[str] = constants.JOINT_NAMES,
        torque_limit: Sequence[float] = constants.TORQUE_LIMIT,
    ) -> None:
        self.limits, self.joint_names = limits, tuple(joint_names)
        self._lower, self._upper = torch.tensor(limits.joint_lower), torch.tensor(limits.joint_upper)
        self._speed, self._torque = torch.tensor(limits.joint_speed), torch.tensor(limits.joint_torque)
        self._commanded = limits.commanded_torque * torch.tensor(torque_limit)
        self.reset()

    def reset(self) -> None:
        """Forget how long speed and torque have been too high."""
        self._count = {"joint speed": 0, "joint torque": 0}

    def check_bus(self, joint_names: Sequence[str], others: Sequence[str]) -> Fault | None:
        """Joint order and other commanders."""
        return _first(
            ("joint order", joint_order(joint_names, self.joint_names)), ("second commander", commanded(others))
        )

    def check_loop(self, now: float, sources: Mapping[str, float], missed: int) -> Fault | None:
        """Missed deadlines, and the commander's sources: operator, depth.

        Raises:
            KeyError: if there is no limit for a source: a source without one would never be too old.
        """
        ages = [
            (
                "lost operator" if name == "operator" else f"stale {name}",
                _about(name, stale(now - heard, self.limits.source_age[name])),
            )
            for name, heard in sources.items()
        ]
        return _first(("missed deadlines", late(missed, self.limits.missed_deadlines)), *ages)

    def check_state(self, state: RobotState | None, now: float) -> Fault | None:
        """Age, finiteness, joints, orientation, tilt."""
        old = stale(None if state is None else now - state.time, self.limits.state_age)
        if state is None or old:
            return Fault("stale state", f"the state {old}")
        entries = {entry.name: getattr(state, entry.name) for entry in fields(state)}
        bad = not_finite(**{name: value for name, value in entries.items() if isinstance(value, Tensor)})
        if bad:
            return Fault("not a number", f"the state's {bad}")
        return _first(
            (
                "joint limits",
                beyond_stops(state.joint_position, self._lower, self._upper, self.limits.stop_tolerance),
            ),
            ("joint speed", self._sustain("joint speed", too_large(state.joint_velocity, self._speed, "rad/s"))),
            ("joint torque", self._sustain("joint torque", too_large(state.joint_torque, self._torque, "N m"))),
            ("orientation", no_orientation(state.quaternion)),
            ("tilt", tilted(state.quaternion, self.limits.tilt)),
        )

    def check_command(self, command: JointCommand, state: RobotState) -> Fault | None:
        """Finiteness, and torques that no reasonable command asks for."""
        entries = {entry.name: getattr(command, entry.name) for entry in fields(command)}
        if bad := not_finite(**entries):
            return Fault("not a number", f"the command's {bad}")
        return _first(("commanded torque", too_large(pd_torque(command, state), self._commanded, "N m")))

    def _sustain(self, name: str, reason: str | None) -> str | None:
        self._count[name] = self._count[name] + 1 if reason else 0
        if self._count[name] < self.limits.sustained:
            return None
        return f"{reason}, for {self._count[name]} control steps"


def _about(name: str, reason: str | None) -> str | None:
    return reason and f"the last word of the source {name!r} {reason}"


def _first(*found: tuple[str, str | None]) -> Fault | None:
    return next((Fault(check, reason) for check, reason in found if reason), None)
