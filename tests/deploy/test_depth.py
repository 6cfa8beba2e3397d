"""Images of a camera that measures as the D435i does, against what simulated rays find in the same scene."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from agility_rl.deploy.depth import DepthPreprocessor, downsample
from agility_rl.go2 import camera

BASELINE = 0.05
"""Distance between the stereo pair's lenses [m] (D435i, data sheet)."""
FOCAL = 8.0 * camera.FOCAL_LENGTH
"""Focal length of the camera's own image [pixels]."""


def directions(step: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Tangents right and down of the camera's own pixels ``[480, 848]``."""
    right = (np.arange(848) + 0.5 - 424.0) / FOCAL
    down = (np.arange(480) + 0.5 - 240.0) / FOCAL
    return np.meshgrid(right, down)


def scene(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Depth of a floor 0.4 m below, a wall 3 m ahead, and a post of 10 cm at 1 m, from the tangents of rays."""
    with np.errstate(divide="ignore"):
        floor = np.where(down > 0.0, 0.4 / np.maximum(down, 1e-9), np.inf)
    post = np.where(np.abs(right * 1.0 - 0.1) < 0.05, 1.0, np.inf)
    return np.minimum(np.minimum(floor, 3.0), post)


def d435i(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a D435i makes of true depths: uint16 millimetres.

    Disparity is measured to a tenth of a pixel or so, in steps of 1/32; the left rim and what lies in the stereo shadow
    to the left of near things is not seen; neither are near things and some pixels without texture.
    """
    disparity = FOCAL * BASELINE / depth
    measured = np.round((disparity + rng.normal(0.0, 0.1, depth.shape)) * 32.0) / 32.0
    counts = np.rint(1000.0 * FOCAL * BASELINE / np.maximum(measured, 1e-3))
    counts[:, : int(disparity.max())] = 0
    for row in range(depth.shape[0]):  # shadowed: a pixel further right is matched to the same place of the right image
        columns = np.arange(depth.shape[1]) - disparity[row]
        nearest = np.minimum.accumulate(columns[::-1])[::-1]
        counts[row, columns > nearest + 0.5] = 0
    counts[(depth < 0.195) | (depth > 10.0)] = 0
    patches = rng.random((60, 106)) < 0.01
    counts[np.kron(patches, np.ones((8, 8), dtype=bool))] = 0
    counts[rng.random(depth.shape) < 0.02] = 0
    return counts.astype(np.uint16)


def ideal() -> torch.Tensor:
    """The network's input by one ray through each pixel."""
    rays = camera.pixel_directions().double()
    return camera.normalize_depth(torch.from_numpy(scene(-rays[..., 1].numpy(), -rays[..., 2].numpy())).float())


@pytest.fixture(scope="module")
def preprocess() -> DepthPreprocessor:
    return DepthPreprocessor()


def test_a_perfect_camera_sees_what_rays_find(preprocess: DepthPreprocessor) -> None:
    image = preprocess(np.rint(1000.0 * scene(*directions())).astype(np.uint16))
    error = camera.metres(image) - camera.metres(ideal())
    off = error.abs() > 0.03
    assert off.float().mean() < 0.01  # the rims of the post, and the horizon
    assert error[~off].abs().mean() < 0.005


def test_a_noisy_camera_sees_nearly_the_same(preprocess: DepthPreprocessor) -> None:
    truth = camera.metres(ideal())
    counts = d435i(scene(*directions()), np.random.default_rng(0))
    unseen = (downsample(counts)[1] == 0).sum()
    error = (camera.metres(preprocess(counts)) - truth).abs()
    print(f"{(counts == 0).mean():.1%} of the pixels not seen, {unseen} of {58 * 87} after down-sampling")
    assert 0.03 < (counts == 0).mean() < 0.3 and unseen > 20
    assert error.median() < 0.01
    assert (error < 0.1).float().mean() > 0.93


def test_post_and_floor_are_where_they_belong(preprocess: DepthPreprocessor) -> None:
    depth = camera.metres(preprocess(np.rint(1000.0 * scene(*directions())).astype(np.uint16)))
    column = round(camera.PRINCIPAL_POINT[0] + 0.1 * camera.FOCAL_LENGTH)
    assert depth[20, column].item() == pytest.approx(1.0, abs=0.002)  # the post is right of the middle
    assert depth[20, 86 - column].item() == pytest.approx(3.0, abs=0.002)
    down = (57.5 - camera.PRINCIPAL_POINT[1]) / camera.FOCAL_LENGTH
    assert depth[57, 10].item() == pytest.approx(0.4 / down, rel=0.02)


def test_median_of_what_was_measured_by_hand() -> None:
    counts = np.zeros((480, 848), dtype=np.uint16)
    block = counts[8:16, 80:88]  # the first pixel after the crop
    block[1, [3, 4]], block[6, 6] = (900, 500), 700
    block[0, 0] = 60000  # between the samples
    depth, seen = downsample(counts)
    assert depth[0, 0] == 700 and seen[0, 0] and seen.sum() == 1
    block[3, 3] = 740  # 500, 700, 740, 900: one surface in the middle
    assert downsample(counts)[0][0, 0] == 720
    block[3, 3] = 800  # 500, 700, 800, 900: two surfaces
    assert downsample(counts)[0][0, 0] == 700


def test_median_equals_numpys_where_everything_is_seen() -> None:
    counts = np.random.default_rng(0).integers(1, 2**15, (480, 848)).astype(np.uint16)
    taken = np.array([1, 3, 4, 6])
    for row, column in ((0, 0), (57, 86), (30, 40)):
        rows, columns = (8 * (at + crop) + taken for at, crop in ((row, camera.CROP_TOP), (column, camera.CROP_LEFT)))
        samples = np.sort(counts[np.ix_(rows, columns)], axis=None).astype(int)
        near, far = samples[7:9]
        expected = (near + far) // 2 if far - near <= near // 16 else near
        assert downsample(counts)[0][row, column] == expected


def test_an_edge_is_not_smeared_into_the_air() -> None:
    counts = np.full((480, 848), 3000, dtype=np.uint16)
    counts[:, :405] = 1000  # cuts through a pixel
    assert set(np.unique(downsample(counts)[0])) == {1000, 3000}


def test_holes_are_filled_from_the_nearest_pixel(preprocess: DepthPreprocessor) -> None:
    counts = np.full((480, 848), 1000, dtype=np.uint16)
    counts[:, 424:] = 3000
    counts[160:320, 416 - 80 : 424 + 80] = 0  # ten pixels to each side of the step
    depth = camera.metres(preprocess(counts))
    torch.testing.assert_close(depth[28, :42], torch.full((42,), 1.0))
    torch.testing.assert_close(depth[28, 44:], torch.full((43,), 3.0))


def test_one_seen_pixel_fills_everything(preprocess: DepthPreprocessor) -> None:
    counts = np.zeros((480, 848), dtype=np.uint16)
    counts[200:208, 400:408] = 2150
    torch.testing.assert_close(preprocess(counts), torch.zeros(58, 87), atol=1e-6, rtol=0.0)


def test_metres_and_counts_are_one(preprocess: DepthPreprocessor) -> None:
    depth = scene(*directions())
    counts = np.rint(1000.0 * depth).astype(np.uint16)
    assert torch.equal(preprocess(depth.astype(np.float64)), preprocess(counts))
    tenths = DepthPreprocessor(1e-4)
    assert (
        tenths(np.rint(1e4 * depth).astype(np.uint16)) - preprocess(counts)
    ).abs().max() < 4e-4  # one and a half millimetres


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((848, 480), dtype=np.uint16), "swapped"),
        (np.ones((480, 640), dtype=np.uint16), r"got \[480, 640\].*848 x 480"),
        (np.ones((480, 848, 3), dtype=np.uint16), r"got \[480, 848, 3\]"),
        (np.ones((480, 848), dtype=np.int64), "uint16 counts or floating-point metres, got int64"),
        (np.zeros((480, 848), dtype=np.uint16), "no pixel of the depth image was measured"),
        (np.full((480, 848), np.nan, dtype=np.float32), "407040 pixels of the camera image are NaN"),
        (np.full((480, 848), -1.0, dtype=np.float32), "must not be negative"),
    ],
)
def test_what_is_no_image(preprocess: DepthPreprocessor, image: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        preprocess(image)


def test_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"agility_rl\[deploy\]"):
        DepthPreprocessor()
