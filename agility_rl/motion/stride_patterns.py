"""In which rhythm the feet of a dog swing in each behaviour: stride frequency and phases of labelled clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2.constants import FOOT_PAIRS
from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.gait_analysis import clip_stance_share, detrend, level_feet, stride_spectrum

MIRRORED_PAIRS = ((0, True), (1, True), (3, False), (2, False), (5, False), (4, False))
"""Which of :data:`~agility_rl.go2.constants.FOOT_PAIRS` each of them becomes in a mirror, and whether its feet change
places."""

FREQUENCY_GROWTH: Mapping[str, float] = {"walk": 1.5}
"""Strides that a second holds more of for each m/s faster [1/m]: commands of the walk reach from standing to four times
the speed of its clips. Others keep the frequency of theirs.

Source: median stride frequencies of the dogs walking in the unlabelled clips, 0.73 Hz at 0.13 m/s, 0.93 at 0.24,
1.12 at 0.34, 1.17 at 0.43, 1.37 at 0.54 (85 stretches of 3 s). Galloping dogs hardly change theirs (Heglund, Taylor
and McMahon 1974, Science 186:1112)."""


def mirrored(cross: Tensor) -> Tensor:
    """Cross-spectra ``[*B, 6]`` of the same gait in a mirror: left feet are right ones.

    Example:
        >>> lead = torch.tensor([1j, 1j, 1.0, -1.0, 1.0, -1.0])  # FL a quarter of a stride ahead of FR, ...
        >>> [complex(number) for number in mirrored(lead)[:4]]
        [-1j, -1j, (-1+0j), (1+0j)]
    """
    return torch.stack([cross[..., i].conj() if turned else cross[..., i] for i, turned in MIRRORED_PAIRS], -1)


def stride_patterns(clips: Sequence[MotionClip], growth: Mapping[str, float] = FREQUENCY_GROWTH) -> TensorDict:
    """Stride frequency and phases between the feet of every behaviour, means of its labelled clips.

    A gait with a leading leg and its mirror image are one pattern: each clip counts as that of its two images which is
    more like those before it.

    Source: phases from the fore-aft motion of the feet: data notes B.2, as in
    :func:`~agility_rl.motion.gait_analysis.measure_gait`.

    Args:
        clips: with labels.
        growth: strides that a second holds more of for each m/s faster [1/m], by behaviour; 0 where it does not say.

    Returns:
        ``[5]`` in the order of :data:`~agility_rl.behaviours.BEHAVIOURS`: ``frequency`` [Hz] at ``speed`` [m/s] and
        how it grows with that, ``growth`` [1/m]; ``duty``, the share of time in which a foot stands; ``share``, how
        much of the mean square of the feet's motion a sine of that frequency is; ``phase`` and ``mirrored_phase``
        ``[5, 6]`` [strides], in the order of :data:`~agility_rl.go2.constants.FOOT_PAIRS`, how far the first foot is
        ahead of the second.

    Raises:
        MotionError: if a behaviour has no clip.

    Example:
        >>> from agility_rl.motion.gaits import synthetic_dataset_clips
        >>> patterns = stride_patterns(synthetic_dataset_clips(0)[0])
        >>> trot = patterns[BEHAVIOURS.index("trot")]
        >>> bool((trot["phase"][4:].abs() < 0.1).all())  # diagonal feet swing together
        True
    """
    figures, crosses = [], []
    for name in BEHAVIOURS:
        own = [_spectrum(clip) for clip in clips if clip.label == name]
        if not own:
            raise MotionError(f"expected a clip labelled {name!r}, to take its rhythm from, got none")
        figures.append(torch.stack([figure for figure, _ in own]).mean(0))
        total = torch.zeros(len(FOOT_PAIRS), dtype=torch.complex64)
        for _, cross in own:
            image = mirrored(cross)
            nearer = (total.conj() * image).real.sum() > (total.conj() * cross).real.sum()
            total = total + torch.where(nearer, image, cross)
        crosses.append(total)
    whole, (frequency, speed, share, duty) = torch.stack(crosses), torch.stack(figures, 1)
    quickening = torch.tensor([growth.get(name, 0.0) for name in BEHAVIOURS])
    phases = {"phase": whole.angle() / (2 * torch.pi), "mirrored_phase": mirrored(whole).angle() / (2 * torch.pi)}
    pace = {"frequency": frequency, "speed": speed, "growth": quickening, "duty": duty, "share": share}
    return TensorDict({**pace, **phases}, [len(BEHAVIOURS)])


def _spectrum(clip: MotionClip) -> tuple[Tensor, Tensor]:
    """``[4]``, frequency [Hz], speed [m/s], share of a sine, duty factor; cross-spectra ``[6]`` of length one."""
    swing = detrend(level_feet(clip)[..., 0].float())
    frequency, cross = stride_spectrum(swing, clip.dt)
    angle = 2 * torch.pi * frequency.double() * clip.dt * torch.arange(len(swing))
    share = _sine_power(angle, swing.double()).sum() / swing.double().square().sum()
    speed = clip.root_linear_velocity[:, :2].norm(dim=-1).mean()
    return torch.stack((frequency, speed, share.float(), clip_stance_share(clip))), cross / cross.abs()


def _sine_power(angle: Tensor, signals: Tensor) -> Tensor:
    """Sum of squares ``[4]`` of the sines of phases ``[T]`` that fit signals ``[T, 4]`` best.

    The two normal equations are solved by hand: LAPACK's last bit depends on where its memory lies, and a run that
    goes on would then reward otherwise than one that never stopped.
    """
    cosine, sine = angle.cos(), angle.sin()
    both = (cosine * sine).sum()
    along, across = ((wave[:, None] * signals).sum(0) for wave in (cosine, sine))
    power = sine.square().sum() * along.square() + cosine.square().sum() * across.square() - 2 * both * along * across
    return power / (cosine.square().sum() * sine.square().sum() - both.square())
