from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl.modules import Critic


@pytest.mark.parametrize("batch", [(), (4,), (4, 3)])
def test_history_is_flattened_at_any_batch(batch: tuple[int, ...]) -> None:
    critic = Critic(2 + 5 * 3, in_keys=["explicit", "history"], hidden=(8,))
    td = TensorDict({"explicit": torch.randn(*batch, 2), "history": torch.randn(*batch, 5, 3)}, batch_size=batch)
    assert critic(td)["state_value"].shape == (*batch, 1)


def test_nested_keys() -> None:
    critic = Critic(15, in_keys=[("o", "h")], hidden=(8,), sequence_keys=[("o", "h")], out_key=("v", "x"))
    assert critic(TensorDict({"o": {"h": torch.zeros(4, 5, 3)}}, batch_size=[4]))["v", "x"].shape == (4, 1)


def test_wrong_size() -> None:
    with pytest.raises(ValueError, match="in_features=3 concatenated numbers, got 2"):
        Critic(3, in_keys=["explicit"])(TensorDict({"explicit": torch.zeros(4, 2)}, batch_size=[4]))
