"""Tiny runs: artifacts of an untrained controller, teacher and student."""

from __future__ import annotations

import importlib
import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor

from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.deploy.task import describe_camera
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.agility_terminations import AGILITY_TERMINATIONS
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import features
from agility_rl.modules import BasicBehaviourController, RecurrentStudent, Teacher
from agility_rl.training import rewind


@pytest.fixture
def untrained(tmp_path: Path) -> Path:
    """Run folder with ``policy/`` and nothing else."""
    bbc = BasicBehaviourController(hidden=(16, 16))
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02)
    manifest |= {"network": bbc.settings, "prior": [0.6, 0.2, 0.1, 0.06, 0.04]}
    Artifact.save(tmp_path / "run" / "policy", bbc.state_dict(), manifest)
    return tmp_path / "run"


@pytest.fixture
def untrained_teacher(untrained: Path, tmp_path: Path) -> Path:
    """Run folder of a teacher on the untrained controller, which decides every second control step."""
    torch.manual_seed(0)
    network = Teacher(len(OBSTACLES), hidden=(16, 16), num_place=8)
    manifest = build_manifest("teacher", features.CONTROLLER_LAYOUTS, control_period=0.04)
    manifest |= {"network": network.settings, "course": "bar_jump"}
    manifest["bbc"] = Artifact.load(untrained / "policy").manifest["weights"]["sha256"]
    Artifact.save(tmp_path / "teacher" / "policy", network.state_dict(), manifest)
    return tmp_path / "teacher"


@pytest.fixture
def make_student(untrained_teacher: Path, tmp_path: Path, module: Callable[[str], ModuleType]) -> Callable[..., Path]:
    """Write the run folder of an untrained student of the untrained teacher: ``make_student("name", byol=False)``."""

    def make(
        name: str = "student", *, byol: bool = True, seed: int = 0, own_estimator: bool = False, **changes: object
    ) -> Path:
        torch.manual_seed(seed)
        teacher = Artifact.load(untrained_teacher / "policy")
        points = [[list(point) for point in kind.way_points] for kind in OBSTACLES.values()]
        sizes = {"memory": 16, "encoder_channels": (4, 8), "encoder_hidden": 8, "encoder_features": 8}
        sizes |= {"heading_gate": 4.0, "glance_hidden": (8, 8), "estimator_history": own_estimator}
        network = RecurrentStudent(
            **teacher.manifest["network"], **sizes, way_points=points, routes=COURSES["bar_jump"].legs
        )
        camera = describe_camera()
        camera["training"] = {"frame_steps": 1, "latency": [1, 1], "pitch": 0.09, "offset_noise": 0.05}
        manifest = build_manifest("student", features.CONTROLLER_LAYOUTS, control_period=0.04)
        manifest |= {"network": network.settings, "camera": camera, "byol": byol, "course": "bar_jump"}
        manifest |= {"bbc": teacher.manifest["bbc"], "teacher": teacher.manifest["weights"]["sha256"], **changes}
        Artifact.save(tmp_path / name / "policy", network.state_dict(), manifest)
        return tmp_path / name

    return make


def kicked(state: AgilityState) -> Tensor:
    """To be faster than 0.3 m/s, a failure of robots that stand as those of an untrained controller do."""
    return state.velocity.norm(dim=-1) > 0.3


@pytest.fixture
def failures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots that are pushed fail, and from the first of them on others begin at most 0.2 s before."""
    monkeypatch.setattr(rewind, "LEAST", 1)
    monkeypatch.setattr(rewind, "BACK", (0.0, 0.2))
    monkeypatch.setitem(AGILITY_TERMINATIONS, "sunk", kicked)  # type: ignore[arg-type]


@pytest.fixture
def recipe(repository: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a recipe as a user does: ``recipe("evaluate", "runs/x", "--episodes", 2)``."""

    def run(name: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
        variables = os.environ | {"PYTHONPATH": str(repository), "OMP_NUM_THREADS": "1"} | environment
        command = [sys.executable, f"recipes/{name}.py", *(str(argument) for argument in arguments)]
        return subprocess.run(command, cwd=repository, env=variables, capture_output=True, text=True, timeout=300)

    return run


@pytest.fixture
def module(repository: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], ModuleType]]:
    """Import a recipe with what it imports from beside it, as running it by path does."""
    folder = repository / "recipes"
    monkeypatch.syspath_prepend(str(folder))
    yield importlib.import_module
    for path in folder.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.fixture
def command(
    repository: Path,
    module: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., subprocess.CompletedProcess[str]]:
    """As ``recipe``, without a process of its own, whose imports take seconds: for what ends before any work begins."""

    def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        path = str(repository / "recipes" / f"{name}.py")
        argv = [path, *(str(argument) for argument in arguments)]
        monkeypatch.setattr(sys, "argv", argv)
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            runpy.run_path(path, run_name="__main__")
        printed = capsys.readouterr()
        return subprocess.CompletedProcess(argv, int(stopped.value.code or 0), printed.out, printed.err)

    return run
