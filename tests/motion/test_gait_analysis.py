"""Phases, frequencies and names of gaits, from feet drawn by hand and from the labelled dog."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from agility_rl.motion import gait_analysis as gait
from agility_rl.motion.formats import load_clip
from agility_rl.motion.gaits import synthesize_gait

Stretch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def stretch(
    phase: tuple[float, float, float, float],
    *,
    frequency: float = 2.0,
    speed: float = 1.0,
    seconds: float = 3.0,
    dt: float = 0.02,
    amplitude: float = 0.1,
    drift: float = 0.0,
) -> Stretch:
    """Feet that swing as sines of known phases under a level trunk, 40 % of the time on the ground."""
    t = torch.arange(round(seconds / dt)) * dt
    cycle = frequency * t[:, None] - torch.tensor(phase)
    x = amplitude * torch.cos(2 * torch.pi * cycle) + drift * t[:, None]
    feet = torch.stack((x, torch.zeros_like(x), torch.full_like(x, -0.29)), -1)
    velocity = torch.tensor([speed, 0.0, 0.0]).expand(len(t), 3)
    return feet, (cycle % 1.0) < 0.4, torch.full((len(t),), 0.31), velocity, torch.full((len(t),), 0.2)


def measurement(**figures: float) -> gait.GaitMeasurement:
    """A measurement of one stretch, by default a trot."""
    values = {
        "speed": 1.2,
        "lateral_speed": 0.0,
        "yaw_rate": 0.0,
        "stride_frequency": 2.0,
        "phase_left_right_front": 0.5,
        "phase_left_right_hind": 0.5,
        "phase_lateral": 0.46,
        "phase_diagonal": 0.04,
        "foot_motion": 0.08,
        "trunk_mean": 0.31,
        "trunk_median": 0.31,
        "trunk_low": 0.3,
        "trunk_peak": 0.33,
        "flight": 0.1,
    }
    tensors = {name: torch.tensor(value) for name, value in (values | figures).items()}
    return gait.GaitMeasurement(duty=torch.full((4,), 0.4), **tensors)


def test_phases_frequency_and_duty_of_known_sines() -> None:
    m = gait.measure_gait(*stretch((0.0, 0.3, 0.1, 0.45), frequency=1.7))
    assert m.phase_left_right_front.item() == pytest.approx(0.3, abs=0.01)
    assert m.phase_left_right_hind.item() == pytest.approx(0.35, abs=0.01)
    assert m.phase_lateral.item() == pytest.approx((0.1 + 0.15) / 2, abs=0.01)
    assert m.phase_diagonal.item() == pytest.approx((0.45 + 0.2) / 2, abs=0.01)
    assert m.stride_frequency.item() == pytest.approx(1.7, abs=0.1)
    assert m.duty.tolist() == pytest.approx([0.4] * 4, abs=0.03)
    assert (m.speed.item(), m.yaw_rate.item()) == pytest.approx((1.0, 0.2))


def test_phases_fold_at_half_a_stride_and_ignore_drift() -> None:
    m = gait.measure_gait(*stretch((0.9, 0.0, 0.6, 0.0), drift=0.1))
    assert m.phase_left_right_front.item() == pytest.approx(0.1, abs=0.01)
    assert m.phase_left_right_hind.item() == pytest.approx(0.4, abs=0.01)


def test_the_stretch_may_hold_little_more_than_one_stride() -> None:
    m = gait.measure_gait(*stretch((0.0, 0.15, 0.4, 0.0), frequency=2.3, seconds=0.6))
    assert m.phase_left_right_front.item() == pytest.approx(0.15, abs=0.04)
    assert m.stride_frequency.item() == pytest.approx(2.3, abs=0.4)


def test_flight_counts_frames_without_any_foot_on_the_ground() -> None:
    feet, contact, height, velocity, yaw = stretch((0.0, 0.0, 0.0, 0.0))
    m = gait.measure_gait(feet, contact, height, velocity, yaw)
    assert m.flight.item() == pytest.approx(0.6, abs=0.03)


def test_batches_equal_single_stretches() -> None:
    phases = [(0.0, 0.5, 0.5, 0.0), (0.0, 0.5, 0.03, 0.5), (0.0, 0.18, 0.25, 0.4)]
    single = [gait.measure_gait(*stretch(phase)) for phase in phases]
    batch = [torch.stack(parts) for parts in zip(*(stretch(phase) for phase in phases), strict=True)]
    together = gait.measure_gait(*batch)  # type: ignore[arg-type]
    torch.testing.assert_close(together.phase_lateral, torch.stack([m.phase_lateral for m in single]))
    torch.testing.assert_close(together.duty, torch.stack([m.duty for m in single]))
    assert gait.classify_index(together).tolist() == [2, 1, 3]


def test_shapes_and_length_are_checked() -> None:
    feet, contact, height, velocity, yaw = stretch((0.0, 0.5, 0.5, 0.0))
    with pytest.raises(ValueError, match=r"foot_contact has shape \(150, 3\), expected \(150, 4\)"):
        gait.measure_gait(feet, contact[:, :3], height, velocity, yaw)
    with pytest.raises(ValueError, match=r"at least 0\.3 s"):
        gait.measure_gait(*(part[:10] for part in (feet, contact, height, velocity, yaw)))
    with pytest.raises(ValueError, match="one stretch"):
        gait.classify_gait(measurement().map(lambda value: value.expand(2, *value.shape)))


@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        ({}, "trot"),
        ({"phase_lateral": 0.03, "phase_diagonal": 0.47}, "pace"),
        ({"phase_lateral": 0.2, "phase_diagonal": 0.3, "speed": 0.3}, "walk"),
        ({"phase_lateral": 0.12, "phase_diagonal": 0.38, "speed": 0.6}, "walk"),
        ({"phase_lateral": 0.12, "phase_diagonal": 0.38, "speed": 1.0}, "pace"),
        ({"phase_left_right_front": 0.18, "phase_left_right_hind": 0.16, "phase_lateral": 0.25}, "canter"),
        ({"phase_left_right_front": 0.02, "phase_left_right_hind": 0.02, "phase_lateral": 0.4}, "other"),
        ({"phase_lateral": 0.25, "phase_diagonal": 0.25}, "other"),
        ({"trunk_peak": 0.5}, "jump"),
        ({"trunk_peak": 0.45, "trunk_low": 0.4}, "trot"),
        ({"speed": 0.01, "foot_motion": 0.002}, "stand"),
        ({"speed": 0.01, "foot_motion": 0.05}, "walk"),
        ({"speed": 0.3}, "trot"),
    ],
)
def test_classification_rule(figures: dict[str, float], expected: str) -> None:
    assert gait.classify_gait(measurement(**figures)) == expected


def test_episodes_go_by_majority_and_figures_by_the_winning_windows() -> None:
    trot, pace = stretch((0.0, 0.5, 0.5, 0.0), speed=1.2), stretch((0.0, 0.5, 0.0, 0.5), speed=0.6)
    episode = [torch.cat((a, b, a)) for a, b in zip(trot, pace, strict=True)]
    windows = gait.measure_windows(*episode, window=3.0)  # type: ignore[arg-type]
    assert [gait.GAIT_LABELS[i] for i in gait.classify_index(windows)] == ["trot", "pace", "trot"]
    label, figures = gait.classify_episodes(windows)
    assert gait.GAIT_LABELS[int(label)] == "trot"
    assert figures.speed.item() == pytest.approx(1.2)
    assert figures.duty.shape == (4,)


def test_half_a_thousand_episodes_at_once() -> None:
    one = stretch((0.0, 0.5, 0.5, 0.0), seconds=20.0)
    many = [part.expand(500, *part.shape) for part in one]
    label, _ = gait.classify_episodes(gait.measure_windows(*many))  # type: ignore[arg-type]
    assert label.tolist() == [2] * 500


def test_a_turned_clip_measures_the_same() -> None:
    clip = synthesize_gait("trot", duration=2.0)
    turn = torch.tensor([0.0, 0.0, 0.0, 1.0])  # half a turn about z
    around = torch.tensor([-1.0, -1.0, 1.0])
    w, x, y, z = clip.root_quaternion.unbind(-1)
    turned = replace(
        clip,
        root_position=clip.root_position * around,
        root_quaternion=torch.stack((-z, -y, x, w), -1) * turn.norm(),
        root_linear_velocity=clip.root_linear_velocity * around,
        foot_position=clip.foot_position * around,
    )
    there, back = gait.measure_clip(clip), gait.measure_clip(turned)
    assert back.speed.item() == pytest.approx(there.speed.item(), abs=1e-4)
    assert back.phase_diagonal.item() == pytest.approx(there.phase_diagonal.item(), abs=1e-3)


# Forward speed, FL-FR phase and stride frequency of the labelled clips as data notes B.2 tabulates them.
DOG = {
    "walk_0": (0.17, 0.41, 0.44, 0.8),
    "walk_2": (0.12, 0.41, 0.44, 0.6),
    "pace_0": (0.67, 0.47, 0.49, 1.6),
    "pace_2": (0.48, 0.47, 0.49, 1.4),
    "trot_0": (1.20, 0.49, 0.50, 2.1),
    "trot_1": (1.29, 0.49, 0.50, 2.1),
    "canter_0": (1.90, 0.12, 0.23, 2.25),
    "canter_3": (1.79, 0.12, 0.23, 2.25),
}


def test_labelled_dog_clips_are_named_rightly(data: Path) -> None:
    folder = data / "nju_go2_json" / "labelled"
    clips = [load_clip(path, label="from name") for path in sorted(folder.glob("*.json"))]
    named = [gait.classify_gait(gait.measure_clip(clip)) for clip in clips]
    right = sum(clip.label == name for clip, name in zip(clips, named, strict=True))
    assert len(clips) == 12
    assert right >= 11, list(zip((clip.name for clip in clips), named, strict=True))


@pytest.mark.parametrize("name", sorted(DOG))
def test_dog_figures_agree_with_an_independent_measurement(data: Path, name: str) -> None:
    speed, low, high, frequency = DOG[name]
    m = gait.measure_clip(load_clip(data / "nju_go2_json" / "labelled" / f"{name}.json"))
    assert m.speed.item() == pytest.approx(speed, abs=0.1)
    assert low - 0.02 <= m.phase_left_right_front.item() <= high + 0.02
    assert m.stride_frequency.item() == pytest.approx(frequency, abs=0.16)


def test_names_that_lie_do_not_mislead(data: Path) -> None:
    lying = data / "a1_metalhead" / "mocap_motions_jump_cmd" / "trot_forward0.json"
    windows = gait.measure_clip(load_clip(lying), window=3.0)
    assert gait.GAIT_LABELS[int(gait.classify_episodes(windows)[0])] == "pace"


@pytest.mark.parametrize("name", gait.BEHAVIOURS)
def test_stance_share_is_the_planned_duty_of_synthetic_gaits(name: str) -> None:
    clip = synthesize_gait(name, yaw_rate=0.3)
    assert gait.clip_stance_share(clip) == pytest.approx(float(clip.foot_contact.float().mean()), abs=0.09)
