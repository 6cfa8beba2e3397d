from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl.losses import AdaptationLoss, StateEstimationLoss
from agility_rl.modules import HistoryEncoder, PrivilegedEncoder, StateEstimator


def observation() -> TensorDict:
    return TensorDict(
        {
            "proprioception": torch.randn(8, 6),
            "explicit": torch.randn(8, 4),
            "history": torch.randn(8, 10, 6),
            "privileged": torch.randn(8, 29),
        },
        batch_size=[8],
    )


def encoders() -> tuple[HistoryEncoder, PrivilegedEncoder]:
    return HistoryEncoder(6), PrivilegedEncoder()


def test_estimation_values() -> None:
    net, td = StateEstimator(6), observation()
    losses = StateEstimationLoss(net)(td)
    error = (net(td.clone())["estimate"] - td["explicit"]).square().mean()
    torch.testing.assert_close(losses["loss_estimation"], error)
    torch.testing.assert_close(losses["error_estimation"], error.sqrt().detach())
    assert StateEstimationLoss(net, reduction="none")(td)["loss_estimation"].shape == (8,)


def test_estimation_gradients_and_keys() -> None:
    net = StateEstimator(6, in_keys=[("o", "p")], out_key=("o", "e"))
    loss = StateEstimationLoss(net)
    loss.set_keys(estimate=("o", "e"), target=("o", "s"))
    target = torch.randn(8, 4, requires_grad=True)
    td = TensorDict({"o": {"p": torch.randn(8, 6), "s": target}}, batch_size=[8])
    assert loss.in_keys == [("o", "p"), ("o", "s")]
    loss(td)["loss_estimation"].backward()
    assert target.grad is None
    assert all(p.grad is not None for p in net.parameters())
    assert set(td.keys(True, True)) == {("o", "p"), ("o", "s")}
    torch.testing.assert_close(
        loss(o_p=td["o", "p"], o_s=td["o", "s"])[0],
        loss(td)["loss_estimation"],
    )


def test_adaptation_values() -> None:
    history, privileged = encoders()
    td = observation()
    losses = AdaptationLoss(history, privileged, history=2.0, privileged=0.1)(td)
    distance = (history(td.clone())["latent"] - privileged(td.clone())["latent"]).square().sum(-1).sqrt().mean()
    torch.testing.assert_close(losses["loss_adaptation"], 2.0 * distance)
    torch.testing.assert_close(losses["loss_privileged"], 0.1 * distance)
    torch.testing.assert_close(losses["error_adaptation"], distance.detach())


@pytest.mark.parametrize(("term", "learner"), [("loss_adaptation", 0), ("loss_privileged", 1)])
def test_each_term_teaches_one_encoder(term: str, learner: int) -> None:
    networks = encoders()
    AdaptationLoss(*networks, privileged=0.1)(observation())[term].backward()
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in networks[learner].parameters())
    assert all(p.grad is None for p in networks[1 - learner].parameters())


def test_equal_latents_have_finite_gradients() -> None:
    history, privileged = encoders()
    with torch.no_grad():
        for parameter in (*history.parameters(), *privileged.parameters()):
            parameter.zero_()
    losses = AdaptationLoss(history, privileged, privileged=1.0)(observation())
    (losses["loss_adaptation"] + losses["loss_privileged"]).backward()
    assert all(bool(p.grad.isfinite().all()) for p in (*history.parameters(), *privileged.parameters()))


def test_adaptation_keys_and_schedule() -> None:
    history = HistoryEncoder(6, in_key=("o", "h"), out_key=("z", "h"))
    privileged = PrivilegedEncoder(in_keys=[("o", "p")], out_key=("z", "p"))
    loss = AdaptationLoss(history, privileged)
    loss.set_keys(history_latent=("z", "h"), privileged_latent=("z", "p"))
    flat = observation()
    td = TensorDict({"o": {"h": flat["history"], "p": flat["privileged"]}}, batch_size=[8])
    assert loss.in_keys == [("o", "h"), ("o", "p")]
    losses = loss(td)
    assert set(losses.keys()) == set(loss.out_keys)
    assert losses["loss_privileged"] == 0
    loss.privileged = 0.1
    torch.testing.assert_close(loss(td)["loss_privileged"], 0.1 * losses["error_adaptation"])


def test_masked_samples_do_not_count() -> None:
    loss, td = AdaptationLoss(*encoders()), observation()
    td["collector", "mask"] = torch.arange(8) < 3
    torch.testing.assert_close(loss(td)["loss_adaptation"], loss(td[:3].exclude("collector"))["loss_adaptation"])


def test_latents_of_different_size_are_refused() -> None:
    with pytest.raises(ValueError, match=r"one shape, got \[8, 29\].*\[8, 7\]"):
        AdaptationLoss(HistoryEncoder(6), PrivilegedEncoder(out_features=7))(observation())
