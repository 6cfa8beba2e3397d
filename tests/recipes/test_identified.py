"""Simulators read from files: what is drawn from them is what the file says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.deploy.simulated import SimulatedRobot
from agility_rl.deploy.transport import JointCommand
from agility_rl.envs.randomization import sample_parameters

Module = Callable[[str], ModuleType]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A search over two gains whose Gaussian is known: medians 40 and 2, both strongly correlated."""
    ranges = {
        "hip_stiffness": {"low": 10.0, "high": 160.0, "scale": "log"},
        "calf_damping": {"low": 0.0, "high": 4.0, "scale": "linear"},
    }
    content = {
        "parameters": {
            "hip_stiffness": {"mean": 40.0, "unit": "N m/rad"},
            "calf_damping": {"mean": 2.0, "unit": "N m s/rad"},
        },
        "model": {"friction_loss": 0.1},
        "search": {"mean": [0.5, 0.5], "covariance": [[0.01, 0.009], [0.009, 0.01]], "ranges": ranges},
    }
    (tmp_path / "result.json").write_text(json.dumps(content))
    return tmp_path / "result.json"


def test_a_result_is_drawn_from_its_gaussian(module: Module, result: Path, generator: torch.Generator) -> None:
    simulator = module("identified").load_simulator(result.parent)
    assert simulator.model == {"friction_loss": 0.1} and "hip_stiffness 40 N m/rad" in simulator.text
    fields = simulator.draw(20000, generator)
    stiffness, damping = fields["stiffness"], fields["damping"]
    assert (stiffness[:, [1, 2, 4]] == 40.0).all() and (damping[:, [0, 1, 3]] == 1.0).all()  # not searched: nominal
    assert "friction_loss" not in fields, "the model has it"
    assert torch.equal(stiffness[:, 0], stiffness[:, 9]) and torch.equal(damping[:, 2], damping[:, 11])
    # u = log(x / 10) / log 16 has mean 0.5 and deviation 0.1
    u = (stiffness[:, 0] / 10.0).log() / torch.tensor(16.0).log()
    assert u.mean().item() == pytest.approx(0.5, abs=0.003) and u.std().item() == pytest.approx(0.1, rel=0.03)
    v = damping[:, 2] / 4.0
    assert torch.corrcoef(torch.stack((u, v)))[0, 1].item() == pytest.approx(0.9, abs=0.01)


def test_joints_that_were_not_searched_keep_the_friction_of_the_log(
    module: Module, result: Path, generator: torch.Generator
) -> None:
    content = json.loads(result.read_text())
    content["parameters"] = {"hip_friction_loss": {"mean": 0.3, "unit": "N m"}}
    content["search"] = {
        "mean": [0.5],
        "covariance": [[0.0]],
        "ranges": {"hip_friction_loss": {"low": 0.1, "high": 0.5, "scale": "linear"}},
    }
    result.write_text(json.dumps(content))
    friction = module("identified").load_simulator(result).draw(3, generator)["friction_loss"]
    torch.testing.assert_close(friction[0], torch.tensor([0.3, 0.1, 0.1] * 4))


def test_the_robot_is_told_its_own_gains(module: Module, result: Path, generator: torch.Generator) -> None:
    randomization = module("identified").load_simulator(result).randomization
    fields, privileged = sample_parameters(5, randomization, generator)
    assert "action_delay" not in fields
    torch.testing.assert_close(privileged[:, 5:17], fields["stiffness"] / 40.0 - 1.0)
    torch.testing.assert_close(privileged[:, 17:], fields["damping"] - 1.0)
    assert (privileged[:, :4] == 0).all() and (privileged[:, 4] == 1).all()


def test_a_truth_is_one_simulator(module: Module, untrained: Path, tmp_path: Path, generator: torch.Generator) -> None:
    record = module("record_log")
    truth = record.Truth(hip_stiffness=1.5, ground_friction=0.5)
    record.main(record.Config(log=tmp_path / "t.csv", steps=200, truth=truth, contact_time=0.04, cone="elliptic"))
    simulator = module("identified").load_simulator(tmp_path / "t.truth.json")
    assert simulator.model == {"friction_loss": 0.2, "contact_time": 0.04, "cone": "elliptic"}
    fields = simulator.draw(3, generator)
    assert (fields["stiffness"][:, ::3] == 60.0).all() and (fields["stiffness"][:, 1::3] == 40.0).all()
    assert (fields["ground_friction"] == 0.5).all()
    rollouts = module("rollouts")
    states = rollouts.load_motion(rollouts.MotionConfig(), {}, 0).start_states(0)
    env = rollouts.make_env(2, rollouts.load_controller(untrained), states, simulator)
    env.reset()
    assert env.simulator.model.geom("floor").solref[0] == 0.04
    assert (env.simulator.parameter("stiffness")[:, 0] == 60.0).all()
    env.close()


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "no file"), ("{", "damaged"), ("{}", "no result of easi.py"), ('{"parameters": {"x": 1}}', "no result")],
)
def test_bad_files_are_refused(module: Module, tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "result.json").write_text(text)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        module("identified").load_simulator(tmp_path / "result.json")


def test_one_robot_has_the_gains_of_the_file(module: Module, result: Path, untrained: Path, tmp_path: Path) -> None:
    record = module("record_log")
    truth = record.Truth(hip_stiffness=1.25, calf_damping=0.5)
    cfg = record.Config(log=tmp_path / "t.csv", steps=200, truth=truth, contact_time=0.03)
    file = record.main(cfg).with_suffix(".truth.json")
    commanded = [40.0] * 12, [2.0] * 12
    options = module("identified").load_simulator(file).one_robot(*commanded)
    assert options["stiffness_factor"] == [1.25, 1.0, 1.0] * 4
    assert options["damping_factor"] == [0.5, 0.5, 0.25] * 4, "nominal is 1, and 2 is commanded"
    assert options["contact_time"] == 0.03 and options["cone"] == "pyramidal"
    robot = SimulatedRobot(**options)
    robot.command(JointCommand(torch.zeros(12), *(torch.tensor(values) for values in commanded)))
    assert robot.model.actuator_gainprm[:3, 0].tolist() == [50.0, 40.0, 40.0]
    assert robot.model.actuator_biasprm[:3, 2].tolist() == [-1.0, -1.0, -0.5]
    content = json.loads(file.read_text())
    open_damping = {name: entry for name, entry in content["parameters"].items() if "stiffness" in name}
    file.write_text(json.dumps({**content, "parameters": open_damping}))
    options = module("identified").load_simulator(file).one_robot(*commanded)
    assert options["stiffness_factor"] == [1.25, 1.0, 1.0] * 4 and options["damping_factor"] == [0.5] * 12
    content["parameters"]["trunk_mass_offset"] = {"value": 1.0, "unit": "kg", "multiple": None}
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"stiffness and damping only, got \['.*mass.*'\]"):
        module("identified").load_simulator(file).one_robot(*commanded)
