"""Multilayer perceptrons over concatenated TensorDict entries: the body of actor, critic, estimator and encoders.

Source: Fu et al. 2025, section S6 (sizes); activations and zeroed biases: released code (method notes, section 3.1).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from agility_rl.keys import HISTORY


def mlp(
    in_features: int,
    hidden: Sequence[int],
    out_features: int | None = None,
    *,
    activation: type[nn.Module] = nn.ELU,
) -> nn.Sequential:
    """Build linear layers with an activation after each hidden one; the output layer, if any, stays linear.

    Source: section S6; biases start at zero as in the released code.

    Args:
        in_features: size of the input.
        hidden: size of every hidden layer, each followed by ``activation``.
        out_features: size of a last linear layer; ``None`` ends with the last hidden activation.
        activation: class of the activation, built without arguments.

    Raises:
        ValueError: if a size is not positive, or no layer is asked for.

    Example:
        >>> mlp(3, (8, 4), 2)(torch.zeros(5, 3)).shape
        torch.Size([5, 2])
    """
    sizes = [in_features, *hidden] + ([] if out_features is None else [out_features])
    if len(sizes) < 2 or any(size < 1 for size in sizes):
        raise ValueError(
            f"an MLP needs positive layer sizes and at least one layer, got in_features={in_features}, "
            f"hidden={tuple(hidden)}, out_features={out_features}"
        )
    layers: list[nn.Module] = []
    for index, (size_in, size_out) in enumerate(itertools.pairwise(sizes)):
        linear = (nn.Linear if index < len(hidden) else OutputLinear)(size_in, size_out)
        nn.init.zeros_(linear.bias)
        layers.append(linear)
        if index < len(hidden):
            layers.append(activation())
    return nn.Sequential(*layers)


class OutputLinear(nn.Linear):
    """A linear layer that computes in float32 inside ``torch.autocast`` too.

    A mean, value or logit rounded to bfloat16's 8 bits blurs what is made of it: distributions, ratios, advantages.

    Example:
        >>> with torch.autocast("cpu", torch.bfloat16):
        ...     nn.Linear(3, 2)(torch.zeros(1, 3)).dtype, OutputLinear(3, 2)(torch.zeros(1, 3)).dtype
        (torch.bfloat16, torch.float32)
    """

    def forward(self, input: Tensor) -> Tensor:
        """``[*B, out_features]``, float32."""
        if not torch.is_autocast_enabled(input.device.type):
            return super().forward(input)
        with torch.autocast(input.device.type, enabled=False):
            return super().forward(input.float())


class ConcatenatedMLP(nn.Module):
    """Flatten sequence inputs, concatenate all inputs along the last dimension, and apply an :func:`mlp`.

    The number of batch dimensions is free, so which inputs end in *two* feature dimensions (history, motion) is
    stated once, at construction, and never guessed from a batch size.

    Args:
        in_keys: keys of the inputs, in the order of the call.
        in_features: size of the concatenated, flattened inputs.
        hidden: size of every hidden layer.
        out_features: size of the output; ``None`` ends with the last hidden activation.
        sequence_keys: those of ``in_keys`` whose inputs end in ``[T, F]`` instead of ``[F]``.

    Raises:
        ValueError: if the concatenated inputs do not have ``in_features`` entries (at the call).

    Example:
        >>> net = ConcatenatedMLP(["proprioception", "history"], 3 + 10 * 3, (8,), 2)
        >>> net(torch.zeros(5, 3), torch.zeros(5, 10, 3)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        in_features: int,
        hidden: Sequence[int],
        out_features: int | None = None,
        *,
        sequence_keys: Sequence[NestedKey] = (HISTORY,),
    ) -> None:
        super().__init__()
        self.names = [unravel_key(key) for key in in_keys]
        sequences = {unravel_key(key) for key in sequence_keys}
        self.is_sequence = [name in sequences for name in self.names]
        self.in_features = in_features
        self.layers = mlp(in_features, hidden, out_features)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Apply the network to one tensor per key of ``in_keys``."""
        flat = [x.flatten(-2) if sequence else x for x, sequence in zip(inputs, self.is_sequence, strict=True)]
        joined = flat[0] if len(flat) == 1 else torch.cat(flat, -1)  # [*B, in_features]
        if joined.shape[-1] != self.in_features:
            sizes = ", ".join(f"{name}: {x.shape[-1]}" for name, x in zip(self.names, flat, strict=True))
            raise ValueError(
                f"expected in_features={self.in_features} concatenated numbers, got {joined.shape[-1]} ({sizes}); "
                "pass the in_features of your observations, and name inputs that end in [T, F] in sequence_keys"
            )
        return self.layers(joined)
