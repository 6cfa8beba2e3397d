"""Joint targets of a clip: the added terms by hand, and what the engine does with them."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import constants, kinematics
from agility_rl.motion import synthesize_gait
from agility_rl.motion.clip import MotionClip, MotionError, clip_from_joints
from agility_rl.motion.tracking import foot_jacobian, joint_targets
from agility_rl.simulation import make_simulator

POSE = torch.tensor(constants.DEFAULT_POSE)
LEVEL = torch.tensor([1.0, 0.0, 0.0, 0.0])


def still(height: float, frames: int = 9) -> MotionClip:
    position = torch.tensor([0.0, 0.0, height]).expand(frames, 3)
    return clip_from_joints("still", 0.02, position, LEVEL.expand(frames, 4), POSE.expand(frames, 12))


def test_jacobian_is_the_derivative_of_the_kinematics() -> None:
    joints = POSE.double() + 0.2 * torch.randn(6, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    jacobian, step = foot_jacobian(joints), 1e-6
    for leg in range(4):
        for joint in range(3):
            move = step * torch.eye(12, dtype=torch.float64)[3 * leg + joint]
            change = (kinematics.forward(joints + move) - kinematics.forward(joints - move))[:, leg] / (2 * step)
            torch.testing.assert_close(jacobian[:, leg, :, joint], change, rtol=0.0, atol=1e-8)


def test_still_in_the_air_asks_for_the_pose_itself() -> None:
    torch.testing.assert_close(joint_targets(still(1.0)), POSE.expand(9, 12))


def test_standing_adds_the_static_torque() -> None:
    # A calf carries m g / 4 with the horizontal distance from knee to foot as its lever.
    added = constants.STIFFNESS * (joint_targets(still(constants.STANDING_HEIGHT), load=1.0) - POSE)[0, 2]
    foot, knee = kinematics.forward(POSE)[0, 0], constants.HIP_OFFSET_X - constants.THIGH * math.sin(0.9)
    expected = constants.TOTAL_MASS * constants.GRAVITY / 4.0 * (foot - knee)
    torch.testing.assert_close(added.abs(), expected.abs(), rtol=1e-4, atol=0.0)
    assert added > 0.0  # the knee is asked to be straighter


def test_damping_leads_a_moving_joint_in_the_air() -> None:
    clip = synthesize_gait("trot")
    lifted = clip_from_joints(
        "air", clip.dt, clip.root_position + torch.tensor([0.0, 0.0, 1.0]), clip.root_quaternion, clip.joint_position
    )
    expected = lifted.joint_position[1:] + 2.0 / 50.0 * lifted.joint_velocity[1:]
    torch.testing.assert_close(joint_targets(lifted, stiffness=50.0, damping=2.0)[:-1], expected)


@pytest.mark.parametrize(("load", "least", "most"), [(0.0, 0.02, 0.08), (1.0, 0.0, 0.012)])
def test_the_engine_stands_where_the_clip_does_when_the_load_is_compensated(
    load: float, least: float, most: float
) -> None:
    simulator = make_simulator(num_simulations=1, num_threads=1)
    simulator.reset(
        torch.ones(1, dtype=torch.bool),
        root_position=torch.tensor([[0.0, 0.0, constants.STANDING_HEIGHT]]),
        root_quaternion=LEVEL[None],
        root_linear_velocity=torch.zeros(1, 3),
        root_angular_velocity=torch.zeros(1, 3),
        joint_position=POSE[None],
        joint_velocity=torch.zeros(1, 12),
    )
    target = joint_targets(still(constants.STANDING_HEIGHT), load=load)[:1]
    for _ in range(50):
        simulator.step(target)
    sag = constants.STANDING_HEIGHT - float(simulator.root_position[0, 2])
    simulator.close()
    assert least <= abs(sag) <= most


def test_frames_at_another_rate_are_refused() -> None:
    clip = still(1.0)
    with pytest.raises(MotionError, match=r"0\.04 s apart, expected 0\.02"):
        joint_targets(clip_from_joints("slow", 0.04, clip.root_position, clip.root_quaternion, clip.joint_position))
