"""Names a gait from foot phases, speed and trunk height; knows nothing of networks, skills or rewards.

Phases come from the fore-aft motion of the feet, not from contacts, so that they do not depend on a contact threshold:
dogs on a badly levelled floor and simulated robots with force sensors are measured by the same yardstick.
Everything is vectorised over leading dimensions, so a thousand episodes are measured in one call.

Source: data notes, part B.2 (labelled clips, phases) and B.3 (classification rule, right on 17 of 17 labelled clips).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2.constants import FOOT_PAIRS
from agility_rl.go2.features import in_stance
from agility_rl.motion.clip import MotionClip

GAIT_LABELS: tuple[str, ...] = (*BEHAVIOURS, "stand", "other")
"""Every answer of :func:`classify_gait`; the first five are the behaviours in their package-wide order."""

STAND = GAIT_LABELS.index("stand")
OTHER = GAIT_LABELS.index("other")

SHORTEST = 0.3
"""A stretch shorter than this shows no gait [s] (ours)."""
JUMP_PEAK = 0.42
"""A trunk that rises over this height [m] has jumped (data notes B.3; the tallest gait stays below 0.36 m)."""
JUMP_RISE = 0.1
"""... and it must clear its usual height by this much [m], or it is merely a tall robot."""
BOUND_PHASE = 0.05
"""Both pairs of feet closer in phase than this gallop side by side: a bound, hence no canter."""
CANTER_PHASE = 0.38
CANTER_SPEED = 0.7
"""Slowest canter [m/s]; data notes B.3 has 1.2 for the dog, but canter is commanded from 0.8 on (Table S2)."""
WALK_SPEED = 0.75
"""Fastest walk [m/s]: the command range of walk ends at 0.6 (Table S2)."""
SLOW_SPEED = 0.4
"""Slower than this, the dog's gait is a walk unless its feet move clearly in pairs (data notes B.3)."""
WALK_LATERAL = 0.10
"""Feet of one side set down this far apart [strides] make four beats: .12 to .21 for walks, .02 to .04 for paces."""
PAIRED = 0.06
"""Feet closer than this [strides] move as one (dog: pace .02 to .04 lateral, trot .04 to .07 diagonal)."""
PACE_LATERAL = 0.22
TROT_DIAGONAL = 0.2
STAND_SPEED = 0.1
STAND_MOTION = 0.012
"""Standard deviation of fore-aft foot motion [m] under which nobody steps."""

_STRIDE_BAND = (0.4, 4.5)


@dataclass(frozen=True)
class GaitMeasurement:
    """Figures of a stretch of locomotion, each ``[*B]`` (``duty``: ``[*B, 4]``).

    Phases are shares of a stride folded to 0 (together) .. 0.5 (alternating); lateral and diagonal ones are means of
    the two sides.
    """

    speed: Tensor
    """Mean forward velocity [m/s]."""
    lateral_speed: Tensor
    """Mean leftward velocity [m/s]."""
    yaw_rate: Tensor
    """Mean turn rate [rad/s], positive to the left."""
    duty: Tensor
    """Share of time on the ground of FL, FR, RL, RR."""
    stride_frequency: Tensor
    """Strides per second."""
    phase_left_right_front: Tensor
    """FL against FR: 0.5 in walk, pace and trot, .12 to .23 in canter, near 0 in jumps."""
    phase_left_right_hind: Tensor
    """RL against RR."""
    phase_lateral: Tensor
    """FL against RL and FR against RR: near 0 in pace."""
    phase_diagonal: Tensor
    """FL against RR and FR against RL: near 0 in trot."""
    foot_motion: Tensor
    """Standard deviation of the fore-aft foot motion [m], mean of the feet."""
    trunk_mean: Tensor
    """Mean trunk height [m]."""
    trunk_median: Tensor
    """Median trunk height [m]."""
    trunk_low: Tensor
    """Lower quartile of the trunk height [m]: the usual height also for one who is half of the time in the air."""
    trunk_peak: Tensor
    """Greatest trunk height [m]."""
    flight: Tensor
    """Share of time without any foot on the ground."""

    def map(self, function) -> GaitMeasurement:  # type: ignore[no-untyped-def]
        """Apply ``function(tensor)`` to every figure."""
        return GaitMeasurement(**{field.name: function(getattr(self, field.name)) for field in fields(self)})


