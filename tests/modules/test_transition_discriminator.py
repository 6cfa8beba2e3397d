from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.losses import TransitionDiscriminatorLoss
from agility_rl.modules import FeatureNormalizer, TransitionDiscriminator, transition_discriminator
from agility_rl.modules.transition_discriminator import DISCREPANCY_SLOPE

S, A = 3, 2


def transitions(count: int = 5, **following: Tensor) -> TensorDict:
    state, action = torch.randn(count, S), torch.randn(count, A)
    after = following.get("following", state + 0.1 * torch.randn(count, S))
    return TensorDict({"measurement": state, "action": action, "next": {"measurement": after}}, [count])


def by_hand(network: TransitionDiscriminator, inputs: np.ndarray) -> np.ndarray:
    w1, b1, w2, b2, w3, b3 = (p.detach().double().numpy() for p in network.parameters())
    if network.normalizer is not None:
        inputs = (inputs - network.normalizer.mean.numpy()) / network.normalizer.std.numpy()
    hidden = np.maximum(np.maximum(inputs @ w1.T + b1, 0) @ w2.T + b2, 0)
    return hidden @ w3.T + b3


@pytest.mark.parametrize("difference", [False, True])
@pytest.mark.parametrize("normalized", [False, True])
def test_values_against_numpy(difference: bool, normalized: bool) -> None:
    normalizer = FeatureNormalizer(torch.linspace(-0.1, 0.1, 8), torch.linspace(0.5, 2.0, 8)) if normalized else None
    network, td = TransitionDiscriminator(S, A, (7, 6), normalizer=normalizer, difference=difference), transitions()
    state, action, after = (td[key].double().numpy() for key in ("measurement", "action", ("next", "measurement")))
    expected = by_hand(network, np.concatenate((state, action, after - state if difference else after), -1))
    out = network(td)
    np.testing.assert_allclose(out["transition_logit"].detach().numpy(), expected, rtol=1e-4, atol=1e-6)
    assert out["normalized_transition"].shape == (5, 8)


def test_default_sizes_are_those_of_the_paper() -> None:
    shapes = [tuple(p.shape) for p in TransitionDiscriminator().parameters() if p.ndim == 2]
    assert shapes == [(128, 70), (128, 128), (1, 128)]


def test_statistics_of_the_log_make_its_inputs_standard() -> None:
    td = transitions(400)
    td["measurement"] = td["measurement"] * torch.tensor([100.0, 0.01, 1.0]) + 5.0
    td["next", "measurement"] = td["measurement"] + 0.02 * torch.randn(400, S)
    network = TransitionDiscriminator.from_transitions(td, difference=True)
    normalized = network(td.clone())["normalized_transition"]
    torch.testing.assert_close(normalized.mean(0), torch.zeros(8), atol=1e-4, rtol=0)
    torch.testing.assert_close(normalized.std(0, correction=0), torch.ones(8), atol=1e-3, rtol=0)


def test_a_constant_input_says_nothing_instead_of_everything() -> None:
    td = transitions(50)
    td["action"] = torch.zeros(50, A)
    network = TransitionDiscriminator.from_transitions(td)
    assert network.normalizer.std[S : S + A].tolist() == pytest.approx([1e-3] * A)
    td["action"] = torch.full((50, A), 1e6)
    assert network(td)["normalized_transition"].abs().max() <= 10.0


def test_any_batch_shape_and_nested_keys() -> None:
    network = TransitionDiscriminator(
        S, A, (4,), measurement_key=("o", "m"), action_key=("o", "a"), out_key=("d", "x"), normalized_key=("d", "n")
    )
    entry = {"o": {"m": torch.randn(4, 6, S), "a": torch.randn(4, 6, A)}}
    td = TensorDict({**entry, "next": {"o": {"m": torch.randn(4, 6, S)}}}, [4, 6])
    assert network.in_keys == [("o", "m"), ("o", "a"), ("next", "o", "m")]
    assert network(td)["d", "x"].shape == (4, 6, 1)
    flat = network(td.exclude("d").reshape(-1))["d", "x"]
    torch.testing.assert_close(flat.reshape(4, 6, 1), td["d", "x"])


def test_state_dict_carries_the_statistics() -> None:
    td = transitions(30)
    one = TransitionDiscriminator.from_transitions(td)
    other = TransitionDiscriminator(S, A, normalizer=FeatureNormalizer(torch.zeros(8), torch.ones(8)))
    other.load_state_dict(one.state_dict())
    assert torch.equal(one(td.clone())["transition_logit"], other(td.clone())["transition_logit"])


def test_permuting_the_batch_permutes_the_logits() -> None:
    network, td, order = TransitionDiscriminator(S, A), transitions(6), torch.tensor([3, 1, 5, 0, 2, 4])
    torch.testing.assert_close(network(td[order])["transition_logit"], network(td)["transition_logit"][order])


