from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl.modules import MotionTrunk, Predictor


@pytest.mark.parametrize("batch", [(), (4,), (4, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    net = Predictor(5, 2, num_skills=3, num_shifts=2, hidden=(8,))
    td = net(TensorDict({"motion": torch.randn(*batch, 2, 5)}, batch_size=batch))
    assert td["skill_logits"].shape == (*batch, 3)
    assert td["shift_estimate"].shape == (*batch, 2)


def test_nested_keys() -> None:
    net = Predictor(
        5, 2, hidden=(8,), motion_key=("a", "m"), skill_logits_key=("b", "c"), shift_estimate_key=("b", "e")
    )
    td = net(TensorDict({"a": {"m": torch.randn(4, 2, 5)}}, batch_size=[4]))
    assert (net.in_keys, net.out_keys) == ([("a", "m")], [("b", "c"), ("b", "e")])
    assert td["b", "c"].shape == (4, 5)
    assert td["b", "e"].shape == (4, 1)


def test_heads_are_linear_in_the_trunk() -> None:
    trunk = MotionTrunk(5, 2, (8,))
    net = Predictor(trunk=trunk)
    motion = torch.randn(4, 2, 5)
    td = net(TensorDict({"motion": motion}, batch_size=[4]))
    hidden = (motion.reshape(4, 10) @ trunk.layers[0].weight.T).clamp_min(0)
    torch.testing.assert_close(td["skill_logits"], hidden @ net.skill_head.weight.T + net.skill_head.bias)
    torch.testing.assert_close(td["shift_estimate"], hidden @ net.shift_head.weight.T + net.shift_head.bias)


def test_state_dict_round_trip() -> None:
    one, other = Predictor(5, 2, hidden=(8,)), Predictor(5, 2, hidden=(8,))
    other.load_state_dict(one.state_dict())
    td = TensorDict({"motion": torch.randn(4, 2, 5)}, batch_size=[4])
    assert torch.equal(one(td.clone())["skill_logits"], other(td.clone())["skill_logits"])
