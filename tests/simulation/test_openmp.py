"""PyTorch's threads end for the physics and start again by themselves."""

import os
import sys
import time

import pytest
import torch

from agility_rl.simulation.openmp import rest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")


def threads() -> int:
    return len(os.listdir("/proc/self/task"))


@pytest.fixture(autouse=True)
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_threads_end_and_the_next_operation_starts_them() -> None:
    large = torch.arange(1_000_000, dtype=torch.float32)
    doubled = large * 2
    working = threads()
    assert rest()
    deadline = time.monotonic() + 10.0
    while threads() >= working and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threads() < working
    assert torch.equal(large * 2, doubled)
    assert threads() == working


def test_rest_after_rest_and_between_forward_and_backward() -> None:
    weight = torch.ones(1_000_000, requires_grad=True)
    loss = weight.square().sum()
    assert rest() and rest()
    loss.backward()
    assert torch.equal(weight.grad, 2.0 * torch.ones_like(weight))
