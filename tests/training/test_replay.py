"""A replay buffer goes on drawing from its stream after it was saved, and after it was loaded."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage

from agility_rl.training.checkpoint import RunCheckpoint
from agility_rl.training.replay import SeededReplay
from agility_rl.training.seeding import Seeds


def make(device: str = "cpu") -> tuple[SeededReplay, Seeds]:
    seeds = Seeds(5, device)
    storage = LazyTensorStorage(64, device=device)
    return SeededReplay(seeds.generator("replay"), storage=storage, batch_size=8), seeds


def drawn(replay: SeededReplay) -> Tensor:
    return torch.stack([replay.sample()["x"] for _ in range(4)]).cpu()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_loaded_buffer_draws_what_the_saved_one_draws(tmp_path: Path, device: str) -> None:
    replay, seeds = make(device)
    replay.extend(TensorDict({"x": torch.arange(40.0, device=device)}, [40], device=device))
    replay.sample()
    RunCheckpoint(tmp_path, replay=replay, seeds=seeds).save(1)
    assert not list(tmp_path.rglob("rng_state")), "the stream is saved once"
    other, others = make(device)
    other.extend(TensorDict({"x": torch.zeros(3, device=device)}, [3], device=device))
    RunCheckpoint(tmp_path, replay=other, seeds=others).load()
    expected = drawn(replay)
    torch.testing.assert_close(drawn(other), expected, rtol=0, atol=0)
    assert len(expected.unique()) > 10
    assert replay.generator is seeds.generator("replay") and other.generator is others.generator("replay")
    stream = others.generator("replay").get_state()
    other.sample()
    assert not torch.equal(others.generator("replay").get_state(), stream), "it draws from its stream, not from a copy"
