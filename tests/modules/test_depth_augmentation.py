from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import tensors
from agility_rl.go2.camera import quantize
from agility_rl.modules import DepthAugmentation, depth_augmentation
from agility_rl.modules.depth_augmentation import gaussian_blur

NONE = {"rectangle": 0.0, "white_noise": 0.0, "dropout": 0.0, "blur": 0.0}


def only(generator: torch.Generator, **options: float) -> DepthAugmentation:
    return DepthAugmentation(generator, **{**NONE, **options})


def test_rectangles_have_the_size_and_values_of_the_source(generator: torch.Generator) -> None:
    images = torch.full((400, 58, 87), 0.123)
    out = only(generator, rectangle=1.0).augment(images)
    changed = out != 0.123
    rows, columns = changed.any(2), changed.any(1)
    heights, widths = rows.sum(1), columns.sum(1)
    assert (heights.min(), widths.min()) == (1, 1)
    assert heights.max() == 58 // 4 and widths.max() == 87 // 4
    assert torch.equal(changed.flatten(1).sum(1), heights * widths)  # filled, in one piece
    values = [image[where] for image, where in zip(out, changed, strict=True)]
    uniform = torch.tensor([len(value.unique()) == 1 for value in values if len(value) > 3])
    assert 0.4 < uniform.float().mean() < 0.6
    every = torch.cat(values)
    assert every.min() < -0.49 and every.max() > 0.49 and every.abs().max() <= 0.5
    assert rows[:, 0].any() and rows[:, -1].any() and columns[:, 0].any() and columns[:, -1].any()


def test_white_noise(generator: torch.Generator) -> None:
    out = only(generator, white_noise=1.0).augment(torch.zeros(50, 58, 87))
    assert out.std().item() == pytest.approx(0.02, rel=0.02) and abs(out.mean()) < 1e-4


def test_drop_out(generator: torch.Generator) -> None:
    out = only(generator, dropout=1.0).augment(torch.zeros(50, 58, 87))
    assert set(out.unique().tolist()) == {-0.5, 0.0}
    assert (out == -0.5).float().mean().item() == pytest.approx(0.05, rel=0.05)


def test_blur_by_hand(generator: torch.Generator) -> None:
    image = torch.zeros(1, 5, 5)
    image[0, 2, 2] = 1.0
    g = math.exp(-0.5 / 0.8**2)
    kernel = torch.tensor([g, 1.0, g]) / (1.0 + 2.0 * g)
    out = gaussian_blur(image, torch.full((1, 1, 1), 0.8))[0]
    torch.testing.assert_close(out[1:4, 1:4], kernel[:, None] * kernel)
    assert out[0].abs().sum() == 0
    flat = torch.full((3, 58, 87), 0.3)
    torch.testing.assert_close(only(generator, blur=1.0).augment(flat), flat)  # edges are repeated, not black


@pytest.mark.parametrize("rows_of", [tensors.rows_of, lambda mask: torch.arange(len(mask))], ids=["CPU", "as on a GPU"])
def test_each_image_draws_for_itself_with_the_given_probability(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch, rows_of: Callable[[Tensor], Tensor]
) -> None:
    monkeypatch.setattr(depth_augmentation, "rows_of", rows_of)
    images = torch.rand(2000, 12, 16, generator=generator) * 0.8 - 0.4
    for name in NONE:
        out = only(generator, **{name: 0.25}).augment(images)
        share = (out != images).flatten(1).any(1).float().mean().item()
        assert share == pytest.approx(0.25, abs=0.04), name


def test_released_probabilities() -> None:
    augmentation = DepthAugmentation(torch.Generator())
    assert (augmentation.rectangle, augmentation.white_noise, augmentation.dropout, augmentation.blur) == (
        0.1,
        0.1,
        0.05,
        0.1,
    )
    assert (augmentation.white_noise_std, augmentation.dropout_share, augmentation.blur_std) == (0.02, 0.05, (0.5, 1.5))


def test_seeds_reproduce_and_the_input_and_the_global_generator_are_left_alone() -> None:
    images = torch.rand(30, 58, 87) - 0.5
    before, state = images.clone(), torch.get_rng_state()
    one, two, three = (
        DepthAugmentation(torch.Generator().manual_seed(seed), rectangle=0.5, blur=0.5).augment(images)
        for seed in (1, 1, 2)
    )
    assert torch.equal(one, two) and not torch.equal(one, three)
    assert torch.equal(images, before) and torch.equal(torch.get_rng_state(), state)
    assert one.abs().max() <= 0.5


def test_keys_batches_storage_and_modes(generator: torch.Generator) -> None:
    augmentation = DepthAugmentation(generator, in_key=("camera", "depth"), out_key="view")
    image = torch.rand(2, 3, 58, 87) - 0.5
    stored = quantize(image, 16)
    td = augmentation(TensorDict({"camera": {"depth": stored}}, [2, 3]))
    assert td["view"].shape == (2, 3, 58, 87) and td["view"].dtype == torch.float32
    assert torch.equal(td["camera", "depth"], stored)
    still = augmentation.eval()(td)["view"]
    torch.testing.assert_close(still, image, atol=1e-4, rtol=0.0)


def test_errors(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match=r"blur is a probability, in 0 to 1, got 1\.5"):
        DepthAugmentation(generator, blur=1.5)
    with pytest.raises(ValueError, match="blur_std"):
        DepthAugmentation(generator, blur_std=(0.0, 1.0))
    with pytest.raises(ValueError, match="generator is on cpu, the images are on meta"):
        DepthAugmentation(generator).augment(torch.zeros(1, 58, 87, device="meta"))
