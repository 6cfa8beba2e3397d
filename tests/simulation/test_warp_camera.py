"""Depth images of the batch renderer against the CPU camera's, robots and obstacles in the same places."""

from __future__ import annotations

import pytest
import torch

from agility_rl import rotations
from agility_rl.envs import COURSES
from agility_rl.envs.layout import CourseLayout
from agility_rl.go2 import camera
from agility_rl.simulation import make_simulator
from tests.simulation.robot_states import everyone, only, standing

pytest.importorskip("mujoco_warp", reason="the extra gpu is not installed")

NETWORK_RANGE = camera.DEPTH_FAR
"""Depths beyond this are one to the network [m]."""


def test_images_are_those_of_the_cpu_camera(generator: torch.Generator) -> None:
    robots = 6
    layout = CourseLayout(COURSES["full"], robots, generator)
    layout.draw(everyone(robots))
    which = torch.arange(robots)
    place = layout.world(which, torch.tensor([-0.9, 0.05]).expand(robots, 2))
    yaw, tilt = layout.yaw[torch.arange(robots), which], 0.2 * torch.rand(robots, generator=generator) - 0.1
    state = standing(
        robots,
        root_position=torch.cat((place, torch.full((robots, 1), 0.33)), -1),
        root_quaternion=rotations.from_euler(tilt, -tilt, yaw),
    )
    pitch = camera.PITCH_JITTER * (2.0 * torch.rand(robots, generator=generator) - 1.0)
    images = []
    for options in ({"name": "warp", "device": "cpu"}, {"name": "batch", "num_threads": 1}):
        simulator = make_simulator(num_simulations=robots, scenery=layout.pieces, **options)
        simulator.place(everyone(robots), *layout.poses())
        simulator.reset(everyone(robots), **state)
        eye = simulator.make_camera()
        eye.set_pitch(only(robots, 0, 1, 2, 3), pitch)
        torch.testing.assert_close(eye.pitch, torch.where(which < 4, pitch, 0.0))
        images.append(eye.render(everyone(robots)))
        assert torch.equal(eye.render(only(robots, 1, 4)), images[-1][[1, 4]])
        simulator.close()
        assert not {"_source", "_data", "_context"} & set(vars(eye)), "a camera would hold the simulations"
    ours, theirs = (image.clamp(max=NETWORK_RANGE) for image in images)
    assert ours.shape == (robots, camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)
    assert (theirs < NETWORK_RANGE).flatten(1).float().mean(-1).min() > 0.2, "every robot must see something"
    same = (ours - theirs).abs() < 1e-3
    print(f"{(~same).sum().item()} of {same.numel()} pixels differ by more than 1 mm")
    assert (~same).float().mean() < 2e-3, "but for rays that graze an edge"


def test_the_sky_is_infinitely_far() -> None:
    simulator = make_simulator("warp", num_simulations=1, device="cpu")
    simulator.reset(everyone(1), **standing(1))
    image = simulator.make_camera().render(everyone(1))[0]
    assert bool(image[0].isinf().all()) and bool(image[-1].isfinite().all())
