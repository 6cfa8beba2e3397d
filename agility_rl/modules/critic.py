"""The state-value network."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule

from agility_rl.keys import COMMAND, EXPLICIT, HISTORY, PEAK, PRIVILEGED, PROPRIOCEPTION
from agility_rl.modules.mlp import ConcatenatedMLP


class Critic(TensorDictModule):
    """Estimate the discounted return from everything the simulator knows.

    Source: sizes and inputs (true state, raw privileged quantities, history): released code (method notes, sections
    3.1 and 3.2); the critic stays in the simulator, so it need not see what the robot sees.

    Keys read:
        proprioception, explicit, privileged, history, command, peak (see :mod:`agility_rl.keys`), or ``in_keys``
    Keys written:
        state_value  float32 ``[*B, 1]``  discounted sum of rewards

    Args:
        in_features: size of all inputs together, sequences flattened.
        in_keys: keys of the inputs.
        hidden: size of every hidden layer (ELU).
        sequence_keys: inputs that end in ``[T, F]``; they are flattened.
        out_key: key of the value.

    Raises:
        ValueError: if the inputs do not have ``in_features`` entries (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> critic = Critic(45 + 10 * 45, in_keys=["proprioception", "history"])
        >>> td = TensorDict({"proprioception": torch.zeros(8, 45), "history": torch.zeros(8, 10, 45)}, batch_size=[8])
        >>> critic(td)["state_value"].shape
        torch.Size([8, 1])
    """

    def __init__(
        self,
        in_features: int,
        *,
        in_keys: Sequence[NestedKey] = (PROPRIOCEPTION, EXPLICIT, PRIVILEGED, HISTORY, COMMAND, PEAK),
        hidden: Sequence[int] = (512, 256, 128),
        sequence_keys: Sequence[NestedKey] = (HISTORY,),
        out_key: NestedKey = "state_value",
    ) -> None:
        network = ConcatenatedMLP(in_keys, in_features, hidden, 1, sequence_keys=sequence_keys)
        super().__init__(network, in_keys=list(in_keys), out_keys=[out_key])
