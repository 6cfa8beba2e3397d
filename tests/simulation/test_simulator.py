"""The protocol, its parameter table and the choice of a backend by name."""

from __future__ import annotations

import inspect

import pytest

from agility_rl.simulation import PARAMETERS, BatchSimulator, Simulator, make_simulator


def test_backend_has_all_that_the_protocol_names() -> None:
    simulator = make_simulator("batch", num_simulations=2, num_threads=1)
    assert isinstance(simulator, BatchSimulator)
    for name in Simulator.__annotations__:
        assert hasattr(simulator, name), name
    for name, member in vars(Simulator).items():
        if not name.startswith("_") and callable(member):
            expected = list(inspect.signature(member).parameters)
            assert list(inspect.signature(getattr(BatchSimulator, name)).parameters) == expected, name


def test_parameters_have_sizes_and_units() -> None:
    assert {size for size, _ in PARAMETERS.values()} == {1, 3, 12}
    assert PARAMETERS["stiffness"] == (12, "N m/rad")


def test_options_of_the_gpu_say_nothing_on_the_cpu() -> None:
    simulator = make_simulator("batch", num_simulations=1, num_threads=1, device="cpu", max_contacts=9)
    assert simulator.device.type == "cpu"


def test_unknown_backend_is_named() -> None:
    with pytest.raises(ValueError, match="'physx'"):
        make_simulator("physx", num_simulations=1)
