"""The controller at run time computes what training computes, by PyTorch and by onnxruntime."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.behaviour import INPUTS, BBCNetwork, DeployedBBC, onnx_network, torch_network
from agility_rl.deploy.commander import BehaviourCommand
from agility_rl.deploy.transport import RobotState
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.terminations import diverged
from agility_rl.go2 import constants, features
from agility_rl.modules import BasicBehaviourController


def state_of(env: LocomotionEnv) -> RobotState:
    """What the only robot of an environment would say."""
    simulator = env.simulator
    return replace(
        RobotState.standing(),
        quaternion=simulator.root_quaternion[0],
        angular_velocity=simulator.root_angular_velocity[0],
        joint_position=simulator.joint_position[0],
        joint_velocity=simulator.joint_velocity[0],
        foot_force=simulator.contact_force[0, list(constants.FOOT_GROUPS)],
        trunk_position=simulator.root_position[0],
    )


@pytest.mark.parametrize("behaviour", ["trot", "jump"])
def test_observations_and_actions_are_those_of_the_training(
    module: BasicBehaviourController, artifact: Artifact, behaviour: str
) -> None:
    deployed = DeployedBBC(torch_network(artifact), artifact, use_trunk_position=True)
    policy = module.deployable_policy()
    command = BehaviourCommand.of(behaviour, yaw_rate=0.3, shift=0.4)
    env = LocomotionEnv(1, simulator_options={"num_threads": 1}, resample_period=None, terminations=(diverged,), seed=3)
    env.set_commands(torch.tensor([command.skill]), command.command[None], torch.tensor([[command.shift]]))
    td = env.reset()
    for _ in range(60):  # the jump's window of 0.9 s is 45 steps
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = policy(td)
        proprioception = deployed.observe(state_of(env))
        action = deployed.act(command)
        assert (proprioception - td[keys.PROPRIOCEPTION][0]).abs().max() <= 1e-6
        assert (action - td[keys.ACTION][0]).abs().max() <= 1e-6
        assert (deployed.estimate - td[keys.ESTIMATE][0]).abs().max() <= 1e-6
        td = env.step(td)["next"]
    if behaviour == "jump":
        assert td[keys.PEAK] > 0.1
    env.close()


def test_a_reset_forgets_everything(deployed: DeployedBBC) -> None:
    trot = BehaviourCommand.of("trot")
    first = RobotState.standing()
    moved = replace(first, joint_velocity=torch.full((12,), 2.0), foot_force=torch.zeros(4))
    deployed.observe(first)
    expected = deployed.act(trot).clone()
    for _ in range(5):
        deployed.observe(moved)
        assert not torch.equal(deployed.act(trot), expected)
    deployed.reset()
    deployed.observe(first)
    assert torch.equal(deployed.act(trot), expected)


def test_without_a_measured_height_the_peak_is_the_highest_estimate(artifact: Artifact) -> None:
    heights = [0.3, 0.5, 0.4, *[0.35] * 50]
    seen: list[float] = []

    def network(proprioception, history, command, peak):
        seen.append(float(peak))
        step = len(seen) - 11  # ten calls warm up
        return torch.zeros(1, 12), torch.tensor([[heights[max(step, 0)], 0.0, 0.0, 0.0]])

    deployed = DeployedBBC(network, artifact)
    for index in range(len(heights)):
        deployed.observe(replace(RobotState.standing(), trunk_position=torch.full((3,), 9.0)))
        deployed.act(BehaviourCommand.of("jump" if index != 3 else "trot"))
    found = seen[10:]
    assert found[:5] == pytest.approx([0.2884, 0.3, 0.5, 0.0, 0.5]), "one step late, and only while jumping"
    assert found[46] == pytest.approx(0.5) and found[47] == pytest.approx(0.4), "45 steps are 0.9 s"


def test_feet_touch_when_they_did_one_step_earlier(deployed: DeployedBBC) -> None:
    contact = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "foot_contact")
    found = []
    for force in (3.0, 1.9, 1.9, 2.1):
        found.append(
            float(deployed.observe(replace(RobotState.standing(), foot_force=torch.full((4,), force)))[contact][0])
        )
    assert found == [0.5, 0.5, -0.5, 0.5]


def test_act_needs_an_observation(deployed: DeployedBBC) -> None:
    deployed.reset()
    with pytest.raises(RuntimeError, match=r"call observe\(state\) first"):
        deployed.act(BehaviourCommand.of("trot"))


def test_targets_are_those_of_the_manifest(deployed: DeployedBBC) -> None:
    target = deployed.target(torch.ones(12))
    assert target[:3].tolist() == pytest.approx([0.125, 0.9 + 0.25, -1.8 + 0.25])


def test_the_plain_network_is_differentiable_where_the_policy_is(module: BasicBehaviourController) -> None:
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.randn(3, *shape, generator=generator) for shape in ((45,), (10, 45), (11,), (1,))]
    action, _ = BBCNetwork(module)(*inputs)
    action.sum().backward()
    assert module.estimator.module.layers[0].weight.grad.abs().sum() > 0
    assert module.privileged_encoder.module.layers[0].weight.grad is None


def test_artifacts_of_another_kind_or_layout_are_refused(artifact: Artifact) -> None:
    other = replace(artifact, manifest={**artifact.manifest, "kind": "teacher"})
    with pytest.raises(ArtifactError, match="expected an artifact of kind 'bbc'"):
        torch_network(other)
    observed = artifact.manifest["observations"]
    turned = {**observed, "proprioception": observed["proprioception"][::-1]}
    with pytest.raises(ArtifactError, match="'proprioception' entry 0: the controller was trained with"):
        torch_network(replace(artifact, manifest={**artifact.manifest, "observations": turned}))
    with pytest.raises(ArtifactError, match="the weights are not those of the expected network"):
        torch_network(replace(artifact, manifest={**artifact.manifest, "network": {"hidden": [8]}}))
    with pytest.raises(ArtifactError, match="has no ONNX file beside the manifest"):
        onnx_network(artifact)


def test_an_altered_onnx_file_is_refused(artifact: Artifact) -> None:
    (artifact.folder / "policy.onnx").write_bytes(b"something else")
    entry = {"file": "policy.onnx", "sha256": "0" * 64, "weights_sha256": artifact.manifest["weights"]["sha256"]}
    with pytest.raises(ArtifactError, match="altered, or of another training; export it again"):
        onnx_network(replace(artifact, manifest={**artifact.manifest, "onnx": entry}))


def test_the_robot_needs_no_training_stack(repository: Path) -> None:
    code = "import sys, agility_rl.deploy, agility_rl.deploy.behaviour, agility_rl.deploy.loopback; "
    code += "print([name for name in ('torchrl', 'mujoco', 'matplotlib', 'mcap') if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
    assert INPUTS == ("proprioception", "history", "command", "peak")
