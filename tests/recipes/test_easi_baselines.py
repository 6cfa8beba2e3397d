"""EASI's baselines on logs of some seconds: methods, and the command that compares them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from mujoco import sysid

from agility_rl.collectors import GAINS, ParameterSpace, RobotLog, cut_windows, record_robot_log
from agility_rl.collectors.windows import predict
from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.simulation import make_simulator

Module = Callable[[str], ModuleType]
SPACE = ParameterSpace()
TRUTH = torch.tensor([0.8, 0.3, 0.25, 0.7, 0.7, 0.4], dtype=torch.float64)
"""In search coordinates, far from the centre in every coordinate."""


@pytest.fixture(scope="module")
def log() -> RobotLog:
    """3 s of a robot that shifts its weight, with the gains of :data:`TRUTH`."""
    simulator = make_simulator(num_simulations=1, num_threads=1)
    generator = torch.Generator().manual_seed(0)
    simulator.set_parameters(torch.ones(1, dtype=torch.bool), **SPACE.fields(SPACE.denormalize(TRUTH[None])))

    def shake(measured: Any) -> torch.Tensor:
        return 0.8 * torch.randn(1, 12, generator=generator)

    made = record_robot_log(simulator, shake, 150, generator=generator)
    simulator.close()
    return made


def problem(module: Module, log: RobotLog, **changes: Any) -> Any:
    easi = replace(module("easi_config").SMOKE, num_robots=32, num_threads=1)
    own = {
        "space": SPACE,
        "windows": cut_windows(log, 5, skip=1),
        "easi": easi,
        "friction_loss": constants.FRICTION_LOSS,
        "budget": 15_000,
        "population": 8,
        "seed": 0,
    }
    return module("easi_methods").Problem(**(own | changes))


# -- methods -----------------------------------------------------------------------------------------------------------
def error(centre: torch.Tensor) -> float:
    truth = SPACE.denormalize(TRUTH)
    return float(((centre - truth).abs() / truth).mean())


@pytest.mark.parametrize(
    ("method", "budget", "share"), [("cma_es", 15_000, 0.35), ("cma_es_robust", 15_000, 0.5), ("sysid", 6_000, 0.15)]
)
def test_a_baseline_comes_nearer_to_the_truth(
    module: Module, log: RobotLog, method: str, budget: int, share: float
) -> None:
    posed = problem(module, log, budget=budget)
    identify = module("easi_methods").identify
    found, centre = identify(method, posed), identify("uniform", posed)
    assert error(centre.centre) > 0.4 and centre.steps == 0
    assert error(found.centre) < share * error(centre.centre)
    assert 0 < found.steps <= posed.budget
    assert bool((found.spread < centre.spread).all()), "the log tells something of every gain"


def test_robust_misses_are_in_medians_and_clipped(module: Module, log: RobotLog) -> None:
    windows = cut_windows(log, 5, skip=1)
    predicted = windows.measured[None].repeat(3, 1, 1, 1)
    predicted[0] += 1.0
    predicted[1] += 2.0
    predicted[2, :, :, 0] = math.nan
    predicted[2, :, :, 1:] += 9.0
    size = module("easi_methods").clipped_medians(windows, predicted)
    assert size.shape == (3, len(windows), 4, 29)
    expected = torch.tensor([0.5, 1.0, 3.0])[:, None, None, None].expand_as(size)  # the median is 2, also with a NaN
    torch.testing.assert_close(size, expected, atol=1e-3, rtol=1e-3)


def test_the_baselines_see_the_windows_of_the_search(module: Module, log: RobotLog, tmp_path: Path) -> None:
    baselines, path = module("easi_baselines"), log.save(tmp_path / "log.npz")
    for name, noise, given, expected in (
        ("clean", 0.0, {}, (1, 0)),
        ("noisy", 1.0, {}, (8, 2)),
        ("clean", 0.0, {"window": 10, "skip": 3}, (10, 3)),
    ):
        condition = replace(baselines.CONDITIONS[name], latency=0)
        assert condition.noise == noise
        posed = baselines.make_problem(replace(baselines.PRESETS["smoke"], **given), path, 0, condition)
        assert (posed.windows.steps, posed.windows.skip) == expected


def test_the_replaying_search_finds_gains_outside_its_first_range(
    module: Module, log: RobotLog, tmp_path: Path
) -> None:
    """The preset ``cpu`` cut to 9,600 control steps; with a span of 1.5, five of the six gains lie outside."""
    cpu = module("easi_config").CPU
    cpu = replace(cpu, log=log.save(tmp_path / "log.npz"), num_robots=40, trajectory_length=20, generations=12)
    posed = problem(module, log, easi=replace(cpu, num_threads=1, search=replace(cpu.search, span=1.5)))
    identify = module("easi_methods").identify
    found = identify("easi", posed)
    assert found.steps == 9_600
    assert error(found.centre) < 0.25 < 0.4 < error(identify("uniform", posed).centre)


def test_the_toolbox_predicts_what_the_batch_simulator_predicts(module: Module, log: RobotLog) -> None:
    """Two ways to simulate: models compiled one by one and ``mujoco.rollout``, or one batch with expanded fields."""
    methods, windows = module("easi_methods"), cut_windows(log, 5, skip=1)
    windows = windows.take(torch.arange(4))
    points = torch.stack((torch.full((6,), 0.5).double(), TRUTH))
    spec = build_spec()
    bounds = torch.zeros(6).double(), torch.ones(6).double()
    values, _, _ = sysid.model_residual(
        points.T.numpy(),
        methods.toolbox_parameters(SPACE, bounds),
        lambda candidate: sysid.apply_param_modifiers(candidate, spec),
        methods.toolbox_trajectories(spec.compile(), windows),
        modify_residual=methods.toolbox_comparison(windows),
        n_threads=1,
        resample_true=False,
    )
    simulator = make_simulator(num_simulations=8, num_threads=1)
    expected = windows.residual(predict(simulator, SPACE, points, windows))
    simulator.close()
    assert values.shape == (4 * 29, 8)
    got = torch.from_numpy(np.ascontiguousarray(values.T)).reshape(expected.shape)
    torch.testing.assert_close(got, expected.double(), atol=2e-2, rtol=1e-2)


def test_a_budget_below_one_generation_is_refused(module: Module, log: RobotLog) -> None:
    with pytest.raises(ValueError, match="a generation of CMA-ES takes"):
        module("easi_methods").identify("cma_es", problem(module, log, budget=10))


# -- comparison --------------------------------------------------------------------------------------------------------
@pytest.fixture
def baselines(module: Module) -> ModuleType:
    return module("easi_baselines")


def smoke(baselines: ModuleType, folder: Path, **changes: Any) -> Any:
    preset = baselines.PRESETS["smoke"]
    easi = replace(preset.easi, num_threads=1)
    usual = {"runs": folder, "name": "run", "steps": 120, "easi": easi, "conditions": ("clean",)}
    return replace(preset, **(usual | changes))


def test_one_command_compares_and_a_resume_runs_nothing_twice(
    baselines: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = baselines.main(smoke(baselines, tmp_path))
    file = folder / "clean" / "target_00.json"
    first = json.loads(file.read_text())
    assert list(first["methods"]) == ["easi", "cma_es", "cma_es_robust", "sysid", "uniform"]
    steps = {name: entry["steps"] for name, entry in first["methods"].items()}
    # Eight robots, three generations of twenty steps, for everybody.
    assert first["budget"] == steps["easi"] == steps["cma_es"] == 480
    assert 0 < steps["sysid"] <= 480 and steps["uniform"] == 0
    recorded = json.loads((folder / "clean" / "target_00.truth.json").read_text())["parameters"]
    for name in GAINS:
        truth = recorded[name]["value"]
        assert first["truth"][name] == truth
        for entry in first["methods"].values():
            assert entry["error"][name] == pytest.approx(abs(entry["value"][name] - truth) / truth)
    for entry in first["methods"].values():
        assert entry["mean_error"] == pytest.approx(sum(entry["error"].values()) / 6)
    output = capsys.readouterr().out
    assert "clean: parameter errors" in output and "cma_es" in output
    before = file.stat().st_mtime_ns

    ran: list[tuple[str, int]] = []
    identify = baselines.identify

    def counting(method: str, posed: Any) -> Any:
        ran.append((method, posed.seed))
        return identify(method, posed)

    monkeypatch.setattr(baselines, "identify", counting)
    baselines.main(replace(baselines.PRESETS["paper"], resume=folder, targets=2, conditions=("clean",)))
    assert [method for method, _ in ran] == ["easi", "cma_es", "cma_es_robust", "sysid", "uniform"]
    assert len({seed for _, seed in ran}) == 1 and file.stat().st_mtime_ns == before
    second = json.loads((folder / "clean" / "target_01.json").read_text())
    assert second["budget"] == 480 and second["truth"] != first["truth"], "a resume keeps the run's own budget"
    table = json.loads((folder / "table.json").read_text())
    assert [(row["method"], row["targets"]) for row in table] == [(name, 2) for name in first["methods"]]
    assert "| cma_es | 2 |" in (folder / "table.md").read_text()


def test_a_method_that_is_missing_is_run_alone_on_the_same_log(baselines: ModuleType, tmp_path: Path) -> None:
    folder = baselines.main(smoke(baselines, tmp_path, methods=("uniform",)))
    log = folder / "clean" / "target_00.npz"
    before = log.stat().st_mtime_ns
    baselines.main(replace(smoke(baselines, tmp_path, methods=("uniform", "cma_es")), resume=folder))
    assert log.stat().st_mtime_ns == before
    assert list(json.loads((folder / "clean" / "target_00.json").read_text())["methods"]) == ["uniform", "cma_es"]
    other = smoke(baselines, tmp_path, methods=("uniform",), conditions=("outside",))
    baselines.main(replace(other, resume=folder))
    rows = [(row["condition"], row["method"]) for row in json.loads((folder / "table.json").read_text())]
    assert rows == [("clean", "uniform"), ("clean", "cma_es"), ("outside", "uniform")], "what was there stays"


def test_targets_are_the_same_in_all_conditions_but_outside(baselines: ModuleType) -> None:
    conditions = baselines.CONDITIONS
    for index in range(20):
        clean, noisy, outside, late = (baselines.draw_target(0, index, drawn) for drawn in conditions.values())
        assert clean == noisy and outside == late and tuple(clean) == GAINS
        assert all(1 / 3 <= multiple <= 3 for multiple in clean.values())
        assert all(1 / 3 <= multiple < 1 / 1.5 or 1.5 < multiple <= 3 for multiple in outside.values())
        assert baselines.draw_target(1, index, conditions["clean"]) != clean


def test_the_table_by_hand(module: Module) -> None:
    table = module("easi_table")

    def result(condition: str, value: float) -> dict[str, Any]:
        found = {"value": {"hip_stiffness": value, "hip_damping": 1.0}, "spread": [4.0, None]}
        found |= {"error": {"hip_stiffness": abs(value - 40.0) / 40.0, "hip_damping": 0.0}}
        found |= {"mean_error": abs(value - 40.0) / 80.0, "steps": 1_500_000, "seconds": 20.0}
        truth = {"hip_stiffness": 40.0, "hip_damping": 1.0}
        return {"condition": condition, "budget": 2_000_000, "truth": truth, "methods": {"sysid": found}}

    rows = table.summarize([result("clean", 44.0), result("clean", 52.0), result("noisy", 40.0)], ["easi", "sysid"])
    clean, noisy = rows
    assert (clean.condition, clean.method, clean.targets) == ("clean", "sysid", 2)
    assert clean.error == pytest.approx(0.1) and clean.parameters == pytest.approx(
        {"hip_stiffness": 0.2, "hip_damping": 0.0}
    )
    # Errors .05 and .15: deviation .1 / sqrt 2, and Student's t with one degree of freedom is 12.706.
    assert clean.interval == pytest.approx(12.706 * (0.1 / 2**0.5) / 2**0.5, rel=1e-3)
    assert clean.covered == 0.5, "44 is within 2 x 4 of 40, 52 is not; a missing spread does not count"
    assert noisy.interval is None and noisy.covered == 1.0
    text = table.markdown(rows)
    assert "## clean (budget 2 million control steps)" in text
    assert "| sysid | 2 | 10.0 ± 63.5 |  | 20.0 | 0.0 | 50 | 1.5 | 20 |" in text
    assert "| sysid | 1 | 0.0 |  | 0.0 | 0.0 | 100 | 1.5 | 20 |" in text


def test_methods_are_compared_target_by_target(module: Module) -> None:
    table = module("easi_table")

    def result(**errors: float) -> dict[str, Any]:
        def found(error: float) -> dict[str, Any]:
            values = {"value": {"hip_damping": 1.0}, "error": {"hip_damping": error}, "mean_error": error}
            return values | {"spread": [None], "steps": 1, "seconds": 1.0}

        methods = {method: found(error) for method, error in errors.items()}
        return {"condition": "noisy", "budget": 1, "truth": {"hip_damping": 1.0}, "methods": methods}

    # By itself each is anywhere from .02 to .22; on the same targets one misses by .02 and .04 more than the other.
    results = [result(easi=0.02, cma_es=0.04), result(easi=0.18, cma_es=0.22), result(cma_es=0.5)]
    easi, cma_es = table.summarize(results, ["easi", "cma_es"])
    assert easi.behind is None and easi.behind_interval is None
    assert cma_es.targets == 3 and cma_es.behind == pytest.approx(0.03), "the third was not searched by both"
    assert cma_es.behind_interval == pytest.approx(12.706 * (0.02 / 2**0.5) / 2**0.5, rel=1e-3)
    assert "| +3.0 ± 12.7 |" in table.markdown([easi, cma_es])
    (alone,) = table.summarize(results, ["cma_es"])
    assert alone.behind is None, "nothing to be behind of"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--conditions", "foggy"), "expected --conditions from clean, noisy, outside, outside_noisy, got foggy"),
        (
            ("--methods", "easi", "guess"),
            "expected --methods from easi, cma_es, cma_es_robust, sysid, uniform, got guess",
        ),
        (("--targets", "0"), "--targets from 1"),
        (("--easi.log", "some.npz"), "leave --easi.log out"),
        (("--easi.search.parameters", "armature"), "leave --easi.search.parameters"),
        (("--widnow", "5"), "did you mean --window"),
        (("--resume", "nowhere"), "nothing to resume"),
    ],
)
def test_bad_options_give_one_clear_line(
    baselines: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    with pytest.raises(SystemExit) as stop, baselines.cli.one_line_errors():
        arguments = ["smoke", "--runs", str(tmp_path / "runs"), *options]
        baselines.main(baselines.cli.from_presets(baselines.PRESETS, arguments))
    assert stop.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors and errors.count("\n") == 1
    assert not (tmp_path / "runs").exists()
