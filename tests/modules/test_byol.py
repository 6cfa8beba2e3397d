from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from agility_rl.modules import BYOL, DepthEncoder


def small() -> BYOL:
    return BYOL(TensorDictModule(nn.Linear(3, 4), in_keys=["x"], out_keys=["depth_feature"]), 4, hidden=8)


def test_sizes_are_those_of_the_source() -> None:
    byol = BYOL(DepthEncoder())
    sizes = [(layer.in_features, layer.out_features) for layer in byol.modules() if isinstance(layer, nn.Linear)][2:]
    assert sizes == [(32, 1024), (1024, 64), (64, 1024), (1024, 64)]
    assert sum(isinstance(layer, nn.BatchNorm1d) for layer in byol.modules()) == 2


@pytest.mark.parametrize("batch", [(4,), (2, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    td = small()(TensorDict({"x": torch.rand(*batch, 3)}, batch))
    assert td["projection"].shape == td["prediction"].shape == (*batch, 64)


def test_the_encoder_is_shared_not_copied() -> None:
    encoder = DepthEncoder()
    byol = BYOL(encoder, hidden=8)
    assert {id(p) for p in encoder.parameters()} <= {id(p) for p in byol.parameters()}


def test_normalisation_is_over_all_leading_dimensions() -> None:
    byol, x = small(), torch.rand(6, 3)
    flat = byol(TensorDict({"x": x}, [6]))["prediction"]
    folded = byol(TensorDict({"x": x.reshape(2, 3, 3)}, [2, 3]))["prediction"]
    torch.testing.assert_close(folded.reshape(6, 64), flat)
