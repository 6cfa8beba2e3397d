"""The teacher: what it reads, what each part of it learns from, and behaviours that it may not choose."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type

from agility_rl.modules import BasicBehaviourController, Teacher

SIZES = {"proprioception": 45, "heading_error": 2, "obstacle": 7, "scandots": 132, "privileged": 29}


@pytest.fixture
def observation(generator: torch.Generator) -> TensorDict:
    td = TensorDict({name: torch.randn(64, size, generator=generator) for name, size in SIZES.items()}, [64])
    return td.set("history", torch.randn(64, 10, 45, generator=generator))


def test_sizes_of_the_supplement() -> None:
    actor = Teacher().actor.network
    assert [layer.out_features for layer in actor.trunk.modules() if isinstance(layer, torch.nn.Linear)] == [
        512,
        256,
        128,
    ]
    outputs = actor(*(torch.zeros(1, n) for n in (45, 2, 7, 32, 4, 29)))
    assert [tuple(output.shape) for output in outputs] == [(1, 5), (1, 5, 6), (1, 5, 6)]


def test_both_policies_differ_only_in_the_latent(observation: TensorDict) -> None:
    teacher = Teacher(hidden=(16, 16))
    with torch.no_grad(), set_interaction_type(InteractionType.DETERMINISTIC):
        privileged = teacher.privileged_policy()(observation.clone())
        deployable = teacher.deployable_policy()(observation.clone())
        assert torch.equal(privileged["terrain_latent"], deployable["terrain_latent"])
        assert torch.equal(privileged["estimate"], deployable["estimate"])
        assert not torch.equal(privileged["loc"], deployable["loc"])
        copied = deployable.clone().set("latent", privileged["latent"])
        assert torch.equal(teacher.actor(copied)["loc"], privileged["loc"])


def test_the_gradient_of_the_actor_reaches_its_encoders_and_not_the_estimator(observation: TensorDict) -> None:
    teacher = Teacher(hidden=(16, 16))
    teacher.estimator.requires_grad_(False)
    with torch.no_grad():
        teacher.privileged_policy()(observation)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        teacher.trained_actor()(observation)["loc"].square().sum().backward()
    for module in (teacher.privileged_encoder, teacher.scandots_encoder):
        assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in module.parameters())
    assert all(p.grad is None for p in (*teacher.estimator.parameters(), *teacher.history_encoder.parameters()))


def test_it_never_chooses_what_it_may_not(observation: TensorDict) -> None:
    teacher = Teacher(hidden=(16, 16), allowed=[1, 3])
    with torch.no_grad():
        td = teacher.privileged_policy()(observation)
        assert set(td["action", "behaviour"].tolist()) == {1, 3}
        entropy = teacher.actor.get_dist(td)["action", "behaviour"].entropy()
    assert bool(entropy.isfinite().all()) and entropy.max() <= torch.tensor(2.0).log() + 1e-5
    with pytest.raises(ValueError, match=r"choices 0 to 4, got \(5,\)"):
        Teacher(allowed=[5])


def test_settings_build_the_same_network() -> None:
    teacher = Teacher(3, (16, 8), 0.5, 0.2, [0, 4])
    again = Teacher(**teacher.settings)
    again.load_state_dict(teacher.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(teacher.parameters(), again.parameters(), strict=True))


def test_the_estimator_is_that_of_the_behaviour_controller() -> None:
    Teacher().estimator.load_state_dict(BasicBehaviourController().estimator.state_dict())
