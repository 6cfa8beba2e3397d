"""Bars, ramps and boxes in the way: where they are put, for whom, when elsewhere, and that robots feel them."""

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
from agility_rl.envs.encounters import (
    ASTRAY,
    BAR,
    BOX,
    BOX_DISTANCE,
    BOX_HEIGHT,
    DISTANCE,
    HALF_WIDTH,
    LIFT,
    NOTHING,
    PATIENCE,
    PIECES,
    RAMP,
    Encounters,
)
from agility_rl.envs.obstacles import APEX_HEIGHT, BOX_HALF, RAMP_LENGTH
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


def encounters(share: float = 1.0, seed: int = 0, boxes: float = 0.0) -> Encounters:
    return Encounters(N, torch.Generator().manual_seed(seed), share, boxes)


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


def test_boxes_lie_before_robots_that_jump(simulator: Simulator) -> None:
    yaw = torch.linspace(-3.0, 3.0, N)
    stand(simulator, torch.randn(N, 2), yaw)
    ahead = encounters(boxes=1.0)
    for skill, yaw_rate, kind in (("jump", 0.3, BOX), ("canter", 0.0, BAR), ("walk", 0.0, RAMP)):
        ahead.place(EVERYONE, simulator, told(skill, yaw_rate))
        assert ahead.kind.unique().tolist() == [kind]
    ahead.place(EVERYONE, simulator, told("jump"))
    near = (ahead.position - simulator.root_position[:, :2]).norm(dim=-1) - BOX_HALF[0]
    assert BOX_DISTANCE[0] - 1e-4 <= near.min() and near.max() <= BOX_DISTANCE[1] + 1e-4 and near.std() > 0.04
    assert BOX_HEIGHT[0] <= ahead.lift.min() and ahead.lift.max() <= BOX_HEIGHT[1] and ahead.lift.std() > 0.04
    ahead.box_height = (0.2, 0.2)
    ahead.place(EVERYONE, simulator, told("jump"))
    torch.testing.assert_close(ahead.lift, torch.full((N,), 0.2))
    some = encounters(boxes=0.5)
    some.place(EVERYONE, simulator, told("jump"))
    assert 15 <= int((some.kind == BOX).sum()) <= 45 and set(some.kind.tolist()) == {BAR, BOX}
    alone = encounters(0.0, boxes=1.0)
    for skill, kind in (("jump", BOX), ("canter", NOTHING), ("walk", NOTHING)):
        alone.place(EVERYONE, simulator, told(skill))
        assert alone.kind.unique().tolist() == [kind]
    with pytest.raises(ValueError, match=r"boxes: expected a share from 0 to 1, got -1"):
        encounters(boxes=-1.0)


