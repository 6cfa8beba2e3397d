"""BYOL around a depth encoder: what two disturbed views of an image have in common."""

from __future__ import annotations

from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from agility_rl.keys import DEPTH_FEATURE, PREDICTION, PROJECTION


class BYOL(TensorDictSequential):
    """An encoder with BYOL's projector and predictor; :class:`agility_rl.losses.BYOLLoss` keeps its moving average.

    The moving average has a predictor too, which is not used.

    Source: BYOL loss for the student: supplement, sections S2 and S8; 1024 hidden units with batch normalisation and
    ReLU, 64 projections: released code (method notes, section 5.10); Grill et al. 2020, "Bootstrap your own latent",
    arXiv:2006.07733.

    Keys read:
        those of the encoder, by default ``depth`` ``[*B, 58, 87]``; batch normalisation needs two images or more
    Keys written:
        those of the encoder, by default ``depth_feature`` ``[*B, F]``
        projection  float32 ``[*B, P]``
        prediction  float32 ``[*B, P]``

    Args:
        encoder: writes features ``[*B, F]``; not copied, so what trains this trains the encoder.
        in_features: F.
        hidden: size of the hidden layers of projector and predictor.
        out_features: P.
        feature_key: key of the features.
        projection_key: key of the projection.
        prediction_key: key of the prediction.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from agility_rl.modules import DepthEncoder
        >>> byol = BYOL(DepthEncoder(), hidden=16)
        >>> byol(TensorDict({"depth": torch.rand(4, 58, 87)}, [4]))["prediction"].shape
        torch.Size([4, 64])
    """

    def __init__(
        self,
        encoder: TensorDictModule,
        in_features: int = 32,
        *,
        hidden: int = 1024,
        out_features: int = 64,
        feature_key: NestedKey = DEPTH_FEATURE,
        projection_key: NestedKey = PROJECTION,
        prediction_key: NestedKey = PREDICTION,
    ) -> None:
        projector = BatchNormMLP(in_features, hidden, out_features)
        predictor = BatchNormMLP(out_features, hidden, out_features)
        super().__init__(
            encoder,
            TensorDictModule(projector, in_keys=[feature_key], out_keys=[projection_key]),
            TensorDictModule(predictor, in_keys=[projection_key], out_keys=[prediction_key]),
        )


class BatchNormMLP(nn.Module):
    """Linear, batch normalisation over all leading dimensions, ReLU, linear.

    Example:
        >>> import torch
        >>> BatchNormMLP(3, 8, 2)(torch.rand(4, 5, 3)).shape
        torch.Size([4, 5, 2])
    """

    def __init__(self, in_features: int, hidden: int, out_features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(in_features, hidden), nn.BatchNorm1d(hidden), nn.ReLU(), nn.Linear(hidden, out_features)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Map ``[*B, in_features]`` to ``[*B, out_features]``."""
        return self.layers(features.reshape(-1, features.shape[-1])).reshape(*features.shape[:-1], -1)
