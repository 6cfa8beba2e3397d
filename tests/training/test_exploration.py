"""Noise that lasts: its distribution, its memory, and an exact continuation."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from agility_rl.training.exploration import LastingNoise


def still(td: TensorDictBase) -> TensorDictBase:
    """A policy with mean 2 and deviation 0.5."""
    return td.update({"loc": torch.full((1000, 3), 2.0), "scale": torch.full((1000, 3), 0.5)})


def draw(noise: LastingNoise, steps: int) -> torch.Tensor:
    act = noise.around(still)
    return torch.stack([act(TensorDict({}, [1000]))["action"] for _ in range(steps)])


def test_every_step_is_normal_and_steps_are_correlated_as_asked(generator: torch.Generator) -> None:
    """Correlation exp(-k dt / tau) after k steps; mean and deviation are the policy's at every step, also the first."""
    drawn = (draw(LastingNoise(0.4, 0.1, generator), 12) - 2.0) / 0.5
    assert drawn.mean((1, 2)).abs().max() < 0.08 and (drawn.std((1, 2)) - 1.0).abs().max() < 0.06
    for steps in (1, 2, 4):
        correlation = (drawn[steps:] * drawn[:-steps]).mean().item()
        assert correlation == pytest.approx(math.exp(-0.25 * steps), abs=0.03)


def test_the_density_is_that_of_what_was_drawn(generator: torch.Generator) -> None:
    """Losses compare it with the density under the new policy; that of another draw would be taken for a new policy."""
    td = LastingNoise(0.4, 0.1, generator, ("action", "parameters")).around(still)(TensorDict({}, [1000]))
    normal = torch.distributions.Normal(td["loc"], td["scale"])
    expected = normal.log_prob(td["action", "parameters"]).sum(-1)
    torch.testing.assert_close(td["action", "parameters_log_prob"], expected)


def test_short_noise_is_new_at_every_step(generator: torch.Generator) -> None:
    drawn = (draw(LastingNoise(1e-3, 0.1, generator), 12) - 2.0) / 0.5
    assert abs((drawn[1:] * drawn[:-1]).mean().item()) < 0.03


def test_a_saved_noise_goes_on(generator: torch.Generator) -> None:
    first = LastingNoise(0.4, 0.1, generator)
    assert first.state_dict() == {}
    draw(first, 3)
    again = LastingNoise(0.4, 0.1, torch.Generator())
    again.load_state_dict(first.state_dict())
    again.generator.set_state(generator.get_state())
    assert torch.equal(draw(first, 2), draw(again, 2))


@pytest.mark.parametrize(("seconds", "dt"), [(0.0, 0.1), (0.5, -0.1), (math.nan, 0.1)])
def test_a_time_that_is_none_is_refused(seconds: float, dt: float) -> None:
    with pytest.raises(ValueError, match="expected times above 0"):
        LastingNoise(seconds, dt, torch.Generator())
