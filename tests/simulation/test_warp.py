"""The GPU simulator on Warp's CPU device: agreement with the CPU simulator, and what the protocol promises."""

from __future__ import annotations

import logging

import pytest
import torch

from agility_rl import rotations
from agility_rl.envs import COURSES, LocomotionEnv
from agility_rl.envs.layout import CourseLayout
from agility_rl.simulation import PARAMETERS, BatchSimulator, HardwareError, make_simulator, rough_pyramids
from tests.simulation.robot_states import POSE, assert_same, everyone, only, snapshot, standing, targets

pytest.importorskip("mujoco_warp", reason="the extra gpu is not installed")

from agility_rl.simulation.warp import WarpSimulator

FORCE_TOLERANCE = 0.5
"""Of contact forces of some 100 N [N]."""


def both(n: int, **options: object) -> tuple[WarpSimulator, BatchSimulator]:
    warp = make_simulator("warp", num_simulations=n, device="cpu", num_threads=1, **options)
    assert isinstance(warp, WarpSimulator)
    batch = make_simulator("batch", num_simulations=n, num_threads=1, **options)
    assert isinstance(batch, BatchSimulator)
    return warp, batch


def assert_agree(warp: WarpSimulator, batch: BatchSimulator, tolerance: float) -> None:
    for name in ("root_position", "root_quaternion", "joint_position", "hinge_angle"):
        torch.testing.assert_close(getattr(warp, name), getattr(batch, name), atol=tolerance, rtol=0.0)
    torch.testing.assert_close(warp.motor_target, batch.motor_target)
    torch.testing.assert_close(warp.joint_velocity, batch.joint_velocity, atol=100 * tolerance, rtol=0.0)
    torch.testing.assert_close(warp.contact_force, batch.contact_force, atol=FORCE_TOLERANCE, rtol=0.01)


# Agreement with the CPU ----------------------------------------------------------------------------------------------


def test_ten_steps_on_the_plane_agree(generator: torch.Generator) -> None:
    warp, batch = both(3)
    for simulator in (warp, batch):
        simulator.reset(everyone(3), **standing(3))
    assert (batch.contact_force == 0.0).all() and (warp.contact_force == 0.0).all()
    for target in targets(3, 10):
        warp.step(target)
        batch.step(target)
    assert warp.contact_force.max() > 30.0, "the robots must touch the ground"
    assert_agree(warp, batch, 1e-4)


def test_steps_on_rough_ground_agree(generator: torch.Generator) -> None:
    field = rough_pyramids(generator, tiles=2)
    warp, batch = both(4, terrain=field)
    assert warp.ground_extent == batch.ground_extent
    place = 8.0 * torch.rand(4, 2, generator=generator) - 4.0
    height = batch.ground_height(place)
    assert torch.equal(warp.ground_height(place), height)
    state = standing(4, root_position=torch.cat((place, 0.34 + height[:, None]), -1))
    for simulator in (warp, batch):
        simulator.reset(everyone(4), **state)
    apart = []
    for target in targets(4, 5):
        warp.step(target)
        batch.step(target)
        apart.append(torch.linalg.vector_norm(warp.root_position - batch.root_position, dim=-1))
    assert warp.contact_force.max() > 30.0
    # The engines choose the contacts of a foot and a height field differently (docs/gpu.md): near, and not the same.
    assert apart[0].max() < 1e-4 and apart[-1].median() < 2e-3 and apart[-1].max() < 2e-2


