from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, ProbabilisticTensorDictSequential, set_interaction_type
from torchrl.objectives import ClipPPOLoss

from agility_rl.modules import Critic, HybridActor, ScandotsEncoder, selected_parameters

CHOICE, PARAMETERS = ("action", "behaviour"), ("action", "parameters")


def actor(shape: tuple[int, ...] = (4, 2), **options: object) -> HybridActor:
    return HybridActor(3, 4, shape, in_keys=["observation"], hidden=(8,), **options)  # type: ignore[arg-type]


def observation(*batch: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*batch, 3)}, batch_size=batch)


def test_sizes_of_section_s6() -> None:
    net = HybridActor(130, in_keys=["observation"])
    shapes = [tuple(p.shape) for p in net.parameters() if p.ndim == 2]
    assert shapes == [(512, 130), (256, 512), (128, 256), (5, 128), (30, 128)]
    td = net(TensorDict({"observation": torch.zeros(2, 130)}, batch_size=[2]))
    assert td[PARAMETERS].shape == td["loc"].shape == td["scale"].shape == (2, 5, 6)
    assert torch.equal(td["scale"], torch.ones(2, 5, 6))


@pytest.mark.parametrize("batch", [(), (5,), (5, 3)])
@pytest.mark.parametrize(("shape", "density"), [((4, 2), (4,)), ((6,), ()), ((3, 2, 2), (3, 2))])
def test_shapes_and_types(batch: tuple[int, ...], shape: tuple[int, ...], density: tuple[int, ...]) -> None:
    td = actor(shape)(observation(*batch))
    assert td[CHOICE].dtype == torch.int64
    assert td[PARAMETERS].dtype == torch.float32
    assert td[CHOICE].shape == td["action", "behaviour_log_prob"].shape == batch
    assert td[PARAMETERS].shape == (*batch, *shape)
    assert td["action", "parameters_log_prob"].shape == (*batch, *density)
    assert td["logits"].shape == (*batch, 4)


def test_log_probabilities_by_hand() -> None:
    td = actor(initial_std=0.5)(observation(6))
    chosen = td["logits"].exp() / td["logits"].exp().sum(-1, keepdim=True)
    expected = chosen[torch.arange(6), td[CHOICE]].log()
    torch.testing.assert_close(td["action", "behaviour_log_prob"], expected)
    z = (td[PARAMETERS] - td["loc"]) / 0.5
    blocks = (-0.5 * z.square() - math.log(0.5) - 0.5 * math.log(2 * math.pi)).sum(-1)
    torch.testing.assert_close(td["action", "parameters_log_prob"], blocks)


def test_samples_follow_the_distribution() -> None:
    net = actor(initial_std=0.5, generator=torch.Generator().manual_seed(3))
    td = net(TensorDict({"observation": torch.tensor([0.3, -1.0, 2.0]).expand(40_000, 3)}, batch_size=[40_000]))
    frequency = torch.bincount(td[CHOICE], minlength=4) / 40_000
    torch.testing.assert_close(frequency, td["logits"][0].softmax(-1), atol=0.01, rtol=0.0)
    torch.testing.assert_close(td[PARAMETERS].mean(0), td["loc"][0], atol=0.015, rtol=0.0)
    torch.testing.assert_close(td[PARAMETERS].std(0), torch.full((4, 2), 0.5), atol=0.015, rtol=0.0)


def test_deterministic_is_argmax_and_mean() -> None:
    with set_interaction_type(InteractionType.DETERMINISTIC):
        td = actor()(observation(50))
    assert torch.equal(td[CHOICE], td["logits"].argmax(-1))
    assert torch.equal(td[PARAMETERS], td["loc"])
    assert td[CHOICE].unique().numel() > 1


def test_samples_follow_the_generator() -> None:
    td = observation(20)
    one, two = (actor(generator=torch.Generator().manual_seed(7)) for _ in range(2))
    two.load_state_dict(one.state_dict())
    before = torch.get_rng_state()
    first, second = (one(td.clone())["action"] for _ in range(2))
    again = two(td.clone())["action"]
    assert bool((first == again).all())
    assert not torch.equal(first["behaviour"], second["behaviour"])
    assert torch.equal(before, torch.get_rng_state())


