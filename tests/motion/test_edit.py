from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.motion import synthesize_gait
from agility_rl.motion.clip import MotionClip, MotionError, central_difference, clip_from_joints
from agility_rl.motion.edit import bend, curvature_limits, floor_height, foot_slip, ground, mirror, resample
from agility_rl.motion.formats import load_clip


def soles(clip: MotionClip) -> torch.Tensor:
    return clip.foot_position[..., 2] - constants.FOOT_RADIUS


def test_resampling_keeps_the_motion(make_clip: Callable[..., MotionClip]) -> None:
    coarse, fine = make_clip(frames=31, dt=1 / 30), make_clip(frames=51, dt=0.02)
    again = resample(coarse, 0.02)
    assert again.num_frames == 51 and again.dt == 0.02
    assert torch.allclose(again.root_position, fine.root_position, atol=1e-5)
    # Linear interpolation of 0.1 sin(6 t) over 33 ms errs by at most 0.1 * 36 * dt^2 / 8 = 0.5 mrad.
    assert (again.joint_position - fine.joint_position).abs().max() < 6e-4
    assert rotations.difference(again.root_quaternion, fine.root_quaternion).norm(dim=-1).max() < 1e-3
    assert torch.allclose(again.root_linear_velocity, fine.root_linear_velocity, atol=1e-3)


def test_resampled_feet_belong_to_resampled_joints(make_clip: Callable[..., MotionClip]) -> None:
    clip = resample(make_clip(frames=31, dt=1 / 30))
    feet = clip.root_position[:, None] + rotations.rotate(
        clip.root_quaternion[:, None], kinematics.forward(clip.joint_position)
    )
    assert torch.allclose(feet, clip.foot_position, atol=1e-6)


