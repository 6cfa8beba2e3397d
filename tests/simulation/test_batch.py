"""The CPU simulator against a plain MuJoCo loop, against laws of mechanics, and against itself."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.simulation import BatchSimulator
from tests.simulation.robot_states import FEET, POSE, assert_same, everyone, only, snapshot, standing, targets

# Stepping ------------------------------------------------------------------------------------------------------------


def test_one_control_step_is_four_steps_of_mujoco() -> None:
    simulator = BatchSimulator(3, num_threads=2)
    simulator.reset(everyone(3), **standing(3))
    model = build_spec().compile()
    loop = mujoco.MjData(model)
    loop.qpos[:] = (0, 0, np.float32(0.3), 1, 0, 0, 0, *POSE.tolist())
    loop.ctrl[:] = POSE.tolist()
    mujoco.mj_forward(model, loop)
    for target in targets(3, 10):
        simulator.step(target)
        loop.ctrl[:] = target[1].numpy()
        mujoco.mj_step(model, loop, 4)
    np.testing.assert_array_equal(simulator.root_position[1].numpy(), loop.qpos[:3].astype(np.float32))
    np.testing.assert_array_equal(simulator.joint_velocity[1].numpy(), loop.qvel[6:].astype(np.float32))


def test_result_does_not_depend_on_the_number_of_threads() -> None:
    one, four = BatchSimulator(9, num_threads=1), BatchSimulator(9, num_threads=4)
    for target in targets(9, 10):
        one.step(target)
        four.step(target)
    assert_same(snapshot(one), snapshot(four))


def test_state_tensors_may_be_kept() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    simulator.step(POSE.expand(2, 12))
    kept = snapshot(simulator)
    copies = {name: value.clone() for name, value in kept.items()}
    for target in targets(2, 3):
        simulator.step(target)
    assert_same(kept, copies)
    assert all(value.dtype in (torch.float32, torch.bool) for value in kept.values())


def test_free_fall() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    simulator.reset(everyone(1), **standing(1, height=5.0))
    for _ in range(10):
        simulator.step(POSE.expand(1, 12))
    # 0.2 s of fall: v = g t. The legs hang from motors that hold the pose, so the trunk falls as the whole does.
    assert simulator.root_linear_velocity[0, 2].item() == pytest.approx(-9.81 * 0.2, abs=0.02)
    assert simulator.contact_force.count_nonzero() == 0


def test_standing_feet_carry_the_weight() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    for _ in range(100):
        simulator.step(POSE.expand(1, 12))
    force = simulator.contact_force[0]
    assert force[FEET].sum().item() == pytest.approx(constants.TOTAL_MASS * 9.81, rel=0.01)
    assert force.sum() == force[FEET].sum()
    assert 0.2 < simulator.root_position[0, 2].item() < constants.STANDING_HEIGHT


def test_targets_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\[2, 12\], got \[12\]"):
        BatchSimulator(2, num_threads=1).step(POSE)


def test_steps_must_fit() -> None:
    with pytest.raises(ValueError, match="multiple"):
        BatchSimulator(1, control_dt=0.02, sim_dt=0.003)
    with pytest.raises(ValueError, match="num_simulations"):
        BatchSimulator(0)


def test_one_millisecond_physics_agrees_with_five() -> None:
    coarse, fine = BatchSimulator(1, num_threads=1), BatchSimulator(1, num_threads=1, sim_dt=0.001)
    assert (coarse.substeps, fine.substeps) == (4, 20)
    for _ in range(30):
        coarse.step(POSE.expand(1, 12))
        fine.step(POSE.expand(1, 12))
    torch.testing.assert_close(coarse.joint_position, fine.joint_position, atol=0.02, rtol=0)


# Resets --------------------------------------------------------------------------------------------------------------


def test_reset_leaves_other_rows_bit_identical() -> None:
    disturbed, alone = BatchSimulator(4, num_threads=2), BatchSimulator(4, num_threads=2)
    for target in targets(4, 5):
        disturbed.step(target)
        alone.step(target)
    disturbed.reset(only(4, 1), **standing(4, height=1.0))
    others = [0, 2, 3]
    assert_same(snapshot(disturbed), snapshot(alone), others)
    for target in targets(4, 5, seed=1):
        disturbed.step(target)
        alone.step(target)
    assert_same(snapshot(disturbed), snapshot(alone), others)


def test_reset_state_is_what_was_asked() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    wanted = standing(
        2,
        root_quaternion=torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5]).repeat(2, 1),
        root_linear_velocity=torch.tensor([1.0, 2.0, 3.0]).repeat(2, 1),
        root_angular_velocity=torch.tensor([0.1, 0.2, 0.3]).repeat(2, 1),
        joint_velocity=torch.arange(12.0).repeat(2, 1),
    )
    simulator.reset(everyone(2), **wanted)
    for name, value in wanted.items():
        torch.testing.assert_close(getattr(simulator, name), value)


def test_reset_refuses_what_the_engine_would_replace_silently() -> None:
    simulator = BatchSimulator(3, num_threads=1)
    before = snapshot(simulator)
    bad = standing(3)
    bad["joint_velocity"] = torch.where(only(3, 2)[:, None], torch.nan, bad["joint_velocity"])
    with pytest.raises(ValueError, match=r"rows \[2\] are not finite"):
        simulator.reset(everyone(3), **bad)
    assert_same(snapshot(simulator), before, [0, 1, 2])
    simulator.reset(only(3, 0), **bad)  # the bad row is not asked for


def test_velocity_frames() -> None:
    # Rolled 90 degrees: base-frame rotation about x is world rotation about x; linear velocity stays in the world.
    turned = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]])
    simulator = BatchSimulator(1, num_threads=1)
    velocity, spin = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    state = standing(1, 5.0, root_quaternion=turned, root_linear_velocity=velocity, root_angular_velocity=spin)
    simulator.reset(everyone(1), **state)
    simulator.step(POSE.expand(1, 12))
    assert simulator.root_position[0, 0].item() == pytest.approx(0.02, abs=2e-3)
    # Pitching up of a robot that faces +y lowers its nose: base x axis gets a negative world z.
    w, x, y, z = simulator.root_quaternion[0]
    assert (2 * (x * z - w * y)).item() == pytest.approx(-0.02, abs=4e-3)


def test_reset_repeats_exactly() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    runs = []
    for _ in range(2):
        simulator.reset(everyone(2), **standing(2))
        for target in targets(2, 5):
            simulator.step(target)
        runs.append(snapshot(simulator))
    assert_same(*runs)


# Pushes, rays, instability, saving -----------------------------------------------------------------------------------


def test_push_sets_horizontal_velocity_of_its_rows() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    simulator.reset(everyone(2), **standing(2, height=3.0))
    simulator.push(only(2, 1), torch.tensor([[9.0, 9.0], [0.5, -0.25]]))
    simulator.step(POSE.expand(2, 12))
    torch.testing.assert_close(simulator.root_linear_velocity[1, :2], torch.tensor([0.5, -0.25]), atol=0.02, rtol=0)
    torch.testing.assert_close(simulator.root_linear_velocity[0, :2], torch.zeros(2), atol=0.02, rtol=0)


def test_rays_pass_through_the_robot() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    origin = torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.0, 2.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    # A direction's length must not matter; upwards there is nothing.
    direction = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -3.0], [0.0, 0.0, 1.0]]).expand(2, 3, 3)
    distance = simulator.ray(origin, direction)
    torch.testing.assert_close(distance, torch.tensor([1.0, 2.0, torch.inf]).expand(2, 3))


def test_divergence_is_flagged_once_and_only_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the engine writes a log where it stands
    simulator = BatchSimulator(3, num_threads=1)
    bad = POSE.repeat(3, 1)
    bad[1, 0] = torch.nan
    simulator.step(bad)
    assert simulator.unstable.tolist() == [False, True, False]
    simulator.step(POSE.repeat(3, 1))
    assert not simulator.unstable.any()
    simulator.batch.bind("qpos")[2, 8] = np.nan
    simulator.step(POSE.repeat(3, 1))
    assert simulator.unstable.tolist() == [False, False, True]
    assert torch.isfinite(simulator.joint_position).all()
    simulator.step(POSE.repeat(3, 1))
    simulator.batch.bind("qpos")[2, 8] = np.nan
    simulator.step(POSE.repeat(3, 1))
    assert simulator.unstable.tolist() == [False, False, True], "a second time too, without a reset between"
    simulator.reset(only(3, 2), **standing(3))
    assert not simulator.unstable.any()


def test_saved_state_continues_bit_for_bit() -> None:
    first = BatchSimulator(3, num_threads=1)
    parameters = {"stiffness": torch.rand(3, 12) * 8 + 36, "action_delay": torch.tensor([[0.0], [0.01], [0.02]])}
    parameters |= {"trunk_mass_offset": torch.tensor([[0.0], [1.0], [1.5]]), "ground_friction": torch.rand(3, 1) + 0.5}
    first.set_parameters(everyone(3), **parameters)
    for target in targets(3, 5):
        first.step(target)
    saved = first.state_dict()
    second = BatchSimulator(3, num_threads=2)
    second.load_state_dict(saved)
    assert_same(snapshot(first), snapshot(second))
    for target in targets(3, 5, seed=1):
        first.step(target)
        second.step(target)
    assert_same(snapshot(first), snapshot(second))


def test_loading_restores_parameters_that_the_saved_simulation_never_set() -> None:
    saved = BatchSimulator(1, num_threads=1).state_dict()
    simulator = BatchSimulator(1, num_threads=1)
    simulator.set_parameters(everyone(1), stiffness=torch.full((1, 12), 20.0))
    simulator.load_state_dict(saved)
    assert torch.equal(simulator.parameter("stiffness"), torch.full((1, 12), 40.0))


def test_saved_state_is_a_copy() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    saved = simulator.state_dict()
    before = saved["state"].clone()
    simulator.step(POSE.expand(1, 12) + 0.1)
    assert torch.equal(saved["state"], before)


def test_state_of_another_size_is_refused() -> None:
    saved = BatchSimulator(2, num_threads=1).state_dict()
    with pytest.raises(ValueError, match="number of robots"):
        BatchSimulator(3, num_threads=1).load_state_dict(saved)


def test_state_of_the_other_simulator_is_refused() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    with pytest.raises(ValueError, match="got several tensors; resume with the simulator"):
        simulator.load_state_dict({**simulator.state_dict(), "state": {"qpos": torch.zeros(2, 19)}})


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="counts threads as Linux does")
def test_closing_releases_the_batch() -> None:
    gc.collect()
    before = len(os.listdir("/proc/self/task"))
    simulator = BatchSimulator(4, num_threads=3)
    camera = simulator.make_camera()
    simulator.step(POSE.repeat(4, 1))
    camera.render(everyone(4))
    assert len(os.listdir("/proc/self/task")) > before
    simulator.close()
    simulator.close()
    assert not hasattr(simulator, "batch") and len(os.listdir("/proc/self/task")) <= before
