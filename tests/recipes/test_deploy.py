"""A short run in real time against the robot's process, and what it leaves behind."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from agility_rl.collectors import RobotLog
from agility_rl.deploy import BehaviourCommand, Mode, RobotState
from agility_rl.deploy.controller import StepRecord
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.lcm import address, connect
from agility_rl.deploy.transport import FakeBus, JointCommand
from agility_rl.deploy.unitree_messages import FootCalibration
from agility_rl.go2 import constants
from agility_rl.record import EpisodeRecorder, read_episode

Module = Callable[[str], ModuleType]


@pytest.fixture
def deploy(module: Module) -> ModuleType:
    return module("deploy")


def test_a_run_is_recorded_as_a_robot_log(
    deploy: ModuleType, untrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # However slow the machine that runs the tests, its deadlines are not what is tested here.
    patient = {"state_age": 600.0, "operator_age": 600.0, "missed_deadlines": 10**9}
    path = tmp_path / "run.mcap"
    cfg = deploy.Config(
        untrained, seconds=2.0, skill="walk", output=path, pose="standing", friction_loss=0.0, **patient
    )
    begin = time.monotonic()
    assert deploy.main(cfg) == 0, capsys.readouterr().out
    assert time.monotonic() - begin > 2.5 + 0.5 + 2.0 + 1.0 + 1.5, "in real time"
    printed = capsys.readouterr().out
    assert "run        requested" in printed and "control steps:" in printed and "p99" in printed
    log, episode = RobotLog.load(path), read_episode(path)
    running = episode["controller/estimated_height"] != 0.0
    steps = (~log.start).sum()
    assert 0 < len(log.transitions()) == steps < running.sum(), "only the behaviour controller's own steps count"
    assert bool(running[~log.start].all())
    assert episode["timing/duration"].min() > 0.0 and (episode["timing/time"].diff() > 0).all()
    assert 0.2 < episode["root_position"][running][:, 2].median() < 0.35


def test_the_same_controller_drives_a_robot_that_speaks_dds(
    deploy: ModuleType, untrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cyclonedds", reason="needs the extra dds")
    patient = {"state_age": 600.0, "operator_age": 600.0, "missed_deadlines": 10**9}
    domain = 1 + os.getpid() % 100  # another run at the same time must not command this robot
    path = tmp_path / "run.mcap"
    cfg = deploy.Config(
        untrained, transport="dds", domain=domain, seconds=1.0, skill="walk", output=path, pose="standing", **patient
    )
    assert deploy.main(cfg) == 0, capsys.readouterr().out
    assert "run        requested" in capsys.readouterr().out
    log, episode = RobotLog.load(path), read_episode(path)
    assert len(log.transitions()) > 0
    assert episode["root_position"][:, :2].abs().max() == 0.0, "nothing tells where the robot is, as on a real one"
    standing = episode["joint_position"][episode["timing/time"] < 0.1].mean(0)
    assert standing[constants.JOINT_NAMES.index("FL_calf_joint")] < -1.0, "our joints, in our order"


def test_and_over_lcm_a_robot_that_is_softer_than_it_is_told(
    deploy: ModuleType, module: Module, untrained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("lcm", reason="needs the extra lcm")
    record = module("record_log")
    truth = record.Truth(**{f"{link}_stiffness": 0.75 for link in constants.LINKS})
    soft = record.main(record.Config(log=tmp_path / "t.csv", steps=200, truth=truth)).with_suffix(".truth.json")
    patient = {"state_age": 600.0, "operator_age": 600.0, "missed_deadlines": 10**9}
    path, domain = tmp_path / "run.mcap", 1 + os.getpid() % 900
    try:
        connect(address(domain))
    except ConnectionError as error:
        pytest.skip(str(error))
    cfg = deploy.Config(
        untrained, transport="lcm", domain=domain, simulator=soft, seconds=1.0, output=path, pose="standing", **patient
    )
    assert deploy.main(cfg) == 0, capsys.readouterr().out
    assert "run        requested" in capsys.readouterr().out
    log, episode = RobotLog.load(path), read_episode(path)
    assert len(log.transitions()) > 0
    first = int((episode["controller/estimated_height"] != 0.0).int().argmax())  # until then it stood
    position, torque = (episode[name][first - 15 : first].mean(0) for name in ("joint_position", "joint_torque"))
    found = torque / (torch.tensor(constants.DEFAULT_POSE) - position)
    knees = [constants.JOINT_NAMES.index(f"{leg}_calf_joint") for leg in constants.LEGS]
    assert found[knees].tolist() == pytest.approx([30.0] * 4, rel=0.05), "three quarters of what it is told"


def test_a_student_decides_by_what_it_sees_of_a_course(
    deploy: ModuleType,
    untrained: Path,
    make_student: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "run.mcap"
    patient = {"state_age": 600.0, "operator_age": 600.0, "depth_age": 600.0, "missed_deadlines": 10**9}
    limits = {"seconds": 1.0, "pose": "standing", "friction_loss": 0.0}
    cfg = deploy.Config(untrained, task=make_student(), course="bar_jump", output=path, **limits, **patient)
    status = deploy.main(cfg)
    printed = capsys.readouterr().out
    assert "run        requested" in printed, printed
    assert status == 0 or "fault: tilt" in printed, "an untrained robot may fall"
    episode = read_episode(path)
    running = episode["controller/estimated_height"] != 0.0
    assert bool(running.any()) and len(episode["perceived/heading"][running].unique()) > 1, "images reach it"
    assert len(episode["perceived/heading"][~running].unique()) <= 2, "it looks only while it runs"
    assert len(RobotLog.load(path).transitions()) > 0


def test_a_student_needs_a_camera(
    deploy: ModuleType, untrained: Path, make_student: Callable[..., Path], tmp_path: Path, monkeypatch: Any
) -> None:
    student = make_student()
    with pytest.raises(ValueError, match="a student looks by a camera: the simulated robot of"):
        deploy.main(deploy.Config(untrained, task=student, transport="dds", output=tmp_path / "run.mcap"))
    with pytest.raises(ValueError, match="expected --camera only with --task: nothing else looks"):
        deploy.main(deploy.Config(untrained, camera="mine:Eye", output=tmp_path / "run.mcap"))
    monkeypatch.chdir(tmp_path)
    eye = "class Eye:\n    def latest(self): return None\n"
    (tmp_path / "mine.py").write_text(f"class Blind: ...\n{eye}def Far(address): ...\n")
    load_camera = deploy.load_camera
    assert load_camera("mine:Eye").latest() is None
    for text, message in (
        ("mine:Blind", "mine:Blind made Blind, expected something with latest()"),
        ("mine:Far", "missing 1 required positional argument: 'address'"),
        ("mine:Other", "expected MODULE:NAME of a class or function, got 'mine:Other'"),
        ("nowhere:Eye", "expected MODULE:NAME of a class or function, got 'nowhere:Eye'"),
        ("mine", "expected MODULE:NAME of a class or function, got 'mine'"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            load_camera(text)


def test_an_option_of_another_transport_is_named(deploy: ModuleType, untrained: Path, tmp_path: Path) -> None:
    for options, message in (
        ({"interface": "eth0"}, "--interface only with --transport dds, got --transport mujoco"),
        ({"ttl": 1}, "--ttl only with --transport lcm, got --transport mujoco"),
        ({"ttl": 1, "transport": "lcm", "simulator": tmp_path}, "--simulator only with a simulated robot, got a real"),
        ({"ttl": 1, "transport": "lcm", "course": "full"}, "--course only with a simulated robot, got a real"),
        ({"ttl": 1, "transport": "lcm", "sim_dt": 0.002}, "--sim-dt only with a simulated robot, got a real"),
        ({"transport": "lcm", "feet": FootCalibration(newtons_per_count=0.7)}, "--feet only with --transport dds, got"),
        ({"domain": 7}, "--domain only with --transport dds or lcm, got --transport mujoco"),
        ({"course": "full", "world": tmp_path}, "expected --course or --world, got both"),
        ({"ttl": 1, "transport": "lcm"}, "a script makes a real robot stand up and run at once: give --operator"),
    ):
        with pytest.raises(ValueError, match=message):
            deploy.main(deploy.Config(untrained, output=tmp_path / "run.mcap", **options))


def test_damping_goes_on_when_the_recorder_fails(
    deploy: ModuleType, untrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock()
    bus = FakeBus(clock)

    class FullDisk(deploy.Recorder):
        def __call__(self, step: StepRecord) -> None:
            super().__call__(step)
            if step.mode is Mode.RUN:
                raise OSError("no space left")

    monkeypatch.setattr(deploy, "connect", lambda *_: contextlib.nullcontext((bus, None)))
    monkeypatch.setattr(deploy, "Recorder", FullDisk)
    cfg = deploy.Config(untrained, output=tmp_path / "run.mcap")
    with pytest.raises(OSError, match="no space left"):
        deploy.drive(cfg, clock, lambda: False)
    last = bus.sent[-75:]
    assert all(bool((sent.damping > 0).all()) and not bool(sent.stiffness.any()) for sent in last), "1.5 s of damping"
    assert read_episode(tmp_path / "run.mcap")["start/value"].shape[0] > 100, "what was recorded until then is there"


def test_a_world_that_is_none_is_refused_before_the_robot_starts(
    deploy: ModuleType, untrained: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "world.xml"
    bad.write_text("<mujoco><worldbody><geom type='sponge'/></worldbody></mujoco>")
    for file in (bad, tmp_path / "missing.xml"):
        with pytest.raises(ValueError, match=f"{file.name}: expected an MJCF file of what stands around the robot"):
            deploy.main(deploy.Config(untrained, world=file, output=tmp_path / "run.mcap"))
    assert not (tmp_path / "run.mcap").exists()


def test_a_file_is_never_overwritten_and_a_bad_name_is_named(
    deploy: ModuleType, untrained: Path, tmp_path: Path
) -> None:
    taken = tmp_path / "taken.mcap"
    taken.write_bytes(b"mine")
    for path in (taken, tmp_path / "log.csv"):
        with pytest.raises(ValueError, match=r"a new file that ends in \.mcap"):
            deploy.main(deploy.Config(untrained, output=path))
    assert taken.read_bytes() == b"mine"
    (tmp_path / ".killed.mcap.incoming").touch()
    with pytest.raises(ValueError, match=r"a new file that ends in \.mcap"):
        deploy.main(deploy.Config(untrained, output=tmp_path / "killed.mcap"))
    with pytest.raises(ValueError, match="'gallop' is no behaviour"):
        deploy.main(deploy.Config(untrained, skill="gallop"))


def test_what_a_row_holds(deploy: ModuleType, untrained: Path, tmp_path: Path) -> None:
    bbc = deploy.Config(untrained).controller(untrained)
    state = replace(RobotState.standing(time=1.0), joint_velocity=torch.arange(12.0), foot_force=torch.zeros(4))
    hold = JointCommand(bbc.target(torch.full((12,), 0.5)), bbc.stiffness, bbc.damping)
    standing = StepRecord(1.01, Mode.STAND_UP, state, hold, None, None, None, False, 0.001, 0.0)
    action = torch.linspace(-1.0, 1.0, 12)
    moving = replace(standing, mode=Mode.RUN, action=action, behaviour=BehaviourCommand.of("trot", velocity_x=0.8))
    moving = replace(moving, estimate=torch.tensor([0.31, 0.0, 0.0, 0.0]))
    limp = replace(standing, mode=Mode.DAMPING, command=JointCommand.damped(3.0))
    path = tmp_path / "rows.mcap"
    with EpisodeRecorder(path, dt=0.02) as episode:
        recorder = deploy.Recorder(episode, bbc)
        recorder(replace(standing, state=None))
        for step in [standing, moving, replace(moving, continues=True), limp]:
            recorder(step)
    log, rows = RobotLog.load(path, min_steps=2), read_episode(path)
    assert log.start.tolist() == [True, True, False, True] and len(log.transitions()) == 1
    assert torch.allclose(log.action[0], torch.full((12,), 0.5), atol=1e-5), "held while standing up, in action units"
    assert torch.allclose(log.action[1], action, atol=1e-6) and not log.action[3].any()
    assert torch.equal(log.joint_velocity[0], torch.arange(12.0)) and log.linear_acceleration[0, 2] > 9.8
    assert rows["command/velocity_x"].tolist() == pytest.approx([0.0, 0.8, 0.8, 0.0])
    assert rows["root_position"][1].tolist() == pytest.approx([0.0, 0.0, 0.31]), (
        "the estimate, where nothing measures it"
    )
    assert rows["timing/state_age"].tolist() == pytest.approx([0.01] * 4) and not rows["foot_contact"].any()
    assert torch.allclose(log.joint_position[0], torch.tensor(constants.DEFAULT_POSE))
