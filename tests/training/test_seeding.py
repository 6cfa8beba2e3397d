"""Streams of random numbers: independent, reproducible, and continued where they stopped."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from agility_rl.training.seeding import Seeds, seed_everything


def test_a_stream_depends_on_seed_and_name_only() -> None:
    plain, crowded = Seeds(4), Seeds(4)
    for name in ("x", "y", "z"):
        crowded.generator(name)
    assert plain.integer("policy") == crowded.integer("policy") == Seeds(4).integer("policy")
    assert len({Seeds(s).integer(n) for s in range(20) for n in ("a", "b", "c")}) == 60
    assert all(0 <= Seeds(s).integer("a") < 2**63 for s in range(20))


def test_streams_are_uncorrelated() -> None:
    seeds = Seeds(0)
    a, b = (torch.randn(20_000, generator=seeds.generator(name)) for name in ("a", "b"))
    assert abs((a * b).mean().item()) < 4 / 20_000**0.5


def test_a_second_call_goes_on() -> None:
    seeds = Seeds(1)
    assert seeds.generator("a") is seeds.generator("a") and seeds.numpy("a") is seeds.numpy("a")
    assert torch.rand(1, generator=seeds.generator("a")) != torch.rand(1, generator=seeds.generator("a"))


def test_state_round_trip_reaches_generators_already_handed_out() -> None:
    seeds = Seeds(2)
    torch.rand(5, generator=seeds.generator("a")), seeds.numpy("n").random(5)
    state = seeds.state_dict()
    expected = torch.rand(5, generator=seeds.generator("a")), seeds.numpy("n").random(5)
    resumed = Seeds(2)
    early = resumed.generator("a")
    resumed.load_state_dict(state)
    assert torch.equal(torch.rand(5, generator=early), expected[0])
    assert (resumed.numpy("n").random(5) == expected[1]).all()


def test_what_had_not_drawn_yet_begins_anew_and_processes_keep_their_own() -> None:
    seeds = Seeds(1)
    state = seeds.state_dict()
    first = torch.rand(3, generator=seeds.generator("late")), seeds.numpy("late").random(3)
    seeds.load_state_dict(state)
    again = torch.rand(3, generator=seeds.generator("late")), seeds.numpy("late").random(3)
    assert torch.equal(first[0], again[0]) and (first[1] == again[1]).all()
    with pytest.raises(ValueError, match="streams of process 0, expected those of 1"):
        Seeds(1, rank=1).load_state_dict(state)


def test_everything_is_seeded() -> None:
    def draw() -> tuple[float, float, float]:
        seed_everything(9)
        return random.random(), float(np.random.rand()), torch.rand(()).item()  # noqa: NPY002

    assert draw() == draw()


def test_errors() -> None:
    with pytest.raises(ValueError, match="at least 0, got -1"):
        Seeds(-1)
    with pytest.raises(ValueError, match="started with seed 1, got seed 2"):
        Seeds(2).load_state_dict(Seeds(1).state_dict())
