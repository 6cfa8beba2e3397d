"""Synthetic gaits: recognised by the classifier, feet that stand still, a leap that obeys gravity."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS, COMMAND_RANGES
from agility_rl.go2 import constants
from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.gait_analysis import classify_gait, measure_clip
from agility_rl.motion.gaits import PATTERNS, synthesize_gait, synthetic_dataset_clips


def stance_speed(clip: MotionClip) -> torch.Tensor:
    """Horizontal speed of feet planted in two consecutive frames [m/s]."""
    both = clip.foot_contact[1:] & clip.foot_contact[:-1]
    moved = (clip.foot_position[1:, :, :2] - clip.foot_position[:-1, :, :2]).norm(dim=-1)
    return moved[both] / clip.dt


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
@pytest.mark.parametrize("speed", [None, "slow", "fast"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_classifier_names_every_gait(behaviour: str, speed: str | None, seed: int) -> None:
    low, high = COMMAND_RANGES[behaviour].velocity_x
    wanted = {None: None, "slow": max(low, 0.15), "fast": high}[speed]
    clip = synthesize_gait(behaviour, speed=wanted, seed=seed)
    figures = measure_clip(clip)
    assert classify_gait(figures) == behaviour == clip.label
    assert figures.speed.item() == pytest.approx(PATTERNS[behaviour].speed[0] if wanted is None else wanted, abs=0.02)


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_stance_feet_do_not_slip_or_sink(behaviour: str, turn: float) -> None:
    clip = synthesize_gait(behaviour, yaw_rate=turn, lateral=0.1)
    assert stance_speed(clip).max() < 1e-3
    sole = clip.foot_position[..., 2] - constants.FOOT_RADIUS
    assert sole.min() > -1e-4
    assert sole[clip.foot_contact].abs().max() < 1e-4


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
def test_joints_stay_within_stops_and_speeds_of_the_robot(behaviour: str) -> None:
    clip = synthesize_gait(behaviour, speed=COMMAND_RANGES[behaviour].velocity_x[1])
    assert (clip.joint_position >= torch.tensor(constants.JOINT_LOWER)).all()
    assert (clip.joint_position <= torch.tensor(constants.JOINT_UPPER)).all()
    assert (clip.joint_velocity.abs() <= torch.tensor(constants.VELOCITY_LIMIT)).all()


def test_turning_and_side_steps_follow_the_request() -> None:
    figures = measure_clip(synthesize_gait("pace", speed=0.8, yaw_rate=-0.6, lateral=0.15))
    assert figures.yaw_rate.item() == pytest.approx(-0.6, abs=0.01)
    assert figures.lateral_speed.item() == pytest.approx(0.15, abs=0.01)
    assert classify_gait(figures) == "pace"


@pytest.mark.parametrize("peak", [0.45, 0.50, 0.55])
def test_the_jump_is_ballistic_and_reaches_its_peak(peak: float) -> None:
    clip = synthesize_gait("jump", height=peak, duration=3.0)
    height = clip.root_position[:, 2].double()
    assert height.max().item() == pytest.approx(peak, abs=0.004)
    free = height > PATTERNS["jump"].height + 0.005
    inner = free[:-2] & free[1:-1] & free[2:]
    acceleration = ((height[2:] - 2 * height[1:-1] + height[:-2]) / clip.dt**2)[inner]
    assert inner.sum() > 20
    torch.testing.assert_close(acceleration, torch.full_like(acceleration, -9.81), atol=0.02, rtol=0.0)
    assert not clip.foot_contact[free].any(), "a foot on the ground during the ballistic flight"
    rise = peak - PATTERNS["jump"].height
    assert free.double().mean().item() == pytest.approx(2 * math.sqrt(2 * rise / 9.81) / jump_period(clip), abs=0.08)


def jump_period(clip: MotionClip) -> float:
    """Seconds between two peaks of the trunk."""
    height = clip.root_position[:, 2]
    peaks = ((height[1:-1] > height[:-2]) & (height[1:-1] >= height[2:]) & (height[1:-1] > 0.42)).nonzero().flatten()
    return float((peaks[-1] - peaks[0]) / (len(peaks) - 1)) * clip.dt


def test_figures_lie_near_those_of_the_dog() -> None:
    # Data notes B.2, ranges of the labelled clips: stride frequency, FL-FR, lateral, diagonal phase.
    ranges = {
        "walk": ((0.6, 1.2), (0.41, 0.50), (0.17, 0.21), (0.29, 0.33)),
        "pace": ((1.4, 1.6), (0.47, 0.50), (0.02, 0.05), (0.45, 0.48)),
        "trot": ((2.0, 2.2), (0.48, 0.50), (0.44, 0.47), (0.02, 0.06)),
        "canter": ((2.1, 2.3), (0.12, 0.23), (0.21, 0.39), (0.21, 0.44)),
    }
    for behaviour, expected in ranges.items():
        m = measure_clip(synthesize_gait(behaviour))
        got = (m.stride_frequency, m.phase_left_right_front, m.phase_lateral, m.phase_diagonal)
        for (low, high), value in zip(expected, got, strict=True):
            assert low - 0.025 <= value.item() <= high + 0.025, (behaviour, expected, [x.item() for x in got])


def test_seeds_vary_clips_and_repeat_them() -> None:
    first, again, other = (synthesize_gait("trot", seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.joint_position, again.joint_position)
    assert not torch.equal(first.joint_position, other.joint_position)


def test_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    synthetic_dataset_clips(0)
    assert torch.equal(before, torch.get_rng_state())


def test_dataset_holds_every_behaviour_and_says_that_it_is_synthetic() -> None:
    labelled, unlabelled = synthetic_dataset_clips(1)
    assert {clip.label for clip in labelled} == set(BEHAVIOURS)
    assert all(clip.label is None for clip in unlabelled)
    assert all(clip.synthetic and clip.source == "gait generator" for clip in labelled + unlabelled)
    assert len({clip.name for clip in labelled + unlabelled}) == len(labelled) + len(unlabelled)
    named = [classify_gait(measure_clip(clip)) for clip in unlabelled]
    assert named == [clip.name.split("_")[1] for clip in unlabelled]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"behaviour": "gallop"}, "'gallop' is no behaviour; expected one of walk"),
        ({"behaviour": "walk", "duration": 0.0}, "duration"),
        ({"behaviour": "walk", "speed": math.nan}, "finite"),
        ({"behaviour": "walk", "height": 0.6}, "trunk height of 0.20 to 0.38"),
        ({"behaviour": "jump", "height": 0.30}, "trunk peak"),
        ({"behaviour": "canter", "speed": 9.0, "height": 0.37}, "legs too short"),
    ],
)
def test_impossible_requests_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        synthesize_gait(**options)  # type: ignore[arg-type]
