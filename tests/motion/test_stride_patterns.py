"""Rhythms of labelled clips: against the gait measurement, mirror images, and what is missing."""

from __future__ import annotations

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.motion import MotionError, synthesize_gait
from agility_rl.motion.edit import mirror
from agility_rl.motion.gait_analysis import clip_stance_share, detrend, level_feet, measure_clip
from agility_rl.motion.gaits import synthetic_dataset_clips
from agility_rl.motion.stride_patterns import FREQUENCY_GROWTH, mirrored, stride_patterns


def test_patterns_are_what_the_gait_measurement_finds() -> None:
    clips = [synthesize_gait(name) for name in BEHAVIOURS]
    patterns = stride_patterns(clips)
    for index, clip in enumerate(clips):
        found, phase = measure_clip(clip), patterns["phase"][index].abs()
        torch.testing.assert_close(patterns["frequency"][index], found.stride_frequency)
        torch.testing.assert_close(patterns["speed"][index], found.speed, atol=0.02, rtol=0.02)
        torch.testing.assert_close(patterns["duty"][index], found.duty.mean(), atol=0.09, rtol=0)
        torch.testing.assert_close(phase[0], found.phase_left_right_front)
        torch.testing.assert_close(phase[2:4].mean(), found.phase_lateral)
        torch.testing.assert_close(phase[4:].mean(), found.phase_diagonal)


def test_the_share_of_a_sine_is_what_the_power_spectrum_has_at_the_stride_frequency() -> None:
    """Of whole strides, the bins of a discrete Fourier transform are the sines."""
    clips = [synthesize_gait(name) for name in BEHAVIOURS]
    patterns = stride_patterns(clips)
    for index, clip in enumerate(clips):
        frequency = patterns["frequency"][index].item()
        strides = int(clip.num_frames * clip.dt * frequency)
        steps = round(strides / frequency / clip.dt)
        swing = level_feet(clip)[:steps, :, 0].float()
        power = torch.fft.rfft(swing - swing.mean(0), dim=0).abs().square().sum(-1)
        assert patterns["share"][index].item() == pytest.approx((power[strides] / power.sum()).item(), abs=0.06)


def test_the_share_of_a_sine_is_that_of_least_squares() -> None:
    for clip in synthetic_dataset_clips(0)[0]:
        patterns = stride_patterns([synthesize_gait(name) for name in BEHAVIOURS if name != clip.label] + [clip])
        pattern = patterns[BEHAVIOURS.index(str(clip.label))]
        swing = detrend(level_feet(clip)[..., 0].float())
        angle = 2 * torch.pi * pattern["frequency"] * clip.dt * torch.arange(len(swing))
        waves = torch.stack((angle.cos(), angle.sin()), 1)
        fitted = waves @ torch.linalg.lstsq(waves, swing).solution
        torch.testing.assert_close(pattern["share"], fitted.square().sum() / swing.square().sum())


def test_feet_stand_as_long_as_in_the_clips() -> None:
    clips = [synthesize_gait(name) for name in BEHAVIOURS]
    torch.testing.assert_close(stride_patterns(clips)["duty"], torch.stack([clip_stance_share(clip) for clip in clips]))


def test_faster_walks_hurry() -> None:
    clips = [synthesize_gait(name) for name in BEHAVIOURS]
    patterns = stride_patterns(clips)
    assert patterns["growth"].tolist() == [FREQUENCY_GROWTH["walk"], 0.0, 0.0, 0.0, 0.0]
    assert stride_patterns(clips, {"pace": 0.5})["growth"].tolist() == [0.0, 0.5, 0.0, 0.0, 0.0]


def test_a_mirrored_clip_has_the_mirrored_pattern() -> None:
    clips = [synthesize_gait(name) for name in BEHAVIOURS]
    one, other = (stride_patterns(some) for some in (clips, [mirror(clip) for clip in clips]))
    difference = torch.remainder(one["mirrored_phase"] - other["phase"] + 0.5, 1.0) - 0.5
    assert difference.abs().max() < 1e-3
    cross = torch.polar(torch.ones(6), torch.arange(6.0))
    assert torch.equal(mirrored(mirrored(cross)), cross)


def test_two_leads_of_a_gait_are_one_pattern() -> None:
    """Averaged as they are, a canter and its mirror image would make a bound, which neither is."""
    canter = synthesize_gait("canter")
    rest = [synthesize_gait(name) for name in BEHAVIOURS if name != "canter"]
    alone, both = stride_patterns([canter, *rest]), stride_patterns([canter, mirror(canter), *rest])
    index = BEHAVIOURS.index("canter")
    torch.testing.assert_close(both["phase"][index], alone["phase"][index], atol=1e-3, rtol=0)
    assert alone["phase"][index, 0].abs() > 0.05


def test_a_behaviour_without_a_clip_is_named() -> None:
    clips = [clip for clip in synthetic_dataset_clips(0)[0] if clip.label != "pace"]
    with pytest.raises(MotionError, match="'pace'"):
        stride_patterns(clips)