def measure_gait(
    foot_position: Tensor,
    foot_contact: Tensor,
    root_height: Tensor,
    linear_velocity: Tensor,
    yaw_rate: Tensor,
    dt: float = 0.02,
) -> GaitMeasurement:
    """Measure speed, foot phases, duty, stride frequency and trunk height of whole stretches.

    The phase of two feet is the angle of their cross-spectrum around the stride frequency :math:`f_0`,

    .. math:: \\phi_{ij} = \\tfrac{1}{2\\pi} \\Big| \\arg \\sum_{|f - f_0| < 0.4 f_0} X_i(f) \\overline{X_j(f)} \\Big|,

    with X the spectrum of the detrended, Hann-windowed fore-aft position of a foot relative to the trunk.

    Source: data notes B.2 (phases from fore-aft foot motion).

    Args:
        foot_position: ``[*B, T, 4, 3]`` [m] relative to the trunk, base or heading frame, feet FL, FR, RL, RR.
        foot_contact: bool ``[*B, T, 4]``.
        root_height: ``[*B, T]`` [m] over the ground.
        linear_velocity: ``[*B, T, 3]`` [m/s], base or heading frame.
        yaw_rate: ``[*B, T]`` [rad/s].
        dt: seconds between frames.

    Raises:
        ValueError: if shapes disagree or the stretch is shorter than 0.3 s.

    Example:
        >>> t = torch.arange(150) * 0.02
        >>> offset = torch.tensor([0.0, 0.5, 0.5, 0.0])
        >>> x = 0.1 * torch.cos(2 * torch.pi * (2.0 * t[:, None] - offset))
        >>> feet = torch.stack((x, torch.zeros_like(x), torch.full_like(x, -0.28)), -1)
        >>> forward = torch.tensor([1.2, 0.0, 0.0]).expand(150, 3)
        >>> m = measure_gait(feet, x > 0, torch.full((150,), 0.3), forward, torch.zeros(150))
        >>> round(m.stride_frequency.item(), 1), classify_gait(m)
        (2.0, 'trot')
    """
    steps = root_height.shape[-1]
    _check_shapes(foot_position, foot_contact, root_height, linear_velocity, yaw_rate)
    if steps * dt < SHORTEST:
        raise ValueError(f"a gait needs at least {SHORTEST} s, got {steps} frames of {dt} s = {steps * dt:.2f} s")
    fore_aft = detrend(foot_position[..., 0].float())
    frequency, crosses = stride_spectrum(fore_aft, dt)
    phases = crosses.angle().abs() / (2 * torch.pi)
    contact = foot_contact.float()
    velocity = linear_velocity.mean(-2)
    return GaitMeasurement(
        speed=velocity[..., 0],
        lateral_speed=velocity[..., 1],
        yaw_rate=yaw_rate.mean(-1),
        duty=contact.mean(-2),
        stride_frequency=frequency,
        phase_left_right_front=phases[..., 0],
        phase_left_right_hind=phases[..., 1],
        phase_lateral=phases[..., 2:4].mean(-1),
        phase_diagonal=phases[..., 4:6].mean(-1),
        foot_motion=fore_aft.std(-2).mean(-1),
        trunk_mean=root_height.mean(-1),
        trunk_median=root_height.median(-1).values,
        trunk_low=root_height.float().quantile(0.25, -1),
        trunk_peak=root_height.amax(-1),
        flight=(contact.amax(-1) < 0.5).float().mean(-1),
    )


