"""Pieces placed per simulation: where rays find them, that robots stand on them, that resets and resumes keep them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.simulation import BatchSimulator, Hinge, Piece, Shape
from agility_rl.simulation.scenery import add_scenery

POSE = torch.tensor(constants.DEFAULT_POSE)
STEP = Piece("step", (Shape("box", (0.5, 0.4, 0.1), (0.0, 0.0, -0.1)),))
PLANK = Shape("box", (1.0, 0.3, 0.02))
SWING = Piece("swing", (Shape("sphere", (0.1,)),), Hinge((PLANK,), 10.0, (0.0, 0.0, 0.3), limits=(-0.2, 0.2)))
UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0])


def everyone(n: int) -> Tensor:
    return torch.ones(n, dtype=torch.bool)


def build(n: int = 3, threads: int = 1) -> BatchSimulator:
    return BatchSimulator(n, num_threads=threads, scenery=(STEP, SWING))


def poses(n: int, spread: float = 0.5) -> tuple[Tensor, Tensor, Tensor]:
    """The step under robot i with its top at 0.1 (i + 1) m, the swing 3 m away."""
    row = torch.arange(n, dtype=torch.float32)
    step = torch.stack((torch.zeros(n), torch.zeros(n), 0.1 * (row + 1)), -1)
    swing = torch.stack((3.0 + spread * row, torch.zeros(n), torch.zeros(n)), -1)
    return torch.stack((step, swing), 1), UPRIGHT.expand(n, 2, 4), torch.linspace(-0.2, 0.2, n)[:, None]


def standing(n: int, height: Tensor) -> dict[str, Tensor]:
    return {
        "root_position": torch.cat((torch.zeros(n, 2), height[:, None]), -1),
        "root_quaternion": UPRIGHT.repeat(n, 1),
        "root_linear_velocity": torch.zeros(n, 3),
        "root_angular_velocity": torch.zeros(n, 3),
        "joint_position": POSE.repeat(n, 1),
        "joint_velocity": torch.zeros(n, 12),
    }


def down(simulator: BatchSimulator, x: float, y: float = 0.0) -> Tensor:
    """Height of what lies under (x, y)."""
    n = simulator.num_simulations
    origin = torch.tensor([x, y, 5.0]).expand(n, 1, 3)
    return 5.0 - simulator.ray(origin, torch.tensor([0.0, 0.0, -1.0]).expand(n, 1, 3))[:, 0]


def test_every_simulation_has_its_own_scenery() -> None:
    simulator = build()
    assert torch.equal(down(simulator, 0.0), torch.zeros(3))  # below the ground until placed
    simulator.place(everyone(3), *poses(3))
    torch.testing.assert_close(down(simulator, 0.49, 0.39), torch.tensor([0.1, 0.2, 0.3]))
    assert torch.equal(down(simulator, 0.51), torch.zeros(3))
    # The plank turns about +y: a positive angle lowers its far end.
    tilt = torch.tensor([-0.2, 0.0, 0.2])
    torch.testing.assert_close(simulator.hinge_angle[:, 0], tilt)
    for row in range(3):
        top = 0.3 + 0.02 / math.cos(tilt[row]) - 0.8 * math.tan(tilt[row])
        assert down(simulator, 3.0 + 0.5 * row + 0.8)[row].item() == pytest.approx(top, abs=1e-4)


def test_robots_stand_on_it_and_their_joints_are_not_its_hinge() -> None:
    simulator = build()
    simulator.place(everyone(3), *poses(3))
    top = torch.tensor([0.1, 0.2, 0.3])
    simulator.reset(everyone(3), **standing(3, top + 0.3))
    for _ in range(50):
        simulator.step(POSE.expand(3, 12))
    assert simulator.joint_position.shape == simulator.joint_velocity.shape == (3, 12)
    plain = BatchSimulator(1, num_threads=1)
    for _ in range(50):
        plain.step(POSE.expand(1, 12))
    expected = plain.root_position[:, 2].expand(3)
    torch.testing.assert_close(simulator.root_position[:, 2] - top, expected, atol=2e-3, rtol=0)
    weight = simulator.contact_force[:, list(constants.FOOT_GROUPS)].sum(-1)
    torch.testing.assert_close(weight, torch.full((3,), constants.TOTAL_MASS * 9.81), rtol=0.02, atol=0)


def test_a_plank_without_friction_turns_only_under_a_load() -> None:
    simulator = build(1)
    position, quaternion, _ = poses(1)
    simulator.place(everyone(1), position, quaternion, torch.full((1, 1), 0.02))
    # Below the centre of a balanced plank nothing turns it.
    for _ in range(50):
        simulator.step(POSE.expand(1, 12))
    assert simulator.hinge_angle.item() == pytest.approx(0.02, abs=1e-3)
    # A robot on the far half brings that end down; the step waits below the ground.
    position[0, :, 0], position[0, 0, 2] = -0.6, -5.0
    simulator.place(everyone(1), position, quaternion, torch.full((1, 1), -0.2))
    simulator.reset(everyone(1), **standing(1, torch.tensor([0.8])))
    assert simulator.hinge_angle.item() == pytest.approx(-0.2)
    for _ in range(60):
        simulator.step(POSE.expand(1, 12))
    assert simulator.hinge_angle.item() == pytest.approx(0.2, abs=0.03)


def test_friction_of_the_ground_is_that_of_the_scenery_too() -> None:
    simulator = BatchSimulator(2, num_threads=1, scenery=(STEP,))
    place = torch.tensor([0.0, 0.0, 0.1]).expand(2, 1, 3)
    simulator.place(everyone(2), place, UPRIGHT.expand(2, 1, 4), torch.zeros(2, 0))
    simulator.reset(everyone(2), **standing(2, torch.full((2,), 0.4)))
    for _ in range(40):
        simulator.step(POSE.expand(2, 12))
    simulator.set_parameters(everyone(2), ground_friction=torch.tensor([[0.02], [0.1]]))
    simulator.push(everyone(2), torch.tensor([0.5, 0.0]).expand(2, 2))
    for _ in range(10):
        simulator.step(POSE.expand(2, 12))
    assert (simulator.root_position[:, 2] > 0.3).all()  # still on the step
    expected = torch.tensor([0.5 - 0.02 * 9.81 * 0.2, 0.5 - 0.1 * 9.81 * 0.2])
    torch.testing.assert_close(simulator.root_linear_velocity[:, 0], expected, atol=0.03, rtol=0)


def test_placing_and_resetting_some_leaves_the_others_bit_identical() -> None:
    simulator = build(4)
    simulator.place(everyone(4), *poses(4))
    simulator.reset(everyone(4), **standing(4, torch.full((4,), 0.8)))
    for _ in range(5):
        simulator.step(POSE.expand(4, 12))
    before = simulator.state_dict()["state"]
    mask = torch.tensor([False, True, False, True])
    position, quaternion, angle = poses(4, spread=1.0)
    simulator.place(mask, position + 0.1, quaternion, -angle)
    simulator.reset(mask, **standing(4, torch.full((4,), 0.9)))
    after = simulator.state_dict()["state"]
    assert torch.equal(after[~mask], before[~mask]) and not torch.equal(after[mask], before[mask])
    torch.testing.assert_close(simulator.hinge_angle[mask], -angle[mask])
    torch.testing.assert_close(down(simulator, 0.0)[1], torch.tensor(0.3))  # a reset keeps what was placed


def test_saved_scenery_continues_bit_for_bit_at_any_number_of_threads() -> None:
    first, second = build(4), build(4, threads=2)
    first.place(everyone(4), *poses(4, spread=-1.0))
    first.reset(everyone(4), **standing(4, torch.full((4,), 0.8)))
    generator = torch.Generator().manual_seed(0)
    targets = POSE + 0.2 * torch.randn(20, 4, 12, generator=generator)
    for target in targets[:10]:
        first.step(target)
    second.load_state_dict(first.state_dict())
    for target in targets[10:]:
        first.step(target)
        second.step(target)
    assert torch.equal(first.root_position, second.root_position)
    assert torch.equal(first.hinge_angle, second.hinge_angle) and first.hinge_angle.std() > 0.0
    assert torch.equal(down(first, 0.0), down(second, 0.0))


def test_parameters_of_the_robot_leave_the_hinge_alone() -> None:
    simulator = build(2)
    damping = simulator.parameter("joint_damping")
    assert damping.shape == (2, 12)
    simulator.set_parameters(everyone(2), joint_damping=damping + 1.0, armature=simulator.parameter("armature") + 0.1)
    hinge = simulator.model.joint("swing/hinge").dofadr[0]
    assert (simulator.batch.expand("dof_damping")[:, hinge] == 0.0).all()
    assert (simulator.batch.expand("dof_armature")[:, hinge] == 0.0).all()


def test_scenery_touches_neither_ground_nor_itself() -> None:
    simulator = build(1)
    position = torch.zeros(1, 2, 3)  # everything inside each other and half in the ground
    simulator.place(everyone(1), position, UPRIGHT.expand(1, 2, 4), torch.zeros(1, 1))
    simulator.reset(everyone(1), **standing(1, torch.tensor([5.0])))
    simulator.step(POSE.expand(1, 12))
    assert simulator.batch.get_data(0).ncon == 0


def test_wrong_scenery_is_refused() -> None:
    with pytest.raises(ValueError, match="step more than once"):
        add_scenery(build_spec(), (STEP, STEP))
    with pytest.raises(ValueError, match="one of box, cylinder, capsule, sphere"):
        Shape("cone", (1.0,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="2 positive sizes"):
        Shape("capsule", (0.1, 0.0))
    simulator = build(2)
    position, quaternion, angle = poses(2)
    with pytest.raises(ValueError, match=r"position of the scenery must be \[2, 2, 3\], got \[2, 1, 3\]"):
        simulator.place(everyone(2), position[:, :1], quaternion, angle)
    with pytest.raises(ValueError, match="hinge_angle of the scenery is not finite"):
        simulator.place(everyone(2), position, quaternion, angle * torch.nan)
