"""Dog to Go2: a wooden dog whose answer is known, and the real one whose gaits must survive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants
from agility_rl.motion.clip import MotionError
from agility_rl.motion.edit import foot_slip
from agility_rl.motion.gait_analysis import classify_gait, measure_clip
from agility_rl.motion.keypoints import POINTS, Keypoints
from agility_rl.motion.retarget import NEUTRAL_PITCH, SCALE, TRUNK_LIFT, retarget

ROOTS = {"LeftArm": (0.24, 0.08), "RightArm": (0.24, -0.08), "LeftUpLeg": (-0.24, 0.05), "RightUpLeg": (-0.24, -0.05)}
TOES = {
    "LeftHand_End": (0.23, 0.03),
    "RightHand_End": (0.23, -0.03),
    "LeftFoot_End": (-0.26, 0.03),
    "RightFoot_End": (-0.26, -0.03),
}


def wooden_dog(speed: float = 0.0, yaw: float = 0.0, step: float = 0.0, frames: int = 120) -> Keypoints:
    """A rigid dog 0.36 m tall that slides forward; with ``step`` [s] each toe in turn stands still, then catches up."""
    dt = 1 / 60
    time = torch.arange(frames, dtype=torch.float64) * dt
    position = torch.zeros(frames, len(POINTS), 3, dtype=torch.float64)
    for name, (x, y) in ROOTS.items():
        position[:, POINTS.index(name)] = torch.tensor([x, y, 0.36], dtype=torch.float64)
        position[:, POINTS.index(name), 0] += speed * time
    for number, (name, (x, y)) in enumerate(TOES.items()):
        toe = position[:, POINTS.index(name)]
        toe[:, 0], toe[:, 1], toe[:, 2] = x, y, 0.01
        if step:
            cycle = time / step + number / 4
            stride, inside = cycle.floor(), cycle - cycle.floor()
            swing = ((inside - 0.6) / 0.4).clamp(0.0, 1.0)
            toe[:, 0] += speed * step * (stride - number / 4 + 0.3 + swing * swing * (3 - 2 * swing))
            toe[:, 2] += 0.08 * torch.sin(torch.pi * swing)
        else:
            toe[:, 0] += speed * time
    zero = torch.zeros((), dtype=torch.float64)
    turn = rotations.from_euler(zero, zero, zero + yaw)
    return Keypoints("wood", dt, rotations.rotate(turn, position))


def test_a_standing_dog_becomes_a_standing_robot() -> None:
    clip = retarget(wooden_dog(), neutral_pitch=0.0)
    height = SCALE * 0.36 + TRUNK_LIFT
    torch.testing.assert_close(clip.root_position[:, 2], torch.full((120,), height), atol=2e-3, rtol=0.0)
    torch.testing.assert_close(clip.root_quaternion[0], torch.tensor([1.0, 0, 0, 0]), atol=1e-5, rtol=0.0)
    # Feet stand under the hips, on the floor.
    width = constants.HIP_OFFSET_Y + constants.ABDUCTION
    expected = torch.tensor([constants.HIP_OFFSET_X, width]) * torch.tensor([[1.0, 1], [1, -1], [-1, 1], [-1, -1]])
    torch.testing.assert_close(
        (clip.foot_position - clip.root_position[:, None])[0, :, :2], expected, atol=1e-4, rtol=0
    )
    assert clip.foot_contact.all()
    assert clip.joint_velocity.abs().max() < 1e-3


def test_a_floor_at_another_height_makes_no_difference() -> None:
    dog = wooden_dog(speed=1.0, step=0.5)
    raised = replace(dog, position=dog.position + torch.tensor([0.0, 0.0, 0.15]))
    for grounding in (1.0, None):
        here, there = retarget(dog, grounding=grounding), retarget(raised, grounding=grounding)
        torch.testing.assert_close(there.root_position, here.root_position)
        torch.testing.assert_close(there.joint_position, here.joint_position, atol=1e-4, rtol=0.0)


def test_speed_scales_and_direction_stays() -> None:
    clip = retarget(wooden_dog(speed=1.0, yaw=2.0, step=0.5))
    velocity = (clip.root_position[-1] - clip.root_position[0]) / clip.duration
    assert velocity[:2].norm().item() == pytest.approx(SCALE, rel=0.02)
    assert torch.atan2(velocity[1], velocity[0]).item() == pytest.approx(2.0, abs=0.01)
    _, pitch, yaw = rotations.to_euler(clip.root_quaternion)
    assert yaw.mean().item() == pytest.approx(2.0, abs=1e-3)
    assert pitch.mean().item() == pytest.approx(-NEUTRAL_PITCH, abs=1e-3)


def test_standing_toes_become_standing_feet() -> None:
    dog = wooden_dog(speed=0.8, yaw=-1.0, step=0.6, frames=200)
    clip = retarget(dog)
    toes = torch.stack([dog.point(name) for name in TOES], 1)
    # The middle of each stance, clear of lift-off, touchdown, and the smoothing around them.
    still = torch.zeros(200, 4, dtype=torch.bool)
    still[1:] = (toes[1:] - toes[:-1]).norm(dim=-1) < 1e-9
    middle = still.clone()
    for shift in range(1, 6):
        middle[shift:] &= still[:-shift]
        middle[:-shift] &= still[shift:]
    moved = (clip.foot_position[1:, :, :2] - clip.foot_position[:-1, :, :2]).norm(dim=-1) / clip.dt
    assert middle[1:].sum() > 100
    assert moved[middle[1:]].max() < 0.01


def test_joints_stay_within_limits_and_the_cost_is_told() -> None:
    clip = retarget(wooden_dog(speed=0.8, step=0.6), hip_limit=0.05, trunk_lift=0.25)
    assert clip.joint_position[:, ::3].abs().max() <= 0.05 + 1e-6
    assert (clip.joint_position >= torch.tensor(constants.JOINT_LOWER) - 1e-6).all()
    note = next(note for note in clip.notes if note.startswith("dog to Go2"))
    # A trunk 0.50 m high is out of reach of 0.43 m legs: clipped knees, and an error that cannot be overlooked.
    assert float(note.split("foot error ")[1].split(" m mean")[0]) > 0.01
    assert float(note.split("greatest, ")[1].split(" %")[0]) > 10.0


# Best clean stretches of the recordings, data notes B.3: behaviour, frames, dog speed [m/s], stride frequency [Hz].
STRETCHES = {
    "D1_073_KAN02_002": ("walk", 1262, 1718, 0.26, 0.86),
    "D1_008_KAN01_001": ("pace", 278, 1070, 1.0, 1.5),
    "D1_009_KAN01_002": ("trot", 218, 542, 1.85, 2.0),
    "D1_031_KAN01_001": ("trot", 470, 710, 1.85, 2.0),
    "D1_010_KAN01_001": ("canter", 374, 566, 2.9, 2.2),
    "D1_010_KAN01_003": ("canter", 2, 194, 2.9, 2.2),
    "D1_ex04_KAN02_003": ("jump", 2, 278, None, None),
}


@pytest.mark.parametrize("name", sorted(STRETCHES))
def test_gaits_of_the_real_dog_survive(data: Path, name: str) -> None:
    behaviour, start, stop, speed, frequency = STRETCHES[name]
    clip = retarget(data / "mann_bvh" / f"{name}.bvh", start=start, stop=stop, label=behaviour)
    figures = measure_clip(clip)
    assert classify_gait(figures) == behaviour == clip.label
    if speed is not None and frequency is not None:
        assert figures.speed.item() == pytest.approx(SCALE * speed, rel=0.2, abs=0.05)
        assert figures.stride_frequency.item() == pytest.approx(frequency, abs=0.3)
    else:
        assert 0.45 < figures.trunk_peak.item() < 0.6
    # The jumping dog climbs on steps, where the floor found per window is smooth and the real one is not.
    sink = 0.05 if behaviour == "jump" else 0.005
    assert clip.foot_position[..., 2].min() > constants.FOOT_RADIUS - sink
    # The released clips, retargeted by others, slip by .11 to .48 m/s by the notes' own measure.
    assert foot_slip(clip).mean < 0.35
    assert any("foot slip" in note for note in clip.notes)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0.0}, "expected a scale"),
        ({"hip_limit": 2.0}, "hip limit"),
        ({"label": "gallop"}, "label 'gallop' is no behaviour"),
        ({"start": 119}, "at least 2 frames, got 1"),
    ],
)
def test_impossible_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(MotionError, match=message):
        retarget(wooden_dog(), **options)  # type: ignore[arg-type]
