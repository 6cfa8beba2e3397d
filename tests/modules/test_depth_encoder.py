from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from agility_rl.go2.camera import dequantize, quantize
from agility_rl.modules import DepthEncoder


def test_layers_are_those_of_the_supplement() -> None:
    layers = [*DepthEncoder().module.convolutions, *DepthEncoder().module.linear]
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    assert [layer.kernel_size for layer in convolutions] == [(5, 5), (3, 3)]
    assert [layer.out_channels for layer in convolutions] == [32, 64]
    pools = [layer for layer in layers if isinstance(layer, nn.MaxPool2d)]
    assert [(layer.kernel_size, layer.stride) for layer in pools] == [(2, 2)]
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    assert [(layer.in_features, layer.out_features) for layer in linear] == [(64 * 25 * 39, 128), (128, 32)]


def test_more_convolutions_with_a_pool_between() -> None:
    encoder = DepthEncoder(48, channels=(4, 6, 5), hidden=7)
    layers = [type(layer) for layer in encoder.module.convolutions]
    pool = [nn.MaxPool2d, nn.ELU]
    assert layers == [nn.Conv2d, *pool, nn.Conv2d, *pool, nn.Conv2d, nn.ELU]
    # rows 58 - 4 = 54, 27 - 2 = 25, 12 - 2 = 10; columns 87 - 4 = 83, 41 - 2 = 39, 19 - 2 = 17
    assert encoder.module.convolutions(torch.zeros(1, 1, 58, 87)).shape == (1, 5, 10, 17)
    linear = [layer for layer in encoder.module.linear if isinstance(layer, nn.Linear)]
    assert [(layer.in_features, layer.out_features) for layer in linear] == [(5 * 10 * 17, 7), (7, 48)]
    assert encoder.module(torch.rand(2, 58, 87)).shape == (2, 48)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_shapes_and_nested_keys(batch: tuple[int, ...]) -> None:
    encoder = DepthEncoder(8, in_key=("camera", "depth"), out_key=("latent", "depth"))
    td = TensorDict({"camera": {"depth": torch.rand(*batch, 58, 87)}}, batch)
    assert encoder(td)["latent", "depth"].shape == (*batch, 8)


def test_each_image_by_itself() -> None:
    encoder, images = DepthEncoder(), torch.rand(3, 58, 87)
    torch.testing.assert_close(encoder.module(images)[1], encoder.module(images[1]), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("bits", [8, 16])
def test_stored_images_are_read(bits: int) -> None:
    encoder, stored = DepthEncoder(), quantize(torch.rand(2, 58, 87) - 0.5, bits)
    assert torch.equal(encoder.module(stored), encoder.module(dequantize(stored)))


def test_gradients_reach_every_parameter() -> None:
    encoder = DepthEncoder()
    encoder.module(torch.rand(2, 58, 87)).square().sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in encoder.parameters())


def test_errors() -> None:
    with pytest.raises(ValueError, match=r"58 rows, 87 columns\], got \[2, 87, 58\]: rows and columns are swapped"):
        DepthEncoder().module(torch.zeros(2, 87, 58))
    with pytest.raises(ValueError, match="at least 10 rows"):
        DepthEncoder(height=6)
    with pytest.raises(ValueError, match="at least 20 rows and columns for 3 convolutions, got 19, 87"):
        DepthEncoder(height=19, channels=(2, 2, 2))
    DepthEncoder(height=20, channels=(2, 2, 2))
    with pytest.raises(ValueError, match=r"two convolutions or more, got \[8\]"):
        DepthEncoder(channels=(8,))


def test_layers_in_bfloat16_leave_features_and_gradients_in_float32() -> None:
    torch.manual_seed(0)
    encoder, images = DepthEncoder(), torch.rand(8, 58, 87) - 0.5
    exact = encoder.module(images)
    encoder.module.precision = torch.bfloat16
    seen: list[torch.dtype] = []
    encoder.module.convolutions.register_forward_hook(lambda module, args, out: seen.append(out.dtype))
    features = encoder.module(images)
    assert seen == [torch.bfloat16] and features.dtype is torch.float32
    torch.testing.assert_close(features, exact, rtol=0.05, atol=0.01)
    features.square().sum().backward()
    assert all(parameter.grad.dtype is torch.float32 for parameter in encoder.parameters())
