"""An untrained controller, and a robot on a fake bus that stands or runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.deploy.behaviour import DeployedBBC, torch_network
from agility_rl.deploy.commander import BehaviourCommand, Operator
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.transport import FakeBus
from agility_rl.go2 import features
from agility_rl.modules import BasicBehaviourController


@pytest.fixture
def module() -> BasicBehaviourController:
    """Random weights, biases included, and small actions."""
    bbc = BasicBehaviourController(hidden=(32, 16))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in bbc.parameters():
            parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
        bbc.actor.network.std.fill_(0.5)
    return bbc


@pytest.fixture
def artifact(tmp_path: Path, module: BasicBehaviourController) -> Artifact:
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02, network=module.settings)
    return Artifact.save(tmp_path / "policy", module.state_dict(), manifest)


@pytest.fixture
def deployed(artifact: Artifact) -> DeployedBBC:
    return DeployedBBC(torch_network(artifact), artifact)


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def bus(clock: ManualClock) -> FakeBus:
    return FakeBus(clock)


@pytest.fixture
def operator() -> Operator:
    return Operator(BehaviourCommand.of("trot"), now=0.0)


@pytest.fixture
def controller(deployed: DeployedBBC, bus: FakeBus, clock: ManualClock, operator: Operator) -> Controller:
    """Passive; every step is a word of the operator, until ``controller.on_step`` is taken away."""
    found = Controller(bus, deployed, operator, clock=clock)
    found.on_step = lambda step: operator.heard(step.time)
    return found


@pytest.fixture
def running(controller: Controller) -> Callable[[], Controller]:
    """Bring the controller into the mode ``run``."""

    def bring() -> Controller:
        controller.request(Mode.STAND_UP)
        for _ in range(200):
            controller.step()
            if controller.mode is Mode.READY:
                break
        controller.request(Mode.RUN)
        for _ in range(3):
            controller.step()
        assert controller.mode is Mode.RUN, list(controller.events)
        return controller

    return bring
