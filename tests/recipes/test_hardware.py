"""Trainings with the GPU's engine, on Warp's CPU device; and that an iteration makes nothing on the CPU by default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from agility_rl.deploy.artifact import Artifact
from agility_rl.simulation import HardwareError
from tests.devices import NamesDevices

Module = Callable[[str], ModuleType]
RECIPES = ("bbc_pretrain", "tsc_teacher", "tsc_student", "tsc_practice")


@pytest.fixture
def options(
    module: Module, untrained: Path, untrained_teacher: Path, make_student: Callable[..., Path], tmp_path: Path
) -> Callable[[str], Any]:
    """A tiny run of each recipe."""

    def make(name: str) -> Any:
        cfg = module(name).PRESETS["smoke"]
        cfg = replace(cfg, runs=tmp_path, env=replace(cfg.env, num_threads=1))
        if name == "tsc_teacher":
            return replace(cfg, bbc=untrained, reward=replace(cfg.reward, imitation=0.0))
        if name == "tsc_practice":
            return replace(cfg, student=make_student(), bbc=untrained)
        return replace(cfg, teacher=untrained_teacher, bbc=untrained) if name == "tsc_student" else cfg

    return make


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("name", RECIPES)
def test_a_training_with_the_other_engine_goes_on_where_it_stopped(
    module: Module, options: Callable[[str], Any], name: str, device: str
) -> None:
    recipe = module(name)
    cfg = replace(options(name), simulator="warp", device=device)
    whole = recipe.train(replace(cfg, name="whole"))
    half = recipe.train(replace(cfg, name="half", iterations=1))
    recipe.train(replace(cfg, resume=half))
    one, other = (Artifact.load(run / "policy").state for run in (whole, half))
    if device == "cpu":  # on a GPU, sums are added in another order each time
        assert not [key for key in one if not torch.equal(one[key], other[key])]


@pytest.mark.parametrize("name", RECIPES)
def test_an_iteration_names_the_device_of_all_it_makes(
    module: Module, options: Callable[[str], Any], name: str
) -> None:
    recipe, cfg = module(name), options(name)
    if name == "tsc_student":
        cfg, trained = module("tsc_student_setup").resolve(cfg)
        parts = recipe.build(cfg, trained)
    else:
        parts = recipe.build(cfg)
    with NamesDevices() as mode:
        recipe.begin(parts, cfg)
        for iteration in range(2):
            recipe.iterate(parts, cfg, iteration)
    parts.env.close()
    assert not mode.silent, "\n".join(sorted(mode.silent))


def test_the_cpu_needs_no_device(module: Module) -> None:
    hardware = module("hardware")
    cfg = hardware.HardwareConfig(device="cuda")
    assert hardware.training_device(cfg) == torch.device("cpu")
    assert hardware.simulator_options(cfg, 3) == {"name": "batch", "num_threads": 3}


def test_contacts_have_the_room_that_is_asked_for(module: Module) -> None:
    hardware = module("hardware")
    cfg = hardware.HardwareConfig(simulator="warp", device="cpu", max_contacts=7)
    expected = {"name": "warp", "device": torch.device("cpu"), "max_contacts": 7}
    assert hardware.simulator_options(cfg, 3) == expected


@pytest.mark.skipif(torch.cuda.is_available(), reason="here is a GPU")
@pytest.mark.parametrize("name", RECIPES)
def test_the_preset_gpu_is_the_preset_cpu_with_more_robots_on_a_gpu(module: Module, name: str) -> None:
    cpu, gpu = (module(name).PRESETS[preset] for preset in ("cpu", "gpu"))
    assert gpu.simulator == "warp" and gpu.device == "cuda" and gpu.env.num_robots > 2 * cpu.env.num_robots
    same = replace(
        gpu,
        simulator=cpu.simulator,
        max_minutes=cpu.max_minutes,
        iterations=cpu.iterations,
        env=replace(gpu.env, num_robots=cpu.env.num_robots),
    )
    assert same == cpu


def test_a_missing_gpu_ends_a_run_before_it_begins(module: Module, options: Callable[[str], Any]) -> None:
    cfg = replace(options("bbc_pretrain"), simulator="warp")
    with pytest.raises(HardwareError, match=r"cannot run on cuda: .*, or take the simulator 'batch'"):
        module("bbc_pretrain").train(cfg)
    assert not list(cfg.runs.glob("*/config.json"))
