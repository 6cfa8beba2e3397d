"""Synthesises walk, pace, trot, canter and jump on the Go2, for machines without recorded motion.

A gait is a table of foot phases, duty factor and stride frequency; feet stand exactly still on the ground and swing
smoothly in between, and the joints follow by inverse kinematics. No animal moved like this: every clip says that it is
synthetic.

Source: targets from the dog's own clips, data notes B.2 and B.3 (phases, stride frequency, speed, trunk height).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2 import constants, kinematics
from agility_rl.motion.clip import CONTROL_DT, MotionClip, MotionError, clip_from_joints

MAX_HALF_STANCE = 0.16
"""A foot stays at most this far [m] in front of or behind its neutral place; faster gaits shorten the stance."""
JUMP_CLEARANCE = 0.06
"""How much more the feet rise than the trunk during a jump [m]."""
_FOOT_RADIUS = math.hypot(constants.HIP_OFFSET_X, constants.HIP_OFFSET_Y + constants.ABDUCTION)
"""Distance of a neutral foot from the trunk's vertical axis [m]."""


@dataclass(frozen=True)
class GaitPattern:
    """What makes a gait.

    Attributes:
        phase: when FL, FR, RL, RR touch down, in strides.
        duty: share of a stride that a foot stands, unless speed forces less.
        speed: usual, slowest and fastest forward speed [m/s].
        frequency: strides per second at zero speed, and their increase per m/s.
        height: trunk height [m]; for the jump, height at take-off.
        clearance: height of a swinging foot [m].
        bob: vertical oscillation of the trunk [m] and how often it happens in a stride.
        pitch: amplitude of the trunk's pitch oscillation [rad], once a stride.
    """

    phase: tuple[float, float, float, float]
    duty: float
    speed: tuple[float, float, float]
    frequency: tuple[float, float]
    height: float
    clearance: float
    bob: tuple[float, int]
    pitch: float = 0.0

    def stride(self, speed: float) -> tuple[float, float]:
        """Stride frequency [1/s] and duty factor at a speed."""
        frequency = self.frequency[0] + self.frequency[1] * abs(speed)
        longest = 2 * MAX_HALF_STANCE * frequency / max(abs(speed), 1e-6)
        return frequency, min(self.duty, longest)


PATTERNS: dict[str, GaitPattern] = {
    # Hind foot, then the front foot of its side a fifth of a stride later: lateral .17 to .21, diagonal .29 to .33.
    "walk": GaitPattern((0.20, 0.70, 0.0, 0.5), 0.68, (0.3, 0.15, 0.6), (0.55, 1.4), 0.31, 0.05, (0.004, 2)),
    # Both feet of a side, .03 apart.
    "pace": GaitPattern((0.03, 0.53, 0.0, 0.5), 0.50, (0.8, 0.5, 1.5), (1.3, 0.3), 0.32, 0.06, (0.006, 2)),
    # Diagonal feet, .04 apart.
    "trot": GaitPattern((0.04, 0.54, 0.5, 0.0), 0.42, (1.2, 0.5, 1.5), (1.55, 0.45), 0.31, 0.07, (0.008, 2)),
    # Three beats, left lead: RR, then RL and FR, then FL; front and hind feet .17 apart, lateral .25.
    "canter": GaitPattern((0.42, 0.25, 0.17, 0.0), 0.33, (1.6, 0.8, 2.0), (2.05, 0.1), 0.32, 0.08, (0.015, 1), 0.06),
    # Front feet land together, hind feet later; times, not duty factors, rule the jump (see _jump_timing).
    "jump": GaitPattern((0.0, 0.0, 0.0, 0.0), 0.0, (1.3, 0.8, 1.8), (0.0, 0.0), 0.35, 0.0, (0.0, 1), 0.10),
}
"""Targets of every behaviour. Source: data notes B.2 (table of labelled clips); duty factors B.2 walk .5 to .94."""


