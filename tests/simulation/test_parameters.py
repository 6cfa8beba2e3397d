"""Parameters that differ between simulations: what they do, by laws of mechanics and a plain MuJoCo loop."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.go2.model import build_spec
from agility_rl.simulation import PARAMETERS, BatchSimulator
from agility_rl.simulation.parameters import SimulationParameters
from agility_rl.simulation.world import World
from tests.simulation.robot_states import FEET, POSE, assert_same, everyone, only, snapshot, standing, targets


def test_only_the_rows_of_the_mask_are_written() -> None:
    world = World()
    gains = torch.zeros(3, 12, 10)
    parameters = SimulationParameters(world, 3, lambda name: gains)
    assert not parameters.set(only(3, 1), {"damping": torch.full((3, 12), 2.0)}), "nothing to compute anew"
    assert gains[1, :, 2].tolist() == [-2.0] * 12 and gains.abs().sum() == 24.0
    assert parameters.value("damping")[:, 0].tolist() == [1.0, 2.0, 1.0]
    masses = {"body_mass": torch.ones(2, world.model.nbody), "body_inertia": torch.ones(2, world.model.nbody, 3)}
    assert SimulationParameters(world, 2, masses.__getitem__).set(only(2, 0), {"trunk_mass_offset": torch.ones(2, 1)})
    trunk = world.model.body("trunk").id
    nominal = float(world.model.body_mass[trunk])
    assert masses["body_mass"][:, trunk].tolist() == pytest.approx([nominal + 1.0, 1.0])
    heavier = torch.tensor(world.model.body_inertia[trunk]).float() * (nominal + 1.0) / nominal
    torch.testing.assert_close(masses["body_inertia"][0, trunk], heavier)


def test_every_parameter_is_read_back_and_masked() -> None:
    simulator = BatchSimulator(3, num_threads=1)
    for name, (size, _) in PARAMETERS.items():
        before = simulator.parameter(name)
        new = before + 0.01
        simulator.set_parameters(only(3, 2), **{name: new})
        after = simulator.parameter(name)
        assert after.shape == (3, size)
        torch.testing.assert_close(after[2], new[2])
        assert torch.equal(after[:2], before[:2])


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "ground_friction"])
def test_every_parameter_changes_motion_only_in_its_rows(name: str) -> None:
    plain, changed = BatchSimulator(2, num_threads=1), BatchSimulator(2, num_threads=1)
    change = {"action_delay": 0.01, "torque_limit": -18.0}.get(name, 0.05)
    changed.set_parameters(only(2, 1), **{name: changed.parameter(name) + change})
    for target in targets(2, 5):
        plain.step(target)
        changed.step(target)
    torch.testing.assert_close(changed.joint_position[0], plain.joint_position[0], atol=1e-5, rtol=0)
    assert not torch.allclose(changed.joint_position[1], plain.joint_position[1], atol=1e-5)


def test_trunk_mass_is_carried_by_the_feet() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    simulator.set_parameters(only(2, 1), trunk_mass_offset=torch.full((2, 1), 1.5))
    for _ in range(100):
        simulator.step(POSE.expand(2, 12))
    carried = simulator.contact_force[:, FEET].sum(-1)
    assert (carried[1] - carried[0]).item() == pytest.approx(1.5 * 9.81, rel=0.05)


def test_centre_of_mass_ahead_loads_the_front_feet() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    simulator.set_parameters(only(2, 1), trunk_com_offset=torch.tensor([0.1, 0.0, 0.0]).expand(2, 3))
    for _ in range(100):
        simulator.step(POSE.expand(2, 12))
    front = simulator.contact_force[:, FEET[:2]].sum(-1)
    assert front[1] > front[0] + 10.0


def test_friction_slows_a_slide_by_coulombs_law() -> None:
    simulator = BatchSimulator(3, num_threads=1)
    for _ in range(60):
        simulator.step(POSE.expand(3, 12))
    simulator.set_parameters(everyone(3), ground_friction=torch.tensor([[0.02], [0.05], [0.1]]))
    simulator.push(everyone(3), torch.tensor([1.0, 0.0]).expand(3, 2))
    for _ in range(20):
        simulator.step(POSE.expand(3, 12))
    # All feet slide: v = v_0 - mu g t after 0.4 s.
    expected = torch.tensor([1.0 - 0.02 * 9.81 * 0.4, 1.0 - 0.05 * 9.81 * 0.4, 1.0 - 0.1 * 9.81 * 0.4])
    torch.testing.assert_close(simulator.root_linear_velocity[:, 0], expected, atol=0.04, rtol=0)


def test_set_const_keeps_the_state() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    for target in targets(2, 3):
        simulator.step(target)
    before = simulator.batch.state.copy()
    simulator.set_parameters(everyone(2), trunk_mass_offset=torch.ones(2, 1), armature=torch.full((2, 12), 0.02))
    np.testing.assert_array_equal(simulator.batch.state, before)


def test_delay_of_a_control_step_shifts_the_targets() -> None:
    delayed, plain = BatchSimulator(1, num_threads=1), BatchSimulator(1, num_threads=1)
    delayed.set_parameters(everyone(1), action_delay=torch.full((1, 1), 0.02))
    for simulator in (delayed, plain):
        simulator.reset(everyone(1), **standing(1))
    sequence = targets(1, 6)
    for target in sequence:
        delayed.step(target)
    plain.step(POSE.expand(1, 12))
    for target in sequence[:-1]:
        plain.step(target)
    assert_same(snapshot(delayed), snapshot(plain))


def test_delay_within_a_control_step_switches_between_physics_steps() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    simulator.set_parameters(everyone(2), action_delay=torch.tensor([[0.005], [0.015]]))
    simulator.reset(everyone(2), **standing(2))
    sequence = targets(2, 4)
    for target in sequence:
        simulator.step(target)
    model = build_spec().compile()
    for row, late in ((0, 1), (1, 3)):
        loop = mujoco.MjData(model)
        loop.qpos[:] = (0, 0, np.float32(0.3), 1, 0, 0, 0, *POSE.tolist())
        loop.ctrl[:] = POSE.tolist()
        mujoco.mj_forward(model, loop)
        for target in sequence:
            mujoco.mj_step(model, loop, late)
            loop.ctrl[:] = target[row].numpy()
            mujoco.mj_step(model, loop, 4 - late)
        np.testing.assert_array_equal(simulator.joint_position[row].numpy(), loop.qpos[7:].astype(np.float32))


def test_wrong_parameters_are_refused() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    with pytest.raises(ValueError, match="stifness"):
        simulator.set_parameters(everyone(2), stifness=torch.zeros(2, 12))
    with pytest.raises(ValueError, match=r"\[2, 12\]"):
        simulator.set_parameters(everyone(2), stiffness=torch.zeros(2, 1))
    for seconds in (0.5, -0.01):
        with pytest.raises(ValueError, match=r"action_delay must be from 0 to one control step, 0.02 s"):
            simulator.set_parameters(everyone(2), action_delay=torch.full((2, 1), seconds))


def test_parameters_are_read_as_copies() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    simulator.set_parameters(everyone(1), stiffness=torch.full((1, 12), 20.0))
    simulator.parameter("stiffness").add_(1.0)
    assert simulator.parameter("stiffness").max() == 20.0
