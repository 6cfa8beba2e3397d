"""The five behaviours: Table S2 to the number, and the distribution of drawn commands."""

from __future__ import annotations

import pytest
import torch

from agility_rl import behaviours
from agility_rl.behaviours import BEHAVIOURS, COMMANDS, command_bounds, sample_commands, skill_index

TABLE_S2 = {
    "walk": [(0.0, 0.6), (-0.15, 0.15), (-1.0, 1.0), (0.0, 0.0), (0.25, 0.34)],
    "pace": [(0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), (0.0, 0.0), (0.25, 0.34)],
    "trot": [(0.5, 1.5), (-0.3, 0.3), (-1.57, 1.57), (0.0, 0.0), (0.25, 0.34)],
    "canter": [(0.8, 2.0), (-0.5, 0.5), (-0.5, 0.5), (0.0, 0.0), (0.25, 0.34)],
    "jump": [(0.8, 1.8), (-0.3, 0.3), (-0.5, 0.5), (0.45, 0.55), (0.0, 0.0)],
}


def test_order_of_behaviours_and_commands() -> None:
    assert BEHAVIOURS == ("walk", "pace", "trot", "canter", "jump")
    assert COMMANDS == ("velocity_x", "velocity_y", "yaw_rate", "jump_height", "locomotion_height")
    assert behaviours.NUM_BEHAVIOURS == 5
    assert behaviours.JUMP == 4
    assert behaviours.RESAMPLE_PERIOD == 6.0


@pytest.mark.parametrize("name", BEHAVIOURS)
def test_bounds_are_those_of_table_s2(name: str) -> None:
    low, high = command_bounds()
    expected = torch.tensor(TABLE_S2[name])
    assert low.shape == high.shape == (5, 5)
    torch.testing.assert_close(low[skill_index(name)], expected[:, 0])
    torch.testing.assert_close(high[skill_index(name)], expected[:, 1])


@pytest.mark.parametrize("shape", [(), (7,), (3, 4)])
def test_sampled_commands_have_the_shape_of_the_skills(shape: tuple[int, ...], generator: torch.Generator) -> None:
    command = sample_commands(torch.zeros(shape, dtype=torch.int64), generator)
    assert command.shape == (*shape, 5)
    assert command.dtype == torch.float32


@pytest.mark.parametrize("skill", range(5))
def test_sampled_commands_fill_their_range(skill: int, generator: torch.Generator) -> None:
    low, high = (bound[skill] for bound in command_bounds())
    command = sample_commands(torch.full((20_000,), skill), generator)
    assert (command >= torch.minimum(low, torch.zeros(5))).all()
    assert (command <= high).all()
    # A uniform variable has its mean in the middle; dead-bands move it by less than the 2 % allowed here.
    torch.testing.assert_close(command.mean(0), (low + high) / 2, atol=0.02, rtol=0)
    torch.testing.assert_close(command.amax(0), high, atol=0.01, rtol=0)


def test_dead_bands_leave_no_small_command(generator: torch.Generator) -> None:
    command = sample_commands(torch.zeros(20_000, dtype=torch.int64), generator)
    for entry, band in ((0, 0.1), (1, 0.05), (2, 0.05)):
        size = command[:, entry].abs()
        assert ((size == 0) | (size >= band)).all()
        assert (size == 0).any()
    # 0..0.1 of 0..0.6 falls into the dead-band: one sixth; |v_y| < 0.05 of 0.15: one third; |yaw| < 0.05 of 1: 5 %.
    share = (command[:, :3] == 0).float().mean(0)
    torch.testing.assert_close(share, torch.tensor([1 / 6, 1 / 3, 0.05]), atol=0.02, rtol=0)


def test_same_seed_same_commands_whatever_the_global_generator_does() -> None:
    skill = torch.arange(5).repeat(10)
    first = sample_commands(skill, torch.Generator().manual_seed(3))
    torch.manual_seed(1234)
    torch.testing.assert_close(sample_commands(skill, torch.Generator().manual_seed(3)), first, atol=0, rtol=0)


def test_an_unknown_behaviour_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'gallop' is no behaviour; expected one of walk, pace, trot, canter, jump"):
        skill_index("gallop")


def test_parameters_reach_both_ends_of_every_range_and_no_further() -> None:
    low, high = command_bounds()
    skill = torch.arange(5)
    for value, bound in ((-1.0, low), (1.0, high), (-3.0, low), (3.0, high), (0.0, (low + high) / 2)):
        command, shift = behaviours.commands_from_parameters(skill, torch.full((5, 6), value))
        torch.testing.assert_close(command, bound)
        assert torch.equal(shift, torch.full((5, 1), max(-1.0, min(1.0, value))))


def test_a_faster_canter_moves_one_number() -> None:
    bounds = command_bounds(fastest_canter=3.2)
    expected = command_bounds()[1].clone()
    expected[skill_index("canter"), 0] = 3.2
    torch.testing.assert_close(bounds[1], expected)
    assert torch.equal(bounds[0], command_bounds()[0])
    skill, parameters = torch.tensor([skill_index("canter"), skill_index("trot")]), torch.full((2, 6), 0.5)
    command, _ = behaviours.commands_from_parameters(skill, parameters, bounds)
    assert command[:, 0].tolist() == pytest.approx([2.6, 1.25])  # three quarters of 0.8 to 3.2, and of 0.5 to 1.5
    assert behaviours.FASTEST_CANTER == 2.0


@pytest.mark.parametrize("speed", [0.8, -1.0, 5.1, float("nan")])
def test_an_impossible_canter_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match=r"fastest canter: expected more than 0.8 and at most 5 m/s, got"):
        command_bounds(fastest_canter=speed)
