"""Scripts: what they command, checked against the command ranges, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, command_bounds, commands_from_parameters
from agility_rl.envs.obstacles import OBSTACLES


@pytest.fixture
def script(module: Callable[[str], ModuleType]) -> Any:
    return module("tsc_script").Script


def seen(obstacles: list[str], errors: list[float]) -> TensorDict:
    kinds = torch.tensor([list(OBSTACLES).index(name) for name in obstacles])
    td = {keys.OBSTACLE: torch.nn.functional.one_hot(kinds, len(OBSTACLES)).float()}
    return TensorDict(td | {keys.HEADING_ERROR: torch.tensor([[error, 0.0] for error in errors])}, [len(kinds)])


def test_a_script_commands_its_speed_and_turns_to_the_way_point(script: Any) -> None:
    action = script.parse("trot:1.2").decide(seen(["tunnel", "seesaw", "seesaw"], [0.3, -0.3, 9.0]))["action"]
    assert action["behaviour"].tolist() == [2, 2, 2]
    command, shift = commands_from_parameters(action["behaviour"], action["parameters"][:, 2])
    assert command[:, 0].tolist() == pytest.approx([1.2] * 3)
    assert command[:, 2].tolist() == pytest.approx([0.6, -0.6, 1.57])  # 2 rad/s for each radian, up to Table S2's
    assert command[:, 1].tolist() == pytest.approx([0.0] * 3) and not shift.any()
    other, _ = commands_from_parameters(torch.tensor([0, 0, 0]), action["parameters"][:, 0])
    assert other[:, 2].tolist() == pytest.approx([0.6, -0.6, 1.0])  # behaviours that were not chosen would turn too


def test_obstacles_may_have_decisions_of_their_own(script: Any) -> None:
    chosen = script.parse("walk:0.5,bar_jump=jump:1.4,tunnel=canter:0.8")
    action = chosen.decide(seen(["bar_jump", "tunnel", "seesaw", "a_frame"], [0.0] * 4))["action"]
    assert [BEHAVIOURS[index] for index in action["behaviour"]] == ["jump", "canter", "walk", "walk"]
    parameters = action["parameters"].take_along_dim(action["behaviour"][:, None, None], 1)[:, 0]
    command, _ = commands_from_parameters(action["behaviour"], parameters)
    assert command[:, 0].tolist() == pytest.approx([1.4, 0.8, 0.5, 0.5])
    assert command[0, 3].item() == pytest.approx(0.5)  # jumps half as high as they may
    assert chosen.behaviours == ("walk", "canter", "jump")


def test_own_says_nothing_but_before_the_obstacles_it_names(script: Any) -> None:
    chosen = script.parse("own,tunnel=canter:0.8")
    action = chosen.decide(seen(["bar_jump", "tunnel"], [0.0] * 2))["action"]
    assert action["behaviour"].tolist() == [-1, BEHAVIOURS.index("canter")]
    assert chosen.behaviours == ("canter",) and not chosen.complete and script.parse("trot:1.2").complete


def test_before_an_obstacle_a_guide_may_decide(script: Any, module: Callable[[str], ModuleType]) -> None:
    """The guide's decision at the tire, the script's before the others; nothing else is asked of the guide."""
    chosen = script.parse("own,tire_jump=leap,tunnel=trot:0.8")
    td = seen(["tire_jump", "bar_jump", "tire_jump", "tunnel"], [0.0] * 4)
    away = torch.tensor([-3.0, -1.0, -1.0, -1.0])  # of the middle; a leap begins at -1.25
    ahead = torch.stack((torch.full((4,), 0.5), torch.zeros(4)), -1)
    td["place"] = torch.cat((ahead, ahead, away[:, None], torch.zeros(4, 2), torch.ones(4, 1)), -1)
    action = chosen.decide(td.clone())["action"]
    assert [BEHAVIOURS[i] if i >= 0 else "own" for i in action["behaviour"].tolist()] == ["trot", "own", "jump", "trot"]
    guide = module("tsc_guide")
    alone = guide.Guide(guide.LEAPS).decide(td.clone())["action"]
    assert torch.equal(action["parameters"][[0, 2]], alone["parameters"][[0, 2]])
    leap, _ = commands_from_parameters(action["behaviour"][2:3], action["parameters"][2, action["behaviour"][2]][None])
    assert leap[0, [0, 3]].tolist() == pytest.approx([1.8, 0.55])
    assert not chosen.complete and chosen.behaviours == ("pace", "trot", "jump")
    assert script.parse("trot:1.0,bar_jump=leap").complete
    assert module("tsc_script").read("leap").complete and "canter" not in module("tsc_script").read("leap").behaviours


def test_a_second_decision_turns_to_way_points_that_are_aside(script: Any) -> None:
    chosen = script.parse("own,bar_jump=canter:1.6/trot:0.7,tunnel=own/pace:0.5")
    kinds = ["bar_jump"] * 3 + ["tunnel"] * 2 + ["seesaw"]
    action = chosen.decide(seen(kinds, [0.49, 0.51, -0.51, 0.4, 0.6, 3.0]))["action"]
    named = [BEHAVIOURS[index] if index >= 0 else "own" for index in action["behaviour"].tolist()]
    assert named == ["canter", "trot", "trot", "own", "pace", "own"]
    assert chosen.behaviours == ("pace", "trot", "canter") and not chosen.complete
    parameters = action["parameters"].take_along_dim(action["behaviour"].clamp(min=0)[:, None, None], 1)[:, 0]
    command, _ = commands_from_parameters(action["behaviour"].clamp(min=0), parameters)
    assert command[:3, 0].tolist() == pytest.approx([1.6, 0.7, 0.7])
    assert command[:3, 2].tolist() == pytest.approx([0.5, 1.02, -1.02])  # a canter's turn rate ends at 0.5


def test_a_faster_canter_may_be_commanded_where_it_is_the_end_of_the_range(script: Any) -> None:
    chosen = script.parse("canter:2.6/trot:1.0", fastest_canter=3.2)
    action = chosen.decide(seen(["tunnel", "tunnel"], [0.1, 1.0]))["action"]
    parameters = action["parameters"].take_along_dim(action["behaviour"][:, None, None], 1)[:, 0]
    bounds = command_bounds(fastest_canter=3.2)
    command, _ = commands_from_parameters(action["behaviour"], parameters, bounds)
    assert command[:, 0].tolist() == pytest.approx([2.6, 1.0])
    with pytest.raises(ValueError, match=r"--script: canter goes at 0.8 to 3.2 m/s \(as its fastest is set\), got 3.5"):
        script.parse("canter:3.5", fastest_canter=3.2)
    with pytest.raises(ValueError, match=r"fastest canter: expected more than 0.8 and at most 5 m/s, got 6"):
        script.parse("trot:1.0", fastest_canter=6.0)


def test_a_sprint_leaves_the_rest_to_a_teacher(script: Any, module: Callable[[str], ModuleType]) -> None:
    sprint = module("tsc_script").read("sprint")
    assert not sprint.complete and not script.parse("trot:1.0,bar_jump=sprint").complete
    chosen = script.parse("own,bar_jump=sprint")
    td = seen(["bar_jump", "bar_jump", "tunnel"], [0.0, 0.1, 0.1])
    td["place"] = torch.tensor([[0.5, 0.0, 2.0, 0.0, x, 0.0, 0.0, 1.0] for x in (-0.5, 0.5, 0.5)])
    action = chosen.decide(td)["action"]
    assert action["behaviour"].tolist() == [-1, 3, -1] and chosen.behaviours == ("canter",)
    for fastest, expected in ((3.2, 3.2), (4.2, 3.359)):  # 3.1 at 0.13 m, 0.7 more for each metre
        action = script.parse("own,bar_jump=sprint", fastest_canter=fastest).decide(td.clone())["action"]
        bounds = command_bounds(fastest_canter=fastest)
        command, _ = commands_from_parameters(action["behaviour"][1:2], action["parameters"][1:2, 3], bounds)
        assert command[0, [0, 2]].tolist() == pytest.approx([expected, 0.2])  # 2 rad/s for each radian


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("trot", r"--script: expected BEHAVIOUR:SPEED such as trot:1.2, got 'trot'"),
        ("gallop:2", r"got 'gallop:2' \(.*gallop"),
        ("trot:fast", r"got 'trot:fast'"),
        ("canter:2.1", r"--script: canter goes at 0.8 to 2 m/s \(Table S2\), got 2.1 m/s"),
        ("trot:1.7", r"--script: trot goes at 0.5 to 1.5 m/s \(Table S2\), got 1.7 m/s"),
        ("trot:1.2,hoop=jump:1.0", r"--script: unknown obstacle 'hoop' in .*, expected bar_jump, a_frame"),
        ("trot:1.2,tunnel", r"expected BEHAVIOUR:SPEED such as trot:1.2"),
        ("trot:1.2/", r"expected BEHAVIOUR:SPEED such as trot:1.2, got 'trot:1.2/'"),
    ],
)
def test_what_is_no_script_is_refused(script: Any, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        script.parse(text)
