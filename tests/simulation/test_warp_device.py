"""Which devices Warp can use, said before anything is built on one."""

from __future__ import annotations

import pytest
import torch

from agility_rl.simulation import HardwareError, make_simulator, simulator_device
from agility_rl.simulation.warp_device import on_device, usable_device, wp


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a GPU")
def test_a_missing_gpu_is_named() -> None:
    for ask in (lambda: usable_device("cuda"), lambda: make_simulator("warp", num_simulations=1)):
        with pytest.raises(HardwareError, match=r"cannot run on cuda: .*, or take the simulator 'batch'"):
            ask()


@pytest.mark.parametrize("device", ["gpu", "meta"])
def test_a_device_that_is_none_is_named(device: str) -> None:
    with pytest.raises(HardwareError, match=f"runs on cuda, or on cpu for tests, got device '{device}'"):
        usable_device(device)


@pytest.mark.gpu
def test_a_gpu_too_many_is_named() -> None:
    with pytest.raises(HardwareError, match=r"there are only \d+ GPUs, counted from 0"):
        usable_device("cuda:99")
    assert usable_device("cuda").index is not None


def test_the_device_of_a_simulator_by_name() -> None:
    assert simulator_device("batch", "cuda") == simulator_device("warp", "cpu") == torch.device("cpu")
    with pytest.raises(ValueError, match="unknown simulator 'physx'"):
        simulator_device("physx")


def test_kernels_are_launched_where_torch_is() -> None:
    with on_device(torch.device("cpu")):
        assert wp.get_device().is_cpu
