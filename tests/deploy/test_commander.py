"""Commands in the range that the controller knows, and who gives them."""

from __future__ import annotations

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS, command_bounds
from agility_rl.deploy.commander import BehaviourCommand, Commander, Operator, Perception
from agility_rl.deploy.transport import RobotState


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
@pytest.mark.parametrize("size", [-100.0, 100.0])
def test_commands_stay_in_the_range_of_table_s2(behaviour: str, size: float) -> None:
    command = BehaviourCommand.of(behaviour, velocity_x=size, velocity_y=size, yaw_rate=size, height=size, shift=size)
    low, high = command_bounds()
    bound = high if size > 0 else low
    expected = bound[BEHAVIOURS.index(behaviour)]
    assert torch.equal(command.command, expected) and abs(command.shift) == 1.0


def test_small_commands_are_zero_and_the_vector_is_the_networks() -> None:
    command = BehaviourCommand.of("walk", velocity_x=0.09, velocity_y=0.04, yaw_rate=-0.04, height=0.3)
    assert command.command.tolist() == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.3])
    jump = BehaviourCommand.of("jump", height=0.5, shift=-0.5)
    assert jump.jumping and jump.name == "jump" and not command.jumping
    assert jump.vector().tolist() == pytest.approx([1.3, 0.0, 0.0, 0.5, 0.0, -0.5, 0, 0, 0, 0, 1])


def test_nonsense_is_refused() -> None:
    with pytest.raises(ValueError, match="'gallop' is no behaviour"):
        BehaviourCommand.of("gallop")
    with pytest.raises(ValueError, match="expected finite commands for trot"):
        BehaviourCommand.of("trot", velocity_x=float("nan"))


def test_an_operator_is_a_commander() -> None:
    operator: Commander = Operator(BehaviourCommand.of("walk"), now=1.0)
    perception = Perception(1.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))
    assert operator.decide(perception).name == "walk" and operator.sources() == {"operator": 1.0}
    assert isinstance(operator, Operator)
    operator.heard(2.0)
    assert operator.sources() == {"operator": 2.0}
    operator.command(BehaviourCommand.of("canter"), 3.0)
    operator.reset()
    assert operator.decide(perception).name == "canter" and operator.sources() == {"operator": 3.0}
