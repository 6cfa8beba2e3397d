"""Disturbances of depth images: what a student should not mind."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from agility_rl.go2.camera import dequantize
from agility_rl.keys import DEPTH
from agility_rl.tensors import rows_of

LOWEST, HIGHEST = -0.5, 0.5
"""Range of normalised images."""


class DepthAugmentation(TensorDictModuleBase):
    """Disturb depth images at random: rectangles, white noise, pixels that drop out, Gaussian blur, in this order.

    Each image draws for itself whether it is disturbed, and how. In ``eval`` mode images pass unchanged.

    Source: rectangles, white noise and blur: supplement, sections S2 and S8; drop-out, probabilities and sizes:
    released code (method notes, section 5.10), which draws once for a batch. Ours: a dropped pixel shows ``dropped``,
    by default what a depth of 0, the camera's mark of an invalid pixel, is normalised to; results are clipped.

    Keys read:
        depth  float32, uint8 or int16 ``[*B, H, W]``, normalised (:func:`agility_rl.go2.camera.quantize`)
    Keys written:
        depth  float32 ``[*B, H, W]``, in [-0.5, 0.5]

    Args:
        generator: source of randomness, on the device of the images.
        rectangle: probability of a rectangle of 1 to H/4 by 1 to W/4 pixels; half of them hold one value, the others
            one for each pixel, from the whole range.
        white_noise: probability of noise on each pixel.
        white_noise_std: its standard deviation, in normalised units.
        dropout: probability that pixels drop out.
        dropout_share: share of the pixels that do.
        dropped: value that they show.
        blur: probability of a Gaussian blur of 3 x 3 pixels.
        blur_std: smallest and largest standard deviation of the blur [pixels].
        in_key: key of the images.
        out_key: key of the disturbed images; by default the same.

    Raises:
        ValueError: if a probability is outside [0, 1], a blur has no width, or the generator is on another device (at
            the call).

    Example:
        >>> from tensordict import TensorDict
        >>> augmentation = DepthAugmentation(torch.Generator().manual_seed(0), rectangle=1.0)
        >>> td = augmentation(TensorDict({"depth": torch.zeros(8, 58, 87)}, [8]))
        >>> bool((td["depth"] != 0.0).flatten(1).any(-1).all())
        True
    """

    def __init__(
        self,
        generator: torch.Generator,
        *,
        rectangle: float = 0.1,
        white_noise: float = 0.1,
        white_noise_std: float = 0.02,
        dropout: float = 0.05,
        dropout_share: float = 0.05,
        dropped: float = LOWEST,
        blur: float = 0.1,
        blur_std: tuple[float, float] = (0.5, 1.5),
        in_key: NestedKey = DEPTH,
        out_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        shares = {"rectangle": rectangle, "white_noise": white_noise, "dropout": dropout, "blur": blur}
        for name, value in {**shares, "dropout_share": dropout_share}.items():
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} is a probability, in 0 to 1, got {value}")
        if white_noise_std < 0.0 or not 0.0 < blur_std[0] <= blur_std[1]:
            raise ValueError(
                "white_noise_std must not be negative and blur_std must be (smallest, largest) positive widths, got "
                f"{white_noise_std} and {blur_std}"
            )
        self.generator = generator
        self.rectangle, self.white_noise, self.dropout, self.blur = rectangle, white_noise, dropout, blur
        self.white_noise_std, self.dropout_share, self.dropped = white_noise_std, dropout_share, dropped
        self.blur_std = blur_std
        self.in_keys, self.out_keys = [in_key], [in_key if out_key is None else out_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write disturbed images."""
        images = dequantize(tensordict.get(self.in_keys[0]))
        return tensordict.set(self.out_keys[0], self.augment(images) if self.training else images)

    def augment(self, images: Tensor) -> Tensor:
        """Disturbed copies of float32 images ``[*B, H, W]``, whatever the mode."""
        if self.generator.device.type != images.device.type:
            raise ValueError(
                f"the generator is on {self.generator.device}, the images are on {images.device}; build it by "
                f"torch.Generator({str(images.device)!r})"
            )
        flat = images.reshape(-1, *images.shape[-2:]).clone()
        for share, disturb in (
            (self.rectangle, self._add_rectangles),
            (self.white_noise, self._add_white_noise),
            (self.dropout, self._drop_pixels),
            (self.blur, self._blur),
        ):
            # On a CPU only the images that are chosen are touched, for most are not.
            chosen = self._uniform(len(flat)) < share
            if len(rows := rows_of(chosen)):
                clean = flat[rows]
                flat[rows] = torch.where(chosen[rows, None, None], disturb(clean), clean)
        return flat.clamp(LOWEST, HIGHEST).reshape(images.shape)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.generator.device)

    def _add_rectangles(self, images: Tensor) -> Tensor:
        number, *sides = images.shape
        inside = torch.ones_like(images, dtype=torch.bool)
        for dimension, side in enumerate(sides):
            size = 1.0 + (self._uniform(number) * (side // 4)).floor()  # 1 to side / 4
            start = (self._uniform(number) * (side - size + 1.0)).floor()
            place = torch.arange(side, device=images.device)
            span = (place >= start[:, None]) & (place < (start + size)[:, None])
            inside &= span[:, :, None] if dimension == 0 else span[:, None, :]
        constant = self._uniform(number, 1, 1) < 0.5
        one, each = self._uniform(number, 1, 1), self._uniform(*images.shape)
        value = LOWEST + (HIGHEST - LOWEST) * torch.where(constant, one, each)
        return torch.where(inside, value, images)

    def _add_white_noise(self, images: Tensor) -> Tensor:
        noise = torch.randn(images.shape, generator=self.generator, device=images.device)
        return images + self.white_noise_std * noise

    def _drop_pixels(self, images: Tensor) -> Tensor:
        return images.masked_fill(self._uniform(*images.shape) < self.dropout_share, self.dropped)

    def _blur(self, images: Tensor) -> Tensor:
        smallest, largest = self.blur_std
        width = smallest + (largest - smallest) * self._uniform(len(images), 1, 1)
        return gaussian_blur(images, width)


def gaussian_blur(images: Tensor, std: Tensor) -> Tensor:
    r"""Blur by 3 x 3 pixels, edges repeated.

    .. math:: k = \frac{(g, 1, g)}{1 + 2 g}, \qquad g = e^{-1 / (2 \sigma^2)}

    in each direction.

    Source: kernel 3 x 3: released code (method notes, section 5.10).

    Args:
        images: ``[N, H, W]``.
        std: standard deviation [pixels], ``[N, 1, 1]``.

    Example:
        >>> image = torch.zeros(1, 3, 3)
        >>> image[0, 1, 1] = 1.0
        >>> [round(x, 3) for x in gaussian_blur(image, torch.ones(1, 1, 1))[0, 1].tolist()]
        [0.124, 0.204, 0.124]
    """
    side = torch.exp(-0.5 / std.square())
    middle = 1.0 / (1.0 + 2.0 * side)
    for dimension in (-2, -1):
        first, last = images.narrow(dimension, 0, 1), images.narrow(dimension, images.shape[dimension] - 1, 1)
        padded = torch.cat((first, images, last), dimension)
        length = images.shape[dimension]
        neighbours = padded.narrow(dimension, 0, length) + padded.narrow(dimension, 2, length)
        images = middle * (images + side * neighbours)
    return images
