"""One loop: what a deployment records identifies the robot, and the controller fine-tuned there is deployed again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from agility_rl.collectors import RobotLog
from agility_rl.deploy import BehaviourCommand, Controller, Mode, Operator
from agility_rl.deploy.controller import StepRecord
from agility_rl.deploy.simulated import SimulatedBus, SimulatedRobot
from agility_rl.go2 import constants
from agility_rl.record import EpisodeRecorder

Module = Callable[[str], ModuleType]
SOFT = {"hip": 0.9, "thigh": 0.8, "calf": 0.85}
"""True stiffness of the robot's motors as multiples of what they are told."""


@pytest.fixture
def shipped(repository: Path) -> Path:
    return repository / "pretrained" / "bbc"


def deployed(module: Module, artifact: Path, path: Path, seconds: float) -> tuple[Controller, SimulatedBus]:
    """What ``deploy.py`` does, without waiting for real time: a soft robot trots, and everything is recorded."""
    deploy = module("deploy")
    bbc = deploy.Config(artifact).controller(artifact)
    factors = [SOFT[link] for _ in constants.LEGS for link in constants.LINKS]
    bus = SimulatedBus(SimulatedRobot(sim_dt=constants.SIM_DT, friction_loss=0.0, stiffness_factor=factors))
    bus.robot.reset("lying")
    operator = Operator(BehaviourCommand.of("trot", velocity_x=1.0), bus.now())
    controller = Controller(bus, bbc, operator, clock=bus)
    with EpisodeRecorder(path, dt=bbc.period) as episode:
        record, procedure = deploy.Recorder(episode, bbc), deploy.Procedure(controller, operator, seconds)

        def on_step(step: StepRecord) -> None:
            record(step)
            procedure(step)

        controller.on_step = on_step
        controller.run(until=lambda: procedure.finished)
    assert controller.fault is None and any(event.mode is Mode.RUN for event in controller.events), controller.events
    return controller, bus


def test_a_recorded_run_is_a_log_to_search_with(module: Module, shipped: Path, tmp_path: Path) -> None:
    deployed(module, shipped, tmp_path / "deploy.mcap", 3.0)
    log = RobotLog.load(tmp_path / "deploy.mcap")
    assert len(log.transitions()) >= 140, "3 s at 50 Hz, without standing up and sinking down"
    easi = module("easi")
    cfg = replace(easi.PRESETS["smoke"], log=tmp_path / "deploy.mcap", policy=shipped, runs=tmp_path, generations=1)
    result = json.loads((easi.train(replace(cfg, num_threads=1)) / "result.json").read_text())
    assert result["generations"] == 1 and len(result["parameters"]) == 6


@pytest.mark.slow
def test_deploy_identify_fine_tune_export_deploy(module: Module, shipped: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="needs the extra export")
    deployed(module, shipped, tmp_path / "first.mcap", 20.0)

    easi = module("easi")
    cfg = replace(
        easi.PRESETS["cpu"], log=tmp_path / "first.mcap", policy=shipped, runs=tmp_path, generations=15, num_threads=1
    )
    identified = easi.train(replace(cfg, num_robots=80))
    found = json.loads((identified / "result.json").read_text())["parameters"]
    for link, factor in SOFT.items():
        assert found[f"{link}_stiffness"]["multiple"]["mean"] == pytest.approx(factor, rel=0.1), link
        assert found[f"{link}_damping"]["multiple"]["mean"] == pytest.approx(1.0, rel=0.25), link

    finetune = module("bbc_finetune")
    smoke = replace(finetune.PRESETS["smoke"], runs=tmp_path, init_from=shipped, simulator=identified, num_threads=1)
    tuned = finetune.main(smoke)
    assert set(json.loads((tuned / "comparison.json").read_text())) == {"identified"}

    export = module("export")
    exported = export.main(export.Config(tuned, output=tmp_path / "exported", steps=50))
    manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (shipped, exported)]
    assert manifests[0]["weights"]["sha256"] != manifests[1]["weights"]["sha256"], "it is another controller"

    _, bus = deployed(module, exported, tmp_path / "second.mcap", 4.0)
    assert len(RobotLog.load(tmp_path / "second.mcap").transitions()) >= 190
    assert float(abs(bus.robot.data.qpos[:2]).max()) > 0.5, "it went somewhere"
