from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from agility_rl.losses import StudentLoss
from agility_rl.modules import RecurrentStudent

K, P, KINDS = 3, 2, 4


class Heads(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.logits, self.loc = nn.Linear(5, K), nn.Linear(5, K * P)
        self.heading, self.obstacle = nn.Linear(5, 2), nn.Linear(5, KINDS)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.logits(x), self.loc(x).unflatten(-1, (K, P)), self.heading(x), self.obstacle(x)


def network() -> TensorDictModule:
    return TensorDictModule(Heads(), in_keys=["x"], out_keys=["logits", "loc", "heading_estimate", "obstacle_logits"])


def batch(*shape: int) -> TensorDict:
    shape = shape or (6,)
    return TensorDict(
        {
            "x": torch.randn(*shape, 5),
            "label": {"behaviour": torch.randint(K, shape), "parameters": torch.randn(*shape, K, P)},
            "heading_error": torch.rand(*shape, 2) - 0.5,
            "obstacle": nn.functional.one_hot(torch.randint(KINDS, shape), KINDS).float(),
        },
        shape,
    )


def test_values_against_numpy() -> None:
    net, td = network(), batch()
    out = StudentLoss(net, behaviour=2.0, continuous=0.5, heading=3.0, obstacle=0.1)(td)
    logits, loc, heading, obstacle = (x.detach().double().numpy() for x in net.module(td["x"]))

    def cross_entropy(scores: np.ndarray, index: np.ndarray) -> float:
        log_sum = np.log(np.exp(scores).sum(-1))
        return float((log_sum - scores[np.arange(len(index)), index]).mean())

    choice, kind = td["label", "behaviour"].numpy(), td["obstacle"].argmax(-1).numpy()
    assert out["loss_behaviour"].item() == pytest.approx(2.0 * cross_entropy(logits, choice), rel=1e-5)
    difference = (td["label", "parameters"].numpy() - loc).reshape(6, -1)
    assert out["loss_parameters"].item() == pytest.approx(0.5 * np.linalg.norm(difference, axis=1).mean(), rel=1e-5)
    turn = td["heading_error"].numpy() - heading
    expected = np.sqrt((2.0 * turn[:, 0]) ** 2 + (0.5 * turn[:, 1]) ** 2).mean()
    assert out["loss_heading"].item() == pytest.approx(3.0 * expected, rel=1e-5)
    assert out["error_heading"].item() == pytest.approx(np.abs(turn[:, 0]).mean(), rel=1e-5)
    assert out["loss_obstacle"].item() == pytest.approx(0.1 * cross_entropy(obstacle, kind), rel=1e-5)
    assert out["accuracy_behaviour"].item() == pytest.approx((logits.argmax(-1) == choice).mean())
    assert out["accuracy_obstacle"].item() == pytest.approx((obstacle.argmax(-1) == kind).mean())


def with_another_head(size: int, key: str) -> TensorDictModule:
    class Wider(Heads):
        def __init__(self) -> None:
            super().__init__()
            self.another = nn.Linear(5, size)

        def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return (*super().forward(x), self.another(x))

    written = ["logits", "loc", "heading_estimate", "obstacle_logits", key]
    return TensorDictModule(Wider(), in_keys=["x"], out_keys=written)


def test_progress_against_numpy() -> None:
    net, td = with_another_head(6, "progress_logits"), batch()
    leg = torch.tensor([0, 5, 3, 3, 1, 2])
    td["progress"] = torch.eye(6)[leg]
    loss = StudentLoss(net, progress=0.5)
    assert "progress" in loss.in_keys and "progress" not in StudentLoss(net).in_keys
    out = loss(td)
    logits = net.module.another(td["x"]).detach().numpy()
    surprise = np.log(np.exp(logits).sum(1)) - logits[np.arange(6), leg.numpy()]
    assert out["loss_progress"].item() == pytest.approx(0.5 * surprise.mean(), rel=1e-5)
    assert out["accuracy_progress"].item() == pytest.approx((logits.argmax(-1) == leg.numpy()).mean())
    assert set(out.keys()) == set(loss.out_keys)
    out["loss_progress"].backward()
    assert net.module.another.weight.grad.abs().sum() > 0 and net.module.logits.weight.grad is None


def test_place_against_numpy() -> None:
    net, td = with_another_head(8, "place_estimate"), batch()
    td["place"] = torch.randn(6, 8)
    loss = StudentLoss(net, place=0.25)
    assert "place" in loss.in_keys and "place" not in StudentLoss(net).in_keys
    out = loss(td)
    distance = np.abs(td["place"].numpy() - net.module.another(td["x"]).detach().numpy())
    assert out["loss_place"].item() == pytest.approx(0.25 * distance.sum(1).mean(), rel=1e-5)
    assert out["error_place"].item() == pytest.approx(distance[:, :2].mean(), rel=1e-5)
    assert set(out.keys()) == set(loss.out_keys)
    out["loss_place"].backward()
    assert net.module.another.weight.grad.abs().sum() > 0 and net.module.logits.weight.grad is None


def test_latent_against_numpy() -> None:
    class Seeing(Heads):
        def __init__(self) -> None:
            super().__init__()
            self.latent = nn.Linear(5, 32)

        def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return (*super().forward(x), self.latent(x))

    written = ["logits", "loc", "heading_estimate", "obstacle_logits", "terrain_latent"]
    net, td = TensorDictModule(Seeing(), in_keys=["x"], out_keys=written), batch()
    td["label", "terrain_latent"] = torch.randn(6, 32)
    loss = StudentLoss(net, latent=2.0)
    assert ("label", "terrain_latent") in loss.in_keys and ("label", "terrain_latent") not in StudentLoss(net).in_keys
    out = loss(td)
    distance = td["label", "terrain_latent"].numpy() - net.module.latent(td["x"]).detach().numpy()
    assert out["loss_latent"].item() == pytest.approx(2.0 * (distance**2).mean(), rel=1e-5)
    assert set(out.keys()) == set(loss.out_keys)
    out["loss_latent"].backward()
    assert net.module.latent.weight.grad.abs().sum() > 0 and net.module.logits.weight.grad is None


def test_only_the_selected_parameters_may_count() -> None:
    net, td = network(), batch()
    loc = net.module(td["x"])[1]
    rows, choice = torch.arange(6), td["label", "behaviour"]
    expected = (td["label", "parameters"] - loc)[rows, choice].norm(dim=-1).mean()
    torch.testing.assert_close(StudentLoss(net, compared="selected")(td)["loss_parameters"], expected)


def test_headings_are_compared_around_the_circle() -> None:
    net, td = network(), batch()
    with torch.no_grad():
        net.module.heading.weight.zero_()
        net.module.heading.bias.copy_(torch.tensor([3.1, 0.0]))
    td["heading_error"] = torch.tensor([-3.1, 0.0]).expand(6, 2)
    out = StudentLoss(net)(td)
    assert out["error_heading"].item() == pytest.approx(2 * math.pi - 6.2, abs=1e-5)
    out["loss_heading"].backward()
    assert net.module.heading.bias.grad[0] < 0  # further up, past pi
    assert net.module.heading.bias.grad[0].item() == pytest.approx(-2.0, rel=1e-4)


def test_gradients_go_to_the_network_only() -> None:
    net, td = network(), batch()
    for name in (("label", "parameters"), "heading_error", "obstacle"):
        td[name].requires_grad_()
    out = StudentLoss(net)(td)
    sum(value for name, value in out.items() if name.startswith("loss_")).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in net.parameters())
    assert td["label", "parameters"].grad is None and td["heading_error"].grad is None
    assert not any(value.requires_grad for name, value in out.items() if not name.startswith("loss_"))


