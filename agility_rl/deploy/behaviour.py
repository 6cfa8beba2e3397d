"""The Basic Behaviour Controller at run time: history, estimates and one network, by PyTorch or onnxruntime."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor, nn

from agility_rl import keys, rotations
from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.commander import BehaviourCommand
from agility_rl.deploy.networks import load_network
from agility_rl.deploy.onnx import onnx_session
from agility_rl.deploy.transport import RobotState
from agility_rl.go2 import constants, features
from agility_rl.modules import BasicBehaviourController
from agility_rl.modules.mlp import ConcatenatedMLP

Network = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""Proprioception [1, 45], history [1, 10, 45], command [1, 11], peak [1, 1] to action [1, 12] and estimate [1, 4]."""

INPUTS = (keys.PROPRIOCEPTION, keys.HISTORY, keys.COMMAND, keys.PEAK)
OUTPUTS = (keys.ACTION, keys.ESTIMATE)


class BBCNetwork(nn.Module):
    """Estimator, history encoder and mean action as one plain network, without TensorDicts: for the robot and ONNX.

    Computes what ``bbc.deployable_policy()`` computes with deterministic actions.

    Source: supplement S6.

    Args:
        bbc: trained controller, whose modules are shared, not copied.

    Example:
        >>> network = BBCNetwork(BasicBehaviourController(hidden=(8,)))
        >>> action, estimate = network(*example_inputs())
        >>> action.shape, estimate.shape
        (torch.Size([1, 12]), torch.Size([1, 4]))
    """

    def __init__(self, bbc: BasicBehaviourController) -> None:
        super().__init__()
        self.estimator: nn.Module = bbc.estimator.module
        self.history_encoder: nn.Module = bbc.history_encoder.module
        self.mean = cast(ConcatenatedMLP, bbc.actor.network.mean)
        self.order = [str(name) for name in self.mean.names]

    def forward(self, proprioception: Tensor, history: Tensor, command: Tensor, peak: Tensor) -> tuple[Tensor, Tensor]:
        """Action ``[*B, 12]`` and estimate ``[*B, 4]``."""
        estimate = self.estimator(proprioception)
        inputs = {
            keys.PROPRIOCEPTION: proprioception,
            keys.ESTIMATE: estimate,
            keys.LATENT: self.history_encoder(history),
            keys.COMMAND: command,
            keys.PEAK: peak,
        }
        return self.mean(*(inputs[name] for name in self.order)), estimate


