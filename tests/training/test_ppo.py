"""The shared PPO update, on a problem small enough to solve."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss, KLAdaptiveLR

from agility_rl.modules import Critic, GaussianActor
from agility_rl.training import ppo
from agility_rl.training.ppo import PPOUpdate

NETWORKS = ((GaussianActor, (1,)), (Critic, ()))


def build(**options: object) -> tuple[GaussianActor, Critic, PPOUpdate]:
    torch.manual_seed(0)
    actor = GaussianActor(2, 1, in_keys=["observation"], hidden=(16,), initial_std=0.5)
    critic = Critic(2, in_keys=["observation"], hidden=(16,))
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=3e-3)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, loss_critic_type="l2")
    settings = {"epochs": 4, "minibatches": 2, **options}
    return actor, critic, PPOUpdate(loss, optimizer, **settings)  # type: ignore[arg-type]


def collect(actor: GaussianActor, critic: Critic, generator: torch.Generator) -> TensorDict:
    """One-step episodes whose reward is highest at action = first observation."""
    batch = TensorDict({"observation": torch.rand(8, 16, 2, generator=generator)}, [8, 16])
    with torch.no_grad():
        critic(actor(batch))
    reward = -(batch["action"] - batch["observation"][..., :1]).square()
    batch["advantage"], batch["value_target"] = reward - batch["state_value"], reward
    return batch


def test_it_learns_the_action_that_pays() -> None:
    actor, critic, update = build()
    generator = torch.Generator().manual_seed(1)
    returns = []
    for _ in range(60):
        batch = collect(actor, critic, generator)
        returns.append(batch["value_target"].mean().item())
        metrics = update(batch, generator)
    assert sum(returns[-5:]) / 5 > 0.4 * sum(returns[:5]) / 5  # rewards are negative: less than half of the first cost
    assert {"loss_objective", "loss_critic", "learning_rate"} <= metrics.keys()


def test_advantages_are_normalised_over_the_batch() -> None:
    actor, critic, update = build()
    batch = collect(actor, critic, torch.Generator().manual_seed(1))
    update(batch, torch.Generator().manual_seed(2))
    assert batch["advantage"].mean().item() == pytest.approx(0.0, abs=1e-5)
    assert batch["advantage"].std().item() == pytest.approx(1.0, abs=1e-4)


def test_advantages_are_normalised_within_each_group() -> None:
    """However much a task pays, it is learned as much as the others; one that a batch holds once stays as it is."""
    normalized = []
    for factor in (1.0, 100.0):
        actor, critic, update = build(groups=("task", 4))
        batch = collect(actor, critic, torch.Generator().manual_seed(1))
        batch["task"] = torch.arange(8 * 16).reshape(8, 16) % 2
        batch["task"][0, 0] = 3
        raw = torch.where(batch["task"] == 1, factor * batch["advantage"][..., 0] - 7.0, batch["advantage"][..., 0])
        batch["advantage"] = raw[..., None].clone()
        update(batch, torch.Generator().manual_seed(2))
        for task in (0, 1):
            own, before = batch["advantage"][batch["task"] == task], raw[batch["task"] == task]
            torch.testing.assert_close(own[:, 0], (before - before.mean()) / before.std(), rtol=1e-4, atol=1e-5)
        assert batch["advantage"][0, 0, 0] == raw[0, 0]  # alone: no deviation to divide by
        normalized.append(batch["advantage"])
    torch.testing.assert_close(*normalized, rtol=1e-3, atol=1e-4)


def test_the_divergence_moves_the_learning_rate() -> None:
    actor, critic, update = build(divergence=lambda sample: torch.tensor(1.0))
    update.schedule = KLAdaptiveLR(update.optimizer, 0.01)
    metrics = update(collect(actor, critic, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2))
    assert metrics["learning_rate"].item() == pytest.approx(3e-3 / 1.5**4)
    assert metrics["kl"].item() == 1.0


@pytest.mark.parametrize(("minibatches", "measured"), [(4, 32), (1, 100)])
def test_the_divergence_is_measured_on_a_part_of_the_last_minibatch(
    minibatches: int, measured: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ppo, "MEASURED", 100)
    seen: list[torch.Tensor] = []

    def divergence(sample: TensorDict) -> torch.Tensor:
        seen.append(sample["observation"])
        return torch.tensor(0.01)

    actor, critic, update = build(epochs=2, minibatches=minibatches, divergence=divergence)
    batch = collect(actor, critic, torch.Generator().manual_seed(1))
    update(batch, torch.Generator().manual_seed(2))
    assert [len(sample) for sample in seen] == [measured, measured]
    assert not torch.equal(*seen)
    rows = {tuple(row) for row in batch["observation"].flatten(0, 1).tolist()}
    assert {tuple(row) for sample in seen for row in sample.tolist()} <= rows


def test_an_entry_may_be_called_like_what_comes_next() -> None:
    generator = torch.Generator().manual_seed(1)
    actor, critic = (kind(2, *size, in_keys=["next_waypoint"], hidden=(4,)) for kind, size in NETWORKS)
    batch = TensorDict({"next_waypoint": torch.rand(4, 4, 2, generator=generator)}, [4, 4])
    with torch.no_grad():
        critic(actor(batch))
    batch["advantage"] = batch["value_target"] = torch.rand(4, 4, 1, generator=generator)
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0, loss_critic_type="l2")
    assert "kl_approx" in PPOUpdate(loss, optimizer, epochs=1, minibatches=1)(batch, generator)


class Slopes(torch.nn.Module):
    """Losses that are straight lines, so that a step of plain descent moves every weight by its slope."""

    in_keys = ("observation",)

    def __init__(self, *slopes: float) -> None:
        super().__init__()
        self.slopes, self.weight = slopes, torch.nn.Parameter(torch.zeros(3))

    def forward(self, sample: TensorDict) -> TensorDict:
        lines = (slope * weight for slope, weight in zip(self.slopes, self.weight, strict=True))
        return TensorDict(dict(zip(("loss_objective", "loss_critic", "loss_entropy"), lines, strict=True)), [])


@pytest.mark.parametrize(
    ("slopes", "options", "moved"),
    [
        ((1.0, 2.0, 3.0), {"epochs": 2, "minibatches": 1}, (-2.0, -4.0, -6.0)),
        # 3 minibatches of 42 samples, and the two that are left over are none.
        ((1.0, 2.0, 3.0), {"epochs": 1, "minibatches": 3}, (-3.0, -6.0, -9.0)),
        # A slope of 13, since 3^2 + 4^2 + 12^2 = 13^2, is made one of 2.
        ((3.0, 4.0, 12.0), {"epochs": 1, "minibatches": 1, "max_grad_norm": 2.0}, (-6 / 13, -8 / 13, -24 / 13)),
    ],
)
def test_every_step_descends_all_losses_once_and_not_too_far(
    slopes: tuple[float, ...], options: dict[str, float], moved: tuple[float, ...]
) -> None:
    actor, critic, _ = build()
    loss = Slopes(*slopes)
    settings = {"max_grad_norm": 100.0, **options}
    update = PPOUpdate(loss, torch.optim.SGD(loss.parameters(), lr=1.0), **settings)  # type: ignore[arg-type]
    update(collect(actor, critic, torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2))
    assert loss.weight.tolist() == pytest.approx(moved)


def test_an_extra_loss_is_added() -> None:
    actor, critic, update = build(epochs=1, minibatches=1)
    before = actor.network.std.detach().clone()
    batch = collect(actor, critic, torch.Generator().manual_seed(1))
    update(batch, torch.Generator().manual_seed(2), extra=lambda sample: 1e3 * actor.network.std.sum())
    assert bool((actor.network.std < before).all())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # torch's compiler, of torch itself
def test_a_compiled_update_is_the_eager_one_but_for_rounding() -> None:
    trained = []
    for compiled in (False, True):
        actor, critic, update = build(compile=compiled)
        batch = collect(actor, critic, torch.Generator().manual_seed(1))
        for _ in range(3):
            metrics = update(batch.clone(), torch.Generator().manual_seed(2))
        trained.append([*actor.parameters(), *critic.parameters(), metrics["loss_objective"]])
    for eager, compiled in zip(*trained, strict=True):
        torch.testing.assert_close(compiled, eager, atol=1e-5, rtol=1e-4)


def test_too_few_samples_are_refused() -> None:
    actor, critic, update = build(minibatches=1000)
    with pytest.raises(ValueError, match="at least 1000 samples"):
        update(collect(actor, critic, torch.Generator().manual_seed(1)), torch.Generator())


def test_a_warm_up_of_the_critic_leaves_the_policy_alone() -> None:
    actor, critic, update = build(divergence=lambda sample: torch.tensor(1.0))
    update.schedule = KLAdaptiveLR(update.optimizer, 0.01)
    before = [[p.clone() for p in network.parameters()] for network in (actor, critic)]
    batch = collect(actor, critic, torch.Generator().manual_seed(1))
    metrics = update(batch, torch.Generator().manual_seed(2), lambda sample: 1 / 0, critic_only=True)
    same = [
        all(torch.equal(a, b) for a, b in zip(old, network.parameters(), strict=True))
        for old, network in zip(before, (actor, critic), strict=True)
    ]
    assert same == [True, False]
    assert metrics["learning_rate"].item() == pytest.approx(3e-3)


def test_hidden_layers_in_bfloat16_leave_the_rest_in_float32_and_learn_the_same() -> None:
    ends = {}
    for precision in (torch.float32, torch.bfloat16):
        actor, critic, update = build(precision=precision)
        generator = torch.Generator().manual_seed(1)
        for _ in range(40):
            metrics = update(collect(actor, critic, generator), generator)
        assert all(value.dtype is torch.float32 for value in (*metrics.values(), *actor.parameters()))
        ends[precision] = collect(actor, critic, torch.Generator().manual_seed(2))["value_target"].mean().item()

        layers = actor.network.mean.layers
        formats = {name: formats_of(layers[index]) for name, index in (("hidden", 0), ("mean", -1))}
        batch = collect(actor, critic, generator)
        assert formats == {"hidden": {torch.float32}, "mean": {torch.float32}}  # roll-outs are not in it
        update(batch, generator)
        assert formats == {"hidden": {torch.float32, precision}, "mean": {torch.float32}}
    assert ends[torch.bfloat16] == pytest.approx(ends[torch.float32], rel=0.15)


def formats_of(layer: torch.nn.Module) -> set[torch.dtype]:
    """Number formats of what a layer puts out, from now on."""
    seen: set[torch.dtype] = set()
    layer.register_forward_hook(lambda module, args, out: seen.add(out.dtype))
    return seen
