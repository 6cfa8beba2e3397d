from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.behaviours import command_vector
from agility_rl.bending import bend_points
from agility_rl.go2 import constants, features
from agility_rl.go2.kinematics import forward

POSE, SCALE = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)


@pytest.fixture
def steering(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("steering")


def observation(speed: float, turn: float, rows: int = 8) -> TensorDict:
    """Robots near the default pose, told to go straight ahead or along a curve."""
    generator = torch.Generator().manual_seed(0)
    command = torch.tensor([speed, 0.0, turn, 0.0, 0.3]).expand(rows, 5)
    small = 0.1 * torch.randn(rows, features.NUM_PROPRIOCEPTION, generator=generator)
    vector = command_vector(torch.full((rows,), 2), command, torch.zeros(rows, 1))
    return TensorDict({keys.PROPRIOCEPTION: small, keys.COMMAND: vector}, [rows])


def test_the_curvature_is_turn_rate_over_speed(steering: ModuleType) -> None:
    for speed, turn, expected in ((1.0, 0.8, 0.8), (1.5, -1.5, -1.0), (0.0, 0.1, 0.4), (0.5, 1.57, 2.0)):
        found = steering.commanded_curvature(observation(speed, turn, 1)[keys.COMMAND])
        torch.testing.assert_close(found, torch.tensor([expected]))


def test_who_is_told_to_go_straight_is_left_alone(steering: ModuleType) -> None:
    td = observation(1.0, 0.0)
    seen = steering.straighten(td)
    torch.testing.assert_close(seen[keys.PROPRIOCEPTION], td[keys.PROPRIOCEPTION], atol=1e-3, rtol=1e-3)
    action = 0.3 * torch.randn(8, 12, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(steering.steered(lambda _: action)(td), action, atol=1e-4, rtol=1e-4)


def test_feet_go_where_the_bent_ground_is(steering: ModuleType) -> None:
    td = observation(1.0, 1.0)
    action = 0.3 * torch.randn(8, 12, generator=torch.Generator().manual_seed(1))
    bent = steering.steered(lambda _: action)(td)
    straight_feet, bent_feet = forward(action * SCALE + POSE), forward(bent * SCALE + POSE)
    torch.testing.assert_close(bent_feet, bend_points(straight_feet, 1.0), atol=1e-5, rtol=0)


def test_a_controller_sees_its_own_straight_world(steering: ModuleType) -> None:
    """A robot that walks the curve as it was told looks to the controller like one that walks straight: no turn rate,
    no turn commanded, its own last action. The observation itself is not touched."""
    td = observation(1.0, 1.0)
    part = {
        e.name: features.layout_slice(features.PROPRIOCEPTION_LAYOUT, e.name) for e in features.PROPRIOCEPTION_LAYOUT
    }
    action = 0.3 * torch.randn(8, 12, generator=torch.Generator().manual_seed(1))
    proprioception = td[keys.PROPRIOCEPTION].clone()
    proprioception[:, part["last_action"]] = steering.steered(lambda _: action)(td)
    proprioception[:, part["angular_velocity"]] = torch.tensor([0.0, 0.0, 1.0]) * features.ANGULAR_VELOCITY_SCALE
    td[keys.PROPRIOCEPTION] = proprioception
    before = td.clone()
    seen = steering.straighten(td)
    assert (td == before).all()
    assert seen[keys.COMMAND][:, 2].abs().max() == 0.0 and torch.equal(
        seen[keys.COMMAND][:, :2], td[keys.COMMAND][:, :2]
    )
    torch.testing.assert_close(seen[keys.PROPRIOCEPTION][:, part["last_action"]], action, atol=1e-3, rtol=0)
    assert seen[keys.PROPRIOCEPTION][:, part["angular_velocity"]].abs().max() < 1e-6
    contact = part["foot_contact"]
    assert torch.equal(seen[keys.PROPRIOCEPTION][:, contact], td[keys.PROPRIOCEPTION][:, contact])
    outward = seen[keys.PROPRIOCEPTION][:, part["roll_pitch"]] - td[keys.PROPRIOCEPTION][:, part["roll_pitch"]]
    leaning = torch.tensor([steering.LEAN * 1.0 * 1.0 / 9.81, 0.0]).expand(8, 2)
    torch.testing.assert_close(outward, leaning, atol=1e-6, rtol=0)


def test_speeds_of_straightened_joints_are_the_derivatives_of_their_positions(steering: ModuleType) -> None:
    td, later = observation(0.8, -1.0), observation(0.8, -1.0)
    position = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "joint_position")
    speed = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "joint_velocity")
    dt = 1e-2
    moved = later[keys.PROPRIOCEPTION].clone()
    moved[:, position] += dt * moved[:, speed] / features.JOINT_VELOCITY_SCALE
    later[keys.PROPRIOCEPTION] = moved
    first, second = (steering.straighten(row)[keys.PROPRIOCEPTION] for row in (td, later))
    measured = (second[:, position] - first[:, position]) / dt * features.JOINT_VELOCITY_SCALE
    torch.testing.assert_close(first[:, speed], measured, atol=0.02, rtol=0.05)


def test_legs_out_of_reach_give_finite_actions(steering: ModuleType) -> None:
    td = observation(0.5, 1.57)
    action = 8.0 * torch.randn(8, 12, generator=torch.Generator().manual_seed(2))
    assert steering.steered(lambda _: action)(td).isfinite().all()
    td[keys.PROPRIOCEPTION] = 30.0 * td[keys.PROPRIOCEPTION]
    assert steering.straighten(td)[keys.PROPRIOCEPTION].isfinite().all()