def test_resampling_to_the_same_rate_changes_nothing(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    assert resample(clip, 0.02) is clip


def test_resampling_a_clip_shorter_than_a_step_is_refused(make_clip: Callable[..., MotionClip]) -> None:
    with pytest.raises(MotionError, match="too short"):
        resample(make_clip(frames=2, dt=0.005), 0.02)


def test_a_mirror_image_of_a_mirror_image_is_the_clip(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    twice = mirror(mirror(clip))
    for name in ("root_position", "root_quaternion", "joint_position", "root_angular_velocity", "foot_position"):
        assert torch.equal(getattr(clip, name), getattr(twice, name)), name


def test_a_mirror_image_is_a_consistent_clip(make_clip: Callable[..., MotionClip]) -> None:
    """Feet, velocities and contacts of the image are those that its own poses give."""
    image = mirror(make_clip())
    rebuilt = clip_from_joints("x", image.dt, image.root_position, image.root_quaternion, image.joint_position)
    for name in ("foot_position", "root_linear_velocity", "root_angular_velocity", "joint_velocity"):
        assert torch.allclose(getattr(image, name), getattr(rebuilt, name), atol=1e-5), name
    assert torch.equal(image.foot_contact, rebuilt.foot_contact)


def test_a_mirror_image_turns_the_other_way(make_clip: Callable[..., MotionClip]) -> None:
    clip = make_clip()
    roll, pitch, yaw = rotations.to_euler(clip.root_quaternion)
    image_roll, image_pitch, image_yaw = rotations.to_euler(mirror(clip).root_quaternion)
    assert torch.allclose(image_roll, -roll, atol=1e-6)
    assert torch.allclose(image_pitch, pitch, atol=1e-6)
    assert torch.allclose(image_yaw, -yaw, atol=1e-6)


@pytest.fixture
def trotting() -> MotionClip:
    return synthesize_gait("trot")


def test_a_path_bent_by_nothing_is_the_path(trotting: MotionClip) -> None:
    image = bend(trotting, 0.0)
    for name in ("root_position", "joint_position", "foot_position"):
        assert torch.allclose(getattr(image, name), getattr(trotting, name), atol=2e-5), name


def test_a_bent_path_is_an_arc_and_the_trunk_turns_along(trotting: MotionClip) -> None:
    """The trunk's track lies on a circle of radius 1 / curvature around a centre to the left, at unchanged heights."""
    curvature = 0.8
    image = bend(trotting, curvature)
    straight = trotting.root_position[:, :2] - trotting.root_position[0, :2]
    course = torch.atan2(straight[-1, 1], straight[-1, 0])
    centre = trotting.root_position[0, :2] + torch.stack((-course.sin(), course.cos())) / curvature
    across = straight @ torch.stack((-course.sin(), course.cos()))
    radius = (image.root_position[:, :2] - centre).norm(dim=-1)
    assert torch.allclose(radius, 1 / curvature - across, atol=1e-4)
    assert torch.allclose(image.root_position[:, 2], trotting.root_position[:, 2])
    along = straight @ torch.stack((course.cos(), course.sin()))
    yaw = rotations.to_euler(image.root_quaternion)[2] - rotations.to_euler(trotting.root_quaternion)[2]
    assert torch.allclose(rotations.wrap_angle(yaw - curvature * along), torch.zeros_like(yaw), atol=1e-4)
    for turned, kept in zip(
        rotations.to_euler(image.root_quaternion)[:2], rotations.to_euler(trotting.root_quaternion)[:2], strict=True
    ):
        assert torch.allclose(turned, kept, atol=1e-4)


def test_standing_feet_stand_on_a_bent_path_too(trotting: MotionClip) -> None:
    image = bend(trotting, 1.0)
    assert torch.equal(image.foot_contact, trotting.foot_contact)
    assert foot_slip(image).mean == pytest.approx(foot_slip(trotting).mean, abs=0.02)
    assert torch.allclose(image.foot_position[..., 2], trotting.foot_position[..., 2], atol=1e-4)


def test_a_path_bent_to_the_right_is_the_mirror_image_of_one_bent_to_the_left(trotting: MotionClip) -> None:
    right, left = mirror(bend(mirror(trotting), 0.7)), bend(trotting, -0.7)
    for name in ("root_position", "joint_position", "root_angular_velocity"):
        assert torch.allclose(getattr(right, name), getattr(left, name), atol=2e-3), name


def test_a_clip_on_the_spot_keeps_its_feet_apart(trotting: MotionClip) -> None:
    """No travel, no direction of it: the world's x is as good as any, and nothing may collapse."""
    still = clip_from_joints(
        "still",
        0.02,
        trotting.root_position[:1].repeat(3, 1),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
        trotting.joint_position[:1].repeat(3, 1),
    )
    image = bend(still, 0.5)
    assert torch.allclose(image.root_position, still.root_position)
    assert (image.foot_position - still.foot_position).abs().max() < 0.05


def test_a_path_is_not_bent_until_it_crosses_itself(trotting: MotionClip) -> None:
    low, high = curvature_limits(trotting)
    bend(trotting, high)
    for curvature in (high * 1.01, low * 1.01):
        with pytest.raises(MotionError, match=r"curvature .*, expected -\d\.\d\d to \d\.\d\d"):
            bend(trotting, curvature)


def test_grounding_lifts_the_floor_and_keeps_the_flight(hop: MotionClip) -> None:
    grounded = ground(hop)
    lowest = soles(grounded).min(-1).values
    assert lowest[:25].abs().max() < 2e-3 and lowest[-24:].abs().max() < 2e-3
    assert lowest.max() == pytest.approx(4.905 * 0.15 * 0.15, abs=2e-3)
    assert (~grounded.foot_contact).all(-1).float().mean() == pytest.approx(0.2, abs=0.05)


def test_grounding_follows_a_step_up_and_a_drift(hop: MotionClip) -> None:
    """A floor that rises by 15 cm half way and sinks by 2 cm a second is found again."""
    clip = replace_height(hop_many(hop), lambda time: 0.15 * (time > 3.0) - 0.02 * time)
    lowest = soles(ground(clip)).min(-1).values
    standing = soles(hop_many(hop)).min(-1).values < -0.069
    away = (torch.arange(clip.num_frames) * 0.02 - 3.0).abs() > 0.6
    assert lowest[standing & away].abs().max() < 0.02
    assert lowest.max() > 0.08


def hop_many(hop: MotionClip) -> MotionClip:
    times = 5
    return clip_from_joints(
        "hops",
        hop.dt,
        hop.root_position.repeat(times, 1),
        hop.root_quaternion.repeat(times, 1),
        hop.joint_position.repeat(times, 1),
    )


def replace_height(clip: MotionClip, floor: Callable[[torch.Tensor], torch.Tensor]) -> MotionClip:
    time = torch.arange(clip.num_frames) * clip.dt
    position = clip.root_position.clone()
    position[:, 2] += floor(time)
    return clip_from_joints(clip.name, clip.dt, position, clip.root_quaternion, clip.joint_position)


def test_grounding_twice_changes_little(hop: MotionClip) -> None:
    once = ground(hop)
    assert (ground(once).root_position - once.root_position).abs().max() < 2e-3


def test_grounding_keeps_velocity_the_derivative_of_position(hop: MotionClip) -> None:
    clip = ground(replace_height(hop_many(hop), lambda time: 0.15 * (time > 3.0)))
    derived = central_difference(clip.root_position, clip.dt)
    assert torch.allclose(clip.root_linear_velocity, derived, atol=1e-4)


def test_a_glitch_does_not_lift_the_clip(hop: MotionClip) -> None:
    feet = hop.foot_position.clone()
    feet[10, 0, 2] -= 0.3
    assert torch.allclose(floor_height(replace(hop, foot_position=feet)), floor_height(hop), atol=5e-3)


def test_grounding_a_clip_shorter_than_the_window(hop: MotionClip) -> None:
    assert soles(ground(hop.slice(0, 5))).abs().max() < 1e-4


def test_standing_feet_do_not_slip_and_dragged_ones_do(hop: MotionClip) -> None:
    standing = ground(hop).slice(0, 20)
    assert foot_slip(standing).mean == pytest.approx(0.0, abs=1e-6)
    position = standing.root_position + torch.arange(20)[:, None] * torch.tensor([0.01, 0.0, 0.0])
    dragged = clip_from_joints("drag", 0.02, position, standing.root_quaternion, standing.joint_position)
    assert foot_slip(dragged).mean == pytest.approx(0.5, rel=1e-3)
    assert foot_slip(dragged).contact_share == 1.0


@pytest.mark.parametrize("name", ["jump_0", "jump_1", "jump_4"])
def test_real_jumps_stay_airborne(data: Path, name: str) -> None:
    clip = load_clip(data / "nju_go2_json" / "labelled" / f"{name}.json")
    # Data notes, section B.2: airborne 27 to 33 %, trunk up to 0.51 m.
    assert 0.25 < (~clip.foot_contact).all(-1).float().mean() < 0.38
    assert 0.48 < clip.root_position[:, 2].max() < 0.53


@pytest.mark.parametrize("name", ["9", "29", "30", "35"])
def test_wrong_floors_are_put_right(data: Path, name: str) -> None:
    """Trunks between 0.15 and 0.45 m and soles on the floor where the file goes down to -0.2 m."""
    raw = load_clip(data / "nju_go2_json" / "unlabelled" / f"{name}.json", grounding=None)
    clip = ground(raw)
    height = clip.root_position[:, 2]
    assert height.min() > 0.2 and height.max() < 0.45
    lowest = soles(clip).min(-1).values
    assert (lowest < -0.03).float().mean() < 0.02
    assert (lowest > 0.05).float().mean() < 0.03
    if name in ("29", "30"):
        assert raw.root_position[:, 2].min() < 0.0
