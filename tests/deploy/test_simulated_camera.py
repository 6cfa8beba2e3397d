"""The camera of the robot in plain MuJoCo sees what the camera of the training sees."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.deploy.depth import DepthPreprocessor
from agility_rl.deploy.simulated import SimulatedBus, SimulatedRobot, add_world
from agility_rl.deploy.simulated_camera import FRAME_PERIOD, SimulatedCamera
from agility_rl.go2 import camera, constants
from agility_rl.go2.appearance import dress
from agility_rl.simulation import BatchSimulator, Piece, Shape

BOXES = (
    Piece("near", (Shape("box", (0.1, 0.3, 0.2), (0.0, 0.0, 0.2)),)),
    Piece("far", (Shape("cylinder", (0.2, 0.5), (0.0, 0.0, 0.5)),)),
)
PLACES = ((1.2, 0.4, 0.0), (3.0, -0.6, 0.0))


def world(file: Path) -> Path:
    """The same boxes as MJCF."""
    file.write_text(
        """<mujoco><worldbody>
        <body name="near" pos="1.2 .4 0"><geom type="box" size=".1 .3 .2" pos="0 0 .2"/></body>
        <body name="far" pos="3 -.6 0"><geom type="cylinder" size=".2 .5" pos="0 0 .5"/></body>
        </worldbody></mujoco>"""
    )
    return file


@pytest.mark.parametrize("pitch", [0.0, 0.08])
def test_it_sees_what_training_shows(tmp_path: Path, pitch: float) -> None:
    simulator = BatchSimulator(1, num_threads=1, scenery=BOXES)
    everybody = torch.ones(1, dtype=torch.bool)
    simulator.place(everybody, torch.tensor([PLACES]), torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2]), torch.zeros(1, 0))
    eye = simulator.make_camera()
    eye.set_pitch(everybody, torch.tensor([pitch]))
    turn = torch.tensor([[0.995, 0.02, 0.05, 0.08]])
    simulator.reset(
        everybody,
        root_position=torch.tensor([[0.1, -0.2, 0.32]]),
        root_quaternion=turn / turn.norm(),
        root_linear_velocity=torch.zeros(1, 3),
        root_angular_velocity=torch.zeros(1, 3),
        joint_position=torch.tensor([constants.DEFAULT_POSE]),
        joint_velocity=torch.zeros(1, 12),
    )
    trained = camera.normalize_depth(eye.render(everybody))[0]
    robot = SimulatedRobot(surround=add_world(world(tmp_path / "world.xml")))
    pose = [0.1, -0.2, 0.32, *(turn / turn.norm())[0].tolist(), *constants.DEFAULT_POSE]
    robot.place(np.array(pose), np.zeros(18))
    seen = DepthPreprocessor()(SimulatedCamera(robot, pitch).latest().image)
    apart = (camera.metres(seen) - camera.metres(trained)).abs()
    assert (apart > 0.001).float().mean() < 0.003, "but for pixels on an edge"
    assert 0.02 < (camera.metres(trained) < 1.5).float().mean() < 0.9 and trained.max() == 0.5


def test_what_only_eyes_see_it_does_not() -> None:
    """The legs of a robot in a handstand's pose are before its camera, dressed or not, and under a skin."""
    folded = np.array([0.0, -1.2, -0.9] * 4)
    images = []

    def hide(spec: mujoco.MjSpec) -> None:
        for geom in spec.body("trunk").find_all("geom"):
            geom.rgba = (*geom.rgba[:3], 0.0)  # as a skin does

    for surround in (lambda spec: None, dress, hide):
        robot = SimulatedRobot(surround=surround)
        robot.data.qpos[7:19] = folded
        mujoco.mj_forward(robot.model, robot.data)
        images.append(SimulatedCamera(robot).counts())
    np.testing.assert_array_equal(images[1], images[0])
    np.testing.assert_array_equal(images[2], images[0])
    assert (images[0] < 400).any(), "the legs are in view"


def test_images_are_taken_at_fifty_hertz() -> None:
    robot = SimulatedRobot()
    robot.reset("standing")
    bus = SimulatedBus(robot)
    eye = SimulatedCamera(robot, now=bus.now)
    first = eye.latest()
    bus.sleep_until(0.4 * FRAME_PERIOD)
    assert eye.latest() is first
    bus.sleep_until(FRAME_PERIOD)
    second = eye.latest()
    assert second is not first and second.time == pytest.approx(FRAME_PERIOD)


def test_a_world_that_is_none_is_refused(tmp_path: Path) -> None:
    bad = tmp_path / "world.xml"
    bad.write_text("<mujoco><worldbody><geom type='egg'/></worldbody></mujoco>")
    for file in (bad, tmp_path / "missing.xml"):
        with pytest.raises(ValueError, match=f"{file.name}: expected an MJCF file of what stands around"):
            SimulatedRobot(surround=add_world(file))


def test_a_robot_meets_what_stands_around_it(tmp_path: Path) -> None:
    file = tmp_path / "step.xml"
    file.write_text("<mujoco><worldbody><geom name='step' type='box' size='1 1 .15'/></worldbody></mujoco>")
    robot = SimulatedRobot(surround=add_world(file))
    robot.place(np.array([0.0, 0.0, 0.65, 1.0, 0.0, 0.0, 0.0, *constants.DEFAULT_POSE]), np.zeros(18))
    robot.advance(1.0)
    touched = {
        mujoco.mj_id2name(robot.model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in robot.data.contact.geom.ravel()
    }
    assert "world/step" in touched and robot.data.qpos[2] > 0.2
