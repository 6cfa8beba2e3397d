"""Trials during a training: when, which is the best, and that the training does not notice them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from agility_rl.deploy.artifact import Artifact
from agility_rl.record.mcap_logger import read_scalars
from agility_rl.training.metrics import Interval

Module = Callable[[str], ModuleType]


@pytest.fixture
def options(module: Module, tmp_path: Path) -> Callable[..., Any]:
    """A tiny training of which the controller is tried after the second and every further iteration."""

    def make(name: str, *, start: int | None = 2, **changes: Any) -> Any:
        cfg = module("bbc_presets").SMOKE
        trials = replace(cfg.trials, start=start, every=1, episodes=1, seconds=2.0, switches=0)
        env = replace(cfg.env, num_threads=1)
        return replace(cfg, name=name, runs=tmp_path, iterations=3, env=env, trials=trials, **changes)

    return make


def weights(folder: Path) -> str:
    """Checksum of a controller."""
    return str(Artifact.load(folder).manifest["weights"]["sha256"])


def write_trial(run: Path, iteration: int, verdicts: list[tuple[bool, bool]]) -> Path:
    folder = run / "trials" / f"{iteration:06d}"
    folder.mkdir(parents=True)
    rows = [{"passed": passed, "certain": certain} for passed, certain in verdicts]
    (folder / "evaluation.json").write_text(json.dumps({"targets": rows}))
    return folder


def test_trials_are_due_from_their_start_on(module: Module, options: Callable[..., Any]) -> None:
    due = module("bbc_trials").due
    cfg = options("run")
    cfg = replace(cfg, trials=replace(cfg.trials, start=10, every=4))
    assert [n for n in range(25) if due(cfg, n)] == [10, 14, 18, 22]
    assert not any(due(options("run", start=None), n) for n in range(25))


def test_the_best_trial_reaches_most_targets_then_most_of_them_wholly(module: Module, tmp_path: Path) -> None:
    best = module("bbc_trials").best_trial
    assert best(tmp_path) is None
    write_trial(tmp_path, 1, [(True, True), (True, True), (False, False)])
    expected = write_trial(tmp_path, 2, [(True, False), (True, True), (True, False)])
    assert best(tmp_path)[0] == expected, "three targets are more than two, however surely"
    expected = write_trial(tmp_path, 3, [(True, True), (True, True), (True, False)])
    write_trial(tmp_path, 4, [(True, True), (True, False), (True, False)])
    assert best(tmp_path)[0] == expected, "of as many targets, more reached by the whole interval"
    expected = write_trial(tmp_path, 12, [(True, False), (True, True), (True, True)])
    assert best(tmp_path)[0] == expected, "of equals the later one"


def test_a_target_is_certain_where_the_whole_interval_reaches_it(module: Module) -> None:
    share = {"walk": Interval(0.95, 0.91, 0.97), "jump": Interval(0.95, 0.89, 0.97)}
    gait = {"walk": Interval(1.0, 0.8, 1.2), "jump": Interval(1.0, 0.7, 1.2)}
    found: dict[str, Any] = {
        "behaviours": {
            name: {
                "recognised": share[name],
                "errors": {"speed": Interval(0.3, 0.2, 0.4)},
                "gait": {"stride frequency": {"robot": gait[name], "dog": [1.0, 1.0], "allowed": [0.75, 1.25]}},
            }
            for name in share
        },
        "nmi": Interval(0.8, 0.7, 0.9),
        "falls": Interval(0.01, 0.0, 0.02),
        "switches": None,
        "prior": None,
    }
    verdicts = {row["name"]: (row["passed"], row["certain"]) for row in module("judgement").targets(found)}
    assert verdicts == {
        "walk: recognised": (True, True),
        "walk: speed error, m/s": (False, False),
        "walk: stride frequency": (True, True),
        "jump: recognised": (True, False),
        "jump: speed error, m/s": (True, False),
        "jump: stride frequency": (True, False),
        "jump: trunk peak error, m": (False, False),
        "NMI of commanded and shown": (False, False),
        "falls": (True, True),
    }


def test_a_training_shows_its_best_trial_and_learns_as_without(
    module: Module, options: Callable[..., Any], tmp_path: Path
) -> None:
    recipe = module("bbc_pretrain")
    run = recipe.train(options("tried"))
    assert sorted(folder.name for folder in (run / "trials").iterdir()) == ["000002", "000003"]
    best, found = module("bbc_trials").best_trial(run)
    manifest = Artifact.load(run, kind="bbc").manifest
    assert weights(run / "policy") == weights(best / "policy")
    assert weights(run / "discriminator") == weights(best / "discriminator")
    reached = sum(row["passed"] for row in found["targets"])
    expected = {"iteration": int(best.name), "targets": reached, "of": len(found["targets"]), "seed": 1_000_003}
    assert manifest["trial"] == expected
    steps, numbers = read_scalars(run)["trial/targets"]
    assert steps.tolist() == [2, 3] and numbers.tolist()[int(best.name) - 2] == reached
    last = run / "trials" / "000003"
    plain = recipe.train(options("plain", start=None))
    assert weights(plain / "policy") == weights(last / "policy") != weights(run / "trials" / "000002" / "policy")
    assert not (plain / "trials").exists() and "trial" not in Artifact.load(plain).manifest
    # A run that was stopped between two trials goes on to the same ones.
    half = recipe.train(replace(options("half"), iterations=2))
    recipe.train(replace(options("half"), resume=half))
    assert weights(half / "trials" / "000003" / "policy") == weights(last / "policy")
    assert weights(half / "policy") == weights(run / "policy")


def test_a_trial_leaves_random_numbers_alone(module: Module, options: Callable[..., Any], tmp_path: Path) -> None:
    setup, cfg = module("bbc_setup"), options("run")
    parts = setup.build(cfg)
    before = torch.random.get_rng_state()
    module("bbc_trials").hold_trial(cfg, tmp_path, 7, lambda folder: setup.save_policy(parts, cfg, folder))
    parts.env.close()
    assert torch.equal(torch.random.get_rng_state(), before)
    assert (tmp_path / "trials" / "000007" / "evaluation.json").is_file()