def test_every_key_may_be_another_and_nested() -> None:
    net = HybridActor(
        2 + 12,
        3,
        (5,),
        in_keys=[("o", "p"), ("o", "h")],
        hidden=(8,),
        sequence_keys=[("o", "h")],
        choice_key=("a", "b", "which"),
        parameters_key="how",
        logits_key=("x", "l"),
        loc_key=("x", "m"),
        scale_key=("x", "s"),
    )
    td = net(TensorDict({"o": {"p": torch.zeros(4, 2), "h": torch.zeros(4, 3, 4)}}, batch_size=[4]))
    assert td["a", "b", "which"].shape == td["a", "b", "which_log_prob"].shape == td["how_log_prob"].shape == (4,)
    assert td["how"].shape == td["x", "m"].shape == td["x", "s"].shape == (4, 5)
    assert td["x", "l"].shape == (4, 3)
    written = set(td.keys(include_nested=True, leaves_only=True)) - {("o", "p"), ("o", "h")}
    assert written == set(net.out_keys)
    assert net.in_keys == [("o", "p"), ("o", "h")]


def test_the_floor_holds_and_lets_the_gradient_pass() -> None:
    net = actor((4, 2), min_std=torch.tensor([0.1, 0.2]))
    with torch.no_grad():
        net.network.parameters_head.std.copy_(torch.tensor([-1.0, 0.5] * 4))
    td = net(observation(3))
    torch.testing.assert_close(td["scale"][0], torch.tensor([[0.1, 0.5]] * 4))
    td["scale"].sum().backward()
    assert net.network.parameters_head.std.grad.tolist() == [3.0] * 8
    net.project_std()
    torch.testing.assert_close(net.network.parameters_head.std.data, torch.tensor([0.1, 0.5] * 4))


def test_it_may_follow_an_encoder() -> None:
    encoder = ScandotsEncoder(9, 4, hidden=(8,))
    net = HybridActor(4, 3, (3, 2), in_keys=["terrain_latent"], hidden=(8,))
    policy = ProbabilisticTensorDictSequential(encoder, *net)
    assert policy.in_keys == ["scandots"]
    td = policy(TensorDict({"scandots": torch.randn(5, 9)}, batch_size=[5]))
    (td["action", "behaviour_log_prob"].sum() + td["action", "parameters_log_prob"].sum()).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())


def test_it_trains_by_torchrls_joint_ratio_too() -> None:
    net, critic = actor(), Critic(3, in_keys=["observation"], hidden=(8,))
    with torch.no_grad():
        td = net(observation(16))
    td["advantage"], td["value_target"] = torch.randn(16, 1), torch.randn(16, 1)
    losses = ClipPPOLoss(net, critic, clip_epsilon=0.2)(td)
    torch.testing.assert_close(losses["loss_objective"], -td["advantage"].mean())
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_selected_parameters() -> None:
    parameters = torch.arange(24.0).reshape(3, 4, 2)
    choice = torch.tensor([2, 0, 3])
    assert selected_parameters(choice, parameters).tolist() == [[4.0, 5.0], [8.0, 9.0], [22.0, 23.0]]
    stacked = selected_parameters(choice.expand(6, 3), parameters.expand(6, 3, 4, 2))
    assert torch.equal(stacked[5], selected_parameters(choice, parameters))
    leaf = parameters.clone().requires_grad_()
    selected_parameters(choice, leaf).sum().backward()
    assert leaf.grad.sum(-1).tolist() == [[0, 0, 2, 0], [2, 0, 0, 0], [0, 0, 0, 2]]
    with pytest.raises(ValueError, match=r"\[\*B, K, P\]"):
        selected_parameters(choice, parameters[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_choices": 1}, "at least 2 choices"),
        ({"continuous_shape": ()}, "positive sizes"),
        ({"continuous_shape": (2, 0)}, "positive sizes"),
        ({"min_std": 0.0}, "min_std"),
        ({"min_std": 1.5}, "min_std"),
        ({"hidden": ()}, "at least one layer"),
    ],
)
def test_impossible_sizes_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HybridActor(3, in_keys=["observation"], **options)  # type: ignore[arg-type]
