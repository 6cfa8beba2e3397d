"""The engine's depth images against single rays through the full model, on every course."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.envs import COURSES
from agility_rl.envs.layout import CourseLayout
from agility_rl.go2 import camera, constants
from agility_rl.simulation import BatchSimulator, DepthCamera

EDGE = 0.05
"""A pixel lies at an edge if depths in its 3 x 3 neighbourhood differ by more than this share."""
NOWHERE = 50.0
"""Depth that stands for none at all, and beyond which none is compared [m]; the network sees 4 m."""


def stand(simulator: BatchSimulator, position: Tensor, quaternion: Tensor, joints: Tensor) -> None:
    n = simulator.num_simulations
    simulator.reset(
        torch.ones(n, dtype=torch.bool),
        root_position=position,
        root_quaternion=quaternion,
        root_linear_velocity=torch.zeros(n, 3),
        root_angular_velocity=torch.zeros(n, 3),
        joint_position=joints,
        joint_velocity=torch.zeros(n, 12),
    )


def on_course(name: str, robots: int, generator: torch.Generator) -> tuple[BatchSimulator, DepthCamera]:
    """Robots near, on and in the obstacles, tilted, legs anywhere within their stops, cameras mounted askew."""
    layout = CourseLayout(COURSES[name], robots, generator)
    everyone = torch.ones(robots, dtype=torch.bool)
    layout.draw(everyone)
    simulator = BatchSimulator(robots, num_threads=1, scenery=layout.pieces)
    position, quaternion, hinge = layout.poses()
    simulator.place(everyone, position, quaternion, -hinge if robots % 2 else hinge)
    which = torch.arange(robots) % len(layout.kinds)
    draw = torch.rand(6, robots, generator=generator)
    place = layout.world(which, torch.stack((-2.0 + 2.5 * draw[0], 0.6 * draw[1] - 0.3), -1))
    yaw = layout.yaw[torch.arange(robots), which] + draw[2] - 0.5
    turned = rotations.from_euler(0.4 * draw[3] - 0.2, 0.8 * draw[4] - 0.4, yaw)
    low, high = torch.tensor(constants.JOINT_LOWER), torch.tensor(constants.JOINT_UPPER)
    joints = low + (high - low) * torch.rand(robots, 12, generator=generator)
    stand(simulator, torch.cat((place, 0.25 + 0.3 * draw[5][:, None]), -1), turned, joints)
    eye = simulator.make_camera()
    eye.set_pitch(everyone, camera.PITCH_JITTER * (2.0 * torch.rand(robots, generator=generator) - 1.0))
    return simulator, eye


def by_single_rays(simulator: BatchSimulator, row: int, pitch: float) -> np.ndarray:
    """Depth ``[58, 87]`` by ``mj_ray`` on the model of the physics, directions from the camera's numbers."""
    model, data = simulator.model, mujoco.MjData(simulator.model)
    for field in ("qpos", "mocap_pos", "mocap_quat"):
        getattr(data, field)[:] = simulator.batch.bind(field)[row]
    mujoco.mj_kinematics(model, data)
    trunk = model.body("trunk").id
    turn = data.xmat[trunk].reshape(3, 3)
    origin = data.xpos[trunk] + turn @ np.array(camera.POSITION)
    directions = camera.pixel_directions(pitch).double().numpy().reshape(-1, 3) @ turn.T
    hit = np.zeros(1, dtype=np.int32)
    distance = np.array([mujoco.mj_ray(model, data, origin, ray, None, 1, trunk, hit) for ray in directions])
    return np.where(distance < 0.0, np.inf, distance).reshape(camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)


def at_edge(depth: np.ndarray) -> np.ndarray:
    padded = np.pad(np.minimum(depth, NOWHERE), 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).reshape(*depth.shape, 9)
    return windows.max(-1) > (1.0 + EDGE) * windows.min(-1)


