"""From an image of the robot's D435i to the network's input: what a simulated ray through each pixel would find."""

from __future__ import annotations

import itertools
import math
from types import ModuleType
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from agility_rl.go2 import camera

DEPTH_UNIT = 0.001
"""Metres of one count of the camera (the D400 series' default)."""
_SAMPLED = (1, 3, 4, 6)
"""Rows and columns of each 8 x 8 block that stand for it, about its centre: 16 of 64 camera pixels."""
_SAME_SURFACE = 16
"""Depths that differ by less than 1/16 are of one surface, and may be averaged."""
_UNSEEN = np.iinfo(np.uint16).max
_SIZE = (camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH)
_FIRST = (camera.DOWNSAMPLING * camera.CROP_TOP, camera.DOWNSAMPLING * camera.CROP_LEFT)


class Frame(NamedTuple):
    """A depth image and when it was taken.

    Attributes:
        time: on the controller's clock [s].
        image: ``[480, 848]``, uint16 counts of a millimetre, or floating-point metres; 0 where nothing was measured.
    """

    time: float
    image: np.ndarray


class DepthSource(Protocol):
    """A camera: whatever takes the images, in its own time."""

    def latest(self) -> Frame | None:
        """The newest image, never waiting; ``None`` if there is none yet. The same one until the next."""


class StillImage:
    """A camera before a wall, whose images never grow old; for tests and measurements.

    Args:
        distance: of the wall [m].

    Example:
        >>> StillImage(2.0).latest().image[0, 0].item()
        2000
    """

    def __init__(self, distance: float) -> None:
        shape = (camera.SENSOR_HEIGHT, camera.SENSOR_WIDTH)
        self.frame = Frame(math.inf, np.full(shape, round(distance / DEPTH_UNIT), dtype=np.uint16))

    def latest(self) -> Frame:
        """The wall."""
        return self.frame


