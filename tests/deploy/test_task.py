"""A student on the robot: the same decisions as in training, at its own rate, with what it sees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.behaviours import commands_from_parameters
from agility_rl.deploy.artifact import Artifact, ArtifactError, build_manifest
from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import Perception
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.depth import DepthPreprocessor, Frame, StillImage, sensor_image
from agility_rl.deploy.operator import SharedControl
from agility_rl.deploy.task import DeployedStudent, StudentNetwork, describe_camera, torch_student
from agility_rl.deploy.transport import FakeBus, RobotState
from agility_rl.go2 import features
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.student import NEXT_HIDDEN

POINTS = [[[x, 0.0] for x in (-1.5, -0.5, 0.5, 1.5)] for _ in range(7)]
BALL = ["sphere", [0.4], [0.0, 0.0, 0.4], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0]]


SHAPES = {"solids": [[BALL]] * 7, "stock": [1] * 7, "estimator_history": True}


@pytest.fixture(params=[(0, {}), (8, {}), (8, SHAPES)], ids=["headings only", "place", "shapes"])
def student(request: pytest.FixtureRequest) -> RecurrentStudent:
    """Random weights, biases included."""
    num_place, options = request.param
    network = RecurrentStudent(
        hidden=(32, 16), num_place=num_place, memory=24, encoder_hidden=16, way_points=POINTS, **options
    )
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(0.15 * torch.randn(parameter.shape, generator=generator))
    return network


@pytest.fixture
def save(tmp_path: Path, student: RecurrentStudent, artifact: Artifact) -> Callable[..., Artifact]:
    def write(**changes: object) -> Artifact:
        manifest = build_manifest("student", features.CONTROLLER_LAYOUTS, control_period=0.1)
        manifest |= {"network": student.settings, "camera": describe_camera()}
        manifest |= {"bbc": artifact.manifest["weights"]["sha256"], **changes}
        return Artifact.save(tmp_path / "student", student.state_dict(), manifest)

    return write


class Camera:
    """Shows what the test puts here."""

    def __init__(self) -> None:
        self.frame: Frame | None = None

    def latest(self) -> Frame | None:
        return self.frame


def deployed_student(artifact: Artifact, bbc: Artifact, eyes: Camera | StillImage) -> DeployedStudent:
    weights = bbc.manifest["weights"]["sha256"]
    return DeployedStudent(torch_student(artifact), artifact, eyes, period=0.02, bbc_weights=weights)


def scene(generator: torch.Generator) -> np.ndarray:
    """Depths of a network's image [mm]."""
    return (300.0 + 3000.0 * torch.rand(58, 87, generator=generator)).round().numpy().astype(np.uint16)


def test_decisions_are_those_of_the_training_policy(
    student: RecurrentStudent, save: Callable[..., Artifact], artifact: Artifact
) -> None:
    generator, camera = torch.Generator().manual_seed(0), Camera()
    task, policy = deployed_student(save(), artifact, camera), student.policy()
    hidden, seen, chosen = student.initial_hidden(1), [], set()
    history = torch.zeros(1, features.HISTORY, 45)
    for step in range(40):
        present = torch.randn(45, generator=generator)
        history = present.expand(1, 10, 45) if step == 0 else torch.cat((history[:, 1:], present[None, None]), 1)
        if step % 5 == 0:
            counts = scene(generator)
            camera.frame = Frame(0.0, sensor_image(counts))
            td = TensorDict({keys.DEPTH: DepthPreprocessor()(camera.frame.image)[None]}, [1])
            td.update({keys.PROPRIOCEPTION: present[None], keys.HISTORY: history, keys.HIDDEN: hidden})
            td[keys.IMAGE_AGE] = torch.full((1, 1), 0.02 * step)
            td["is_init"] = torch.full((1, 1), step == 0)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                td = policy(td)
            hidden = td[NEXT_HIDDEN]
            skill = td[keys.ACTION, keys.BEHAVIOUR]
            parameters = td[keys.ACTION, keys.PARAMETERS][0, int(skill)].clamp(-1.0, 1.0)
            command, shift = commands_from_parameters(skill, parameters[None])
            seen.append((int(skill), command[0], shift.item()))
        told = task.decide(Perception(0.02 * step, RobotState.standing(), present, torch.zeros(4)))
        assert told.skill == seen[-1][0] and told.shift == pytest.approx(seen[-1][2], abs=1e-6)
        torch.testing.assert_close(told.command, seen[-1][1], rtol=0, atol=1e-6)
        torch.testing.assert_close(task.heading, td[keys.HEADING_ESTIMATE][0], rtol=0, atol=1e-6)
        assert task.obstacle == int(td[keys.OBSTACLE_LOGITS].argmax())
        chosen.add(round(told.command[0].item(), 4))
    assert len(chosen) > 3, "it decides anew"


def test_its_canters_are_as_fast_as_its_manifest_says(
    student: RecurrentStudent, save: Callable[..., Artifact], artifact: Artifact
) -> None:
    """The same network that always canters as fast as it may, from manifests with and without the entry."""
    with torch.no_grad():
        student.actor.network.choice_head[-1].bias[3] = 100.0
        student.actor.network.parameters_head.mean[-1].bias.view(5, 6)[3, 0] = 100.0
    look = Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))
    for entry, fastest in (({}, 2.0), ({"fastest_canter": 3.2}, 3.2), ({"fastest_canter": 3}, 3.0)):
        told = deployed_student(save(**entry), artifact, StillImage(1.0)).decide(look)
        assert (told.name, told.command[0].item()) == ("canter", pytest.approx(fastest)), entry
    for wrong, message in (("fast", r"expected fastest_canter in m/s in the manifest, got 'fast'"), (9.0, "got 9")):
        with pytest.raises(ValueError, match=message):
            deployed_student(save(fastest_canter=wrong), artifact, StillImage(1.0))


