"""Encoders of the robot's physical parameters: from the simulator's truth, and from what the robot remembers.

Source: section S6 (kernels {4, 2}, strides {2, 1}); channel numbers: released code (method notes, section 3.1);
regularised online adaptation: Cheng et al. 2023, "Extreme Parkour with Legged Robots", arXiv:2309.14341.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from agility_rl.keys import HISTORY, LATENT, PRIVILEGED
from agility_rl.modules.mlp import ConcatenatedMLP


class PrivilegedEncoder(TensorDictModule):
    """Encode the true physical parameters of the simulator.

    Source: 29-64-29 with ELU after both layers: released code (method notes, section 3.1).

    Keys read:
        privileged  float32 ``[*B, 29]``
    Keys written:
        latent      float32 ``[*B, L]``, L = ``out_features``

    Args:
        in_features: size of the privileged quantities.
        out_features: L, size of the latent.
        in_keys: keys of the inputs.
        hidden: size of the hidden layers.
        out_key: key of the latent.

    Raises:
        ValueError: if the inputs do not have ``in_features`` entries (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"privileged": torch.zeros(8, 29)}, batch_size=[8])
        >>> PrivilegedEncoder()(td)["latent"].shape
        torch.Size([8, 29])
    """

    def __init__(
        self,
        in_features: int = 29,
        out_features: int = 29,
        *,
        in_keys: Sequence[NestedKey] = (PRIVILEGED,),
        hidden: Sequence[int] = (64,),
        out_key: NestedKey = LATENT,
    ) -> None:
        network = ConcatenatedMLP(in_keys, in_features, (*hidden, out_features))
        super().__init__(network, in_keys=list(in_keys), out_keys=[out_key])


class HistoryEncoder(TensorDictModule):
    """Infer the physical parameters from the proprioception of the last ten control steps.

    Every frame passes one linear layer; two convolutions run over time; one linear layer writes the latent.

    Source: section S6; 30, 20 and 10 channels, ELU throughout: released code (method notes, section 3.1).

    Keys read:
        history  float32 ``[*B, T, P]``  oldest first
    Keys written:
        latent   float32 ``[*B, L]``, L = ``out_features``

    Args:
        num_features: P, numbers of one frame.
        num_frames: T, frames of the history.
        out_features: L, size of the latent.
        in_key: key of the history.
        out_key: key of the latent.

    Raises:
        ValueError: if the history is too short for the convolutions, or has another shape (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"history": torch.zeros(8, 10, 45)}, batch_size=[8])
        >>> HistoryEncoder(num_features=45)(td)["latent"].shape
        torch.Size([8, 29])
    """

    def __init__(
        self,
        num_features: int,
        num_frames: int = 10,
        out_features: int = 29,
        *,
        in_key: NestedKey = HISTORY,
        out_key: NestedKey = LATENT,
    ) -> None:
        network = TemporalConvolution(num_features, num_frames, out_features)
        super().__init__(network, in_keys=[in_key], out_keys=[out_key])


class TemporalConvolution(nn.Module):
    """Per-frame linear layer, two convolutions over time (kernels 4 and 2, strides 2 and 1), linear output, all ELU.

    Example:
        >>> import torch
        >>> TemporalConvolution(45, 10, 29)(torch.zeros(3, 7, 10, 45)).shape
        torch.Size([3, 7, 29])
    """

    def __init__(self, num_features: int, num_frames: int, out_features: int) -> None:
        super().__init__()
        num_outputs = (num_frames - 4) // 2  # frames left after kernel 4 stride 2, then kernel 2 stride 1
        if num_outputs < 1:
            raise ValueError(
                f"a history needs at least 6 frames for kernels (4, 2) and strides (2, 1), got {num_frames}"
            )
        self.num_frames = num_frames
        self.num_features = num_features
        self.frame = nn.Sequential(nn.Linear(num_features, 30), nn.ELU())
        self.time = nn.Sequential(
            nn.Conv1d(30, 20, 4, stride=2), nn.ELU(), nn.Conv1d(20, 10, 2), nn.ELU(), nn.Flatten()
        )
        self.output = nn.Sequential(nn.Linear(10 * num_outputs, out_features), nn.ELU())

    def forward(self, history: Tensor) -> Tensor:
        """Map ``[*B, T, P]`` to ``[*B, out_features]``."""
        if history.shape[-2:] != (self.num_frames, self.num_features):
            raise ValueError(
                f"history must be [*B, {self.num_frames} frames, {self.num_features} features], "
                f"got {list(history.shape)}; build the encoder with the sizes of your observations"
            )
        batch = history.shape[:-2]
        frames = self.frame(history.reshape(-1, self.num_frames, self.num_features))  # [N, T, 30]
        latent = self.output(self.time(frames.transpose(1, 2)))  # channels before time: [N, 30, T] -> [N, L]
        return latent.reshape(*batch, latent.shape[-1])
