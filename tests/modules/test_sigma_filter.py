from __future__ import annotations

import pytest
import torch
from torch import Tensor

from agility_rl.go2 import camera
from agility_rl.modules.sigma_filter import ALIKE, LEAST, is_noisy, sigma_filter, smoothed


def normal(count: int, seed: int = 0) -> Tensor:
    """Images of white noise, ``[count, 58, 87]``."""
    return torch.randn(count, 58, 87, generator=torch.Generator().manual_seed(seed))


def ground(pitch: float = 0.0) -> Tensor:
    """What a camera at 0.37 m measures of level ground, ``[1, 58, 87]`` [m]."""
    falls = (-camera.pixel_directions(pitch)[..., 2]).clamp(min=1e-6)
    return (0.37 / falls).clamp(max=camera.DEPTH_FAR)[None]


def test_noise_on_a_surface_falls_to_a_third() -> None:
    """Nine pixels average to a third of the deviation of one, where none is left out."""
    left = sigma_filter(2.0 + 0.01 * normal(200))[:, 1:-1, 1:-1] - 2.0
    assert left.std().item() == pytest.approx(0.01 / 3.0, rel=0.02)
    assert abs(left.mean().item()) < 1e-4


def test_what_is_farther_than_alike_is_left_out() -> None:
    """Eight of nine count: seven at 1 m, and one at 0.9 of the difference that is allowed."""
    image = torch.full((1, 3, 3), 1.0)
    image[0, 0, 0], image[0, 2, 2] = 1.0 + 0.9 * ALIKE, 1.0 + 1.1 * ALIKE
    assert sigma_filter(image)[0, 1, 1].item() == pytest.approx(1.0 + 0.9 * ALIKE / 8.0)
    assert sigma_filter(image, alike=0.01)[0, 1, 1].item() == 1.0


def test_edges_and_posts_of_one_pixel_stay() -> None:
    image = torch.tensor([1.0, 1.0, 3.0, 3.0, 2.0, 3.0, 3.0]).expand(1, 5, -1)
    torch.testing.assert_close(sigma_filter(image), image)
    torch.testing.assert_close(sigma_filter(image.mT), image.mT)


def test_planes_stay_but_at_the_rim() -> None:
    """A depth that grows by the same from pixel to pixel is the mean of those around it."""
    image = (1.0 + 0.05 * torch.arange(8.0) + 0.03 * torch.arange(6.0)[:, None])[None]
    torch.testing.assert_close(sigma_filter(image)[:, 1:-1, 1:-1], image[:, 1:-1, 1:-1])


@pytest.mark.parametrize("deviation", [0.0, 0.045, 0.06, 0.074])
def test_noise_is_told_by_its_deviation(deviation: float) -> None:
    """Noisy from 0.07 / (0.6745 * 2) = 0.0519 m on, by 4,902 differences of which the median is within 3 %."""
    assert is_noisy(2.0 + deviation * normal(50)).tolist() == 50 * [deviation > 0.0519]


def test_what_stands_in_an_image_is_not_noise() -> None:
    """The ground, level or not; posts and bars; the camera's own noise at its largest."""
    posts = ground()
    posts[:, :, ::4] = 1.5
    bars = ground()
    bars[:, ::4] = 1.5
    tilted = torch.cat([ground(pitch) for pitch in (-camera.PITCH_JITTER, camera.PITCH_JITTER)])
    own = ground() + 0.05 * (2.0 * torch.rand(50, 58, 87, generator=torch.Generator().manual_seed(1)) - 1.0)
    assert not is_noisy(torch.cat((posts, bars, tilted, own.clamp(0.3, 4.0)))).any()


def test_nothing_is_said_of_what_is_clipped_or_of_too_little() -> None:
    far, few = torch.full((2, 2, 58, 87), camera.DEPTH_FAR)
    few.view(2, -1)[:, : LEAST - 1] = 2.0 + normal(2).view(2, -1)[:, : LEAST - 1]
    far -= 0.09 * torch.rand(far.shape, generator=torch.Generator().manual_seed(0))
    assert not is_noisy(torch.cat((far, few))).any()


def test_clear_images_stay_as_they_are_beside_noisy_ones() -> None:
    clear, noisy = ground(), ground() + 0.074 * normal(1)
    both = smoothed(torch.cat((clear, noisy)))
    assert torch.equal(both[:1], clear) and smoothed(clear) is clear
    assert torch.equal(both[1:], sigma_filter(noisy)) and torch.equal(smoothed(noisy), both[1:])


def test_an_export_holds_both() -> None:
    """It asks at every call whether the image is noisy, not when it is exported."""

    class Filter(torch.nn.Module):
        def forward(self, metres: Tensor) -> Tensor:
            return smoothed(metres)

    clear, noisy = ground(), ground() + 0.074 * normal(1)
    exported = torch.export.export(Filter(), (clear,)).module()
    for image in (clear, noisy):
        torch.testing.assert_close(exported(image), smoothed(image))