def compare(name: str, robots: int, generator: torch.Generator) -> None:
    simulator, eye = on_course(name, robots, generator)
    images = eye.render(torch.ones(robots, dtype=torch.bool)).double().numpy()
    pixels = edges = wrong_inside = wrong_at_edges = 0
    for row in range(robots):
        expected = by_single_rays(simulator, row, float(eye.pitch[row]))
        same = np.abs(np.minimum(images[row], NOWHERE) - np.minimum(expected, NOWHERE)) <= 1e-3
        edge = at_edge(expected)
        pixels, edges = pixels + same.size, edges + int(edge.sum())
        wrong_inside += int((~same & ~edge).sum())
        wrong_at_edges += int((~same & edge).sum())
    print(f"{name}: {pixels} pixels, {edges} at edges; > 1 mm off: {wrong_inside} inside, {wrong_at_edges} at edges")
    assert wrong_inside == 0
    assert wrong_at_edges <= 0.01 * max(edges, 100)
    simulator.close()


@pytest.mark.parametrize("course", sorted(COURSES))
def test_images_are_what_single_rays_find(course: str, generator: torch.Generator) -> None:
    compare(course, 1, generator)


@pytest.mark.slow
@pytest.mark.parametrize("course", sorted(COURSES))
def test_images_are_what_single_rays_find_from_many_places(course: str, generator: torch.Generator) -> None:
    compare(course, 32, generator)


def test_a_floor_by_hand() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    pose = torch.tensor([constants.DEFAULT_POSE])
    stand(simulator, torch.tensor([[0.0, 0.0, 0.3]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), pose)
    image = simulator.make_camera().render(torch.tensor([True]))[0]
    height, down = 0.3 + 0.098, (torch.arange(58) + 0.5 - 29.0) / camera.FOCAL_LENGTH
    expected = torch.where(down > 0, height / down, torch.inf)
    torch.testing.assert_close(image, expected[:, None].expand(58, 87), rtol=1e-5, atol=0.0)


def test_pitch_is_positive_downwards_and_of_one_robot_alone() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    eye = simulator.make_camera()
    before = eye.render(torch.tensor([True, True]))
    eye.set_pitch(torch.tensor([False, True]), torch.full((2,), 0.08))
    after = eye.render(torch.tensor([True, True]))
    assert torch.equal(before[0], after[0])
    assert after[1].isfinite().sum() > before[1].isfinite().sum()  # more floor
    row = (torch.isfinite(after[1, :, 43])).nonzero()[0].item()
    horizon = 29.0 - camera.FOCAL_LENGTH * math.tan(0.08)
    assert row == math.ceil(horizon - 0.5)


def test_only_the_front_legs_of_its_own_body_can_be_seen() -> None:
    simulator = BatchSimulator(2, num_threads=1)
    pose = torch.tensor(constants.DEFAULT_POSE).repeat(2, 1)
    pose[1, 0:3] = torch.tensor([0.0, -1.5, -0.84])  # left front leg stretched out ahead
    place = torch.tensor([[0.0, 0.0, 0.5]]).repeat(2, 1)
    stand(simulator, place, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1), pose)
    image = simulator.make_camera().render(torch.tensor([True, True]))
    assert image[0].min() > 0.5
    seen = image[1] < 0.5
    assert seen.any() and seen[:, 60:].sum() == 0  # only on the left


def test_rows_of_a_mask_and_the_number_of_threads(generator: torch.Generator) -> None:
    simulator, eye = on_course("full", 5, generator)
    everyone = eye.render(torch.ones(5, dtype=torch.bool))
    mask = torch.tensor([False, True, False, True, True])
    assert torch.equal(eye.render(mask), everyone[mask])
    assert eye.render(torch.zeros(5, dtype=torch.bool)).shape == (0, 58, 87)
    other = DepthCamera(simulator.world.spec, simulator.batch, num_threads=2)
    other.set_pitch(torch.ones(5, dtype=torch.bool), eye.pitch)
    assert torch.equal(other.render(torch.ones(5, dtype=torch.bool)), everyone)
    simulator.close()


def test_physics_does_not_know_whether_somebody_looks() -> None:
    states = []
    for looked_at in (False, True):
        simulator = BatchSimulator(2, num_threads=1)
        eye = simulator.make_camera()
        for step in range(5):
            simulator.step(torch.tensor(constants.DEFAULT_POSE).repeat(2, 1) + 0.1 * step)
            if looked_at:
                eye.render(torch.tensor([step % 2 == 0, True]))
        states.append(simulator.state_dict())
    assert torch.equal(states[0]["state"], states[1]["state"])
    assert torch.equal(states[0]["contact_force"], states[1]["contact_force"])
