"""One robot in plain MuJoCo: motors, poses, standing up, and agreement with the training environment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact
from agility_rl.deploy.behaviour import DeployedBBC, torch_network
from agility_rl.deploy.commander import BehaviourCommand, Operator
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.safety import SafetyLimits, pd_torque
from agility_rl.deploy.simulated import SimulatedBus, SimulatedRobot
from agility_rl.deploy.transport import JointCommand
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.terminations import diverged
from agility_rl.go2 import constants
from agility_rl.modules import BasicBehaviourController

PATIENT = SafetyLimits(source_age={"operator": 1e6})


def hold(position: torch.Tensor, stiffness: float = 40.0, damping: float = 1.0) -> JointCommand:
    return JointCommand(position, torch.full((12,), stiffness), torch.full((12,), damping))


def test_motors_follow_their_law() -> None:
    robot = SimulatedRobot()
    robot.reset("lying")
    generator = torch.Generator().manual_seed(0)
    position, stiffness, damping, velocity, torque = torch.rand(5, 12, generator=generator)
    command = JointCommand(position - 1.0, 10 * stiffness, damping, velocity, torque)
    robot.command(command)
    before = robot.state(0.0)
    robot.advance(robot.sim_dt)
    expected = pd_torque(command, before).clamp(
        -torch.tensor(constants.TORQUE_LIMIT), torch.tensor(constants.TORQUE_LIMIT)
    )
    assert torch.allclose(robot.state(0.0).joint_torque, expected, atol=1e-4)


def test_motors_may_be_stiffer_than_they_are_told() -> None:
    generator = torch.Generator().manual_seed(0)
    position, stiffness, damping, velocity, torque = torch.rand(5, 12, generator=generator)
    factor = torch.linspace(0.5, 2.0, 12)
    robot = SimulatedRobot(stiffness_factor=factor.tolist(), damping_factor=1.5)
    robot.reset("lying")
    robot.command(JointCommand(position - 1.0, 10 * stiffness, damping, velocity, torque))
    before = robot.state(0.0)
    robot.advance(robot.sim_dt)
    true = JointCommand(position - 1.0, 10 * stiffness * factor, 1.5 * damping, velocity, torque)
    limit = torch.tensor(constants.TORQUE_LIMIT)
    assert torch.allclose(robot.state(0.0).joint_torque, pd_torque(true, before).clamp(-limit, limit), atol=1e-4)


def test_without_commands_the_motors_damp() -> None:
    robot = SimulatedRobot(command_timeout=0.1)
    robot.command(hold(torch.tensor(constants.DEFAULT_POSE)))
    robot.advance(0.1)
    assert robot.model.actuator_gainprm[0, 0] == constants.STIFFNESS
    robot.advance(0.1)
    assert robot.model.actuator_gainprm[:, 0].tolist() == [0.0] * 12
    robot.advance(2.0)
    assert float(robot.data.qpos[2]) < 0.2, "it has sunk down"


@pytest.mark.parametrize("sim_dt", [0.001, 0.003, 0.005])
def test_time_passes_as_it_should_whatever_the_physics_step(sim_dt: float) -> None:
    robot = SimulatedRobot(sim_dt=sim_dt)
    for call in range(1, 16):
        robot.advance(0.002)
        assert 0.002 * call - sim_dt < robot.time <= 0.002 * call + 1e-9
    assert robot.time == pytest.approx(0.03)
    robot.advance(0.001)
    robot.reset()
    robot.advance(sim_dt)
    assert robot.time == pytest.approx(sim_dt), "what was owed is forgotten"


def test_a_physics_step_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"a physics step above 0 s, got 0\.0"):
        SimulatedRobot(sim_dt=0.0)


def test_an_unknown_pose_is_named() -> None:
    with pytest.raises(ValueError, match="expected the pose standing or lying, got 'sitting'"):
        SimulatedRobot().reset("sitting")


@pytest.fixture
def still(artifact: Artifact) -> DeployedBBC:
    """A controller that asks for the default pose."""
    return DeployedBBC(lambda *inputs: (torch.zeros(1, 12), torch.zeros(1, 4)), artifact)


def test_it_stands_up_from_the_ground_runs_and_sinks_down(still: DeployedBBC) -> None:
    bus = SimulatedBus(SimulatedRobot(friction_loss=0.0))
    bus.robot.reset("lying")
    bus.robot.advance(0.5)
    assert bus.robot.data.qpos[2] < 0.12
    controller = Controller(bus, still, Operator(BehaviourCommand.of("walk"), 0.0), limits=PATIENT, clock=bus)
    controller.request(Mode.STAND_UP)
    for _ in range(130):
        record = controller.step()
    assert controller.mode is Mode.READY, list(controller.events)
    assert float(record.state.trunk_position[2]) > 0.22 and float(record.state.foot_force.min()) > 10.0
    controller.request(Mode.RUN)
    for _ in range(20):
        assert controller.step().mode is Mode.RUN
    heights = []
    controller.request(Mode.DAMPING)
    for _ in range(100):
        heights.append(float(controller.step().state.trunk_position[2]))
    assert heights[-1] < 0.16 and min(np.diff(heights)) > -0.02, "slower than 1 m/s all the way down"
    assert controller.deadlines.misses == 0


def same_start(env: LocomotionEnv, robot: SimulatedRobot) -> None:
    qpos = env.simulator._qpos[0].copy()
    start = JointCommand(torch.from_numpy(qpos[7:]).float(), torch.full((12,), 40.0), torch.ones(12))
    robot.place(qpos, env.simulator._qvel[0].copy(), start)


@pytest.mark.parametrize("behaviour", BEHAVIOURS)
def test_sim_to_sim(repository: Path, behaviour: str) -> None:
    """The shipped controller in plain MuJoCo acts as in the training environment, from the same state."""
    artifact = Artifact.load(repository / "pretrained" / "bbc", kind="bbc")
    bbc = BasicBehaviourController(**artifact.manifest["network"])
    bbc.load_state_dict(artifact.state)
    policy = bbc.deployable_policy()
    command = BehaviourCommand.of(behaviour)
    options = {"num_threads": 1, "friction_loss": 0.0}
    env = LocomotionEnv(1, simulator_options=options, resample_period=None, terminations=(diverged,), seed=5)
    env.set_commands(torch.tensor([command.skill]), command.command[None])
    td = env.reset()

    bus = SimulatedBus(SimulatedRobot(sim_dt=constants.SIM_DT, friction_loss=0.0, command_timeout=None))
    deployed = DeployedBBC(torch_network(artifact), artifact, use_trunk_position=True)
    controller = Controller(bus, deployed, Operator(command, 0.0), limits=PATIENT, clock=bus)
    controller.mode = Mode.READY
    same_start(env, bus.robot)
    controller.request(Mode.RUN)
    worst = 0.0
    for _ in range(50):
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = policy(td)
        record = controller.step()
        assert record.mode is Mode.RUN, list(controller.events)
        worst = max(worst, float((record.action - td[keys.ACTION][0]).abs().max()))
        td = env.step(td)["next"]
    env.close()
    assert worst <= 1e-4, worst
    assert float(record.state.trunk_position[0].abs() + record.state.trunk_position[1].abs()) > 0.05, "it did move"


def test_the_bus_keeps_time_with_the_physics(still: DeployedBBC) -> None:
    bus = SimulatedBus(SimulatedRobot())
    bus.sleep_until(0.0205)
    assert bus.now() == pytest.approx(bus.robot.time) and bus.now() == pytest.approx(0.02, abs=1e-3)
    state = bus.read()
    assert state.time == bus.now() and bus.read().sequence == state.sequence + 1
    assert torch.allclose(state.linear_acceleration.norm(), torch.tensor(9.81), rtol=0.7)
    assert replace(state, time=0.0).quaternion.shape == (4,) and bus.other_commanders() == ()
