"""The compiled model has the robot's masses, limits, order, sensors and collisions."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.simulation import BatchSimulator


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_spec().compile()


def principal_inertia(model: mujoco.MjModel, body: str) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.body(body).iquat)
    rotation = matrix.reshape(3, 3)
    return rotation @ np.diag(model.body(body).inertia) @ rotation.T


def test_sizes_and_mass(model: mujoco.MjModel) -> None:
    assert (model.nq, model.nv, model.nu, model.na) == (19, 18, 12, 0)
    assert model.body_mass.sum() == pytest.approx(constants.TOTAL_MASS, abs=5e-5)


def test_joint_and_actuator_order(model: mujoco.MjModel) -> None:
    assert tuple(model.joint(i + 1).name for i in range(12)) == constants.JOINT_NAMES
    assert tuple(model.actuator(i).name for i in range(12)) == constants.ACTUATOR_NAMES
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(1, 13))


def test_limits(model: mujoco.MjModel) -> None:
    np.testing.assert_allclose(model.jnt_range[1:], np.stack((constants.JOINT_LOWER, constants.JOINT_UPPER), -1))
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], constants.TORQUE_LIMIT)
    assert model.jnt_limited[1:].all() and model.actuator_forcelimited.all()


def test_gains_and_passive_joints(model: mujoco.MjModel) -> None:
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], 40)
    np.testing.assert_allclose(model.actuator_biasprm[:, :3], [[0, -40, -1]] * 12)
    np.testing.assert_allclose(model.dof_damping[6:], constants.JOINT_DAMPING)
    np.testing.assert_allclose(model.dof_armature[6:], constants.ARMATURE)
    np.testing.assert_allclose(model.dof_frictionloss[6:], constants.FRICTION_LOSS)


def test_jacobian_is_dense(model: mujoco.MjModel) -> None:
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE


@pytest.mark.parametrize("link", ["hip", "thigh", "calf"])
def test_right_legs_mirror_left_legs(model: mujoco.MjModel, link: str) -> None:
    mirror = np.diag([1.0, -1.0, 1.0])
    for end in "FR":
        left, right = f"{end}L_{link}", f"{end}R_{link}"
        np.testing.assert_allclose(model.body(right).ipos, mirror @ model.body(left).ipos, atol=1e-9)
        np.testing.assert_allclose(
            principal_inertia(model, right), mirror @ principal_inertia(model, left) @ mirror, atol=2e-8
        )


def test_sensors_follow_the_contact_groups(model: mujoco.MjModel) -> None:
    for index, group in enumerate(constants.CONTACT_GROUPS):
        sensor = model.sensor(f"{group}_contact")
        assert sensor.adr[0] == 3 * index and sensor.dim[0] == 3


def test_imu_and_joint_sensors_measure_the_state(model: mujoco.MjModel) -> None:
    state = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    state.qpos[2], state.qpos[7:] = 1.0, constants.DEFAULT_POSE
    state.qvel[:] = generator.normal(size=18)
    mujoco.mj_forward(model, state)
    np.testing.assert_allclose(state.sensor("gyro").data, state.qvel[3:6], atol=1e-12)
    np.testing.assert_allclose(state.sensor("orientation").data, [1, 0, 0, 0], atol=1e-12)
    measured = [state.sensor(f"{name}_position").data[0] for name in constants.JOINT_NAMES]
    np.testing.assert_allclose(measured, constants.DEFAULT_POSE)
    measured = [state.sensor(f"{name}_velocity").data[0] for name in constants.JOINT_NAMES]
    np.testing.assert_allclose(measured, state.qvel[6:])


def contacts_with_crossed_legs(self_collision: bool) -> int:
    model = build_spec(self_collision=self_collision).compile()
    state = mujoco.MjData(model)
    state.qpos[2] = 2.0
    # Hips turned inwards to their stops: the left and right shanks pass through each other.
    state.qpos[7:] = (-1.0, 0.9, -1.8, 1.0, 0.9, -1.8) * 2
    mujoco.mj_forward(model, state)
    return state.ncon


def test_self_collision_is_an_option() -> None:
    assert contacts_with_crossed_legs(False) == 0
    assert contacts_with_crossed_legs(True) > 0


def test_standing_robot_has_no_self_contact() -> None:
    model = build_spec(self_collision=True).compile()
    state = mujoco.MjData(model)
    state.qpos[2], state.qpos[7:] = 1.0, constants.DEFAULT_POSE
    mujoco.mj_forward(model, state)
    assert state.ncon == 0


def test_every_link_meets_the_floor(model: mujoco.MjModel) -> None:
    state = mujoco.MjData(model)
    state.qpos[2], state.qpos[7:] = -1.0, constants.DEFAULT_POSE
    mujoco.mj_forward(model, state)
    touching = {model.body(model.geom_bodyid[geom]).name for pair in state.contact.geom for geom in pair}
    assert touching == {"world", *constants.CONTACT_GROUPS}


def test_options_are_passed_on() -> None:
    model = build_spec(
        sim_dt=0.001, stiffness=list(range(1, 13)), torque_limit=[5.0] * 12, ground_friction=0.5
    ).compile()
    assert model.opt.timestep == 0.001
    np.testing.assert_allclose(model.actuator_gainprm[:, 0], range(1, 13))
    np.testing.assert_allclose(model.actuator_forcerange, [[-5, 5]] * 12)
    assert model.geom("floor").friction[0] == 0.5


def test_height_field_stands_where_it_is_told() -> None:
    heights = np.array([[-0.2, 0.0, 0.1], [-0.2, 0.3, 0.1], [-0.2, 0.0, 0.1]])
    model = build_spec(heights=heights, height_field_size=(2.0, 1.0)).compile()
    state = mujoco.MjData(model)
    state.qpos[:3] = (50, 50, 50)
    mujoco.mj_forward(model, state)
    hit = np.zeros(1, np.int32)
    for x, y, height in ((0.0, 0.0, 0.3), (-1.99, 0.9, -0.2), (1.99, -0.9, 0.1)):
        distance = mujoco.mj_ray(model, state, [x, y, 5.0], [0, 0, -1], None, 1, -1, hit)
        assert 5 - distance == pytest.approx(height, abs=0.01)


def test_wrong_numbers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="torque_limit"):
        build_spec(torque_limit=[20.0])
    with pytest.raises(ValueError, match=r"base_0\.obj"):
        build_spec(skin=tmp_path)


def test_the_contact_model_is_an_option() -> None:
    model = build_spec(contact_time=0.05, cone="elliptic").compile()
    assert model.geom("floor").solref.tolist() == [0.05, 1.0]
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    with pytest.raises(ValueError, match=r"at least twice sim_dt, 0.01 s, got 0.005"):
        build_spec(contact_time=0.005)
    with pytest.raises(ValueError, match="pyramidal, elliptic, got 'round'"):
        build_spec(cone="round")  # type: ignore[arg-type]


def test_a_knee_on_the_ground_is_the_calfs() -> None:
    """As in the released robot description, where a landing that bends the legs fully is no failure."""
    simulator = BatchSimulator(1, num_threads=1)
    folded = torch.tensor([0.0, 0.0, -2.7]).repeat(4)[None]
    everyone = torch.ones(1, dtype=torch.bool)
    simulator.reset(
        everyone,
        root_position=torch.tensor([[0.0, 0.0, constants.THIGH - 0.01]]),
        root_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        root_linear_velocity=torch.zeros(1, 3),
        root_angular_velocity=torch.zeros(1, 3),
        joint_position=folded,
        joint_velocity=torch.zeros(1, 12),
    )
    force = dict(zip(constants.CONTACT_GROUPS, simulator.contact_force[0].tolist(), strict=True))
    for leg in constants.LEGS:
        assert force[f"{leg}_calf"] > 5.0 and force[f"{leg}_thigh"] == 0.0, force
