from __future__ import annotations

import pytest
import torch

from agility_rl.modules import FeatureNormalizer


def test_values() -> None:
    normalizer = FeatureNormalizer([1.0, 0.0, 2.0], [2.0, 0.1, 0.0], clip=3.0, epsilon=0.5)
    out = normalizer(torch.tensor([[[5.0, 1.0, 2.5]]]))  # (5-1)/2, (1-0)/0.5 for the small std, 0.5/0.5
    torch.testing.assert_close(out, torch.tensor([[[2.0, 2.0, 1.0]]]))
    assert normalizer(torch.tensor([100.0, -100.0, 2.0])).tolist() == [3.0, -3.0, 0.0]


def test_weights_scale_after_the_clip_and_follow_in_place() -> None:
    normalizer = FeatureNormalizer(torch.zeros(2), torch.ones(2))
    alias = normalizer.weight
    normalizer.set_weight([0.0, 0.5])
    assert alias.tolist() == [0.0, 0.5]
    assert normalizer(torch.tensor([7.0, 100.0])).tolist() == [0.0, 5.0]


def test_state_dict_carries_statistics_and_weights() -> None:
    one = FeatureNormalizer([1.0, 2.0], [3.0, 4.0])
    one.set_weight([0.5, 0.25])
    other = FeatureNormalizer([0.0, 0.0], [1.0, 1.0])
    other.load_state_dict(one.state_dict())
    x = torch.randn(4, 2)
    assert torch.equal(one(x), other(x))


def test_the_statistics_given_stay_untouched() -> None:
    std = torch.zeros(2)
    FeatureNormalizer(torch.zeros(2), std)
    assert std.tolist() == [0.0, 0.0]


def test_errors() -> None:
    with pytest.raises(ValueError, match=r"one length, got \[2\] and \[3\]"):
        FeatureNormalizer(torch.zeros(2), torch.ones(3))
    with pytest.raises(ValueError, match="finite"):
        FeatureNormalizer([float("nan")], [1.0])
    with pytest.raises(ValueError, match=r"shape \[2\], got \[1\]"):
        FeatureNormalizer(torch.zeros(2), torch.ones(2)).set_weight([1.0])


def test_statistics_of_any_numbers_become_floats() -> None:
    whole = FeatureNormalizer([0, 0], [1, 2])
    whole.set_weight([0.5, 1.0])
    assert whole.weight.tolist() == [0.5, 1.0]
    double = FeatureNormalizer(torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    assert double(torch.ones(1, 2)).dtype == torch.float32