@dataclass(frozen=True)
class _Schedule:
    """When feet stand, and the trunk's height and pitch over time."""

    period: float
    touchdown: Tensor  # [4] seconds within the period
    stance: float  # seconds
    height: Tensor  # [T]
    pitch: Tensor  # [T]
    swing: Tensor  # [4] greatest foot height [m]
    leap: bool  # feet leave and meet the ground with the speed of the trunk, not at rest


def synthesize_gait(
    behaviour: str,
    *,
    speed: float | None = None,
    duration: float = 4.0,
    height: float | None = None,
    lateral: float = 0.0,
    yaw_rate: float = 0.0,
    seed: int = 0,
    dt: float = CONTROL_DT,
) -> MotionClip:
    """Generate one clip of a behaviour at constant speed and turn rate.

    A foot in stance stands where it is neutral under the trunk at mid-stance; with duty factor d and stride frequency f
    the trunk passes over it by v d / f. A jump is a chain of leaps, ballistic from take-off to landing:

    .. math:: z(t) = z_0 + v_0 t - g t^2 / 2, \\quad v_0 = \\sqrt{2 g (z_{peak} - z_0)}

    Source: data notes B.2 and B.3 (numbers); section C.2 (a procedural generator as the embedded default).

    Args:
        behaviour: one of :data:`agility_rl.behaviours.BEHAVIOURS`.
        speed: forward [m/s]; None takes the pattern's usual speed.
        duration: seconds.
        height: trunk height [m], for a jump the height of the trunk's peak (0.45 to 0.55); None takes the usual one.
        lateral: leftward speed [m/s].
        yaw_rate: turn rate [rad/s], positive to the left.
        seed: varies start phase, stride frequency (3 %), phases (.01) and height (5 mm).
        dt: seconds between frames.

    Returns:
        A clip marked ``synthetic``, labelled with the behaviour, whose contacts are the planned ones.

    Raises:
        MotionError: if the behaviour is none of the five, a number is impossible, or the legs cannot reach that far.

    Example:
        >>> from agility_rl.motion.gait_analysis import classify_gait, measure_clip
        >>> clip = synthesize_gait("canter", speed=1.6)
        >>> clip.synthetic, classify_gait(measure_clip(clip))
        (True, 'canter')
    """
    if behaviour not in PATTERNS:
        raise MotionError(f"{behaviour!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)}")
    pattern = PATTERNS[behaviour]
    speed = pattern.speed[0] if speed is None else float(speed)
    if not (math.isfinite(duration) and duration >= 2 * dt):
        raise MotionError(f"{behaviour}: expected a duration of at least two frames ({2 * dt} s), got {duration}")
    if not all(math.isfinite(number) for number in (speed, lateral, yaw_rate)):
        raise MotionError(f"{behaviour}: expected finite speeds, got {speed}, {lateral} m/s and {yaw_rate} rad/s")
    noise = torch.rand(7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    time = torch.arange(round(duration / dt) + 1, dtype=torch.float64) * dt
    start = 0.5 * (1 + float(noise[0]))
    plan = _jump_timing if behaviour == "jump" else _stride_timing
    # Turning moves the outer feet faster than the trunk; stances must be short enough for them.
    foot_speed = math.hypot(speed, lateral) + abs(yaw_rate) * _FOOT_RADIUS
    schedule = plan(pattern, foot_speed, height, time, start, noise[1:])

    velocity = torch.tensor([speed, lateral], dtype=torch.float64)
    feet, planted = _feet(schedule, time + start * schedule.period, start * schedule.period, velocity, yaw_rate)
    planar, yaw = _path(time, velocity, yaw_rate)
    root = torch.cat((planar, schedule.height[:, None]), -1)
    quaternion = rotations.from_euler(torch.zeros_like(yaw), schedule.pitch, yaw)
    joints = kinematics.inverse(rotations.rotate_inverse(quaternion[:, None], feet - root[:, None]))
    low, high = torch.tensor(constants.JOINT_LOWER), torch.tensor(constants.JOINT_UPPER)
    joints = joints.clamp(low.to(joints), high.to(joints))
    clip = clip_from_joints(
        behaviour,
        dt,
        root,
        quaternion,
        joints,
        label=behaviour,
        source="gait generator",
        synthetic=True,
        notes=(f"synthetic {behaviour}, {speed:.2f} m/s, {lateral:.2f} m/s left, {yaw_rate:.2f} rad/s",),
    )
    miss = float((clip.foot_position - feet).norm(dim=-1).max())
    if miss > 0.005:
        raise MotionError(
            f"{behaviour} at {speed:.2f} m/s, {lateral:.2f} m/s left, {yaw_rate:.2f} rad/s: legs too short by "
            f"{miss * 1000:.0f} mm; ask for a slower or lower gait"
        )
    return replace(clip, foot_contact=planted)


def synthetic_dataset_clips(seed: int = 0) -> tuple[list[MotionClip], list[MotionClip]]:
    """Labelled and unlabelled synthetic clips for training without recorded motion.

    Source: the proportions of the real set (data notes B.2): labelled is a small part, unlabelled is mostly slow gaits.

    Args:
        seed: source of speeds, turns and variations.

    Returns:
        Two labelled clips a behaviour (3 s, straight on), and unlabelled ones (4 s) over each behaviour's speeds with
        turns of up to 0.5 rad/s and side steps: 8 walk, 8 pace, 6 trot, 5 canter, 5 jump.

    Example:
        >>> labelled, unlabelled = synthetic_dataset_clips()
        >>> len(labelled), len(unlabelled), unlabelled[0].label
        (10, 32, None)
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    labelled, unlabelled = [], []
    for behaviour, count in zip(BEHAVIOURS, (8, 8, 6, 5, 5), strict=True):
        usual, slow, fast = PATTERNS[behaviour].speed
        for number in range(2):
            height = (0.48, 0.52)[number] if behaviour == "jump" else None
            clip = synthesize_gait(
                behaviour, speed=usual * draw(0.85, 1.15), duration=3.0, height=height, seed=seed + number
            )
            labelled.append(replace(clip, name=f"{behaviour}_{number}"))
        for number in range(count):
            turn = 0.0 if number % 2 == 0 else draw(-0.5, 0.5)
            height = draw(0.45, 0.55) if behaviour == "jump" else None
            clip = synthesize_gait(
                behaviour,
                # Evenly spread over the range, so that a handful of clips covers all of it.
                speed=slow + (fast - slow) * (number + draw(0.2, 0.8)) / count,
                height=height,
                yaw_rate=turn,
                lateral=draw(-0.1, 0.1),
                seed=seed + 100 + number,
            )
            unlabelled.append(replace(clip, name=f"unlabelled_{behaviour}_{number}", label=None))
    return labelled, unlabelled


def _stride_timing(
    pattern: GaitPattern, speed: float, height: float | None, time: Tensor, start: float, noise: Tensor
) -> _Schedule:
    """Periodic gait: touchdown times from phases, gentle oscillation of the trunk."""
    frequency, duty = pattern.stride(speed)
    frequency *= 1 + 0.03 * float(noise[0])
    trunk = pattern.height + 0.005 * float(noise[1]) if height is None else height
    if not 0.2 <= trunk <= 0.38:
        raise MotionError(f"expected a trunk height of 0.20 to 0.38 m, got {trunk}")
    phase = (torch.tensor(pattern.phase, dtype=torch.float64) + 0.01 * noise[2:6]) % 1.0
    cycle = 2 * torch.pi * (time * frequency + start)
    # Lowest in the middle of the stances, where legs carry most.
    times = pattern.bob[1]
    middle = 2 * torch.pi * (phase[0] + duty / 2)
    bob = -pattern.bob[0] * torch.cos(times * (cycle - middle))
    return _Schedule(
        period=1 / frequency,
        touchdown=phase / frequency,
        stance=duty / frequency,
        height=trunk + bob,
        pitch=pattern.pitch * torch.cos(cycle - middle),
        swing=torch.full((4,), pattern.clearance, dtype=torch.float64),
        leap=False,
    )


def _jump_timing(
    pattern: GaitPattern, speed: float, height: float | None, time: Tensor, start: float, noise: Tensor
) -> _Schedule:
    """Chain of leaps: front feet land at time 0, hind feet after them, all four are off the ground in between."""
    peak = 0.5 + 0.01 * float(noise[0]) if height is None else height
    take_off = pattern.height
    if not take_off + 0.05 <= peak <= 0.6:
        raise MotionError(f"jump: expected a trunk peak of {take_off + 0.05:.2f} to 0.60 m, got {peak}")
    launch = math.sqrt(2 * constants.GRAVITY * (peak - take_off))
    flight = 2 * launch / constants.GRAVITY
    lag = 0.16
    stance = min(0.28, 2 * MAX_HALF_STANCE / max(abs(speed), 1e-6))
    on_ground = lag + stance
    period = on_ground + flight
    inside = (time + start * period) % period
    # On the ground: the even quartic through the landing and take-off height and velocity, lowest 0.08 m below them.
    tau = 2 * inside / on_ground - 1
    slope, depth = launch * on_ground / 2, 0.08
    quartic = (slope - 2 * depth) / 2
    ground = take_off - depth + (depth - quartic) * tau.square() + quartic * tau.pow(4)
    air_time = inside - on_ground
    air = take_off + launch * air_time - constants.GRAVITY * air_time.square() / 2
    return _Schedule(
        period=period,
        touchdown=torch.tensor([0.0, 0.0, lag, lag], dtype=torch.float64),
        stance=stance,
        height=torch.where(air_time < 0, ground, air),
        # Nose up (negative) at take-off, down at landing.
        pitch=-pattern.pitch * torch.sin(2 * torch.pi * (inside - on_ground / 2) / period),
        swing=torch.full((4,), peak - take_off + JUMP_CLEARANCE, dtype=torch.float64),
        leap=True,
    )


def _feet(
    schedule: _Schedule, clock: Tensor, offset: float, velocity: Tensor, yaw_rate: float
) -> tuple[Tensor, Tensor]:
    """World foot centres ``[T, 4, 3]`` and planted flags ``[T, 4]``; ``clock`` runs ``offset`` ahead of path time."""
    period, stance = schedule.period, schedule.stance
    since = clock[:, None] - schedule.touchdown
    stride = torch.floor(since / period)
    inside = since - stride * period
    planted = inside < stance
    swing = ((inside - stance) / (period - stance)).clamp(0.0, 1.0)
    neutral = kinematics.forward(torch.tensor(constants.DEFAULT_POSE, dtype=torch.float64))[:, :2]
    # Under the hips the reach is the same to both sides; the folded default pose has its feet there to 1 mm.

    def foothold(number: Tensor) -> Tensor:
        """Where the feet stand in stride ``number`` ``[T, 4]``: neutral under the trunk at mid-stance."""
        middle = schedule.touchdown + number * period + stance / 2 - offset
        planar, yaw = _path(middle, velocity, yaw_rate)
        return planar + rotations.turn(neutral, yaw)

    here, there = foothold(stride), foothold(stride + 1)
    # Cubic blend: no velocity at lift-off and touchdown; half of it linear in a leap, or the legs would be too short.
    blend = swing.square() * (3 - 2 * swing)
    if schedule.leap:
        blend = (blend + swing) / 2
    planar = here + blend[..., None] * (there - here)
    arch = torch.sin(torch.pi * swing).clamp(min=0.0).pow(1 if schedule.leap else 2)
    lift = constants.FOOT_RADIUS + schedule.swing * arch
    return torch.cat((planar, lift[..., None]), -1), planted


def _path(time: Tensor, velocity: Tensor, yaw_rate: float) -> tuple[Tensor, Tensor]:
    """Planar position ``[*B, 2]`` and yaw ``[*B]`` at given times of a walk with constant speed and turn rate."""
    yaw = yaw_rate * time
    # The integral of the turned velocity is the chord: straight distance x sinc, along the mean heading.
    chord = torch.sinc(yaw / (2 * torch.pi)) * time
    return rotations.turn(velocity, yaw / 2) * chord[..., None], yaw
