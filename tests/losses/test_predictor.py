from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.losses import DiscriminatorLoss, PredictorLoss
from agility_rl.modules import Discriminator, Predictor, SkillPrior

F, H, K = 3, 2, 4


def network(**options: object) -> Predictor:
    return Predictor(F, H, K, hidden=(8,), **options)


def batch() -> TensorDict:
    return TensorDict(
        {
            "labelled": TensorDict({"motion": torch.randn(4, H, F), "skill": torch.tensor([0, 1, 2, 3])}, [4]),
            "policy": TensorDict({"motion": torch.randn(6, H, F), "shift": 2 * torch.rand(6, 1) - 1}, [6]),
            "unlabelled": TensorDict({"motion": torch.randn(5, H, F)}, [5]),
        }
    )


def total(losses: TensorDict) -> Tensor:
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


def probabilities(net: Predictor, motion: Tensor) -> np.ndarray:
    logits = net(TensorDict({"motion": motion}))["skill_logits"].detach().double().numpy()
    exponential = np.exp(logits)
    return exponential / exponential.sum(-1, keepdims=True)


def test_values_against_numpy() -> None:
    net, td = network(), batch()
    losses = PredictorLoss(net, labelled=2.0, shift=3.0, information=0.5, marginal=0.1)(td)
    p = probabilities(net, td["labelled", "motion"])
    label = td["labelled", "skill"].numpy()
    assert losses["loss_skill"].item() == pytest.approx(-2.0 * np.log(p[np.arange(4), label]).mean(), rel=1e-5)
    assert losses["accuracy_labelled"].item() == pytest.approx((p.argmax(-1) == label).mean())
    estimate = net(TensorDict({"motion": td["policy", "motion"]}))["shift_estimate"].detach()
    error = (estimate - td["policy", "shift"]).abs().mean().item()
    assert losses["loss_shift"].item() == pytest.approx(3.0 * error, rel=1e-5)
    assert losses["error_shift"].item() == pytest.approx(error, rel=1e-5)
    p = probabilities(net, td["unlabelled", "motion"])
    entropy = -(p * np.log(p)).sum(-1).mean()
    assert losses["loss_information"].item() == pytest.approx(0.5 * entropy, rel=1e-5)
    assert losses["entropy_unlabelled"].item() == pytest.approx(entropy, rel=1e-5)
    mean = p.mean(0)
    assert losses["loss_marginal"].item() == pytest.approx(0.1 * (mean * np.log(mean)).sum(), rel=1e-5)
    np.testing.assert_allclose(losses["unlabelled_skill_probability"].numpy(), mean, rtol=1e-5)


def test_cross_entropy_is_not_taken_of_a_second_softmax() -> None:
    net, td = network(), batch()
    with torch.no_grad():
        net.skill_head.weight.zero_()
        net.skill_head.bias.copy_(torch.tensor([50.0, 0.0, 0.0, 0.0]))
    td["labelled", "skill"] = torch.zeros(4, dtype=torch.long)
    assert PredictorLoss(net)(td)["loss_skill"].item() < 1e-6  # the released form could not fall below 0.905


def test_gradients_go_where_the_paper_says() -> None:
    discriminator = Discriminator(F, H, (8,))
    net, td = Predictor(trunk=discriminator.trunk, num_skills=K), batch()
    loss = PredictorLoss(net)
    losses = loss(td)
    losses["loss_shift"].backward(retain_graph=True)
    assert net.skill_head.weight.grad is None
    assert net.shift_head.weight.grad.abs().sum() > 0
    net.zero_grad(set_to_none=True)
    (losses["loss_skill"] + losses["loss_information"]).backward()
    assert net.shift_head.weight.grad is None
    assert net.skill_head.weight.grad.abs().sum() > 0
    assert discriminator.trunk.layers[0].weight.grad.abs().sum() > 0
    assert discriminator.head.weight.grad is None
    assert not any(value.requires_grad for name, value in losses.items() if not name.startswith("loss_"))


def test_one_optimiser_step_on_both_losses_moves_the_shared_trunk_once() -> None:
    discriminator = Discriminator(F, H, (8,))
    net, td = Predictor(trunk=discriminator.trunk, num_skills=K), batch()
    adversarial, loss = DiscriminatorLoss(discriminator), PredictorLoss(net)
    td["expert"] = td["unlabelled"]
    groups = [{"params": discriminator.parameters()}, {"params": [*net.skill_head.parameters()], "lr": 0.1}]
    optimizer = torch.optim.SGD(groups, lr=0.01)
    weight = discriminator.trunk.layers[0].weight
    before = weight.detach().clone()
    (total(adversarial(td)) + total(loss(td))).backward()
    gradient = weight.grad.clone()
    optimizer.step()
    torch.testing.assert_close(weight.detach(), before - 0.01 * gradient)
    assert loss.predictor_params["trunk", "layers", "0", "weight"].data_ptr() == weight.data_ptr()


def test_the_input_is_not_modified_and_in_keys_suffice() -> None:
    loss, td = PredictorLoss(network()), batch()
    keys_before = set(td.keys(True, True))
    losses = loss(td)
    assert set(td.keys(True, True)) == keys_before
    assert set(losses.keys()) == set(loss.out_keys)
    torch.testing.assert_close(total(loss(td.select(*loss.in_keys))), total(losses))


def test_call_without_tensordict() -> None:
    loss, td = PredictorLoss(network(), shift=None), batch()
    values = loss(
        labelled_motion=td["labelled", "motion"],
        labelled_skill=td["labelled", "skill"],
        unlabelled_motion=td["unlabelled", "motion"],
    )
    torch.testing.assert_close(values[0], loss(td)["loss_skill"])


