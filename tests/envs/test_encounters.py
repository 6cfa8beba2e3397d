"""Bars and ramps in the way: where they are put, for whom, when they are put elsewhere, and that robots feel them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import pytest
import torch

from agility_rl import rotations
from agility_rl.behaviours import skill_index
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.encounters import ASTRAY, BAR, DISTANCE, LIFT, NOTHING, PIECES, RAMP, Encounters
from agility_rl.envs.obstacles import APEX_HEIGHT, RAMP_LENGTH
from agility_rl.go2.constants import DEFAULT_POSE, STANDING_HEIGHT
from agility_rl.simulation import Piece, Shape, Simulator, make_simulator, ridges
from agility_rl.simulation.scenery import PARKED_DEPTH

N = 60
EVERYONE = torch.ones(N, dtype=torch.bool)


@pytest.fixture(scope="module")
def simulator() -> Iterator[Simulator]:
    simulator = make_simulator(num_simulations=N, num_threads=1, scenery=PIECES)
    yield simulator
    simulator.close()


def stand(simulator: Simulator, place: torch.Tensor, yaw: torch.Tensor, height: torch.Tensor | float = 0.0) -> None:
    """Put every robot on the ground at places ``[N, 2]`` with headings ``[N]``."""
    root = torch.cat((place, (torch.zeros(N) + height + STANDING_HEIGHT)[:, None]), -1)
    level = torch.zeros(N)
    simulator.reset(
        EVERYONE,
        root_position=root,
        root_quaternion=rotations.from_euler(level, level, yaw),
        root_linear_velocity=torch.zeros(N, 3),
        root_angular_velocity=torch.zeros(N, 3),
        joint_position=torch.tensor(DEFAULT_POSE).repeat(N, 1),
        joint_velocity=torch.zeros(N, 12),
    )


def told(skill: str, yaw_rate: float = 0.0) -> CommandSampler:
    commands = CommandSampler(N, torch.Generator(), None)
    command = torch.zeros(N, 5)
    command[:, 2] = yaw_rate
    commands.assign(EVERYONE, torch.full((N,), skill_index(skill)), command, torch.zeros(N, 1))
    commands.age = torch.ones(N, dtype=torch.int64)
    return commands


def encounters(share: float = 1.0, seed: int = 0) -> Encounters:
    return Encounters(N, torch.Generator().manual_seed(seed), share)


@pytest.mark.parametrize(
    ("skill", "yaw_rate", "kind"),
    [("walk", 0.0, RAMP), ("trot", -0.2, RAMP), ("trot", 0.4, NOTHING), ("canter", 0.4, BAR), ("jump", 0.0, BAR)],
)
def test_it_lies_ahead_of_whom_it_is_for(simulator: Simulator, skill: str, yaw_rate: float, kind: int) -> None:
    yaw = torch.linspace(-3.0, 3.0, N)
    stand(simulator, torch.randn(N, 2), yaw)
    ahead = encounters()
    ahead.place(EVERYONE, simulator, told(skill, yaw_rate))
    assert ahead.kind.unique().tolist() == [kind]
    offset = ahead.position - simulator.root_position[:, :2]
    bearing = rotations.wrap_angle(torch.atan2(offset[:, 1], offset[:, 0]) - yaw)
    assert bearing.abs().max() <= 0.2 + 1e-5 and bearing.std() > 0.05
    near = offset.norm(dim=-1) - RAMP_LENGTH * (kind == RAMP)
    assert DISTANCE[0] - 1e-4 <= near.min() and near.max() <= DISTANCE[1] + 1e-4
    assert LIFT[0] <= ahead.lift.min() and ahead.lift.max() <= LIFT[1] and ahead.lift.std() > 0.02


def test_as_often_as_told(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, never = encounters(0.5), encounters(0.0)
    for one in (ahead, never):
        one.place(EVERYONE, simulator, told("jump"))
    assert 15 <= int((ahead.kind == BAR).sum()) <= 45 and not bool(never.kind.any())
    with pytest.raises(ValueError, match=r"expected a share from 0 to 1, got 1\.5"):
        encounters(1.5)


def test_nothing_moves_under_a_robot_and_what_lies_behind_comes_again(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, commands = encounters(), told("trot")
    ahead.place(EVERYONE, simulator, commands)
    before = ahead.position.clone()
    way = torch.stack((ahead.yaw.cos(), ahead.yaw.sin()), -1)
    commands.age[:] = 0  # another command for everyone
    stand(simulator, before - 0.5 * way, ahead.yaw)
    ahead.advance(simulator, commands)
    assert torch.equal(ahead.position, before), "the robots stand on their ramps"
    commands.age[:] = 1
    stand(simulator, before - 3.0 * way, ahead.yaw)
    ahead.advance(simulator, commands)
    assert torch.equal(ahead.position, before), "they have not come to them yet"
    for away in (RAMP_LENGTH + 0.6, -ASTRAY - 0.1):  # past it, and gone elsewhere
        stand(simulator, ahead.position + away * way, ahead.yaw)
        here = simulator.root_position[:, :2].clone()
        ahead.advance(simulator, commands)
        offset = ((ahead.position - here) * way).sum(-1)
        assert offset.min() > RAMP_LENGTH
        way = torch.stack((ahead.yaw.cos(), ahead.yaw.sin()), -1)


def test_another_command_brings_something_else(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, walks, jumps = encounters(), told("walk"), told("jump")
    ahead.place(EVERYONE, simulator, walks)
    ahead.advance(simulator, jumps)
    assert ahead.kind.unique().tolist() == [RAMP], "only with the command's first step"
    jumps.age[:] = 0
    ahead.advance(simulator, jumps)
    assert ahead.kind.unique().tolist() == [BAR]


def test_the_ground_is_where_rays_meet_it(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.linspace(-3.0, 3.0, N))
    ahead = encounters()
    ahead.place(EVERYONE, simulator, told("walk"))
    data = mujoco.MjData(simulator.model)
    generator = torch.Generator().manual_seed(1)
    checked = 0
    for row in range(0, N, 6):
        points = ahead.position[row] + 2.0 * torch.rand(20, 2, generator=generator) - 1.0
        heights = torch.stack([ahead.ground(point.expand(N, 2))[row] for point in points])
        data.mocap_pos[0] = (0.0, 0.0, PARKED_DEPTH)
        data.mocap_pos[1] = (*ahead.position[row].tolist(), 0.0)
        data.mocap_quat[1] = (math.cos(ahead.yaw[row] / 2), 0.0, 0.0, math.sin(ahead.yaw[row] / 2))
        data.qpos[:3] = (50.0, 50.0, 1.0)
        mujoco.mj_forward(simulator.model, data)
        for point, height in zip(points.tolist(), heights.tolist(), strict=True):
            down = mujoco.mj_ray(simulator.model, data, [*point, 2.0], [0.0, 0.0, -1.0], None, 1, -1, None)
            assert 2.0 - down == pytest.approx(height, abs=1e-5)
            checked += height > 0.05
    assert checked > 100


def test_robots_stand_on_ramps(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead = encounters()
    ahead.place(EVERYONE, simulator, told("walk"))
    stand(simulator, ahead.position, ahead.yaw, APEX_HEIGHT)
    for _ in range(10):
        simulator.step(torch.tensor(DEFAULT_POSE).repeat(N, 1))
    assert simulator.root_position[:, 2].min() > APEX_HEIGHT + 0.1
    assert ahead.ground(simulator.root_position[:, :2]).min() > 0.8 * APEX_HEIGHT


def test_another_world_is_refused_with_them_only() -> None:
    field = ridges(torch.Generator().manual_seed(0), half_size=6.0)
    step = Piece("step", (Shape("box", (0.5, 0.5, 0.1)),))
    for world in ({"scenery": ()}, {"terrain": field}, {"scenery": (step,)}):
        options = {"num_threads": 1, **world}
        with pytest.raises(ValueError, match="encounters need a plane, and a simulator that holds"):
            LocomotionEnv(2, simulator_options=options, encounters=0.5)
        env = LocomotionEnv(2, simulator_options=options)
        env.rollout(2)
        env.close()