def example_inputs(batch: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Zeros in the shapes that the network takes."""
    size = features.NUM_PROPRIOCEPTION
    return (
        torch.zeros(batch, size),
        torch.zeros(batch, features.HISTORY, size),
        torch.zeros(batch, 11),
        torch.zeros(batch, 1),
    )


def torch_network(artifact: Artifact) -> BBCNetwork:
    """The network of an artifact, by PyTorch.

    Raises:
        ArtifactError: if the artifact holds other weights, or was trained with another layout of what it sees.
    """
    if artifact.manifest["kind"] != "bbc" or "network" not in artifact.manifest:
        raise ArtifactError(
            f"{artifact.folder}: expected an artifact of kind 'bbc' with an entry 'network', got kind "
            f"{artifact.manifest['kind']!r}; export it with recipes/export.py"
        )
    artifact.check_layout(keys.PROPRIOCEPTION, features.PROPRIOCEPTION_LAYOUT)
    artifact.check_layout(keys.EXPLICIT, features.EXPLICIT_LAYOUT)
    bbc = load_network(BasicBehaviourController, artifact)
    return BBCNetwork(bbc.eval().requires_grad_(False))


def onnx_network(artifact: Artifact) -> Network:
    """The network of an artifact, by onnxruntime on one thread.

    Raises:
        ArtifactError: if the artifact has no ONNX file, or it is not the one that was checked at the export.
        ImportError: if onnxruntime is not installed.
    """
    artifact.check_layout(keys.PROPRIOCEPTION, features.PROPRIOCEPTION_LAYOUT)
    artifact.check_layout(keys.EXPLICIT, features.EXPLICIT_LAYOUT)
    return cast(Network, onnx_session(artifact, INPUTS, OUTPUTS))


class DeployedBBC:
    """Joint targets of one robot, with the memory that the training environment kept for it.

    In every control step call :meth:`observe`, then :meth:`act`. After :meth:`reset` the history is filled with copies
    of the first observation and the last action is zero, as at the start of an episode. The highest trunk of the last
    0.9 s, which the policy sees while jumping, is taken from the trunk position if the robot's state has one and
    ``use_trunk_position`` is set; otherwise from the network's own estimates, the last of them one step old, and at
    first from the height of a robot that stands.

    Source: method notes, section 3.2.

    Args:
        network: :func:`torch_network` or :func:`onnx_network`.
        artifact: manifest of the same controller.
        use_trunk_position: trust the state's trunk height over the estimate.

    Attributes:
        period: control step [s].
        stiffness: ``[12]`` [N m/rad].
        damping: ``[12]`` [N m s/rad].
        estimate: ``[4]`` of the last step (:data:`agility_rl.keys.ESTIMATE`).

    Example:
        >>> import tempfile
        >>> from agility_rl.deploy.artifact import build_manifest
        >>> bbc = BasicBehaviourController(hidden=(8,))
        >>> manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02, network=bbc.settings)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     artifact = Artifact.save(folder, bbc.state_dict(), manifest)
        >>> deployed = DeployedBBC(torch_network(artifact), artifact)
        >>> _ = deployed.observe(RobotState.standing())
        >>> deployed.act(BehaviourCommand.of("trot")).shape
        torch.Size([12])
    """

    def __init__(self, network: Network, artifact: Artifact, *, use_trunk_position: bool = False) -> None:
        manifest = artifact.manifest
        self.network, self.manifest, self.use_trunk_position = network, manifest, use_trunk_position
        self.joint_names: tuple[str, ...] = tuple(manifest["joint_names"])
        self.period = float(manifest["control_period"])
        self.default_pose, self.action_scale, self.stiffness, self.damping = (
            torch.tensor(manifest[name]) for name in ("default_pose", "action_scale", "stiffness", "damping")
        )
        self._window = round(features.PEAK_WINDOW / self.period)
        with torch.inference_mode():
            for _ in range(10):  # the first calls allocate and compile
                network(*example_inputs())
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next observation is the first."""
        self.action = torch.zeros(constants.NUM_JOINTS)
        self.estimate = torch.zeros(features.NUM_EXPLICIT)
        self._history: Tensor | None = None
        self._touched: Tensor | None = None
        self._heights: deque[float] = deque(maxlen=self._window)

    @torch.inference_mode()
    def observe(self, state: RobotState) -> Tensor:
        """Take the state of a new control step; returns the proprioception ``[45]``."""
        roll, pitch, _ = rotations.to_euler(state.quaternion)
        touching = state.foot_force > features.FOOT_CONTACT_FORCE
        touched = touching if self._touched is None else touching | self._touched
        present = features.proprioception(
            torch.stack((roll, pitch), -1),
            state.angular_velocity,
            state.joint_position,
            state.joint_velocity,
            self.action,
            touched,
        ).clamp(-features.OBSERVATION_LIMIT, features.OBSERVATION_LIMIT)
        if self._history is None:
            self._history = present.expand(features.HISTORY, -1).clone()
        else:
            self._history = torch.cat((self._history[1:], present[None]))
        self._touched = touching
        if self.use_trunk_position and state.trunk_position is not None:
            self._heights.append(float(state.trunk_position[2]))
        return present

    @torch.inference_mode()
    def act(self, command: BehaviourCommand) -> Tensor:
        """Action ``[12]`` for the observation just taken.

        Raises:
            RuntimeError: before the first observation.
        """
        if self._history is None:
            raise RuntimeError("act() needs an observation: call observe(state) first, in every control step")
        peak = max(self._heights, default=constants.STANDING_HEIGHT) if command.jumping else 0.0
        action, estimate = self.network(
            self._history[-1:], self._history[None], command.vector()[None], torch.tensor([[peak]])
        )
        self.action, self.estimate = action[0], estimate[0]
        if not self.use_trunk_position:
            self._heights.append(float(self.estimate[0]))
        return self.action

    def target(self, action: Tensor) -> Tensor:
        """Joint angles ``[12]`` [rad] that an action asks for."""
        return self.default_pose + self.action_scale * action
