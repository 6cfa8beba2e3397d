"""Decisions to commands, their noise, and the memory of what was decided before."""

from __future__ import annotations

import pytest
import torch

from agility_rl.behaviours import NUM_BEHAVIOURS, command_bounds
from agility_rl.envs.decisions import Decisions


def numbers(n: int, value: float) -> torch.Tensor:
    return torch.full((n, NUM_BEHAVIOURS, 6), value)


def test_the_chosen_block_becomes_the_command(generator: torch.Generator) -> None:
    decisions = Decisions(5, generator, noise=(1.0, 1.0))
    low, high = command_bounds()
    skill = torch.arange(5)
    parameters = torch.randn(5, 5, 6, generator=generator)
    decisions.decide(skill, parameters)
    chosen = torch.stack([parameters[row, row] for row in range(5)]).clamp(-1.0, 1.0)
    torch.testing.assert_close(decisions.commands.command, low + (high - low) * (chosen[:, :5] + 1.0) / 2.0)
    assert torch.equal(decisions.commands.shift, chosen[:, 5:]) and torch.equal(decisions.commands.skill, skill)
    assert decisions.commands.command[:4, 3].abs().max() == 0.0 and decisions.commands.command[4, 4] == 0.0
    assert torch.equal(decisions.applied[:, 0], chosen)


def test_noise_multiplies_each_command_but_not_the_shift(generator: torch.Generator) -> None:
    decisions = Decisions(2000, generator, noise=(0.8, 1.2))
    decisions.decide(torch.full((2000,), 2), numbers(2000, 1.0))
    command, exact = decisions.commands.command, command_bounds()[1][2]
    factor = command[:, [0, 1, 2, 4]] / exact[[0, 1, 2, 4]]
    assert factor.min() >= 0.8 and factor.max() <= 1.2
    torch.testing.assert_close(factor.mean(0), torch.ones(4), atol=0.02, rtol=0)
    assert torch.corrcoef(factor.T).triu(1).abs().max() < 0.1
    assert (decisions.commands.shift == 1.0).all()
    decisions = Decisions(5, generator, noise=(0.8, 0.8))  # a slower robot, for all that it is told
    decisions.decide(torch.full((5,), 2), numbers(5, 1.0))
    torch.testing.assert_close(decisions.commands.command[:, 0], (0.8 * exact[0]).expand(5))
    with pytest.raises(ValueError, match="command noise"):
        Decisions(1, generator, noise=(1.2, 0.8))


def test_canters_may_be_commanded_faster_than_in_table_s2(generator: torch.Generator) -> None:
    decisions = Decisions(3, generator, noise=(1.0, 1.0), fastest_canter=3.2)
    decisions.decide(torch.tensor([3, 3, 4]), numbers(3, 0.5) * torch.tensor([1.0, 4.0, 4.0])[:, None, None])
    assert decisions.commands.command[:, 0].tolist() == pytest.approx([2.6, 3.2, 1.8])
    with pytest.raises(ValueError, match=r"fastest canter: expected more than 0.8"):
        Decisions(1, generator, fastest_canter=0.5)


def test_memory_runs_on_the_control_steps(generator: torch.Generator) -> None:
    decisions = Decisions(1, generator)
    seen = []
    for behaviour in (2, 2, 4, 0):
        decisions.decide(torch.tensor([behaviour]), numbers(1, behaviour / 10))
        seen.append((decisions.behaviours[0].tolist(), round(decisions.applied[0, 1, 0].item(), 1)))
        decisions.advance()
    # The first decision of an episode is compared with itself.
    assert seen == [([2, 2, 2], 0.2), ([2, 2, 2], 0.2), ([4, 2, 2], 0.2), ([0, 4, 2], 0.4)]
    decisions.advance()  # held for another control step
    assert decisions.behaviours[0].tolist() == [0, 0, 0]
    assert decisions.parameters.shape == (1, 2, 5, 6)


def test_beginning_forgets_only_its_rows_and_saving_is_exact(generator: torch.Generator) -> None:
    decisions = Decisions(3, generator)
    decisions.decide(torch.tensor([1, 2, 3]), numbers(3, 0.5))
    decisions.advance()
    decisions.begin(torch.tensor([False, True, False]))
    assert decisions.commands.skill.tolist() == [1, 0, 3] and decisions.commands.command[1].abs().sum() == 0.0
    saved = decisions.state_dict()
    other = Decisions(3, generator)
    other.load_state_dict(saved)
    for one in (decisions, other):
        one.decide(torch.tensor([4, 4, 4]), numbers(3, 0.1))
    assert other.behaviours.tolist() == decisions.behaviours.tolist() == [[4, 1, 1], [4, 4, 4], [4, 3, 3]]
