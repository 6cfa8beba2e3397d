"""The encoder of depth images: convolutions with max-pools between them, two linear layers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from agility_rl.go2.camera import IMAGE_HEIGHT, IMAGE_WIDTH, check_image_size, dequantize
from agility_rl.keys import DEPTH, DEPTH_FEATURE


class DepthEncoder(TensorDictModule):
    """Encode depth images into features, each image by itself.

    Source: kernels {5, 3}, max-pool of size and stride 2, two linear layers, 32 features: supplement, section S6; 32
    and 64 channels, 128 hidden units, ELU, linear output: released code (method notes, section 5.9).

    Keys read:
        depth          float32 ``[*B, 58, 87]`` in [-0.5, 0.5], or stored as uint8 or int16
    Keys written:
        depth_feature  float32 ``[*B, F]``, F = ``out_features``

    Args:
        out_features: F.
        height: rows of an image.
        width: columns of an image.
        channels: of the convolutions, two as published, or more (ours): a kernel of 5, then kernels of 3, a max-pool
            after each but the last.
        hidden: size of the hidden linear layer.
        in_key: key of the images.
        out_key: key of the features.

    Raises:
        ValueError: if images are too small for the kernels, or have another size, or swapped axes (at the call).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"depth": torch.zeros(4, 58, 87)}, batch_size=[4])
        >>> DepthEncoder()(td)["depth_feature"].shape
        torch.Size([4, 32])
    """

    def __init__(
        self,
        out_features: int = 32,
        *,
        height: int = IMAGE_HEIGHT,
        width: int = IMAGE_WIDTH,
        channels: Sequence[int] = (32, 64),
        hidden: int = 128,
        in_key: NestedKey = DEPTH,
        out_key: NestedKey = DEPTH_FEATURE,
    ) -> None:
        network = DepthNetwork(height, width, channels, hidden, out_features)
        super().__init__(network, in_keys=[in_key], out_keys=[out_key])


class DepthNetwork(nn.Module):
    """The layers of :class:`DepthEncoder`, tensor in, tensor out.

    Attributes:
        precision: number format of the layers; weights, images and features are float32 whatever it is. With
            ``torch.bfloat16`` a training takes half the time where the processor multiplies in it.

    Example:
        >>> import torch
        >>> DepthNetwork(58, 87, (32, 64), 128, 32)(torch.zeros(2, 3, 58, 87)).shape
        torch.Size([2, 3, 32])
    """

    def __init__(self, height: int, width: int, channels: Sequence[int], hidden: int, out_features: int) -> None:
        super().__init__()
        if len(channels) < 2:
            raise ValueError(f"expected the channels of two convolutions or more, got {list(channels)}")
        rows, columns = height - 4, width - 4
        layers: list[nn.Module] = [nn.Conv2d(1, channels[0], 5)]
        for before, after in pairwise(channels):
            layers += [nn.MaxPool2d(2, 2), nn.ELU(inplace=True), nn.Conv2d(before, after, 3)]
            rows, columns = rows // 2 - 2, columns // 2 - 2
        if min(rows, columns) < 1:
            least = 1
            for _ in channels[1:]:
                least = 2 * (least + 2)
            raise ValueError(
                f"images must have at least {least + 4} rows and columns for {len(channels)} convolutions, "
                f"got {height}, {width}"
            )
        self.height, self.width = height, width
        self.precision = torch.float32
        self.convolutions = nn.Sequential(*layers, nn.ELU(inplace=True))
        self.linear = nn.Sequential(
            *(_FlattenPixels(), _PixelLinear(channels[-1], rows, columns, hidden)),
            *(nn.ELU(), nn.Linear(hidden, out_features)),
        )

    def forward(self, depth: Tensor) -> Tensor:
        """Map images ``[*B, H, W]`` to features ``[*B, F]``."""
        check_image_size(depth.shape, self.height, self.width)
        images = dequantize(depth).reshape(-1, 1, self.height, self.width)  # [N, channels, H, W]
        with torch.autocast(images.device.type, self.precision, enabled=self.precision is not torch.float32):
            features = self.linear(self.convolutions(images))
        return features.float().reshape(*depth.shape[:-2], -1)


class _FlattenPixels(nn.Module):
    """``[N, C, H, W]`` to ``[N, H W C]``, without a copy where the memory is channels-last."""

    def forward(self, images: Tensor) -> Tensor:
        return images.permute(0, 2, 3, 1).flatten(1)


class _PixelLinear(nn.Linear):
    """A linear layer on :class:`_FlattenPixels`, whose weights are stored in the usual order of channels first.

    To reorder the weights takes the time of some images, and a quarter less time is needed for a minibatch of hundreds.
    """

    def __init__(self, channels: int, rows: int, columns: int, out_features: int) -> None:
        super().__init__(channels * rows * columns, out_features)
        self.image = (channels, rows, columns)

    def forward(self, pixels: Tensor) -> Tensor:
        weight = self.weight.unflatten(1, self.image).permute(0, 2, 3, 1).flatten(1)
        return nn.functional.linear(pixels, weight, self.bias)
