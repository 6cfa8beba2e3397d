from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl.modules import ScandotsEncoder


def test_sizes_of_section_s6() -> None:
    shapes = [tuple(p.shape) for p in ScandotsEncoder().parameters() if p.ndim == 2]
    assert shapes == [(128, 132), (64, 128), (32, 64)]


def test_elu_elu_tanh() -> None:
    net = ScandotsEncoder(3, 2, hidden=(5, 4))
    first, second, third = (p for p in net.parameters() if p.ndim == 2)
    heights = torch.randn(7, 3)
    expected = torch.nn.functional.elu(torch.nn.functional.elu(heights @ first.T) @ second.T) @ third.T  # zero biases
    latent = net(TensorDict({"scandots": heights}, batch_size=[7]))["terrain_latent"]
    torch.testing.assert_close(latent, expected.tanh())
    assert net(TensorDict({"scandots": 1e3 * heights}, batch_size=[7]))["terrain_latent"].abs().max() <= 1.0


@pytest.mark.parametrize("batch", [(), (4,), (2, 4)])
def test_a_grid_is_the_flat_row(batch: tuple[int, ...]) -> None:
    flat = ScandotsEncoder(out_key=("o", "z"))
    grid = ScandotsEncoder(in_key=("o", "s"), grid=True)
    grid.load_state_dict(flat.state_dict())
    heights = torch.randn(*batch, 11, 12)
    one = flat(TensorDict({"scandots": heights.flatten(-2)}, batch_size=batch))
    two = grid(TensorDict({"o": {"s": heights}}, batch_size=batch))
    assert one["o", "z"].shape == (*batch, 32)
    assert torch.equal(one["o", "z"], two["terrain_latent"])


def test_another_number_of_scandots_is_refused() -> None:
    with pytest.raises(ValueError, match="in_features=132"):
        ScandotsEncoder()(TensorDict({"scandots": torch.zeros(2, 99)}, batch_size=[2]))
