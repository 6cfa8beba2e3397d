from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torchrl.objectives import ClipPPOLoss

from agility_rl.modules import Critic, DiagonalGaussian, GaussianActor


def actor(**options: object) -> GaussianActor:
    return GaussianActor(3 + 2, 2, in_keys=["proprioception", "command"], hidden=(8,), **options)


def observation(*batch: int) -> TensorDict:
    return TensorDict({"proprioception": torch.randn(*batch, 3), "command": torch.randn(*batch, 2)}, batch_size=batch)


@pytest.mark.parametrize("batch", [(), (4,), (4, 3)])
def test_shapes(batch: tuple[int, ...]) -> None:
    td = actor()(observation(*batch))
    assert td["action"].shape == td["loc"].shape == td["scale"].shape == (*batch, 2)
    assert td["action_log_prob"].shape == batch


def test_the_log_density_is_the_gaussians() -> None:
    td = actor(initial_std=0.5)(observation(6))
    z = (td["action"] - td["loc"]) / 0.5
    expected = (-0.5 * z.square() - math.log(0.5) - 0.5 * math.log(2 * math.pi)).sum(-1)
    torch.testing.assert_close(td["action_log_prob"], expected)


def test_the_deterministic_action_is_the_mean() -> None:
    with set_interaction_type(InteractionType.DETERMINISTIC):
        td = actor()(observation(6))
    assert torch.equal(td["action"], td["loc"])


def test_nested_keys() -> None:
    net = GaussianActor(
        2 + 12,
        2,
        in_keys=[("o", "p"), ("o", "h")],
        hidden=(8,),
        sequence_keys=[("o", "h")],
        action_key=("x", "a"),
        loc_key=("x", "l"),
        scale_key=("x", "s"),
        log_prob_key=("x", "lp"),
    )
    td = net(TensorDict({"o": {"p": torch.zeros(4, 2), "h": torch.zeros(4, 3, 4)}}, batch_size=[4]))
    assert td["x", "a"].shape == (4, 2)
    assert td["x", "lp"].shape == (4,)


def test_the_floor_holds_and_lets_the_gradient_pass() -> None:
    net = actor(min_std=torch.tensor([0.1, 0.2]))
    with torch.no_grad():
        net.network.std.copy_(torch.tensor([-1.0, 0.5]))
    td = net(observation(4))
    torch.testing.assert_close(td["scale"][0], torch.tensor([0.1, 0.5]))
    td["scale"].sum().backward()
    assert net.network.std.grad.tolist() == [4.0, 4.0]
    net.project_std()
    torch.testing.assert_close(net.network.std.data, torch.tensor([0.1, 0.5]))


def test_samples_follow_the_generator() -> None:
    td = observation(4)
    one, two = (actor(generator=torch.Generator().manual_seed(7)) for _ in range(2))
    two.load_state_dict(one.state_dict())
    before = torch.get_rng_state()
    first, second = one(td.clone())["action"], one(td.clone())["action"]
    assert torch.equal(first, two(td.clone())["action"])
    assert not torch.equal(first, second)
    assert torch.equal(before, torch.get_rng_state())


def test_it_trains_in_clip_ppo() -> None:
    net, critic = actor(), Critic(3, in_keys=["proprioception"], hidden=(8,))
    td = net(observation(16)).detach()
    td["advantage"], td["value_target"] = torch.randn(16, 1), torch.randn(16, 1)
    td["action_log_prob"] = td["action_log_prob"].detach()
    loss = ClipPPOLoss(net, critic, clip_epsilon=0.2)
    losses = loss(td)
    # on the data's own policy the ratio is one, so the objective is minus the mean advantage
    torch.testing.assert_close(losses["loss_objective"], -td["advantage"].mean())
    # entropy of two unit Gaussians
    assert losses["entropy"].item() == pytest.approx(1.0 + math.log(2 * math.pi), rel=1e-5)
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    for parameter in [*net.parameters(), *critic.parameters()]:
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()


def test_the_diagonal_gaussian_has_one_log_density_a_row() -> None:
    gaussian = DiagonalGaussian(torch.zeros(3, 2), torch.ones(3, 2))
    torch.testing.assert_close(gaussian.log_prob(torch.zeros(3, 2)), torch.full((3,), -math.log(2 * math.pi)))
    assert torch.equal(gaussian.deterministic_sample, torch.zeros(3, 2))


@pytest.mark.parametrize("floor", [0.0, 1.5])
def test_impossible_floors_are_refused(floor: float) -> None:
    with pytest.raises(ValueError, match="min_std"):
        actor(min_std=floor)