def test_terms_may_be_left_out_and_their_entries_are_not_read() -> None:
    td = batch()
    loss = StudentLoss(network(), continuous=None, heading=None, obstacle=None)
    assert loss.in_keys == ["x", ("label", "behaviour")]
    assert set(loss(td.select(*loss.in_keys)).keys()) == set(loss.out_keys) == {"loss_behaviour", "accuracy_behaviour"}
    loss = StudentLoss(network(), behaviour=None)
    assert ("label", "behaviour") not in loss.in_keys
    assert set(loss(td.select(*loss.in_keys)).keys()) == set(loss.out_keys)
    with pytest.raises(ValueError, match="at least one"):
        StudentLoss(network(), behaviour=None, continuous=None, heading=None, obstacle=None)
    with pytest.raises(ValueError, match="'all' or 'selected', got 'some'"):
        StudentLoss(network(), compared="some")


def test_keys_schedule_reduction_and_the_input() -> None:
    net, td = network(), batch(3, 2)
    loss = StudentLoss(net)
    before = set(td.keys(True, True))
    plain = loss(td)
    assert set(td.keys(True, True)) == before
    loss.behaviour = 3.0
    torch.testing.assert_close(loss(td)["loss_behaviour"], 3.0 * plain["loss_behaviour"])
    loss.set_keys(behaviour=("expert", "choice"), heading_error=("truth", "heading"))
    moved = td.exclude("heading_error", "label")
    moved["expert", "choice"], moved["truth", "heading"] = td["label", "behaviour"], td["heading_error"]
    moved["label", "parameters"] = td["label", "parameters"]
    torch.testing.assert_close(loss(moved)["loss_heading"], plain["loss_heading"])
    none = StudentLoss(net, reduction="none")(td)
    assert all(value.shape == (3, 2) for name, value in none.items() if name.startswith("loss_"))
    torch.testing.assert_close(none["loss_parameters"].mean(), plain["loss_parameters"])


def test_with_the_recurrent_student_on_a_window() -> None:
    student = RecurrentStudent(memory=8)
    loss = StudentLoss(student.policy(assisted=True, sequence=True))
    td = TensorDict(
        {
            "depth": torch.randint(256, (3, 2, 58, 87), dtype=torch.uint8),
            "proprioception": torch.randn(3, 2, 45),
            "history": torch.randn(3, 2, 10, 45),
            "hidden": torch.zeros(3, 2, 8),
            "is_init": torch.zeros(3, 2, 1, dtype=torch.bool),
            "heading_error": torch.randn(3, 2, 2),
            "obstacle": torch.eye(7)[torch.randint(7, (3, 2))],
            "label": {"behaviour": torch.randint(5, (3, 2)), "parameters": torch.randn(3, 2, 5, 6)},
        },
        [3, 2],
    )
    out = loss(td.select(*loss.in_keys))
    sum(value for name, value in out.items() if name.startswith("loss_")).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in student.memory.parameters())
    assert all(parameter.grad.abs().sum() > 0 for parameter in student.depth_encoder.parameters())
