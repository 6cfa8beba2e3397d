from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import camera


def test_sizes_and_optics_against_the_sources() -> None:
    assert (camera.IMAGE_WIDTH, camera.IMAGE_HEIGHT) == (87, 58)  # supplement, section S3
    # Half of 106 columns spans half of 87 degrees, and the axis is the middle of the image before the crop.
    assert math.degrees(2 * math.atan(53 / camera.FOCAL_LENGTH)) == pytest.approx(87.0)
    assert camera.PRINCIPAL_POINT == (43.0, 29.0)
    # The same optics in the camera's own pixels: 8 of them make one.
    assert math.degrees(2 * math.atan(424 / (8 * camera.FOCAL_LENGTH))) == pytest.approx(87.0)


def test_normalisation_by_hand() -> None:
    depth = torch.full((58, 87), 1.0)
    depth[0, :5] = torch.tensor([0.0, 0.3, 2.15, 4.0, torch.inf])
    image = camera.normalize_depth(depth)
    torch.testing.assert_close(image[0, :5], torch.tensor([-0.5, -0.5, 0.0, 0.5, 0.5]))
    assert image[1, 1].item() == pytest.approx(0.7 / 3.7 - 0.5)
    torch.testing.assert_close(camera.metres(image)[0, :5], torch.tensor([0.3, 0.3, 2.15, 4.0, 4.0]))


def test_near_is_small() -> None:
    depth = torch.linspace(0.3, 4.0, 58 * 87).reshape(58, 87)
    assert (camera.normalize_depth(depth).flatten().diff() > 0).all()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((87, 58), "swapped"),
        ((3, 58, 86), r"got \[3, 58, 86\]"),
        ((60, 106), r"58 rows, 87 columns\], got \[60, 106\]"),
    ],
)
def test_wrong_sizes(shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        camera.normalize_depth(torch.ones(shape))


def test_nan() -> None:
    depth = torch.ones(2, 58, 87)
    depth[1, 3, 4] = torch.nan
    with pytest.raises(ValueError, match="1 pixels of the depth images are NaN"):
        camera.normalize_depth(depth)


@pytest.mark.parametrize(("bits", "dtype", "step"), [(8, torch.uint8, 1 / 255), (16, torch.int16, 1 / 65534)])
def test_stored_images_are_off_by_half_a_step(bits: int, dtype: torch.dtype, step: float) -> None:
    image = torch.rand(5, 58, 87) - 0.5
    stored = camera.quantize(image, bits)
    assert stored.dtype == dtype
    assert (camera.dequantize(stored) - image).abs().max() <= step / 2 + 1e-6
    torch.testing.assert_close(camera.quantize(camera.dequantize(stored), bits), stored)


def test_what_cannot_be_stored_or_read() -> None:
    with pytest.raises(ValueError, match="8 or 16 bits, got 4"):
        camera.quantize(torch.zeros(2), 4)
    with pytest.raises(ValueError, match="int64"):
        camera.dequantize(torch.zeros(2, dtype=torch.int64))


def test_directions_of_pixels() -> None:
    straight = camera.pixel_directions()
    assert straight[0, 43, 2] > 0 > straight[-1, 43, 2]  # the first row looks up
    assert straight[29, 0, 1] > 0 > straight[29, -1, 1]  # the first column looks left, +y
    torch.testing.assert_close(straight[..., 0], torch.ones(58, 87))
    # Looking down by 0.1 rad turns each ray about y, and nothing else.
    down = camera.pixel_directions(0.1)
    torch.testing.assert_close(down.norm(dim=-1), straight.norm(dim=-1))
    axis = down[28:30, 42:44].mean((0, 1))
    assert axis.tolist() == pytest.approx([math.cos(0.1), 0.0, -math.sin(0.1)], abs=1e-6)