def test_a_course_is_the_same_place_with_both(generator: torch.Generator) -> None:
    robots = 3
    layout = CourseLayout(COURSES["full"], robots, generator)
    layout.draw(everyone(robots))
    warp, batch = both(robots, scenery=layout.pieces)
    which = torch.tensor([0, 1, 3])
    place = layout.world(which, torch.tensor([[-0.6, 0.1], [-0.2, 0.0], [-0.3, 0.0]]))
    yaw = layout.yaw[torch.arange(robots), which]
    state = standing(
        robots,
        root_position=torch.cat((place, torch.full((robots, 1), 0.45)), -1),
        root_quaternion=rotations.from_euler(0.0 * yaw, 0.0 * yaw, yaw),
    )
    for simulator in (warp, batch):
        simulator.place(everyone(robots), *layout.poses())
        simulator.reset(everyone(robots), **state)
        simulator.step(POSE.expand(robots, 12))
    assert_agree(warp, batch, 1e-4)
    down = torch.tensor([0.0, 0.0, -1.0]).expand(robots, 20, 3)
    grid = place[:, None] + 4.0 * torch.rand(robots, 20, 2, generator=generator) - 2.0
    origin = torch.cat((grid, torch.full((robots, 20, 1), 3.0)), -1)
    torch.testing.assert_close(warp.ray(origin, down), batch.ray(origin, down), atol=1e-4, rtol=0.0)
    assert (warp.ray(origin, down) < 2.95).any(), "some rays must meet obstacles"
    for _ in range(15):
        warp.step(POSE.expand(robots, 12))
        batch.step(POSE.expand(robots, 12))
    torch.testing.assert_close(warp.root_position, batch.root_position, atol=5e-3, rtol=0.0)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_does_the_same_with_both_and_only_in_its_rows(name: str, generator: torch.Generator) -> None:
    change = {"action_delay": 0.01, "torque_limit": -18.0, "ground_friction": -0.5, "stiffness": 5.0}.get(name, 0.2)
    commanded = targets(2, 6)
    plain, _ = both(2)
    warp, batch = both(2)
    for simulator in (warp, batch):
        new = simulator.parameter(name) + change
        simulator.set_parameters(only(2, 1), **{name: new})
        torch.testing.assert_close(simulator.parameter(name)[1], new[1])
        torch.testing.assert_close(simulator.parameter(name)[0], new[0] - change)
    for simulator in (plain, warp, batch):
        simulator.reset(everyone(2), **standing(2, 0.28))
        for target in commanded:
            simulator.step(target)
    torch.testing.assert_close(warp.joint_position, batch.joint_position, atol=1e-3, rtol=0.0)
    torch.testing.assert_close(warp.joint_position[0], plain.joint_position[0], atol=1e-4, rtol=0.0)
    assert (warp.joint_position[1] - plain.joint_position[1]).abs().max() > 3e-3


# What the protocol promises ------------------------------------------------------------------------------------------


def test_a_reset_is_what_was_asked_and_leaves_other_rows_bit_identical(generator: torch.Generator) -> None:
    simulator, other = WarpSimulator(3, device="cpu"), WarpSimulator(3, device="cpu")
    commanded = targets(3, 8)
    for target in commanded[:4]:
        simulator.step(target)
        other.step(target)
    kept = simulator.joint_position
    state = standing(3, root_linear_velocity=torch.rand(3, 3, generator=generator))
    simulator.reset(only(3, 1), **state)
    for name, value in state.items():
        assert torch.equal(getattr(simulator, name)[1], value[1]), name
    assert not simulator.contact_force[1].any() and torch.equal(kept, other.joint_position)
    assert_same(snapshot(simulator), snapshot(other), ~only(3, 1))
    for target in commanded[4:]:
        simulator.step(target)
        other.step(target)
    assert_same(snapshot(simulator), snapshot(other), ~only(3, 1))
    with pytest.raises(ValueError, match=r"states of rows \[2\] are not finite"):
        simulator.reset(
            everyone(3), **standing(3, joint_velocity=torch.tensor([0.0, 0.0, torch.nan])[:, None] + 0.0 * POSE)
        )