def test_nested_keys() -> None:
    net = network(motion_key=("o", "m"), skill_logits_key=("q", "c"), shift_estimate_key=("q", "e"))
    loss = PredictorLoss(net)
    loss.set_keys(
        labelled=("g", "l"),
        policy=("g", "p"),
        unlabelled=("g", "u"),
        skill=("y", "c"),
        shift=("y", "e"),
        skill_logits=("q", "c"),
        shift_estimate=("q", "e"),
    )
    flat = batch()
    td = TensorDict(
        {
            "g": {
                "l": {"o": {"m": flat["labelled", "motion"]}, "y": {"c": flat["labelled", "skill"]}},
                "p": {"o": {"m": flat["policy", "motion"]}, "y": {"e": flat["policy", "shift"]}},
                "u": {"o": {"m": flat["unlabelled", "motion"]}},
            }
        }
    )
    assert set(loss.in_keys) == set(td.keys(True, True)) - {"g", ("g", "l"), ("g", "p"), ("g", "u")}
    plain = network()
    plain.load_state_dict(net.state_dict())
    torch.testing.assert_close(total(loss(td)), total(PredictorLoss(plain)(flat)))


@pytest.mark.parametrize("term", ["labelled", "shift", "information", "marginal"])
def test_a_term_alone_reads_only_its_group(term: str) -> None:
    off = dict.fromkeys(("labelled", "shift", "information", "marginal"))
    loss = PredictorLoss(network(), **{**off, term: 1.0})
    td = batch().select(*loss.in_keys)
    assert len(td.keys()) == 1
    losses = loss(td)
    assert set(losses.keys()) == set(loss.out_keys)
    total(losses).backward()


def test_coefficients_change_in_place() -> None:
    loss, td = PredictorLoss(network(), information=0.0), batch()
    assert loss(td)["loss_information"] == 0
    loss.information = 0.3
    losses = loss(td)
    torch.testing.assert_close(losses["loss_information"], 0.3 * losses["entropy_unlabelled"])


def test_batches_of_any_shape_sums_and_masks() -> None:
    net, td = network(), batch()
    folded = TensorDict(
        {
            "labelled": {key: value.reshape(2, 2, *value.shape[1:]) for key, value in td["labelled"].items()},
            "policy": {key: value.reshape(2, 3, *value.shape[1:]) for key, value in td["policy"].items()},
            "unlabelled": {"motion": td["unlabelled", "motion"][None]},
        }
    )
    torch.testing.assert_close(total(PredictorLoss(net)(folded)), total(PredictorLoss(net)(td)))
    assert PredictorLoss(net)(folded)["unlabelled_skill_probability"].shape == (K,)
    summed, mean = PredictorLoss(net, reduction="sum")(td), PredictorLoss(net)(td)
    torch.testing.assert_close(summed["loss_shift"], 6 * mean["loss_shift"])
    td["labelled", "collector", "mask"] = torch.tensor([True, False, True, False])
    masked = PredictorLoss(net)(td)["loss_skill"]
    td["labelled"] = td["labelled"][::2].exclude("collector")
    torch.testing.assert_close(masked, PredictorLoss(net)(td)["loss_skill"])


def test_what_does_not_count_is_in_no_number() -> None:
    net, td = network(), batch()
    for group in ("labelled", "policy", "unlabelled"):
        counting = torch.arange(td[group].numel()) % 2 == 0
        td[group, "collector", "mask"] = counting
    some, alone = TensorDict(), TensorDict()
    for group in ("labelled", "policy", "unlabelled"):
        some[group], alone[group] = td[group], td[group][::2].exclude("collector")
    loss = PredictorLoss(net, marginal=0.5)
    for name, value in loss(alone).items():
        torch.testing.assert_close(loss(some)[name], value, msg=name)


def test_a_target_of_another_shape_is_refused_not_broadcast() -> None:
    td = batch()
    td["policy", "shift"] = td["policy", "shift"].squeeze(-1)
    with pytest.raises(ValueError, match=r"expected 'shift' of shape \[6, 1\], as it is estimated, got \[6\]"):
        PredictorLoss(network())(td)


def test_the_probability_feeds_the_prior() -> None:
    prior = SkillPrior(K, decay=0.0)
    losses = PredictorLoss(network())(batch())
    prior.update(losses["unlabelled_skill_probability"])
    torch.testing.assert_close(prior.probabilities, losses["unlabelled_skill_probability"])


def test_it_learns_labels_and_spreads_them_over_clusters() -> None:
    generator = torch.Generator().manual_seed(3)
    centres = 3 * torch.randn(K, H, F, generator=generator)
    net, td = network(), batch()
    label = torch.arange(K).repeat(16)
    unlabelled = centres[label] + 0.3 * torch.randn(64, H, F, generator=generator)
    td["labelled"] = TensorDict({"motion": centres, "skill": torch.arange(K)}, [K])
    td["unlabelled"] = TensorDict({"motion": unlabelled}, [64])
    loss = PredictorLoss(net, information=0.1)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    for _ in range(150):
        optimizer.zero_grad()
        losses = loss(td)
        total(losses).backward()
        optimizer.step()
    assert losses["accuracy_labelled"] == 1.0
    assert (probabilities(net, unlabelled).argmax(-1) == label.numpy()).mean() > 0.95
    assert losses["entropy_unlabelled"] < 0.1


def test_no_term_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one"):
        PredictorLoss(network(), labelled=None, shift=None, information=None)
