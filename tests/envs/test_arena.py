"""Starts, curriculum and what is perceived of the course."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from agility_rl import keys, rotations
from agility_rl.envs.arena import Arena
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.misjudgement import UNSEEN, Misjudgement
from agility_rl.simulation import BatchSimulator

N = 60


def build(course: str = "full", n: int = N, **options: Any) -> tuple[Arena, BatchSimulator]:
    arena = Arena(COURSES[course], n, torch.Generator().manual_seed(0), **options)
    return arena, BatchSimulator(n, num_threads=1, scenery=arena.layout.pieces)


def begin(arena: Arena, simulator: BatchSimulator) -> None:
    arena.begin(torch.ones(simulator.num_simulations, dtype=torch.bool), simulator)


def test_robots_start_before_a_random_obstacle_and_face_it() -> None:
    arena, simulator = build()
    begin(arena, simulator)
    assert torch.bincount(arena.progress.leg, minlength=6).min() > 2
    goal = arena.progress.local_goal()
    offset = arena.progress.local - goal
    assert offset[:, 0].min() >= -0.2 - 1e-5 and offset[:, 0].max() <= 1e-5 and offset[:, 0].std() > 0.04
    assert offset[:, 1].abs().max() <= 0.1 + 1e-5 and offset[:, 1].std() > 0.04
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    rows = torch.arange(N)
    turn = rotations.wrap_angle(yaw - arena.layout.yaw[rows, arena.progress.obstacle])
    assert turn.abs().max() <= 0.2 + 1e-5 and turn.std() > 0.08
    assert torch.equal(arena.progress.end, arena.layout.length)
    assert (simulator.contact_force[:, :1] == 0.0).all()  # nobody starts inside something


def test_starts_may_spread_to_how_robots_leave_an_obstacle() -> None:
    arena, simulator = build(n=400, start_spread=4.0)
    begin(arena, simulator)
    offset = arena.progress.local - arena.progress.local_goal()
    assert 0.3 < offset[:, 1].abs().max() <= 0.4 + 1e-5 and offset[:, 0].min() >= -0.2 - 1e-5
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    turn = rotations.wrap_angle(yaw - arena.layout.yaw[torch.arange(400), arena.progress.obstacle])
    assert 0.7 < turn.abs().max() <= 0.8 + 1e-5
    with pytest.raises(ValueError, match="start_spread must be from 0 to 10, got -1"):
        build(start_spread=-1.0)


def test_a_start_before_the_first() -> None:
    arena, simulator = build(start="first")
    begin(arena, simulator)
    assert (arena.progress.leg == 0).all()
    with pytest.raises(ValueError, match="'random' or 'first', got 'last'"):
        build(start="last")


def test_a_start_where_the_obstacle_before_is_left() -> None:
    arena, simulator = build(n=400, start_after=1.0)
    begin(arena, simulator)
    rows, leg = torch.arange(400), arena.progress.leg
    later = leg > 0
    behind = arena.layout.route[rows, leg - 1]
    # Half a metre behind A-frame (1.46 m), poles (1.61) and seesaw (1.5), or at the last way-point.
    ends = {"bar_jump": 0.9, "a_frame": 1.9625, "weave_poles": 2.11, "seesaw": 2.0, "tire_jump": 0.9, "tunnel": 1.525}
    end = torch.tensor([(ends[kind.name], 0.5 if kind.name == "weave_poles" else 0.0) for kind in arena.layout.kinds])
    short = end[behind] - arena.layout.local_to(behind, simulator.root_position[:, :2])
    assert short[later, 0].min() >= -1e-5 and short[later, 0].max() <= 0.2 + 1e-5
    assert short[later, 1].abs().max() <= 0.1 + 1e-5
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    along = rotations.wrap_angle(yaw - arena.layout.yaw[rows, behind])
    assert along[later].abs().max() <= 0.2 + 1e-5
    # The way turns back behind the second and the fourth obstacle: there robots look away from what comes.
    turn = rotations.wrap_angle(yaw - arena.layout.yaw[rows, arena.progress.obstacle]).abs()
    back = (leg == 2) | (leg == 4)
    assert turn[back].min() > 2.5 and turn[~back].max() < 0.6
    first = (arena.progress.local - arena.progress.local_goal())[~later]
    assert first[:, 0].min() >= -0.2 - 1e-5 and first[:, 1].abs().max() <= 0.1 + 1e-5
    assert (simulator.contact_force[:, :1] == 0.0).all()  # nobody starts inside something

    half, simulator = build(n=400, start_after=0.5)
    begin(half, simulator)
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    turn = rotations.wrap_angle(yaw - half.layout.yaw[rows, half.progress.obstacle]).abs()
    back = (half.progress.leg == 2) | (half.progress.leg == 4)
    assert 0.3 < (turn[back] > 2.5).float().mean() < 0.7
    with pytest.raises(ValueError, match=r"start_after must be a share from 0 to 1, got 1\.5"):
        build(start_after=1.5)
    with pytest.raises(ValueError, match=r"a share of random starts, got 0\.5 with start 'first'"):
        build(start="first", start_after=0.5)


def test_curriculum() -> None:
    arena, simulator = build(n=400)
    weights = torch.tensor([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1.0])
    arena.set_curriculum(0.0, 2, weights)
    begin(arena, simulator)
    assert (arena.progress.obstacle == 5).all()
    assert ((arena.progress.end - arena.progress.leg) <= 2).all() and (arena.progress.end <= 6).all()
    bar = [kind.name for kind in arena.layout.kinds].index("bar_jump")
    assert (arena.layout.lift[:, bar] == torch.tensor(0.05)).all()
    arena.set_curriculum(None, None, None)
    assert arena.max_obstacles == 2 and arena.layout.difficulty == 0.0
    for bad, message in (
        ((2.0, None, None), "difficulty"),
        ((None, 7, None), "1 to 6"),
        ((None, None, -weights), "positive"),
    ):
        with pytest.raises(ValueError, match=message):
            arena.set_curriculum(*bad)


def test_routes_of_other_lengths() -> None:
    arena, simulator = build("bidirectional")
    begin(arena, simulator)
    assert (arena.progress.leg < arena.layout.length).all()


def test_progress_on_routes_that_end_at_the_ramp_and_at_the_tunnel() -> None:
    """Two routes of two obstacles each: the hurdle and the ramp, the hurdle and the tunnel."""
    arena, simulator = build("bidirectional")
    begin(arena, simulator)
    seen = arena.observe(simulator, rotations.to_euler(simulator.root_quaternion)[2])
    assert seen[keys.PROGRESS].shape == (N, 16) and (seen[keys.PROGRESS].sum(-1) == 1.0).all()
    leg = seen[keys.PROGRESS].argmax(-1) // 4
    assert (seen[keys.PROGRESS].argmax(-1) % 4 == 0).all() and torch.bincount(leg, minlength=4).min() > 2
    assert torch.equal(leg % 2, arena.progress.leg)
    goes_to = arena.layout.route[:, 1]  # the second slot or the third
    assert torch.equal(leg // 2, goes_to - 1)
    arena.progress.point[:] = 3
    assert torch.equal(arena.progress.stage, 4 * leg + 3)


def test_heading_errors_by_hand() -> None:
    arena, simulator = build("tunnel", n=1)
    begin(arena, simulator)
    layout = arena.layout
    layout.position, layout.yaw = torch.tensor([[[2.0, 3.5]]]), torch.tensor([[math.pi / 2]])
    # Goals lie at y = 3.5 - 2.025 and 3.5 - 1.525; the robot stands left of the line and looks along x.
    goal, error = arena.heading_error(torch.tensor([[1.0, 1.475]]), torch.tensor([0.0]))
    torch.testing.assert_close(goal, torch.tensor([[1.0, 0.0]]))
    torch.testing.assert_close(error, torch.tensor([[0.0, math.atan2(0.5, 1.0)]]))
    _, behind = arena.heading_error(torch.tensor([[3.0, 1.475]]), torch.tensor([0.5]))
    torch.testing.assert_close(behind[:, 0], torch.tensor([math.pi - 0.5]))


def test_place_by_hand() -> None:
    """A robot that looks along x, and then along y, beside a tunnel that leads along y."""
    arena, simulator = build("tunnel", n=1)
    begin(arena, simulator)
    layout = arena.layout
    layout.position, layout.yaw = torch.tensor([[[2.0, 3.5]]]), torch.tensor([[math.pi / 2]])
    place = arena.place(arena.expected_goals(), torch.tensor([[1.0, 1.475]]), torch.tensor([0.0]))
    torch.testing.assert_close(place, torch.tensor([[1.0, 0.0, 1.0, 0.5, -2.025, 1.0, -1.0, 0.0]]), atol=1e-6, rtol=0)
    turned = arena.place(arena.expected_goals(), torch.tensor([[1.0, 1.475]]), torch.tensor([math.pi / 2]))
    torch.testing.assert_close(turned, torch.tensor([[0.0, -1.0, 0.5, -1.0, -2.025, 1.0, 0.0, 1.0]]), atol=1e-6, rtol=0)


def test_observation() -> None:
    arena, simulator = build()
    begin(arena, simulator)
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    seen = arena.observe(simulator, yaw)
    assert seen[keys.OBSTACLE].shape == (N, 7) and (seen[keys.OBSTACLE].sum(-1) == 1.0).all()
    names = [arena.layout.kinds[index].name for index in arena.progress.obstacle.tolist()]
    expected = ["bar_jump", "a_frame", "weave_poles", "seesaw", "tire_jump", "tunnel"]
    assert [expected[index] for index in seen[keys.OBSTACLE].argmax(-1).tolist()] == names
    speed = torch.tensor([2.5 if name in ("bar_jump", "tire_jump") else 0.4 for name in names])
    assert torch.equal(arena.target_speed(), speed)
    assert seen[keys.SCANDOTS].shape == (N, 132) and seen[keys.HEADING_ERROR].abs().max() <= math.pi


def test_the_ground_is_what_carries() -> None:
    arena, simulator = build("a_frame", n=2)
    begin(arena, simulator)
    top = arena.layout.position[:, 0]
    torch.testing.assert_close(arena.ground(top, simulator), torch.full((2,), 0.333), atol=3e-3, rtol=0)
    assert (arena.ground(top + 1.9, simulator) == 0.0).all()


def test_saved_arena_is_exact() -> None:
    arena, simulator = build(n=5)
    arena.set_curriculum(0.5, 3, torch.arange(1.0, 7.0))
    begin(arena, simulator)
    other, _ = build(n=5)
    other.load_state_dict(arena.state_dict())
    assert torch.equal(other.progress.goal(), arena.progress.goal())
    assert other.max_obstacles == 3 and other.layout.difficulty == 0.5
    assert torch.equal(other.start_weights, arena.start_weights)


def test_robots_that_misjudge_their_place_are_told_one_story() -> None:
    arena, simulator = build(n=200, misjudgement=Misjudgement(200, torch.Generator(), 1.0, 0.04))
    begin(arena, simulator)
    yaw = rotations.to_euler(simulator.root_quaternion)[2]
    position = simulator.root_position[:, :2]
    seen = arena.observe(simulator, yaw)
    place = seen[keys.PLACE]
    assert not torch.allclose(place, arena.place(arena.expected_goals(), position, yaw), atol=0.05)
    bearing = torch.atan2(place[:, [1, 3]], place[:, [0, 2]])
    torch.testing.assert_close(bearing, seen[keys.HEADING_ERROR], atol=1e-4, rtol=0)
    # Way-points are as far from each other as they are expected, and the present one from the obstacle, too.
    goals = arena.expected_goals()
    apart = torch.linalg.vector_norm(goals[:, 0] - goals[:, 1], dim=-1)
    torch.testing.assert_close(torch.linalg.vector_norm(place[:, :2] - place[:, 2:4], dim=-1), apart)
    at_obstacle = arena.layout.local_to(arena.progress.obstacle, goals[:, 0])
    away = torch.linalg.vector_norm(at_obstacle - place[:, 4:6], dim=-1)
    torch.testing.assert_close(torch.linalg.vector_norm(place[:, :2], dim=-1), away, atol=1e-5, rtol=0)
    # The terrain is that of where they think they are.
    obstacle, parameter = arena.progress.obstacle, arena.layout.parameter(simulator.hinge_angle)
    told = torch.cat((arena.layout.world(obstacle, place[:, 4:6]), simulator.root_position[:, 2:]), -1)
    turned = torch.atan2(place[:, 6], place[:, 7]) + arena.layout.axis(obstacle)
    same = (seen[keys.SCANDOTS] - arena.scan.scandots(told, turned, parameter)).abs() < 1e-4
    assert same.float().mean() > 0.99  # but for cells at edges
    assert not torch.equal(seen[keys.SCANDOTS], arena.scan.scandots(simulator.root_position, yaw, parameter))
    state = arena.state_dict()
    arena.advance(arena.progress.leg, position, yaw)
    assert not torch.equal(arena.observe(simulator, yaw)[keys.PLACE], place)
    arena.load_state_dict(state)
    assert torch.equal(arena.observe(simulator, yaw)[keys.PLACE], place)


def test_obstacles_that_nobody_has_seen_have_usual_way_points_and_no_type() -> None:
    errors = Misjudgement(200, torch.Generator(), 1.0, 0.04)
    arena, simulator = build(n=200, misjudgement=errors)
    begin(arena, simulator)
    rows, obstacle = torch.arange(200), arena.progress.obstacle
    usual = torch.tensor([slot.goals for slot in COURSES["full"].slots]).mean(0)
    for unknown in (1.0, 0.25, 0.0):
        errors.unknown.fill_(unknown)
        errors.guessed.zero_()
        own = arena.layout.local_to(obstacle, arena.expected_goals()[:, 0])
        torch.testing.assert_close(own, arena.progress.local_goal().lerp(usual[0].expand(200, 2), unknown))
        assert torch.equal(arena.expected_type(), (1.0 - unknown) * arena.types[obstacle])
        errors.guessed.fill_(True)
        assert torch.equal(arena.expected_type(), arena.types[obstacle].float())
    errors.foreseen.zero_()
    arena.progress.point.fill_(3)  # the last one of every obstacle
    goals, coming = torch.stack(arena.progress.goals(), 1), arena.progress.next_obstacle
    further = arena.progress.leg + 1 < arena.progress.end
    expected = arena.expected_goals()
    assert torch.equal(expected[:, 0], goals[:, 0]) and torch.equal(expected[~further], goals[~further])
    shift = arena.layout.local_to(coming, expected[:, 1])[further] - usual[0]
    wanted = -errors.upcoming[rows[further], :2] * torch.tensor(UNSEEN[:2])
    torch.testing.assert_close(shift, wanted, atol=1e-5, rtol=0)
    errors.foreseen.fill_(True)
    foreseen = arena.layout.local_to(coming, arena.expected_goals()[:, 1])[further]
    own = arena.layout.local_to(coming, goals[:, 1])[further]
    torch.testing.assert_close(foreseen, own + wanted, atol=1e-5, rtol=0)
