"""Draws of skills, shifts and commands, and the clocks that redraw them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, COMMANDS
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.commands import CommandSampler

N = 5000
EVERYONE = torch.ones(N, dtype=torch.bool)
TABLE_S2 = {
    "walk": [(0.0, 0.6), (-0.15, 0.15), (-1.0, 1.0), (0.0, 0.0), (0.25, 0.34)],
    "pace": [(0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), (0.0, 0.0), (0.25, 0.34)],
    "trot": [(0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), (0.0, 0.0), (0.25, 0.34)],
    "canter": [(0.8, 2.0), (-0.5, 0.5), (-0.5, 0.5), (0.0, 0.0), (0.25, 0.34)],
    "jump": [(0.8, 1.8), (-0.3, 0.3), (-0.5, 0.5), (0.45, 0.55), (0.0, 0.0)],
}


@pytest.fixture
def sampler(generator: torch.Generator) -> CommandSampler:
    sampler = CommandSampler(N, generator, period=3)
    sampler.resample(EVERYONE)
    return sampler


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
def test_commands_fill_the_ranges_of_table_s2(sampler: CommandSampler, behaviour: str) -> None:
    drawn = sampler.command[sampler.skill == BEHAVIOURS.index(behaviour)]
    assert len(drawn) > 800
    for column, (low, high) in zip(drawn.unbind(-1), TABLE_S2[behaviour], strict=True):
        assert column.min() >= low - 1e-6 and column.max() <= high + 1e-6
        assert column.max() - column.min() >= 0.98 * (high - low)


def test_shift_is_uniform(sampler: CommandSampler) -> None:
    assert sampler.shift.shape == (N, 1)
    assert sampler.shift.min() >= -1.0 and sampler.shift.max() <= 1.0
    counts = torch.histc(sampler.shift, 4, -1.0, 1.0)
    assert (counts - N / 4).abs().max() < 5 * (N * 3 / 16) ** 0.5


def test_skills_follow_the_given_probabilities(sampler: CommandSampler) -> None:
    sampler.probabilities = torch.tensor([0.0, 0.6, 0.0, 0.1, 0.3])
    sampler.resample(EVERYONE)
    shares = torch.bincount(sampler.skill, minlength=5) / N
    torch.testing.assert_close(shares, sampler.probabilities, atol=0.03, rtol=0)
    assert shares[0] == shares[2] == 0
    assert torch.equal(sampler.jumping, sampler.skill == 4)


def test_clocks_redraw_each_row_at_its_own_time(sampler: CommandSampler) -> None:
    half = torch.arange(N) < N // 2
    sampler.advance()
    sampler.resample(half)  # these are one step younger
    first = sampler.command
    sampler.advance()
    assert torch.equal(sampler.command, first)
    sampler.advance()
    changed = (sampler.command != first).any(-1)
    assert not changed[half].any() and changed[~half].float().mean() > 0.99
    assert sampler.age.tolist() == [2] * (N // 2) + [0] * (N // 2)
    sampler.advance()
    assert (sampler.command != first).any(-1)[half].float().mean() > 0.99


def test_who_is_held_is_told_the_same_until_let_go(sampler: CommandSampler) -> None:
    held, first = torch.arange(N) < N // 2, sampler.command
    for _ in range(5):
        sampler.advance(held)
    changed = (sampler.command != first).any(-1)
    assert not changed[held].any() and changed[~held].float().mean() > 0.99
    assert sampler.age.tolist() == [5] * (N // 2) + [2] * (N // 2)
    sampler.advance()
    assert (sampler.command != first).any(-1).float().mean() > 0.99 and not sampler.age.any()


def test_without_a_period_nothing_is_redrawn(generator: torch.Generator) -> None:
    sampler = CommandSampler(2, generator, period=None)
    sampler.assign(torch.tensor([True, True]), torch.tensor([1, 4]), torch.ones(2, 5), torch.zeros(2, 1))
    for _ in range(1000):
        sampler.advance()
    assert sampler.skill.tolist() == [1, 4] and (sampler.command == 1).all()


def test_assign_fills_the_chosen_rows(generator: torch.Generator) -> None:
    sampler = CommandSampler(4, generator, period=None)
    before = sampler.skill, sampler.command, sampler.shift
    sampler.assign(
        torch.tensor([False, True, False, True]),
        torch.tensor([1, 3, 4, 2]),
        torch.arange(20.0).reshape(4, 5),
        torch.tensor([[0.1], [0.5], [0.2], [-0.5]]),
    )
    assert sampler.skill.tolist() == [0, 3, 0, 2]
    assert sampler.command[1].tolist() == [5, 6, 7, 8, 9] and sampler.command[3].tolist() == [15, 16, 17, 18, 19]
    assert not sampler.command[0].any() and not sampler.command[2].any()
    assert sampler.shift[:, 0].tolist() == [0.0, 0.5, 0.0, -0.5]
    assert all(not entry.any() for entry in before)  # observations of earlier steps may refer to them


def test_vector_layout(generator: torch.Generator) -> None:
    sampler = CommandSampler(1, generator, period=None)
    command = torch.tensor([[1.0, 0.1, -0.5, 0.0, 0.3]])
    sampler.assign(torch.tensor([True]), torch.tensor([2]), command, torch.tensor([[-0.25]]))
    assert len(COMMANDS) == 5
    torch.testing.assert_close(
        sampler.vector(), torch.tensor([[1.0, 0.1, -0.5, 0.0, 0.3, -0.25, 0.0, 0.0, 1.0, 0.0, 0.0]])
    )


def test_state_dict_restores(sampler: CommandSampler) -> None:
    sampler.advance()
    state, rng = sampler.state_dict(), sampler.generator.get_state()
    other = CommandSampler(N, torch.Generator(), period=3)
    other.load_state_dict(state)
    other.generator.set_state(rng)
    for _ in range(4):
        sampler.advance()
        other.advance()
    for name, value in sampler.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_the_environment_redraws_every_six_seconds(build: Callable[..., LocomotionEnv]) -> None:
    env = build(3, terminations=(lambda state: torch.zeros(3, dtype=torch.bool),))
    carrier = env.reset()
    drawn = carrier[keys.COMMAND]
    times = []
    for step in range(1, 605):
        carrier = env.step(carrier.set(keys.ACTION, torch.zeros(3, 12)))["next"]
        changed = (carrier[keys.COMMAND] != drawn).any(-1)
        if changed.any():
            assert changed.all()
            times.append(step)
            drawn = carrier[keys.COMMAND]
    assert times == [300, 600]