def test_a_push_sets_the_horizontal_velocity_of_its_rows() -> None:
    simulator = WarpSimulator(2, device="cpu")
    simulator.push(only(2, 0), torch.tensor([[1.0, -0.5], [9.0, 9.0]]))
    simulator.step(POSE.expand(2, 12))
    assert simulator.root_linear_velocity[0, :2].tolist() == pytest.approx([1.0, -0.5], abs=0.1)
    assert simulator.root_linear_velocity[1, :2].abs().max() < 0.1


def test_divergence_is_flagged_once_and_only_there() -> None:
    simulator = WarpSimulator(3, device="cpu")
    bad = POSE.repeat(3, 1)
    bad[1, 0] = torch.nan
    simulator.step(bad)
    assert simulator.unstable.tolist() == [False, True, False]
    assert all(bool(torch.isfinite(value).all()) for value in snapshot(simulator).values())
    simulator.step(POSE.repeat(3, 1))
    assert not simulator.unstable.any()


def test_too_little_room_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    in_the_ground = standing(2, root_position=torch.tensor([[0.0, 0.0, 0.02], [0.0, 0.0, 3.0]]))
    simulator = WarpSimulator(2, device="cpu", max_constraints=16)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            simulator.reset(everyone(2), **in_the_ground)
            simulator.step(POSE.expand(2, 12))
            assert simulator.unstable.tolist() == [True, False]
    assert len(caplog.records) == 1, "said once"
    assert "constraints of 1 of 2 simulations did not fit" in caplog.text
    assert "give more max_constraints than 16" in caplog.text
    simulator = WarpSimulator(2, device="cpu", max_contacts=8)
    simulator.reset(everyone(2), **in_the_ground)
    with pytest.raises(HardwareError, match="and some were left out; give more max_contacts than 8"):
        simulator.step(POSE.expand(2, 12))


def test_a_saved_state_continues_bit_for_bit(generator: torch.Generator) -> None:
    commanded = targets(2, 8)
    first = WarpSimulator(2, device="cpu")
    first.set_parameters(only(2, 1), stiffness=torch.full((2, 12), 30.0), trunk_mass_offset=torch.ones(2, 1))
    for target in commanded[:4]:
        first.step(target)
    saved = first.state_dict()
    second = WarpSimulator(2, device="cpu")
    second.set_parameters(everyone(2), damping=torch.ones(2, 12))
    second.load_state_dict(saved)
    assert_same(snapshot(first), snapshot(second), everyone(2))
    for target in commanded[4:]:
        first.step(target)
        second.step(target)
    assert_same(snapshot(first), snapshot(second), everyone(2))
    assert not torch.equal(saved["state"]["qpos"], first.state_dict()["state"]["qpos"]), "it must be a copy"
    for wrong in (WarpSimulator(3, device="cpu").state_dict(), BatchSimulator(2, num_threads=1).state_dict()):
        with pytest.raises(ValueError, match="resume with the simulator, the number of robots and the model"):
            first.load_state_dict(wrong)


def test_an_environment_needs_only_another_name() -> None:
    env = LocomotionEnv(2, simulator_options={"name": "warp", "device": "cpu"}, seed=0)
    assert isinstance(env.simulator, WarpSimulator)
    rollout = env.rollout(12, break_when_any_done=False)
    assert rollout.batch_size == (2, 12) and bool(torch.isfinite(rollout["next", "reward"]).all())
    env.close()


def test_what_cannot_be_simulated_is_refused() -> None:
    for options, message in (
        ({"num_simulations": 0}, "num_simulations must be at least 1, got 0"),
        ({"max_contacts": 0}, "max_contacts must be at least 1, got 0"),
        ({"sim_dt": 0.003}, "control_dt must be a multiple of sim_dt"),
    ):
        with pytest.raises(ValueError, match=message):
            WarpSimulator(**{"num_simulations": 1, "device": "cpu", **options})
    simulator = WarpSimulator(2, device="cpu")
    with pytest.raises(ValueError, match=r"target must be \[2, 12\], got \[3, 12\]"):
        simulator.step(POSE.expand(3, 12))
    simulator.close()
