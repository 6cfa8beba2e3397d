"""The Go2's depth camera as numbers, and what turns metres into a network's input, for simulation and robot alike.

An Intel RealSense D435i looks ahead from the robot's head. Its 848 x 480 pixels are down-sampled eightfold to
106 x 60 and cropped to 87 x 58; simulations cast one ray through the centre of each pixel that is left.

Sources: [S] supplement, sections S3 and S6; [5.8] method notes, section 5.8 (released code).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from agility_rl.go2 import constants

SENSOR_WIDTH, SENSOR_HEIGHT = 848, 480
"""Pixels of the camera's own image. [S]"""

DOWNSAMPLING = 8
"""Camera pixels, each way, that make one: 848 x 480 to 106 x 60. [5.8]"""

CROP_TOP, CROP_BOTTOM, CROP_LEFT, CROP_RIGHT = 1, 1, 10, 9
"""Rows and columns of the 106 x 60 that are cut off. [5.8]"""

IMAGE_WIDTH = SENSOR_WIDTH // DOWNSAMPLING - CROP_LEFT - CROP_RIGHT
IMAGE_HEIGHT = SENSOR_HEIGHT // DOWNSAMPLING - CROP_TOP - CROP_BOTTOM
"""Size of the network's input, 87 x 58. [S]"""

HORIZONTAL_FIELD = math.radians(87.0)
"""Field of view over the 848 (or 106) columns [rad]. [5.8], as in the vendor's data sheet; pixels are square."""

FOCAL_LENGTH = SENSOR_WIDTH / DOWNSAMPLING / 2.0 / math.tan(HORIZONTAL_FIELD / 2.0)
"""In pixels of the down-sampled image, from the field of view."""

PRINCIPAL_POINT = (SENSOR_WIDTH / DOWNSAMPLING / 2.0 - CROP_LEFT, SENSOR_HEIGHT / DOWNSAMPLING / 2.0 - CROP_TOP)
"""Where the optical axis meets the cropped image: pixels from its left and upper edge, (43, 29)."""

POSITION = (0.305, 0.0175, 0.098)
"""Of the camera in the trunk's frame [m]; it looks along +x. [5.8]"""

PITCH_JITTER = math.radians(5.0)
"""The mounting angle is drawn from +- this [rad]; positive looks down. [5.8]"""

LATENCY = constants.CONTROL_DT
"""Age of an image when a student decides by it [s]: one frame at 50 Hz. [5.8]"""

DEPTH_NEAR, DEPTH_FAR = 0.3, 4.0
"""Depths are clipped to this range [m]. [5.8]"""

OFFSET_NOISE, PIXEL_NOISE = 0.05, 0.05
"""Half-widths of an image's common error, and of its pixels' errors before a factor U(0, 1). [5.8]

The notes leave the unit open: metres here, before the clip, as in the code from which the release derives.
"""


def check_image_size(shape: Sequence[int], height: int = IMAGE_HEIGHT, width: int = IMAGE_WIDTH) -> None:
    """Refuse the shape of what is no image of this size.

    Raises:
        ValueError: if the size is another, or the axes are swapped.

    Example:
        >>> check_image_size((3, 58, 87))
        >>> check_image_size((87, 58))
        Traceback (most recent call last):
        ...
        ValueError: depth images must be [*B, 58 rows, 87 columns], got [87, 58]: rows and columns are swapped
    """
    size = tuple(shape[-2:])
    if size != (height, width):
        advice = ": rows and columns are swapped" if size == (width, height) else ""
        raise ValueError(f"depth images must be [*B, {height} rows, {width} columns], got {list(shape)}{advice}")


def normalize_depth(depth: Tensor) -> Tensor:
    r"""Network's input from depths in metres: near is small.

    .. math:: x = \frac{\mathrm{clip}(z, z_n, z_f) - z_n}{z_f - z_n} - \tfrac12, \qquad z_n = 0.3, z_f = 4\ \mathrm{m}

    Source: range [-0.5, 0.5]: supplement, section S3; clip: method notes, section 5.8.

    Args:
        depth: float32 ``[*B, 58, 87]``, distance along the optical axis [m]; infinite where nothing is.

    Returns:
        float32 of the same shape, in [-0.5, 0.5].

    Raises:
        ValueError: if the size is another, or a pixel is NaN.

    Example:
        >>> round(normalize_depth(torch.full((58, 87), 2.15))[0, 0].item(), 4)
        0.0
    """
    check_image_size(depth.shape)
    if bool(torch.isnan(depth).any()):
        count = int(torch.isnan(depth).sum())
        raise ValueError(f"{count} pixels of the depth images are NaN; a camera marks what it does not see by 0")
    return (depth.clamp(DEPTH_NEAR, DEPTH_FAR) - DEPTH_NEAR) / (DEPTH_FAR - DEPTH_NEAR) - 0.5


def metres(image: Tensor) -> Tensor:
    """Depths [m] of a normalised image, as far as the clip left them.

    Example:
        >>> metres(torch.tensor(-0.5)).item()
        0.30000001192092896
    """
    return (dequantize(image) + 0.5) * (DEPTH_FAR - DEPTH_NEAR) + DEPTH_NEAR


def quantize(image: Tensor, bits: Literal[8, 16]) -> Tensor:
    """Store normalised images in ``uint8`` (steps of 14.5 mm) or ``int16`` (steps of 0.06 mm).

    Raises:
        ValueError: if ``bits`` is neither 8 nor 16.

    Example:
        >>> quantize(torch.tensor([-0.5, 0.5]), 8).tolist(), quantize(torch.tensor([-0.5, 0.5]), 16).tolist()
        ([0, 255], [-32767, 32767])
    """
    if bits == 8:
        return ((image + 0.5) * 255.0).round().clamp(0, 255).to(torch.uint8)
    if bits == 16:
        return (image * 65534.0).round().clamp(-32767, 32767).to(torch.int16)
    raise ValueError(f"images are stored in 8 or 16 bits, got {bits}")


def dequantize(stored: Tensor) -> Tensor:
    """Normalised float32 images of what :func:`quantize` returned; floating-point images pass unchanged.

    Raises:
        ValueError: if the type is another.

    Example:
        >>> dequantize(torch.tensor([0, 255], dtype=torch.uint8)).tolist()
        [-0.5, 0.5]
    """
    if stored.is_floating_point():
        return stored
    if stored.dtype == torch.uint8:
        return stored.float() / 255.0 - 0.5
    if stored.dtype == torch.int16:
        return stored.float() / 65534.0
    raise ValueError(f"depth images must be floating-point, uint8 or int16, got {stored.dtype}")


def pixel_directions(pitch: float = 0.0) -> Tensor:
    """Ray through the centre of each pixel, ``[58, 87, 3]`` in the trunk's frame, one metre along the optical axis.

    Args:
        pitch: mounting angle [rad], positive looks down.

    Example:
        >>> pixel_directions()[28:30, 42:44].mean((0, 1)).tolist()  # around the optical axis
        [1.0, 0.0, 0.0]
    """
    right = (torch.arange(IMAGE_WIDTH) + 0.5 - PRINCIPAL_POINT[0]) / FOCAL_LENGTH
    down = (torch.arange(IMAGE_HEIGHT) + 0.5 - PRINCIPAL_POINT[1]) / FOCAL_LENGTH
    down, right = torch.meshgrid(down, right, indexing="ij")
    sine, cosine = math.sin(pitch), math.cos(pitch)
    return torch.stack((cosine - sine * down, -right, -sine - cosine * down), -1)