class DepthPreprocessor:
    """Fill, down-sample, crop, clip and normalise camera images.

    A pixel of the network is the median of the depths that its 8 x 8 camera pixels measured: a mean would put a surface
    half-way between an edge and what is behind it, where there is none. Where nothing was measured, the nearest pixel
    that was measured stands in. Normalisation is :func:`agility_rl.go2.camera.normalize_depth`, as in training.

    Source: 848 x 480, down-sampled and cropped to 87 x 58, scaled to [-0.5, 0.5], holes filled by OpenCV: supplement,
    section S3; crop and clip: method notes, section 5.8. Median and nearest pixel are ours.

    Args:
        depth_unit: metres of one count of integer images.

    Raises:
        ImportError: if OpenCV is not installed.

    Example:
        >>> image = np.full((480, 848), 2150, dtype=np.uint16)
        >>> image[100:200, 300:500] = 0  # not seen
        >>> output = DepthPreprocessor()(image)
        >>> output.shape, round(output.abs().max().item(), 3)
        (torch.Size([58, 87]), 0.0)
    """

    def __init__(self, depth_unit: float = DEPTH_UNIT) -> None:
        if not 0.0 < depth_unit < 1.0:
            raise ValueError(f"depth_unit must be metres of one count, such as 0.001, got {depth_unit}")
        self.depth_unit = depth_unit
        self._cv2 = _opencv()

    def __call__(self, image: np.ndarray) -> Tensor:
        """Network's input float32 ``[58, 87]`` of one image.

        Args:
            image: ``[480, 848]``, uint16 counts or floating-point metres; 0 where nothing was measured.

        Raises:
            ValueError: if the size or type is another, the axes are swapped, a pixel is NaN or negative, or nothing was
                measured at all.
        """
        counts = self._counts(image)
        depth, seen = downsample(counts)
        if not seen.any():
            raise ValueError(
                "no pixel of the depth image was measured; check the camera's lens, its projector, and that the stream "
                f"is depth in units of {self.depth_unit} m"
            )
        if not seen.all():
            depth = self._fill(depth, seen)
        return camera.normalize_depth(torch.from_numpy(depth.astype(np.float32) * np.float32(self.depth_unit)))

    def _counts(self, image: np.ndarray) -> np.ndarray:
        image = np.asarray(image)
        expected = (camera.SENSOR_HEIGHT, camera.SENSOR_WIDTH)
        if image.shape != expected:
            advice = ": rows and columns are swapped" if image.shape == expected[::-1] else ""
            raise ValueError(
                f"camera images must be [{expected[0]} rows, {expected[1]} columns], got {list(image.shape)}{advice}; "
                "set the depth stream to 848 x 480"
            )
        if image.dtype == np.uint16:
            return image
        if not np.issubdtype(image.dtype, np.floating):
            raise ValueError(f"camera images must be uint16 counts or floating-point metres, got {image.dtype}")
        if np.isnan(image).any():
            count = int(np.isnan(image).sum())
            raise ValueError(f"{count} pixels of the camera image are NaN; mark what is not seen by 0")
        if (image < 0.0).any():
            raise ValueError(f"depths must not be negative, got {image.min()} m; mark what is not seen by 0")
        return np.minimum(np.rint(image / self.depth_unit), _UNSEEN - 1).astype(np.uint16)

    def _fill(self, depth: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """Depths with those of the nearest seen pixel where there is none."""
        cv2 = self._cv2
        # Labels number the seen (zero) pixels; each other pixel bears the label of the nearest of them.
        _, labels = cv2.distanceTransformWithLabels(
            (~seen).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        of_label = np.zeros(int(labels.max()) + 1, dtype=depth.dtype)
        of_label[labels[seen]] = depth[seen]
        return of_label[labels]


def downsample(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median of what the camera pixels of each pixel measured, cropped.

    Args:
        counts: uint16 ``[480, 848]``, 0 where nothing was measured.

    Returns:
        uint16 ``[58, 87]``, the median of what was measured (the nearer, if the middle falls between two surfaces), and
        bool ``[58, 87]``, whether anything was.

    Example:
        >>> depth, seen = downsample(np.full((480, 848), 700, dtype=np.uint16))
        >>> depth.shape, int(depth[0, 0]), bool(seen.all())
        ((58, 87), 700, True)
    """
    ordered = np.empty((len(_SAMPLED) ** 2, *_SIZE), dtype=np.uint16)
    for sample, (row, column) in zip(ordered, itertools.product(_SAMPLED, _SAMPLED), strict=True):
        sample[...] = counts[_FIRST[0] + row :: camera.DOWNSAMPLING, _FIRST[1] + column :: camera.DOWNSAMPLING][
            : _SIZE[0], : _SIZE[1]
        ]
    number = np.count_nonzero(ordered, 0)
    ordered[ordered == 0] = _UNSEEN  # what was not measured comes last
    _sort(ordered)
    last = np.maximum(number, 1)
    low, high = (np.take_along_axis(ordered, at[None], 0)[0] for at in ((last - 1) // 2, last // 2))
    between = high - low
    return low + np.where(between <= low // _SAME_SURFACE, between // 2, 0).astype(np.uint16), number > 0


def _sort(samples: np.ndarray) -> None:
    """Sort along the first axis, in place: exchanges of neighbours on whole images beat many short sorts."""
    for turn in range(len(samples)):
        lower, upper = samples[turn % 2 : -1 : 2], samples[turn % 2 + 1 :: 2]
        nearer = np.minimum(lower, upper)
        np.maximum(lower, upper, out=upper)
        lower[...] = nearer


def sensor_image(counts: np.ndarray) -> np.ndarray:
    """Camera image of which :func:`downsample` makes ``counts``: each pixel as a block, nothing around the crop.

    For simulated cameras, which cast one ray a pixel of the network and go the real camera's way from there.

    Args:
        counts: uint16 ``[58, 87]``, 0 where nothing was measured.

    Returns:
        uint16 ``[480, 848]``.

    Raises:
        ValueError: if the size is another.

    Example:
        >>> image = sensor_image(np.full((58, 87), 1200, dtype=np.uint16))
        >>> image.shape, int(downsample(image)[0].min())
        ((480, 848), 1200)
    """
    camera.check_image_size(counts.shape)
    image = np.zeros((camera.SENSOR_HEIGHT, camera.SENSOR_WIDTH), dtype=np.uint16)
    size = camera.DOWNSAMPLING
    rows = slice(_FIRST[0], _FIRST[0] + size * _SIZE[0])
    columns = slice(_FIRST[1], _FIRST[1] + size * _SIZE[1])
    image[rows, columns] = np.repeat(np.repeat(counts, size, 0), size, 1)
    return image


def _opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ImportError("depth images need OpenCV: pip install 'agility_rl[deploy]'") from error
    return cv2
