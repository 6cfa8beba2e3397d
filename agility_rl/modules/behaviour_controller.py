"""The Basic Behaviour Controller: estimator, encoders and actor in one module."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import nn

from agility_rl import keys
from agility_rl.behaviours import COMMANDS, NUM_BEHAVIOURS
from agility_rl.go2 import features
from agility_rl.modules.actor import GaussianActor
from agility_rl.modules.adaptation import HistoryEncoder, PrivilegedEncoder
from agility_rl.modules.estimator import StateEstimator

NUM_COMMAND = len(COMMANDS) + 1 + NUM_BEHAVIOURS
"""Five commands, shift, one-hot skill."""
NUM_LATENT = 29
"""Size of the latent physical parameters (released code)."""


class BasicBehaviourController(nn.Module):
    """Joint targets from measured and estimated proprioception, latent physical parameters and commands.

    The same actor is driven in two ways: :meth:`privileged_policy` encodes the simulator's true parameters (training),
    :meth:`deployable_policy` infers them from the history of what the robot measured.

    Source: supplement S6; sizes: method notes, section 3.1.

    Keys read: ``proprioception`` [*B, 45], ``command`` [*B, 11], ``peak`` [*B, 1], and ``privileged`` [*B, 29] or
    ``history`` [*B, 10, 45].
    Keys written: ``estimate`` [*B, 4], ``latent`` [*B, 29], ``loc``, ``scale``, ``action`` [*B, 12],
    ``action_log_prob`` [*B].

    Args:
        hidden: sizes of the actor's hidden layers.
        initial_std: standard deviation of the actions at the start.
        min_std: its floor.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> bbc = BasicBehaviourController()
        >>> td = TensorDict({"proprioception": torch.zeros(2, 45), "history": torch.zeros(2, 10, 45)}, [2])
        >>> td["command"], td["peak"] = torch.zeros(2, 11), torch.zeros(2, 1)
        >>> bbc.deployable_policy()(td)["action"].shape
        torch.Size([2, 12])
    """

    def __init__(self, hidden: Sequence[int] = (512, 256, 128), initial_std: float = 1.0, min_std: float = 0.1) -> None:
        super().__init__()
        self.settings: dict[str, Any] = {"hidden": list(hidden), "initial_std": initial_std, "min_std": min_std}
        self.estimator = StateEstimator(features.NUM_PROPRIOCEPTION, features.NUM_EXPLICIT)
        self.privileged_encoder = PrivilegedEncoder(features.NUM_PRIVILEGED, NUM_LATENT)
        self.history_encoder = HistoryEncoder(features.NUM_PROPRIOCEPTION, out_features=NUM_LATENT)
        inputs = {
            keys.PROPRIOCEPTION: features.NUM_PROPRIOCEPTION,
            keys.ESTIMATE: features.NUM_EXPLICIT,
            keys.LATENT: NUM_LATENT,
            keys.COMMAND: NUM_COMMAND,
            keys.PEAK: 1,
        }
        self.actor = GaussianActor(
            sum(inputs.values()), in_keys=list(inputs), hidden=hidden, initial_std=initial_std, min_std=min_std
        )

    def privileged_policy(self) -> TensorDictSequential:
        """Policy for roll-outs in training: estimator, privileged encoder, actor."""
        return TensorDictSequential(self.estimator, self.privileged_encoder, self.actor)

    def deployable_policy(self) -> TensorDictSequential:
        """Policy that reads only what the robot has: estimator, history encoder, actor."""
        return TensorDictSequential(self.estimator, self.history_encoder, self.actor)

    def trained_actor(self) -> ProbabilisticTensorDictSequential:
        """Privileged encoder and actor, as a PPO loss takes them; the estimate is an input, so PPO does not move it."""
        return ProbabilisticTensorDictSequential(self.privileged_encoder, *self.actor)
