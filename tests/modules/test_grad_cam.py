from __future__ import annotations

import pytest
import torch
from torch import Tensor

from agility_rl.modules import DepthEncoder, grad_cam


def planted() -> DepthEncoder:
    """An encoder whose only feature is the mean of near pixels in the left half."""
    encoder = DepthEncoder(1)
    with torch.no_grad():
        for parameter in encoder.parameters():
            parameter.zero_()
        first, second = encoder.module.convolutions[0], encoder.module.convolutions[3]
        first.weight[0, 0, 2, 2] = -1.0  # near is small
        second.weight[0, 0, 1, 1] = 1.0
        maps = encoder.module.linear[1].weight[0].view(64, 25, 39)
        maps[0, :, :19] = 1.0 / (25 * 19)
        encoder.module.linear[3].weight[0, 0] = 1.0
    return encoder


def test_attention_lies_on_what_the_output_depends_on() -> None:
    images = torch.full((2, 58, 87), 0.5)
    images[0, 20:30, 10:20] = -0.5
    images[1, 40:50, 25:32] = -0.5
    cam = grad_cam(planted(), images, lambda feature: feature[:, 0])
    for image, attention in zip(images, cam, strict=True):
        obstacle = image < 0.0
        assert attention[obstacle].mean() > 0.7
        assert attention[~obstacle].mean() < 0.05
        assert attention.max() == 1.0 and attention.min() == 0.0


def test_by_formula() -> None:
    encoder, image = DepthEncoder(), torch.rand(1, 58, 87) - 0.5
    maps = encoder.module.convolutions(image[:, None]).detach().requires_grad_()
    encoder.module.linear(maps).norm().backward()
    expected = (maps.grad.mean((2, 3), keepdim=True) * maps.detach()).sum(1, keepdim=True).relu()
    expected = torch.nn.functional.interpolate(expected, size=(58, 87), mode="bilinear")[0, 0]
    torch.testing.assert_close(grad_cam(encoder, image)[0], expected / expected.max())


def test_the_encoder_is_left_as_it_was_and_may_be_frozen() -> None:
    encoder, image = DepthEncoder(), torch.rand(3, 2, 58, 87)
    with torch.no_grad():
        free = grad_cam(encoder, image)
    assert free.shape == image.shape
    assert all(parameter.grad is None for parameter in encoder.parameters())
    assert not encoder.module.convolutions._forward_hooks
    torch.testing.assert_close(grad_cam(encoder.requires_grad_(False), image), free)


def test_errors_leave_no_hook_behind() -> None:
    encoder = DepthEncoder()

    def scalar(feature: Tensor) -> Tensor:
        return feature.sum()

    with pytest.raises(ValueError, match="one number an image"):
        grad_cam(encoder, torch.rand(2, 58, 87), scalar)
    assert not encoder.module.convolutions._forward_hooks
