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


def standing(kind: str, *places: tuple[float, float, float]) -> TensorDict:
    """Robots at local (x, y) [m] with headings [rad], before an obstacle."""
    x, y, yaw = torch.tensor(places).unbind(-1)
    place = torch.stack((*torch.zeros(4, len(places)), x, y, yaw.sin(), yaw.cos()), -1)
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
        guide, standing(kind, (-2.9, -passage.beside, 0.0), (passage.start, -passage.beside, 0.0))
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
    left, right = (-2.0, 0.3, 0.0), (-2.0, -0.3, 0.0)
    skill, command = commands(guide, standing("a_frame", left, right, (-1.6, 0.3, -0.9), (-2.9, 1.5, -1.5)))
    assert skill.tolist() == [skill_index("trot")] * 4
    low, high = (bound[skill_index("trot")] for bound in command_bounds())
    assert low[2] <= command[0, 2] < 0.0 < command[1, 2] <= high[2]
    assert command[2, 0] < 0.7 and command[0, 0] < guide.CRUISE
    # 1.5 m aside and heading across: straight on towards (-2.1, 0), 0.49 rad further left than -1.5 - 0.41
    bearing = math.atan2(-1.5, -2.1 + 2.9)
    assert command[3, 2].item() == pytest.approx(guide.STEERING * (bearing + 1.5), abs=1e-4)


def test_poles_are_passed_on_arcs_that_join(module: Module) -> None:
    guide = module("tsc_guide")
    radius = guide.BEND
    # On the arc about the second pole, at its top and where it meets its neighbours (slope: sine 0.5 / radius).
    slope = math.asin(0.5 / radius)
    td = standing("weave_poles", (-0.5, guide.SWAY, 0.0), (-0.999, 0.001, slope), (-0.001, 0.001, -slope))
    skill, command = commands(guide, td)
    assert skill.tolist() == [skill_index("trot")] * 3
    turn = -command[:, 0] / radius  # to the right, as fast as the arc bends
    torch.testing.assert_close(command[:, 2], turn, atol=0.02, rtol=0.0)
    _, beyond = commands(guide, standing("weave_poles", (0.001, -0.001, -slope)))  # on the next arc, to the left
    torch.testing.assert_close(beyond[:, 2], -turn[2:], atol=0.02, rtol=0.0)