def measure_windows(
    foot_position: Tensor,
    foot_contact: Tensor,
    root_height: Tensor,
    linear_velocity: Tensor,
    yaw_rate: Tensor,
    dt: float = 0.02,
    window: float = 3.0,
) -> GaitMeasurement:
    """Measure a long stretch piece by piece: arguments as :func:`measure_gait`, results ``[*B, W]``.

    The stretch is cut into ``W`` equal pieces of about ``window`` seconds, none below 0.3, so that a robot that
    changes its gait in between, or drifts in stride frequency, is not averaged into a gait that nobody showed.
    """
    steps = root_height.shape[-1]
    count = max(1, min(round(steps * dt / window), steps // math.ceil(SHORTEST / dt)))
    length = steps // count

    def cut(value: Tensor, trailing: int) -> Tensor:
        axis = value.dim() - 1 - trailing
        return value.narrow(axis, 0, count * length).unflatten(axis, (count, length))

    return measure_gait(
        cut(foot_position, 2),
        cut(foot_contact, 1),
        cut(root_height, 0),
        cut(linear_velocity, 1),
        cut(yaw_rate, 0),
        dt,
    )


def classify_index(measurement: GaitMeasurement) -> Tensor:
    """Index into :data:`GAIT_LABELS` of every stretch, int64 ``[*B]``, by the rule of :func:`classify_gait`."""
    m = measurement
    speed = torch.hypot(m.speed, m.lateral_speed)
    front, hind = m.phase_left_right_front, m.phase_left_right_hind
    lateral, diagonal = m.phase_lateral, m.phase_diagonal
    jump = (m.trunk_peak > JUMP_PEAK) & (m.trunk_peak - m.trunk_low > JUMP_RISE)
    stand = (speed < STAND_SPEED) & (m.foot_motion < STAND_MOTION)
    bound = (front < BOUND_PHASE) & (hind < BOUND_PHASE)
    canter = (speed > CANTER_SPEED) & (front < CANTER_PHASE) & ~bound
    paired = (torch.minimum(lateral, diagonal) < PAIRED) & (speed > STAND_SPEED)
    four_beats = (lateral > WALK_LATERAL) & (diagonal > WALK_LATERAL) & (front > CANTER_PHASE / 2)
    walk = ((speed < SLOW_SPEED) & ~paired) | ((speed < WALK_SPEED) & four_beats)
    pace = (lateral < PACE_LATERAL) & (lateral < diagonal)
    trot = diagonal < TROT_DIAGONAL
    label = torch.full(speed.shape, OTHER, dtype=torch.int64, device=speed.device)
    # The last assignment wins, so the rules stand from the weakest to the strongest.
    for name, condition in (("trot", trot), ("pace", pace), ("walk", walk), ("canter", canter), ("other", bound)):
        label = label.masked_fill(condition, GAIT_LABELS.index(name))
    label = label.masked_fill(stand, STAND)
    return label.masked_fill(jump, GAIT_LABELS.index("jump"))


def classify_gait(measurement: GaitMeasurement) -> str:
    """Name the gait of one measured stretch: a behaviour, ``"stand"`` or ``"other"``.

    In this order: *jump* if the trunk peaks over 0.42 m and 0.1 m over its usual height (one leap or a chain);
    *stand* if neither trunk nor feet move; *other* if both front and both hind feet move side by side; *canter* if
    faster than 0.7 m/s with front feet less than 0.38 of a stride apart; *walk* if slower than 0.4 m/s and the feet do
    not move in pairs, or slower than 0.75 m/s with four separate beats; *pace* if the feet of a side are together;
    *trot* if the diagonal ones are; else *other*.

    Source: data notes B.3. Differences, because robots are measured too: the walk's and the canter's speed bounds
    follow the command ranges of Table S2, and a slow trot or pace is no walk.

    Raises:
        ValueError: if the measurement holds more than one stretch; use :func:`classify_index` for many.

    Example:
        >>> from agility_rl.motion.gaits import synthesize_gait
        >>> classify_gait(measure_clip(synthesize_gait("pace")))
        'pace'
    """
    if measurement.speed.numel() != 1:
        raise ValueError(
            f"classify_gait names one stretch, got a batch of shape {tuple(measurement.speed.shape)}; "
            "use classify_index for many, classify_episodes for windows"
        )
    return GAIT_LABELS[int(classify_index(measurement).reshape(()))]


def majority(label: Tensor) -> Tensor:
    """Most frequent label along the last dimension of int64 ``[*B, W]``; a tie goes to the label seen first.

    Example:
        >>> majority(torch.tensor([[2, 0, 2], [3, 1, 6]])).tolist()
        [2, 3]
    """
    votes = torch.nn.functional.one_hot(label, len(GAIT_LABELS)).sum(-2)
    own_votes = votes.gather(-1, label)
    return label.gather(-1, own_votes.argmax(-1, keepdim=True)).squeeze(-1)


def classify_episodes(windows: GaitMeasurement) -> tuple[Tensor, GaitMeasurement]:
    """Name whole episodes by the majority of their windows.

    Args:
        windows: result of :func:`measure_windows`, figures ``[*B, W]``.

    Returns:
        int64 ``[*B]`` (index into :data:`GAIT_LABELS`) and the figures ``[*B]``: medians over the windows that carry
        the winning label, so that a start or a stumble does not blur them (``trunk_peak`` likewise: the typical peak).
    """
    label = classify_index(windows)
    winner = majority(label)
    chosen = label == winner[..., None]

    def typical(value: Tensor) -> Tensor:
        mask = chosen if value.dim() == chosen.dim() else chosen[..., None]
        return value.float().masked_fill(~mask, float("nan")).nanmedian(chosen.dim() - 1).values

    return winner, windows.map(typical)


def measure_clip(clip: MotionClip, window: float | None = None) -> GaitMeasurement:
    """Measure a motion clip; with ``window`` [s], piece by piece as :func:`measure_windows`."""
    heading = rotations.heading(clip.root_quaternion)
    stretch = (
        level_feet(clip),
        clip.foot_contact,
        clip.root_position[:, 2],
        rotations.rotate_inverse(heading, clip.root_linear_velocity),
        clip.root_angular_velocity[:, 2],
    )
    return measure_gait(*stretch, dt=clip.dt) if window is None else measure_windows(*stretch, clip.dt, window)


def stance(feet: Tensor, velocity: Tensor, yaw_rate: Tensor, dt: float) -> Tensor:
    """When a foot stands, bool ``[*B, T, 4]``: it goes forward over the ground at less than half of the trunk's speed.

    Feet of retargeted dogs hover or sink by centimetres, so heights and forces would not measure dog and robot alike;
    on the synthetic gaits, whose contacts are known, their share of the time is right to 0.09.

    Args:
        feet: ``[*B, T, 4, 3]`` [m] relative to the trunk, heading frame.
        velocity: ``[*B, T, 3]`` [m/s], heading frame.
        yaw_rate: ``[*B, T]`` [rad/s].
        dt: seconds between frames.
    """
    foot = torch.gradient(feet[..., 0], spacing=dt, dim=-2)[0] + velocity[..., :1] - yaw_rate[..., None] * feet[..., 1]
    return in_stance(foot, velocity[..., :1].mean(-2, keepdim=True))


def clip_stance(clip: MotionClip) -> Tensor:
    """:func:`stance` of a clip, ``[T, 4]``."""
    heading = rotations.heading(clip.root_quaternion)
    velocity = rotations.rotate_inverse(heading, clip.root_linear_velocity)
    return stance(level_feet(clip), velocity, clip.root_angular_velocity[:, 2], clip.dt)


def stance_share(feet: Tensor, velocity: Tensor, yaw_rate: Tensor, dt: float) -> Tensor:
    """Duty factor ``[*B]``: share of time in which a foot stands by :func:`stance`, mean of the feet."""
    return stance(feet, velocity, yaw_rate, dt).float().mean((-1, -2))


def clip_stance_share(clip: MotionClip) -> Tensor:
    """:func:`stance_share` of a clip."""
    return clip_stance(clip).float().mean()


def level_feet(clip: MotionClip) -> Tensor:
    """Feet relative to the trunk, ``[T, 4, 3]`` [m], in the heading frame, so that pitching does not move them."""
    heading = rotations.heading(clip.root_quaternion)
    return rotations.rotate_inverse(heading[:, None], clip.foot_position - clip.root_position[:, None])


def detrend(signal: Tensor) -> Tensor:
    """Remove mean and slope of ``[*B, T, 4]`` along time, so that a drifting foot does not look like a slow stride."""
    time = torch.linspace(-1.0, 1.0, signal.shape[-2], dtype=signal.dtype, device=signal.device)[:, None]
    signal = signal - signal.mean(-2, keepdim=True)
    slope = (signal * time).sum(-2, keepdim=True) / time.square().sum()
    return signal - slope * time


def stride_spectrum(fore_aft: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Stride frequency [Hz] and cross-spectra of the pairs of feet around it.

    Args:
        fore_aft: ``[*B, T, 4]`` fore-aft positions of the feet [m], detrended.
        dt: seconds between frames.

    Returns:
        ``[*B]`` and complex ``[*B, 6]``, in the order of :data:`~agility_rl.go2.constants.FOOT_PAIRS`, whose angle is
        how far the first foot is ahead of the second, 2 pi for a stride.
    """
    steps = fore_aft.shape[-2]
    window = torch.hann_window(steps + 2, periodic=False, dtype=fore_aft.dtype, device=fore_aft.device)[1:-1, None]
    size = max(512, 1 << (4 * steps - 1).bit_length())
    # Without the slowest frequencies that fit no whole stride into the stretch, a rest of a drift cannot win.
    low = max(_STRIDE_BAND[0], 0.8 / (steps * dt))
    frequency = torch.fft.rfftfreq(size, dt, device=fore_aft.device)
    high_bin = int((frequency <= 1.4 * _STRIDE_BAND[1]).sum())
    frequency = frequency[:high_bin]
    spectrum = torch.fft.rfft(fore_aft * window, n=size, dim=-2)[..., :high_bin, :]
    power = spectrum.abs().square().sum(-1)
    allowed = (frequency >= low) & (frequency <= _STRIDE_BAND[1])
    stride = frequency[power.masked_fill(~allowed, -1.0).argmax(-1)]
    near = ((frequency - stride[..., None]).abs() < 0.4 * stride[..., None]).to(spectrum.dtype)
    crosses = [(spectrum[..., first] * spectrum[..., second].conj() * near).sum(-1) for first, second in FOOT_PAIRS]
    return stride, torch.stack(crosses, -1)


def _check_shapes(foot_position: Tensor, contact: Tensor, height: Tensor, velocity: Tensor, yaw_rate: Tensor) -> None:
    batch = tuple(height.shape)
    expected = {"foot_position": (*batch, 4, 3), "foot_contact": (*batch, 4), "linear_velocity": (*batch, 3)}
    expected["yaw_rate"] = batch
    for (name, shape), value in zip(expected.items(), (foot_position, contact, velocity, yaw_rate), strict=True):
        if tuple(value.shape) != shape:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected {shape} to match root_height {batch} ([*B, T])"
            )