def test_the_network_is_told_how_old_its_image_is(
    monkeypatch: pytest.MonkeyPatch, save: Callable[..., Artifact], artifact: Artifact
) -> None:
    """On the controller's clock, at 7.5 s, an image of 7.44 s."""
    camera, ages = Camera(), []
    task = deployed_student(save(), artifact, camera)
    network = task.network
    monkeypatch.setattr(task, "network", lambda *inputs: ages.append(inputs[1]) or network(*inputs))
    camera.frame = Frame(7.44, sensor_image(scene(torch.Generator().manual_seed(0))))
    task.decide(Perception(7.5, RobotState.standing(), torch.zeros(45), torch.zeros(4)))
    assert len(ages) == 1 and ages[0].shape == (1, 1) and ages[0].item() == pytest.approx(0.06)


def test_it_looks_only_when_a_decision_is_due_and_forgets_at_a_start(
    save: Callable[..., Artifact], artifact: Artifact
) -> None:
    camera, generator = Camera(), torch.Generator().manual_seed(1)
    task = deployed_student(save(), artifact, camera)
    look = Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))
    with pytest.raises(RuntimeError, match="no depth image has arrived; is the camera running"):
        task.decide(look)
    assert task.sources() == {"depth": float("-inf")}
    first = Frame(1.0, sensor_image(scene(generator)))
    camera.frame = first
    begun = task.decide(look)
    assert task.sources() == {"depth": 1.0}
    camera.frame = Frame(1.1, sensor_image(scene(generator)))
    assert all(task.decide(look) is begun for _ in range(4))
    later = task.decide(look)
    assert not torch.equal(later.command, begun.command)
    camera.frame = first
    task.reset()
    again = task.decide(look)
    assert torch.equal(again.command, begun.command) and again.skill == begun.skill


def test_a_camera_that_stops_or_is_covered_ends_in_damping(
    save: Callable[..., Artifact], artifact: Artifact, deployed: DeployedBBC
) -> None:
    for spoil, fault in (
        (lambda camera: None, "stale depth: the last word of the source 'depth' is"),
        (
            lambda camera: setattr(camera, "frame", Frame(math.inf, np.zeros((480, 848), np.uint16))),
            "no pixel of the depth",
        ),
        (
            lambda camera: setattr(camera, "frame", Frame(math.inf, np.ones((848, 480), np.uint16))),
            "columns are swapped",
        ),
    ):
        clock, camera = ManualClock(), Camera()
        camera.frame = Frame(0.0, np.full((480, 848), 2000, np.uint16))
        control = SharedControl(deployed_student(save(), artifact, camera), 0.0)
        controller = Controller(FakeBus(clock), deployed, control, clock=clock)

        def alive(
            camera: Camera = camera, control: SharedControl = control, controller: Controller = controller
        ) -> Mode:
            control.heard(controller.clock.now())
            assert camera.frame is not None
            camera.frame = camera.frame._replace(time=controller.clock.now())
            return controller.step().mode

        controller.request(Mode.STAND_UP)
        while alive() is not Mode.READY:
            assert controller.fault is None
        controller.request(Mode.RUN)
        assert [alive() for _ in range(10)] == [Mode.RUN] * 10
        spoil(camera)
        for _ in range(20):
            control.heard(clock.now())
            controller.step()
        assert controller.mode is Mode.DAMPING and fault in str(controller.fault)


def test_a_person_corrects_it_and_gives_back(save: Callable[..., Artifact], artifact: Artifact) -> None:
    control = SharedControl(deployed_student(save(), artifact, StillImage(1.0)), 0.0)
    look = Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))
    own = control.decide(look)
    other = "1" if own.name != "walk" else "3"
    control.press(other)
    assert control.decide(look).name != own.name and control.chosen_by == "operator: behaviour"
    control.press("space")
    assert control.decide(look).name == own.name and set(control.sources()) == {"operator", "depth"}


def test_what_does_not_fit_is_refused(save: Callable[..., Artifact], artifact: Artifact) -> None:
    with pytest.raises(ArtifactError, match="expected a student of tsc_student"):
        torch_student(artifact)
    with pytest.raises(ArtifactError, match=r"images of image \[60, 106\], this code's camera has \[58, 87\]"):
        torch_student(save(camera=describe_camera() | {"image": [60, 106]}))
    with pytest.raises(ArtifactError, match="was trained on the BBC other, but the robot runs"):
        deployed_student(save(bbc="other"), artifact, StillImage(1.0))
    good = save()
    with pytest.raises(ArtifactError, match="not those of the expected network"):
        torch_student(replace(good, manifest=good.manifest | {"network": good.manifest["network"] | {"memory": 8}}))


def test_the_network_has_no_memory_of_its_own(student: RecurrentStudent) -> None:
    network, generator = StudentNetwork(student), torch.Generator().manual_seed(0)
    inputs = (
        torch.rand(1, 58, 87, generator=generator) - 0.5,
        torch.full((1, 1), 0.02),
        torch.randn(1, 45, generator=generator),
        torch.randn(1, 10, 45, generator=generator),
        torch.randn(1, student.memory.size, generator=generator),
    )
    with torch.no_grad():
        first, second = network(*inputs), network(*inputs)
        other = network(*inputs[:-1], torch.zeros(1, student.memory.size))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first[-1], other[-1])
