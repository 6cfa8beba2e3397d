"""The model that every engine steps: where things are in it."""

from __future__ import annotations

import mujoco
import pytest
import torch

from agility_rl.go2 import constants
from agility_rl.simulation import HeightField, Hinge, Piece, Shape
from agility_rl.simulation.world import FORCES, JOINT_SPEEDS, JOINTS, World, check_finite, check_target

PLANK = Piece("plank", (Shape("sphere", (0.1,)),), Hinge((Shape("box", (1.0, 0.3, 0.02)),), 10.0, (0.0, 0.0, 0.3)))
STEP = Piece("step", (Shape("box", (0.5, 0.4, 0.1)),))


def test_joints_and_forces_are_where_the_constants_say() -> None:
    model = World(scenery=(PLANK, STEP)).model
    for index, name in enumerate(constants.JOINT_NAMES):
        assert model.joint(name).qposadr[0] == range(*JOINTS.indices(model.nq))[index]
        assert model.joint(name).dofadr[0] == range(*JOINT_SPEEDS.indices(model.nv))[index]
    forces = [index for index in range(model.nsensor) if model.sensor_type[index] == mujoco.mjtSensor.mjSENS_CONTACT]
    addresses = [int(model.sensor_adr[index]) for index in forces]
    assert addresses == list(range(0, FORCES.stop, 3))


def test_hinges_and_ground_of_the_scenery_are_found() -> None:
    world = World(scenery=(PLANK, STEP))
    assert world.hinges == [JOINTS.stop] and world.hinge_speeds == [JOINT_SPEEDS.stop]
    bodies = {world.model.body(world.model.geom_bodyid[geom]).name for geom in world.ground}
    assert bodies == {"world", "plank", "plank/moving", "step"}
    assert World().hinges == [] and len(World().ground) == 1


def test_robots_start_two_metres_from_the_edge_of_a_height_field() -> None:
    assert World(terrain=HeightField(torch.zeros(4, 4), (6.0, 9.0))).ground_extent == 4.0
    with pytest.raises(ValueError, match=r"must reach farther than 2\.0 m from its middle, got half sides of \(2"):
        World(terrain=HeightField(torch.zeros(4, 4), (2.0, 9.0)))
    assert World().ground_extent == 0.0


def test_steps_that_do_not_fit_are_refused() -> None:
    assert World(control_dt=0.02, sim_dt=0.002).substeps == 10
    for sim_dt in (0.003, 0.04):
        with pytest.raises(ValueError, match="control_dt must be a multiple of sim_dt"):
            World(control_dt=0.02, sim_dt=sim_dt)


def test_places_that_are_none_are_refused() -> None:
    world = World(scenery=(PLANK, STEP))
    everyone, places = torch.ones(2, dtype=torch.bool), [torch.zeros(2, 2, 3), torch.zeros(2, 2, 4), torch.zeros(2, 1)]
    world.check_places(everyone, *places)
    with pytest.raises(ValueError, match=r"quaternion of the scenery must be \[2, 2, 4\], got \[2, 2, 3\]"):
        world.check_places(everyone, places[0], places[0], places[2])
    places[2][1] = torch.nan
    world.check_places(torch.tensor([True, False]), *places)
    world.check_places(everyone, *places, finite=False)
    with pytest.raises(ValueError, match="hinge_angle of the scenery is not finite"):
        world.check_places(everyone, *places)


def test_states_and_targets_are_checked_by_name() -> None:
    check_target(torch.zeros(2, 12), 2)
    with pytest.raises(ValueError, match=r"target must be \[3, 12\], got \[2, 12\]"):
        check_target(torch.zeros(2, 12), 3)
    position, speed = torch.zeros(2, 3), torch.zeros(2, 4)
    check_finite(torch.tensor([4, 7]), position, speed)
    speed[1, 0] = torch.inf
    with pytest.raises(ValueError, match=r"states of rows \[7\] are not finite"):
        check_finite(torch.tensor([4, 7]), position, speed)