def test_errors() -> None:
    with pytest.raises(ValueError, match=r"7 numbers, but a transition has 2 \* 3 \+ 2 = 8"):
        TransitionDiscriminator(S, A, normalizer=FeatureNormalizer(torch.zeros(7), torch.ones(7)))
    with pytest.raises(ValueError, match=r"'action' must be \[\*B, 2\], got \[5, 4\]"):
        TransitionDiscriminator(S, A)(transitions().set("action", torch.zeros(5, 4)))
    with pytest.raises(ValueError, match="relative to one state"):
        TransitionDiscriminator(S, A, difference=True, matched_key=MATCHED)
    with pytest.raises(ValueError, match="rescale needs a matched_key"):
        TransitionDiscriminator.from_transitions(transitions()).rescale(transitions())


MATCHED = ("next", "matched_measurement")


def matched(count: int, scale: Tensor) -> TensorDict:
    td = transitions(count)
    td[MATCHED] = td["next", "measurement"] - scale * torch.randn(count, S)
    return td


def test_before_it_learns_a_matched_critic_is_a_distance() -> None:
    td = matched(5, torch.ones(S))
    network = TransitionDiscriminator(S, A, (7, 6), matched_key=MATCHED)
    expected = -0.25 * (td["next", "measurement"] - td[MATCHED]).abs().sum(-1, keepdim=True)
    torch.testing.assert_close(network(td)["transition_logit"], expected)


def test_no_other_slope_begins_with_a_smaller_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eq. (13) with a penalty of 1, for misses of mean 1."""
    simulator = matched(4000, torch.ones(S))
    simulator[MATCHED] = simulator["next", "measurement"] - 2.0 * torch.rand(4000, S)
    robot = simulator.clone()
    robot["next", "measurement"] = robot[MATCHED]
    loss = TransitionDiscriminatorLoss(
        TransitionDiscriminator(S, A, matched_key=MATCHED), weight_clip=None, gradient_penalty=1.0
    )
    losses = {}
    for share in (0.6, 0.8, 1.0, 1.2, 1.4):
        monkeypatch.setattr(transition_discriminator, "DISCREPANCY_SLOPE", share * DISCREPANCY_SLOPE)
        out = loss(TensorDict({"expert": robot, "policy": simulator}))
        losses[share] = (out["loss_discriminator"] + out["loss_gradient_penalty"]).item()
    assert min(losses, key=lambda share: losses[share]) == 1.0


def test_the_discrepancy_from_the_robot_against_numpy_has_no_sign() -> None:
    network = TransitionDiscriminator(S, A, (7, 6), matched_key=MATCHED)
    torch.nn.init.normal_(network.head.weight)
    td = matched(5, torch.ones(S))
    state, action, after, robot = (
        td[key].double().numpy() for key in ("measurement", "action", ("next", "measurement"), MATCHED)
    )
    expected = by_hand(network, np.concatenate((state, action, abs(after - robot)), -1))
    expected -= 0.25 * abs(after - robot).sum(-1, keepdims=True)
    np.testing.assert_allclose(network(td)["transition_logit"].detach().numpy(), expected, rtol=1e-4, atol=1e-6)
    assert network.in_keys[-1] == MATCHED
    other = td.clone()
    other["next", "measurement"] = 2.0 * td[MATCHED] - td["next", "measurement"]  # as far off to the other side
    torch.testing.assert_close(network(other)["transition_logit"], network(td)["transition_logit"])


def test_the_discrepancy_is_scaled_by_its_median_and_clipped() -> None:
    real = transitions(50)
    real[MATCHED] = real["next", "measurement"]
    network = TransitionDiscriminator.from_transitions(real, clip=3.0, matched_key=MATCHED)
    scale = torch.tensor([1e-3, 1.0, 50.0])
    td = matched(400, scale)
    td["next", "measurement"][0] += 1e6  # a window whose start state was far off
    td["collector"] = TensorDict({"mask": torch.arange(400) < 200}, [400])
    td[MATCHED][200:] += 1e6
    before = network.normalizer.std[: S + A].clone()
    network.rescale(td)
    discrepancy = (td["next", "measurement"] - td[MATCHED])[:200].abs().numpy()
    middle = np.sort(discrepancy, 0)[99]
    np.testing.assert_allclose(network.normalizer.std[-S:].numpy(), middle, rtol=1e-5)
    assert torch.equal(network.normalizer.std[: S + A], before)
    seen = network(td)["normalized_transition"][..., -S:]
    assert float(seen[0].min()) == 3.0 and float(network(real)["normalized_transition"][..., -S:].abs().max()) == 0.0
    td["collector", "mask"] = torch.zeros(400, dtype=torch.bool)
    with pytest.raises(ValueError, match="no transition is valid"):
        network.rescale(td)
