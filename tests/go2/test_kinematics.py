"""Leg kinematics against MuJoCo's and against triangles drawn by hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.go2 import constants, kinematics
from agility_rl.go2.model import build_spec


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    return np.random.default_rng(0).uniform(constants.JOINT_LOWER, constants.JOINT_UPPER, (100, 12))


def test_forward_is_mujocos(poses: np.ndarray) -> None:
    model = build_spec().compile()
    state = mujoco.MjData(model)
    state.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    for pose in poses:
        state.qpos[7:] = pose
        mujoco.mj_kinematics(model, state)
        feet = np.stack([state.geom(f"{leg}_foot").xpos for leg in constants.LEGS])
        np.testing.assert_allclose(kinematics.forward(torch.tensor(pose)).numpy(), feet, atol=1e-12)


def test_straight_leg_by_hand() -> None:
    feet = kinematics.forward(torch.zeros(12, dtype=torch.float64))
    expected = [[0.1914, 0.142, -0.426], [0.1914, -0.142, -0.426], [-0.1954, 0.142, -0.426], [-0.1954, -0.142, -0.426]]
    torch.testing.assert_close(feet, torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize(("thigh", "calf", "height"), [(0.9, -1.8, 0.2884), (0.8, -1.5, 0.3346), (1.0, -1.5, 0.3250)])
def test_height_at_which_soles_touch(thigh: float, calf: float, height: float) -> None:
    feet = kinematics.forward(torch.tensor([0.0, thigh, calf] * 4))
    lowest = constants.FOOT_RADIUS - feet[:, 2].min()
    assert lowest.item() == pytest.approx(height, abs=5e-5)


def test_inverse_undoes_forward_in_working_range(poses: np.ndarray) -> None:
    # Foot below the hip axis: above it the same point has a second solution with the hip turned half round.
    pose = torch.tensor(poses)
    middle = torch.tensor(constants.DEFAULT_POSE, dtype=torch.float64)
    pose = middle + (pose - (torch.tensor(constants.JOINT_LOWER) + torch.tensor(constants.JOINT_UPPER)) / 2) * 0.3
    torch.testing.assert_close(kinematics.inverse(kinematics.forward(pose)), pose, atol=1e-8, rtol=0)


def test_inverse_keeps_leading_shape_and_float32() -> None:
    pose = torch.tensor(constants.DEFAULT_POSE).expand(3, 5, 12)
    back = kinematics.inverse(kinematics.forward(pose))
    assert back.shape == (3, 5, 12) and back.dtype == torch.float32
    torch.testing.assert_close(back, pose.contiguous(), atol=1e-5, rtol=0)


def test_foot_out_of_reach_gets_a_straight_leg() -> None:
    feet = kinematics.forward(torch.zeros(12, dtype=torch.float64)) - torch.tensor([0.0, 0.0, 1.0])
    joints = kinematics.inverse(feet)
    reached = kinematics.forward(joints)
    assert torch.isfinite(joints).all()
    assert (
        (reached - kinematics.hip_positions(reached)).norm(dim=-1) - (0.4260094**2 + 0.0955**2) ** 0.5
    ).abs().max() < 1e-4


def test_foot_at_the_hip_is_finite() -> None:
    feet = kinematics.hip_positions(torch.zeros(1)).clone()
    assert torch.isfinite(kinematics.inverse(feet)).all()


def test_gradient_is_the_finite_difference() -> None:
    pose = torch.tensor(constants.DEFAULT_POSE, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(kinematics.forward, (pose,))


@pytest.mark.parametrize("function", [kinematics.forward, kinematics.inverse])
def test_wrong_shape_is_named(function: object) -> None:
    with pytest.raises(ValueError, match=r"\[\*B, "):
        function(torch.zeros(2, 11))  # type: ignore[operator]
