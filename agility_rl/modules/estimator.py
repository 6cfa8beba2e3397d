"""The estimator of what the robot cannot measure: trunk height and linear velocity."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule

from agility_rl.keys import ESTIMATE, HISTORY, PROPRIOCEPTION
from agility_rl.modules.mlp import ConcatenatedMLP


class StateEstimator(TensorDictModule):
    """Estimate trunk height and base-frame velocity from measured proprioception.

    Source: section S6, "estimated proprioception" by a two-layer MLP of sizes {128, 64}; ELU and linear output:
    released code (method notes, section 3.1).

    Keys read:
        proprioception  float32 ``[*B, P]``
    Keys written:
        estimate        float32 ``[*B, 4]``  height [m], base-frame velocity x 0.5 [m/s]

    Args:
        in_features: size of all inputs together.
        out_features: size of the estimate.
        in_keys: keys of the inputs.
        hidden: size of every hidden layer (ELU).
        sequence_keys: inputs that end in ``[T, F]``; they are flattened.
        out_key: key of the estimate.

    Raises:
        ValueError: if the inputs do not have ``in_features`` entries (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"proprioception": torch.zeros(8, 45)}, batch_size=[8])
        >>> StateEstimator(45)(td)["estimate"].shape
        torch.Size([8, 4])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int = 4,
        *,
        in_keys: Sequence[NestedKey] = (PROPRIOCEPTION,),
        hidden: Sequence[int] = (128, 64),
        sequence_keys: Sequence[NestedKey] = (HISTORY,),
        out_key: NestedKey = ESTIMATE,
    ) -> None:
        network = ConcatenatedMLP(in_keys, in_features, hidden, out_features, sequence_keys=sequence_keys)
        super().__init__(network, in_keys=list(in_keys), out_keys=[out_key])
