"""The benchmarks run, on a few robots; what they measure is not looked at here."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
PEERS = {"peer_mjbatch": "mjbatch"}
"""Scripts of another environment, and what only that one need have."""


@pytest.mark.parametrize("file", sorted((REPOSITORY / "benchmarks").glob("*.py")), ids=lambda file: file.stem)
def test_every_benchmark_finds_what_it_imports(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if file.stem in PEERS:
        pytest.importorskip(PEERS[file.stem])
    folders = [REPOSITORY / "recipes", REPOSITORY / "benchmarks"]
    for folder in folders:
        monkeypatch.syspath_prepend(str(folder))
    assert runpy.run_path(str(file))["__doc__"]
    for imported in (script.stem for folder in folders for script in folder.glob("*.py")):
        sys.modules.pop(imported, None)


@pytest.mark.parametrize(
    "given, said", [("nowhere", "expected the Python of another environment"), (sys.executable, "ended")]
)
def test_a_peer_that_is_not_there_is_said(repository: Path, given: str, said: str) -> None:
    command = [sys.executable, "benchmarks/ppo_peer.py", "--peer", given, "--robots", "4"]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and said in done.stderr


def run(repository: Path, *arguments: str) -> str:
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_env_step_prints_a_share_of_the_bare_engine(repository: Path) -> None:
    output = run(repository, "benchmarks/env_step.py", "--robots=4", "--threads=1", "--rounds=1", "--steps=2")
    assert "bare Batch.step" in output and output.count("% of bare") == 6


@pytest.mark.slow
def test_agility_speed_prints_a_share_of_the_bare_engine(repository: Path) -> None:
    output = run(repository, "benchmarks/agility_speed.py", "--robots=4", "--threads=1", "--rounds=1", "--steps=5")
    assert "bare Batch.step" in output and output.count("% of bare") == 4


@pytest.mark.slow
def test_plain_loop_and_recipe_run_in_turns(repository: Path) -> None:
    output = run(repository, "benchmarks/plain_ppo.py", "--preset=smoke", "--robots=4", "--iterations=1", "--warmup=0")
    assert "speed of the recipe relative to the plain loop" in output and "nan" not in output


@pytest.mark.slow
def test_plain_loop_and_teacher_run_in_turns(repository: Path) -> None:
    output = run(repository, "benchmarks/plain_teacher.py", "--preset=smoke", "--iterations=1", "--warmup=0")
    assert "speed of the recipe relative to the plain loop" in output and "nan" not in output


@pytest.mark.slow
def test_training_prints_every_stage_on_either_engine(repository: Path) -> None:
    size = ("--preset=smoke", "--robots", "4", "8", "--steps=2", "--rounds=1")
    output = run(repository, "benchmarks/training.py", *size)
    assert output.count("an iteration, s: collect") == 2 and "nan" not in output
    pytest.importorskip("mujoco_warp")
    output = run(repository, "benchmarks/training.py", "--simulator=warp", "--device=cpu", *size)
    assert output.count("an iteration, s: collect") == 2


@pytest.mark.slow
def test_growth_prints_costs_of_robots_courses_and_images(repository: Path) -> None:
    options = ("--robots", "2", "4", "--course-robots=2", "--threads=1", "--rounds=1")
    output = run(repository, "benchmarks/growth.py", *options)
    assert output.count(" us\n") == 2 + 7 + 3


@pytest.mark.slow
def test_easi_collection_prints_a_share_of_the_bare_engine(repository: Path) -> None:
    output = run(repository, "benchmarks/easi_collection.py", "--robots=4", "--threads=1", "--rounds=1", "--steps=5")
    assert "EASICollector" in output and output.count("% of bare") == 2


@pytest.mark.slow
def test_depth_prints_its_rate_beside_bare_rays(repository: Path) -> None:
    output = run(repository, "benchmarks/depth.py", "--robots=2", "--threads=1", "--rounds=1")
    assert "bare mj_multiRay" in output and output.count("x bare") == 3


@pytest.mark.slow
def test_control_step_prints_times_and_memory(repository: Path) -> None:
    output = run(repository, "benchmarks/control_step.py", "pretrained/bbc_course", "--steps=20")
    assert "20 control steps" in output and "p99" in output and "memory" in output


@pytest.mark.slow
def test_engines_prints_agreement_and_shares(repository: Path) -> None:
    options = (
        "--controller=pretrained/bbc_joined",
        "--robots=4",
        "--threads=1",
        "--episodes=1",
        "--seconds=0.2",
        "--rounds=1",
    )
    output = run(repository, "benchmarks/engines.py", *options)
    assert "distance of the trunks" in output and output.count("% of bare") == 6
