"""The guide that knows where robots stand: what it decides at places that are worked out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.behaviours import command_bounds, commands_from_parameters, skill_index
from agility_rl.envs.mirror import mirror
from agility_rl.envs.obstacles import OBSTACLES

Module = Callable[[str], ModuleType]
KINDS = list(OBSTACLES)


def standing(kind: str, *places: tuple[float, float, float], goal: int | None = None) -> TensorDict:
    """Robots at local (x, y) [m] with headings [rad], before an obstacle; its next way-point is theirs."""
    x, y, yaw = torch.tensor(places).unbind(-1)
    points = torch.tensor(OBSTACLES[kind].way_points)
    following = (points[:, 0] < x[:, None] - 0.2).sum(-1).clamp(max=len(points) - 1)
    goal_x, goal_y = points[following if goal is None else torch.full_like(following, goal)].unbind(-1)
    ahead = yaw.cos() * (goal_x - x) + yaw.sin() * (goal_y - y)
    aside = yaw.cos() * (goal_y - y) - yaw.sin() * (goal_x - x)
    place = torch.stack((ahead, aside, *torch.zeros(2, len(places)), x, y, yaw.sin(), yaw.cos()), -1)
    obstacle = torch.eye(len(KINDS))[KINDS.index(kind)].expand(len(places), -1)
    return TensorDict({keys.PLACE: place, keys.OBSTACLE: obstacle}, [len(places)])


def commands(guide: ModuleType, td: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
    """Behaviours ``[N]`` and commands ``[N, 5]``."""
    decision = guide.Guide().decide(td)[keys.ACTION]
    rows = torch.arange(td.numel())
    chosen = decision[keys.PARAMETERS][rows, decision[keys.BEHAVIOUR]]
    return decision[keys.BEHAVIOUR], commands_from_parameters(decision[keys.BEHAVIOUR], chosen)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_on_its_line_it_goes_straight_ahead(module: Module, kind: str) -> None:
    guide = module("tsc_guide")
    passage = guide.PASSAGES[kind]
    skill, command = commands(
        guide, standing(kind, (-2.9, -passage.beside, 0.0), (passage.start + 0.1, -passage.beside, 0.0))
    )
    torch.testing.assert_close(command[:, 1:3], torch.zeros(2, 2), atol=1e-5, rtol=0.0)
    assert skill.tolist() == [skill_index("trot"), skill_index(passage.behaviour)]
    assert command[0, 0].item() == pytest.approx(guide.CRUISE, abs=0.01)  # far away
    assert command[1, 0].item() == pytest.approx(passage.speed, abs=1e-5)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "weave_poles"])
def test_it_decides_alike_in_a_mirror(module: Module, kind: str) -> None:
    guide = module("tsc_guide").Guide()
    places = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    td = standing(kind, *(places * torch.tensor([3.0, 2.0, math.pi])).tolist())
    here, there = guide.decide(td.clone())[keys.ACTION], guide.decide(mirror(td))[keys.ACTION]
    image = mirror(TensorDict({keys.ACTION: here}, td.batch_size))[keys.ACTION]
    assert torch.equal(there[keys.BEHAVIOUR], image[keys.BEHAVIOUR])
    torch.testing.assert_close(there[keys.PARAMETERS], image[keys.PARAMETERS], atol=1e-4, rtol=0.0)


def test_who_is_beside_the_axis_is_led_back_and_slows_down(module: Module) -> None:
    guide = module("tsc_guide")
    left, right = (-1.9, 0.15, 0.0), (-1.9, -0.15, 0.0)
    skill, command = commands(guide, standing("a_frame", left, right))
    assert skill.tolist() == [skill_index("trot")] * 2
    assert command[0, 2] < 0.0 < command[1, 2] and command[1, 1] > 0.0 > command[0, 1]
    assert command[0, 0] < guide.CRUISE
    straight = commands(guide, standing("a_frame", (-1.9, 0.0, 0.0)))[1]
    assert command[0, 0] < straight[0, 0]


def test_who_is_far_aside_or_has_missed_it_goes_to_where_there_is_room(module: Module) -> None:
    guide = module("tsc_guide")
    # 2 m beside the mouth of the tunnel, which begins at -1.1: to (-2.025, 0), the first way-point, in a straight line
    bearing = math.atan2(-2.0, -2.025 + 1.0)
    _, command = commands(guide, standing("tunnel", (-1.0, 2.0, bearing), (-1.0, 2.0, bearing + 0.2), goal=0))
    torch.testing.assert_close(command[:, 2], torch.tensor([0.0, -0.2 * guide.STEERING]), atol=1e-4, rtol=0.0)
    # straight before the mouth, but the way-point behind it was not reached: back, as slowly as it may
    _, command = commands(guide, standing("tunnel", (-1.1, 0.1, 0.0), goal=0))
    assert command[0, 0].item() == pytest.approx(guide.SLOW) and abs(command[0, 2].item()) == pytest.approx(1.57)


def test_poles_are_passed_on_alternating_sides(module: Module) -> None:
    guide = module("tsc_guide")
    skill, command = commands(guide, standing("weave_poles", (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    assert skill.tolist() == [skill_index("trot")] * 3
    turn = torch.tensor([1.0, -1.0, 1.0]) * min(guide.STEERING * math.atan2(guide.SWAY, 0.5), 1.57)
    torch.testing.assert_close(command[:, 2], turn, atol=1e-3, rtol=0.0)
    assert (command[:, 0] - guide.SLOW).abs().max() < 1e-5 and not bool(command[:, 1].abs().gt(1e-6).any())


def test_its_speeds_are_the_same_whatever_the_fastest_canter_is(module: Module) -> None:
    guide = module("tsc_guide")
    td = standing("bar_jump", (-1.0, 0.0, 0.0), (-2.9, 0.0, 0.0))  # a canter at 1.6 m/s, and a trot
    usual, fast = (guide.Guide(guide.PASSAGES, fastest).decide(td.clone())[keys.ACTION] for fastest in (2.0, 3.2))
    rows = torch.arange(2)
    assert usual[keys.BEHAVIOUR].tolist() == fast[keys.BEHAVIOUR].tolist() == [3, 2]
    commanded = [
        commands_from_parameters(one[keys.BEHAVIOUR], one[keys.PARAMETERS][rows, one[keys.BEHAVIOUR]], bounds)[0]
        for one, bounds in ((usual, command_bounds()), (fast, command_bounds(fastest_canter=3.2)))
    ]
    torch.testing.assert_close(*commanded)
    assert commanded[0][0, 0].item() == pytest.approx(1.6)
