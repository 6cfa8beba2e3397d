"""Frames and shapes: the frames' chain must put the feet where forward kinematics puts them."""

from __future__ import annotations

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.record.scene import BODIES, Shape, body_transforms, entity, foot_entity, robot_entities


def test_the_frames_agree_with_forward_kinematics(generator: torch.Generator) -> None:
    joints = torch.empty(12).uniform_(-1.0, 1.0, generator=generator)
    turn = torch.nn.functional.normalize(torch.randn(4, generator=generator), dim=0)
    root = torch.tensor([1.0, -2.0, 0.4])
    pose = {"world": (torch.zeros(3), torch.tensor([1.0, 0.0, 0.0, 0.0]))}
    for transform in body_transforms(root.tolist(), turn.tolist(), joints.tolist()):
        position, quaternion = pose[transform.parent_frame_id]
        t, r = transform.translation, transform.rotation
        here = position + rotations.rotate(quaternion, torch.tensor([t.x, t.y, t.z]))
        pose[transform.child_frame_id] = (here, rotations.multiply(quaternion, torch.tensor([r.w, r.x, r.y, r.z])))
    assert tuple(pose)[1:] == BODIES and len(BODIES) == 13
    feet = root + rotations.rotate(turn, kinematics.forward(joints))
    for index, leg in enumerate(constants.LEGS):
        position, quaternion = pose[f"{leg}_calf"]
        centre = foot_entity(leg, False).spheres[0].pose.position
        foot = position + rotations.rotate(quaternion, torch.tensor([centre.x, centre.y, centre.z]))
        torch.testing.assert_close(foot, feet[index], atol=1e-5, rtol=0)


def test_every_body_has_a_shape_that_moves_with_it() -> None:
    entities = robot_entities()
    assert [e.frame_id for e in entities] == list(BODIES) and all(e.frame_locked for e in entities)
    assert foot_entity("FL", True).spheres[0].color.r > foot_entity("FL", False).spheres[0].color.r


def test_shapes() -> None:
    shapes = [Shape("box", (1, 2, 3), (4, 5, 6)), Shape("sphere", (1, 1, 1)), Shape("cylinder", (1, 1, 2))]
    result = entity("obstacle", "world", shapes)
    assert (len(result.cubes), len(result.spheres), len(result.cylinders)) == (1, 1, 1)
    assert result.cubes[0].pose.position.z == 6 and result.cubes[0].pose.orientation.w == 1
    assert result.cylinders[0].bottom_scale == result.cylinders[0].top_scale == 1
    with pytest.raises(ValueError, match="box, cylinder or sphere, got 'cone'"):
        Shape("cone", (1, 1, 1))
    with pytest.raises(ValueError, match="positive sizes"):
        Shape("box", (1, 0, 1))
