"""In which rhythm the feet of a dog swing in each behaviour: stride frequency and phases of labelled clips."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.go2.constants import FOOT_PAIRS
from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.gait_analysis import detrend, level_feet, stride_spectrum

MIRRORED_PAIRS = ((0, True), (1, True), (3, False), (2, False), (5, False), (4, False))
"""Which of :data:`~agility_rl.go2.constants.FOOT_PAIRS` each of them becomes in a mirror, and whether its feet change
places."""


def mirrored(cross: Tensor) -> Tensor:
    """Cross-spectra ``[*B, 6]`` of the same gait in a mirror: left feet are right ones.

    Example:
        >>> lead = torch.tensor([1j, 1j, 1.0, -1.0, 1.0, -1.0])  # FL a quarter of a stride ahead of FR, ...
        >>> [complex(number) for number in mirrored(lead)[:4]]
        [-1j, -1j, (-1+0j), (1+0j)]
    """
    return torch.stack([cross[..., i].conj() if turned else cross[..., i] for i, turned in MIRRORED_PAIRS], -1)


def stride_patterns(clips: Sequence[MotionClip]) -> TensorDict:
    """Stride frequency and phases between the feet of every behaviour, means of its labelled clips.

    A gait with a leading leg and its mirror image are one pattern: each clip counts as that of its two images which is
    more like those before it.

    Source: phases from the fore-aft motion of the feet: data notes B.2, as in
    :func:`~agility_rl.motion.gait_analysis.measure_gait`.

    Args:
        clips: with labels.

    Returns:
        ``[5]`` in the order of :data:`~agility_rl.behaviours.BEHAVIOURS`: ``frequency`` [Hz]; ``phase`` and
        ``mirrored_phase`` ``[5, 6]`` [strides], in the order of :data:`~agility_rl.go2.constants.FOOT_PAIRS`,
        how far the first foot is ahead of the second.

    Raises:
        MotionError: if a behaviour has no clip.

    Example:
        >>> from agility_rl.motion.gaits import synthetic_dataset_clips
        >>> patterns = stride_patterns(synthetic_dataset_clips(0)[0])
        >>> trot = patterns[BEHAVIOURS.index("trot")]
        >>> bool((trot["phase"][4:].abs() < 0.1).all())  # diagonal feet swing together
        True
    """
    frequencies, crosses = [], []
    for name in BEHAVIOURS:
        own = [_spectrum(clip) for clip in clips if clip.label == name]
        if not own:
            raise MotionError(f"expected a clip labelled {name!r}, to take its rhythm from, got none")
        frequencies.append(torch.stack([frequency for frequency, _ in own]).mean())
        total = torch.zeros(len(FOOT_PAIRS), dtype=torch.complex64)
        for _, cross in own:
            image = mirrored(cross)
            nearer = (total.conj() * image).real.sum() > (total.conj() * cross).real.sum()
            total = total + torch.where(nearer, image, cross)
        crosses.append(total)
    whole = torch.stack(crosses)
    phases = {"phase": whole.angle() / (2 * torch.pi), "mirrored_phase": mirrored(whole).angle() / (2 * torch.pi)}
    return TensorDict({"frequency": torch.stack(frequencies), **phases}, [len(BEHAVIOURS)])


def _spectrum(clip: MotionClip) -> tuple[Tensor, Tensor]:
    """Stride frequency ``()`` and cross-spectra ``[6]`` of length one."""
    frequency, cross = stride_spectrum(detrend(level_feet(clip)[..., 0].float()), clip.dt)
    return frequency, cross / cross.abs()