def test_boxes_lie_where_a_jump_begins(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, jumps = encounters(boxes=1.0), told("jump")
    ahead.begin(EVERYONE, simulator, jumps)
    assert ahead.kind.unique().tolist() == [BAR], "an episode may begin in mid-air"
    jumps.age[:] = 0
    ahead.advance(simulator, jumps)
    assert ahead.kind.unique().tolist() == [BAR], "they jump already"
    trots = told("trot")
    ahead.advance(simulator, trots)
    ahead.advance(simulator, jumps)
    assert ahead.kind.unique().tolist() == [BOX]


def test_who_meets_a_box_goes_straight_on_fast_and_high(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, commands = encounters(boxes=1.0), told("jump")
    slow, fast = torch.tensor([0.8, -0.3, -0.5, 0.45, 0.0]), torch.tensor([1.8, 0.3, 0.5, 0.55, 0.0])
    half = EVERYONE.clone()
    half[N // 2 :] = False
    for given, wanted in (
        (slow, (1.5, -0.3, -0.3, 0.50, 0.0)),
        (fast, (1.8, 0.3, 0.3, 0.55, 0.0)),
        ((slow + fast) / 2.0, (1.65, 0.0, 0.0, 0.525, 0.0)),
    ):
        commands.command = given.repeat(N, 1)
        ahead.place(half, simulator, commands)
        torch.testing.assert_close(commands.command[: N // 2], torch.tensor(wanted).repeat(N // 2, 1))
        assert torch.equal(commands.command[N // 2 :], given.repeat(N // 2, 1)), "who is not asked about"


def test_who_is_before_a_box_or_on_it_is_told_the_same(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead, commands = encounters(boxes=1.0), told("jump")
    ahead.place(EVERYONE, simulator, commands)
    way = torch.stack((ahead.yaw.cos(), ahead.yaw.sin()), -1)
    left = torch.stack((-way[:, 1], way[:, 0]), -1)
    # A box is 1.6 m long and 2 m wide, and one is at it for another half metre.
    for along, across, held in ((-2.0, 0.0, True), (0.0, -0.9, True), (1.2, 0.0, True), (1.4, 0.0, False)):
        stand(simulator, ahead.position + along * way + across * left, ahead.yaw)
        assert ahead.holding(simulator, commands).tolist() == [held] * N
    stand(simulator, ahead.position + (HALF_WIDTH + 0.1) * left, ahead.yaw)
    assert not bool(ahead.holding(simulator, commands).any()), "it passes beside it"
    stand(simulator, ahead.position, ahead.yaw)
    commands.age[:] = round(PATIENCE / simulator.control_dt)
    assert not bool(ahead.holding(simulator, commands).any()), "it will not get over it any more"
    ahead.place(EVERYONE, simulator, told("walk"))
    assert not bool(ahead.holding(simulator, told("walk")).any()), "ramps hold nobody"


def test_feet_that_come_to_a_box_ought_to_be_higher_than_its_top(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead = encounters(boxes=1.0)
    ahead.box_height = (0.2, 0.2)
    ahead.place(EVERYONE, simulator, told("jump"))
    way = torch.stack((ahead.yaw.cos(), ahead.yaw.sin()), -1)
    left = torch.stack((-way[:, 1], way[:, 0]), -1)

    def foot(before: float, aside: float, height: float) -> torch.Tensor:
        """So far before the near side, which is 0.8 m before the middle."""
        place = ahead.position - (0.8 + before) * way + aside * left
        return torch.cat((place, torch.full((N, 1), height)), -1)

    # 4 cm above the top are enough: 0.24 m. The third is too far away, the fourth stands on the box.
    feet = [foot(0.05, 0.0, 0.1), foot(0.1, 0.3, 0.21), foot(0.2, 0.0, 0.0), foot(-0.1, 0.0, 0.2)]
    wanted = torch.full((N,), 0.14 + 0.03)
    torch.testing.assert_close(ahead.low_feet(torch.stack(feet, 1)), wanted)
    feet = [foot(0.05, 1.1, 0.1), foot(0.05, 0.0, 0.3), foot(0.05, 0.0, 0.24), foot(2.0, 0.0, 0.0)]
    torch.testing.assert_close(ahead.low_feet(torch.stack(feet, 1)), torch.zeros(N), atol=1e-6, rtol=0.0)
    ahead.place(EVERYONE, simulator, told("trot"))
    assert not bool(ahead.low_feet(torch.stack([foot(0.05, 0.0, 0.0)] * 4, 1)).any()), "ramps are walked on"


def test_critics_are_told_what_lies_where(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead = encounters(boxes=1.0)
    ahead.place(EVERYONE, simulator, told("jump"))
    way = torch.stack((ahead.yaw.cos(), ahead.yaw.sin()), -1)
    left = torch.stack((-way[:, 1], way[:, 0]), -1)
    stand(simulator, ahead.position - 1.5 * way + 0.4 * left, ahead.yaw + 0.1)
    wanted = torch.tensor([0.0, 0.0, 1.0, 0.0, -1.5, 0.4, math.sin(0.1)]).repeat(N, 1)
    wanted[:, 3] = ahead.lift
    torch.testing.assert_close(ahead.observe(simulator), wanted)
    stand(simulator, ahead.position - 4.5 * way, ahead.yaw)
    assert torch.all(ahead.observe(simulator)[:, 4] == -3.0), "farther than anybody should care"
    ahead.place(EVERYONE, simulator, told("trot", 1.0))
    assert not bool(ahead.observe(simulator).any())


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


@pytest.mark.parametrize(("skill", "piece"), [("walk", 1), ("jump", 2)])
def test_the_ground_is_where_rays_meet_it(simulator: Simulator, skill: str, piece: int) -> None:
    stand(simulator, torch.zeros(N, 2), torch.linspace(-3.0, 3.0, N))
    ahead = encounters(boxes=1.0)
    ahead.place(EVERYONE, simulator, told(skill))
    data = mujoco.MjData(simulator.model)
    generator = torch.Generator().manual_seed(1)
    checked = 0
    for row in range(0, N, 6):
        points = ahead.position[row] + 2.0 * torch.rand(20, 2, generator=generator) - 1.0
        heights = torch.stack([ahead.ground(point.expand(N, 2))[row] for point in points])
        data.mocap_pos[:] = (0.0, 0.0, PARKED_DEPTH)
        data.mocap_pos[piece] = (*ahead.position[row].tolist(), ahead.lift[row].item() if skill == "jump" else 0.0)
        data.mocap_quat[piece] = (math.cos(ahead.yaw[row] / 2), 0.0, 0.0, math.sin(ahead.yaw[row] / 2))
        data.qpos[:3] = (50.0, 50.0, 1.0)
        mujoco.mj_forward(simulator.model, data)
        for point, height in zip(points.tolist(), heights.tolist(), strict=True):
            down = mujoco.mj_ray(simulator.model, data, [*point, 2.0], [0.0, 0.0, -1.0], None, 1, -1, None)
            assert 2.0 - down == pytest.approx(height, abs=1e-5)
            checked += height > 0.05
    assert checked > 100


def test_robots_stand_on_boxes(simulator: Simulator) -> None:
    stand(simulator, torch.zeros(N, 2), torch.zeros(N))
    ahead = encounters(boxes=1.0)
    ahead.place(EVERYONE, simulator, told("jump"))
    stand(simulator, ahead.position, ahead.yaw, ahead.lift)
    for _ in range(10):
        simulator.step(torch.tensor(DEFAULT_POSE).repeat(N, 1))
    over = simulator.root_position[:, 2] - ahead.ground(simulator.root_position[:, :2])
    assert over.min() > 0.2 and over.max() < STANDING_HEIGHT + 0.01
    assert torch.equal(ahead.ground(simulator.root_position[:, :2]), ahead.lift)


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
        with pytest.raises(ValueError, match="encounters need a plane, and a simulator that holds"):
            LocomotionEnv(2, simulator_options=options, boxes=0.5)
        env = LocomotionEnv(2, simulator_options=options)
        env.rollout(2)
        env.close()
