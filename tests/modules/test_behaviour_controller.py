"""The assembled controller: two ways to drive one actor, and which parameters each loss may move."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torchrl.objectives import ClipPPOLoss

from agility_rl import keys
from agility_rl.modules import BasicBehaviourController, Critic

HIDDEN = (16, 8)


@pytest.fixture
def bbc() -> BasicBehaviourController:
    return BasicBehaviourController(HIDDEN)


def observation(*batch: int) -> TensorDict:
    generator = torch.Generator().manual_seed(1)
    sizes = {
        keys.PROPRIOCEPTION: (45,),
        keys.COMMAND: (11,),
        keys.PEAK: (1,),
        keys.PRIVILEGED: (29,),
        keys.HISTORY: (10, 45),
    }
    return TensorDict({key: torch.randn(*batch, *size, generator=generator) for key, size in sizes.items()}, batch)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("way", ["privileged_policy", "deployable_policy"])
def test_shapes(bbc: BasicBehaviourController, batch: tuple[int, ...], way: str) -> None:
    out = getattr(bbc, way)()(observation(*batch))
    assert out[keys.ESTIMATE].shape == (*batch, 4) and out[keys.LATENT].shape == (*batch, 29)
    for key in ("loc", "scale", keys.ACTION):
        assert out[key].shape == (*batch, 12), key
    assert out["action_log_prob"].shape == batch


def test_inputs(bbc: BasicBehaviourController) -> None:
    common = {keys.PROPRIOCEPTION, keys.COMMAND, keys.PEAK}
    assert set(bbc.privileged_policy().in_keys) == common | {keys.PRIVILEGED}
    assert set(bbc.deployable_policy().in_keys) == common | {keys.HISTORY}
    assert set(bbc.trained_actor().in_keys) == common | {keys.PRIVILEGED, keys.ESTIMATE}
    only = observation(2).select(*common, keys.HISTORY)
    assert bbc.deployable_policy()(only)[keys.ACTION].shape == (2, 12)  # what the robot has is enough


def test_values_are_those_of_the_parts(bbc: BasicBehaviourController) -> None:
    seen = observation(5)
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        told = bbc.privileged_policy()(seen.clone())
        felt = bbc.deployable_policy()(seen.clone())
        estimate = bbc.estimator(seen.clone())[keys.ESTIMATE]
        for out, encoder in ((told, bbc.privileged_encoder), (felt, bbc.history_encoder)):
            latent = encoder(seen.clone())[keys.LATENT]
            inputs = seen[keys.PROPRIOCEPTION], estimate, latent, seen[keys.COMMAND], seen[keys.PEAK]
            loc, scale = bbc.actor.network(*inputs)
            assert torch.equal(out["loc"], loc) and torch.equal(out["scale"], scale)
            assert torch.equal(out[keys.ACTION], loc)
    assert not torch.equal(told["loc"], felt["loc"])


def test_both_ways_agree_where_the_latents_do(bbc: BasicBehaviourController) -> None:
    for encoder in (bbc.privileged_encoder, bbc.history_encoder):
        for parameter in encoder.parameters():
            torch.nn.init.zeros_(parameter)
    with torch.no_grad():
        told, felt = (way(observation(4)) for way in (bbc.privileged_policy(), bbc.deployable_policy()))
    assert torch.equal(told["loc"], felt["loc"])


def test_trained_actor_matches_the_privileged_policy(bbc: BasicBehaviourController) -> None:
    """PPO's first ratio is one: the log-density of a roll-out's action is found again."""
    with torch.no_grad():
        collected = bbc.privileged_policy()(observation(6))
        again = bbc.trained_actor().get_dist(collected.clone()).log_prob(collected[keys.ACTION])
    torch.testing.assert_close(again, collected["action_log_prob"])


def test_ppo_moves_actor_and_privileged_encoder_only(bbc: BasicBehaviourController) -> None:
    critic = Critic(45, in_keys=[keys.PROPRIOCEPTION], hidden=HIDDEN)
    loss = ClipPPOLoss(bbc.trained_actor(), critic, entropy_coeff=0.01)
    with torch.no_grad():
        batch = bbc.privileged_policy()(observation(6))
    batch["advantage"], batch["value_target"] = torch.randn(6, 1), torch.randn(6, 1)
    out = loss(batch)
    (out["loss_objective"] + out["loss_entropy"]).backward()
    moved = {name for name, p in bbc.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0}
    expected = {name for name, _ in bbc.named_parameters() if name.startswith(("actor.", "privileged_encoder."))}
    assert moved == expected


def test_state_dict_holds_each_parameter_once(bbc: BasicBehaviourController) -> None:
    other = BasicBehaviourController(**bbc.settings)
    other.load_state_dict(bbc.state_dict())
    roots = {name.split(".")[0] for name in bbc.state_dict()}
    assert roots == {"estimator", "privileged_encoder", "history_encoder", "actor"}
    with torch.no_grad():
        one, two = (each.deployable_policy()(observation(3))["loc"] for each in (bbc, other))
    assert torch.equal(one, two)


def test_settings_are_plain_data() -> None:
    bbc = BasicBehaviourController((8, 4), initial_std=0.5, min_std=0.2)
    assert bbc.settings == {"hidden": [8, 4], "initial_std": 0.5, "min_std": 0.2}
    assert bbc.privileged_policy()(observation(1))["scale"].unique().tolist() == [0.5]


def test_published_sizes() -> None:
    """Section S6: {512, 256, 128} over 45 + 4 + 29 + 11 + 1 = 90 numbers, estimator {128, 64}."""
    shapes = [tuple(p.shape) for p in BasicBehaviourController().actor.parameters() if p.ndim == 2]
    assert shapes == [(512, 90), (256, 512), (128, 256), (12, 128)]
    estimator = [tuple(p.shape) for p in BasicBehaviourController().estimator.parameters() if p.ndim == 2]
    assert estimator == [(128, 45), (64, 128), (4, 64)]


def test_errors(bbc: BasicBehaviourController) -> None:
    with pytest.raises(KeyError, match=keys.HISTORY):
        bbc.deployable_policy()(observation(2).exclude(keys.HISTORY))
    with pytest.raises(ValueError, match="min_std must be positive"):
        BasicBehaviourController(HIDDEN, initial_std=0.05, min_std=0.1)
