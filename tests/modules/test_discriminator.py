from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl.modules import Discriminator, FeatureNormalizer, MotionTrunk, Predictor


@pytest.mark.parametrize("batch", [(), (4,), (4, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    td = Discriminator(5, 2, (8,))(TensorDict({"motion": torch.randn(*batch, 2, 5)}, batch_size=batch))
    assert td["discriminator_logit"].shape == (*batch, 1)
    assert td["normalized_motion"].shape == (*batch, 2, 5)


def test_nested_keys() -> None:
    net = Discriminator(
        5,
        2,
        (8,),
        num_skills=3,
        motion_key=("a", "m"),
        skill_key=("a", "c"),
        out_key=("b", "d"),
        normalized_key=("b", "n"),
    )
    td = net(TensorDict({"a": {"m": torch.randn(4, 2, 5), "c": torch.zeros(4, dtype=torch.long)}}, batch_size=[4]))
    assert net.in_keys == [("a", "m"), ("a", "c")]
    assert td["b", "d"].shape == (4, 1)
    assert td["b", "n"].shape == (4, 2, 5)


def test_initialisation_of_the_released_code() -> None:
    net = Discriminator()
    assert [tuple(p.shape) for p in net.parameters()] == [(512, 98), (512,), (256, 512), (256,), (1, 256), (1,)]
    weight = net.head.weight
    assert weight.abs().max() <= 1.0
    assert weight.std().item() == pytest.approx(3**-0.5, rel=0.15)  # of U(-1, 1)
    assert all(bool((p == 0).all()) for name, p in net.named_parameters() if name.endswith("bias"))


def test_value_of_one_unit() -> None:
    normalizer = FeatureNormalizer([1.0], [2.0])
    net = Discriminator(1, 2, (1,), normalizer=normalizer)
    with torch.no_grad():
        net.trunk.layers[0].weight.copy_(torch.tensor([[1.0, 2.0]]))
        net.head.weight.fill_(3.0)
        net.head.bias.fill_(0.5)
    td = net(TensorDict({"motion": torch.tensor([[[3.0], [5.0]], [[-3.0], [1.0]]])}, batch_size=[2]))
    # normalised (1, 2) and (-2, 0); relu(1 + 4) = 5 and relu(-2) = 0
    assert td["discriminator_logit"].flatten().tolist() == [15.5, 0.5]
    assert td["normalized_motion"].flatten().tolist() == [1.0, 2.0, -2.0, 0.0]


def test_the_trunk_is_shared() -> None:
    discriminator = Discriminator(5, 2, (8,))
    predictor = Predictor(trunk=discriminator.trunk)
    assert predictor.trunk is discriminator.trunk
    shared = {id(p) for p in discriminator.parameters()} & {id(p) for p in predictor.parameters()}
    assert shared == {id(p) for p in discriminator.trunk.parameters()}


def test_the_conditional_form_starts_unconditional_and_learns_the_skill() -> None:
    net = Discriminator(5, 2, (8,), num_skills=3)
    td = TensorDict({"motion": torch.randn(1, 2, 5).expand(3, 2, 5), "skill": torch.arange(3)}, batch_size=[3])
    logit = net(td.clone())["discriminator_logit"]
    assert logit.std() < 1e-6
    features = net.trunk(td["motion"])
    logit[1].backward()
    torch.testing.assert_close(net.embedding.weight.grad, torch.stack([0 * features[0], features[1], 0 * features[0]]))


def test_gradients_reach_every_parameter() -> None:
    net = Discriminator(5, 2, (8, 6))
    net(TensorDict({"motion": torch.randn(16, 2, 5)}, batch_size=[16]))["discriminator_logit"].sum().backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in net.parameters())


def test_errors() -> None:
    with pytest.raises(ValueError, match=r"motion must be \[\*B, 2 frames, 5 features\], got \[4, 3, 5\]"):
        Discriminator(5, 2, (8,))(TensorDict({"motion": torch.zeros(4, 3, 5)}, batch_size=[4]))
    normalizer = FeatureNormalizer(torch.zeros(5), torch.ones(5))
    with pytest.raises(ValueError, match="brings its own normaliser"):
        Discriminator(trunk=MotionTrunk(5), normalizer=normalizer)
    with pytest.raises(ValueError, match="5 features"):
        MotionTrunk(6, normalizer=normalizer)
