from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn import functional

from agility_rl.modules import HistoryEncoder, PrivilegedEncoder


@pytest.mark.parametrize("batch", [(), (4,), (4, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    td = TensorDict({"history": torch.randn(*batch, 10, 6), "privileged": torch.randn(*batch, 29)}, batch_size=batch)
    assert HistoryEncoder(6)(td)["latent"].shape == (*batch, 29)
    assert PrivilegedEncoder()(td)["latent"].shape == (*batch, 29)


def test_nested_keys() -> None:
    td = TensorDict({"o": {"h": torch.zeros(4, 10, 6), "p": torch.zeros(4, 7)}}, batch_size=[4])
    assert HistoryEncoder(6, in_key=("o", "h"), out_key=("z", "h"))(td)["z", "h"].shape == (4, 29)
    assert PrivilegedEncoder(7, in_keys=[("o", "p")], out_key=("z", "p"))(td)["z", "p"].shape == (4, 29)


def test_layers_of_the_sources() -> None:
    net = HistoryEncoder(45)
    convolutions = [m for m in net.modules() if isinstance(m, nn.Conv1d)]
    assert [(c.in_channels, c.out_channels, c.kernel_size, c.stride) for c in convolutions] == [
        (30, 20, (4,), (2,)),
        (20, 10, (2,), (1,)),
    ]
    assert [tuple(p.shape) for p in PrivilegedEncoder().parameters() if p.ndim == 2] == [(64, 29), (29, 64)]
    assert PrivilegedEncoder()(TensorDict({"privileged": 100 * torch.randn(64, 29)}, [64]))["latent"].min() >= -1  # ELU


def test_the_history_encoder_equals_its_layers_written_out() -> None:
    net = HistoryEncoder(6).module
    x = torch.randn(3, 10, 6)
    frames = torch.stack([functional.elu(net.frame[0](x[:, t])) for t in range(10)], dim=-1)  # [3, 30, 10]
    hidden = functional.elu(functional.conv1d(frames, net.time[0].weight, net.time[0].bias, stride=2))
    hidden = functional.elu(functional.conv1d(hidden, net.time[2].weight, net.time[2].bias))
    expected = functional.elu(hidden.reshape(3, 30) @ net.output[0].weight.T + net.output[0].bias)
    torch.testing.assert_close(net(x), expected)


def test_errors() -> None:
    with pytest.raises(ValueError, match="at least 6 frames"):
        HistoryEncoder(6, num_frames=5)
    with pytest.raises(ValueError, match=r"\[\*B, 10 frames, 6 features\], got \[2, 9, 6\]"):
        HistoryEncoder(6)(TensorDict({"history": torch.zeros(2, 9, 6)}, batch_size=[2]))
