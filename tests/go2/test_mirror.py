"""Mirror images of features, against features of mirrored states and against the engine."""

from __future__ import annotations

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants, features, kinematics
from agility_rl.go2.mirror import AXIAL, OTHER_SIDE, POLAR, mirror_commands, mirror_features, mirror_joints
from agility_rl.simulation import make_simulator

LAYOUTS = (
    features.PROPRIOCEPTION_LAYOUT,
    features.EXPLICIT_LAYOUT,
    features.PRIVILEGED_LAYOUT,
    features.MOTION_LAYOUT,
    features.MEASUREMENT_LAYOUT,
)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_image_of_an_image_is_the_vector_itself(layout: tuple[features.Entry, ...]) -> None:
    values = torch.randn(3, 5, sum(entry.size for entry in layout))
    image = mirror_features(layout, values)
    assert not torch.equal(image, values) and torch.equal(mirror_features(layout, image), values)


def test_feet_of_mirrored_joints_are_mirrored_feet() -> None:
    joints = torch.tensor(constants.DEFAULT_POSE) + 0.3 * torch.randn(7, 12)
    expected = kinematics.forward(joints)[:, list(OTHER_SIDE)] * torch.tensor(POLAR)
    torch.testing.assert_close(kinematics.forward(mirror_joints(joints)), expected)


def test_a_symmetric_stand_is_its_own_image() -> None:
    stand = features.proprioception(
        torch.zeros(1, 2),
        torch.zeros(1, 3),
        torch.tensor([constants.DEFAULT_POSE]),
        torch.zeros(1, 12),
        torch.zeros(1, 12),
        torch.ones(1, 4, dtype=torch.bool),
    )
    torch.testing.assert_close(mirror_features(features.PROPRIOCEPTION_LAYOUT, stand), stand)


def test_numbers_go_where_their_names_say() -> None:
    layout = features.PROPRIOCEPTION_LAYOUT
    values = torch.zeros(features.NUM_PROPRIOCEPTION)
    values[features.layout_slice(layout, "roll_pitch")] = torch.tensor([0.1, 0.2])
    values[features.layout_slice(layout, "angular_velocity")] = torch.tensor([1.0, 2.0, 3.0])
    values[features.layout_slice(layout, "foot_contact")] = torch.tensor([0.5, -0.5, -0.5, -0.5])  # front left only
    values[features.layout_slice(layout, "last_action")] = torch.arange(1.0, 13.0)
    image = mirror_features(layout, values)
    part = {entry.name: image[features.layout_slice(layout, entry.name)].tolist() for entry in layout}
    assert part["roll_pitch"] == pytest.approx([-0.1, 0.2])
    assert part["angular_velocity"] == [-1.0, 2.0, -3.0]
    assert part["foot_contact"] == [-0.5, 0.5, -0.5, -0.5]
    assert part["last_action"] == [-4.0, 5.0, 6.0, -1.0, 2.0, 3.0, -10.0, 11.0, 12.0, -7.0, 8.0, 9.0]


def test_commands_turn_and_step_to_the_other_side() -> None:
    vector = torch.tensor([[1.0, 0.1, -0.5, 0.5, 0.3, 0.7, 0.0, 0.0, 1.0, 0.0, 0.0]])
    image = mirror_commands(vector)
    assert image[0, 1] == -0.1 and image[0, 2] == 0.5
    assert torch.equal(image[:, 3:], vector[:, 3:]) and image[0, 0] == 1.0


def test_the_engine_moves_the_image_as_the_image_of_what_it_moves() -> None:
    """Two robots, one in the other's mirror, stay so for a quarter of a second of random targets."""
    generator = torch.Generator().manual_seed(2)
    simulator = make_simulator(num_simulations=2, num_threads=1)
    pose = torch.tensor(constants.DEFAULT_POSE)
    joints = pose + 0.1 * torch.randn(12, generator=generator)
    turned = rotations.from_euler(*torch.tensor([[0.1, -0.1], [0.05, 0.05], [0.0, 0.0]]))
    linear, angular = torch.tensor([0.4, 0.3, 0.0]), torch.tensor([0.5, 0.2, -0.7])
    simulator.reset(
        torch.ones(2, dtype=torch.bool),
        root_position=torch.tensor([[0.0, 0.0, 0.36]]).expand(2, 3),
        root_quaternion=turned,
        root_linear_velocity=torch.stack((linear, linear * torch.tensor(POLAR))),
        root_angular_velocity=torch.stack((angular, angular * torch.tensor(AXIAL))),
        joint_position=torch.stack((joints, mirror_joints(joints))),
        joint_velocity=torch.zeros(2, 12),
    )
    for _ in range(12):
        target = pose + 0.2 * torch.randn(12, generator=generator)
        simulator.step(torch.stack((target, mirror_joints(target))))
        one, image = simulator.joint_position
        torch.testing.assert_close(image, mirror_joints(one), atol=2e-4, rtol=0.0)
        place, other = simulator.root_position
        torch.testing.assert_close(other, place * torch.tensor(POLAR), atol=2e-4, rtol=0.0)
    assert (simulator.root_position[0] - torch.tensor([0.0, 0.0, 0.36])).norm() > 0.05
    simulator.close()


def test_what_has_no_image_is_refused() -> None:
    with pytest.raises(ValueError, match="mirror image of 'whiskers' is not known"):
        mirror_features((features.Entry("whiskers", 2, "m"),), torch.zeros(2))
    with pytest.raises(ValueError, match="expected vectors of 4 numbers for this layout, got 5"):
        mirror_features(features.EXPLICIT_LAYOUT, torch.zeros(5))
    with pytest.raises(ValueError, match=r"expected 3 numbers of 'trunk_com', the layout has 2"):
        mirror_features((features.Entry("trunk_com", 2, "m"),), torch.zeros(2))
