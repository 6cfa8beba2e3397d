from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from agility_rl.collectors import (
    EASICollector,
    EvolutionStrategy,
    ParameterSpace,
    RobotLog,
    one_thread,
    record_robot_log,
)
from agility_rl.losses import TransitionDiscriminatorLoss
from agility_rl.modules import TransitionDiscriminator
from agility_rl.simulation import BatchSimulator

Simulate = Callable[..., BatchSimulator]


def collector(simulator: BatchSimulator, policy: Any, seed: int = 0, **options: Any) -> EASICollector:
    options.setdefault("num_steps", 12)
    generator = torch.Generator().manual_seed(seed)
    return EASICollector(simulator, ParameterSpace(), policy, generator=generator, **options)


def test_every_simulation_has_its_own_parameters(simulate: Simulate, swing: Any) -> None:
    individuals = torch.rand(4, 6)
    individuals[3] = individuals[0]
    simulator = simulate(4)
    collecting = collector(simulator, swing())
    transitions = collecting.collect(individuals)
    values = collecting.space.denormalize(individuals)
    torch.testing.assert_close(simulator.parameter("stiffness")[:, 2], values[:, 4].float())
    torch.testing.assert_close(simulator.parameter("damping")[:, 3], values[:, 1].float())
    states = transitions["measurement"]
    assert torch.equal(states[0], states[3])
    assert not torch.equal(states[0], states[1])
    assert transitions["individual"].shape == (4, 12, 6)
    assert torch.equal(transitions["individual"][2, 5], individuals[2])


def test_the_score_is_the_mean_over_valid_transitions() -> None:
    logit = torch.tensor([[1.0, 2.0, 6.0], [1.0, math.nan, 3.0], [9.0, 9.0, 9.0]])
    mask = torch.tensor([[True, True, True], [True, False, True], [False, False, False]])
    td = TensorDict({"x": logit[..., None], "collector": {"mask": mask}}, [3, 3])
    scores = EASICollector.score(lambda part: part.set("transition_logit", part["x"]), td, chunk=2)
    assert scores.tolist() == [3.0, 2.0, -math.inf]
    assert "transition_logit" not in td


def test_scores_do_not_depend_on_the_chunk(simulate: Simulate, swing: Any) -> None:
    transitions = collector(simulate(5), swing()).collect(torch.rand(5, 6))
    network = TransitionDiscriminator.from_transitions(transitions)
    scores = [EASICollector.score(network, transitions, chunk=chunk) for chunk in (1, 2, 5)]
    torch.testing.assert_close(scores[0], scores[2])
    torch.testing.assert_close(scores[1], scores[2])
    whole = network(transitions.clone())["transition_logit"].mean((1, 2))
    torch.testing.assert_close(scores[2], whole)
    assert not scores[0].requires_grad


def test_a_batch_has_equally_many_valid_transitions_of_everyone(generator: torch.Generator) -> None:
    mask = torch.tensor([[True, False, True], [False, False, False], [False, True, False]])
    td = TensorDict({"x": torch.arange(9).view(3, 3), "collector": {"mask": mask}}, [3, 3])
    batch = EASICollector.sample(td, generator, per_simulation=40)
    assert batch.shape == (80,)
    assert set(batch["x"].tolist()) == {0, 2, 7}
    assert (batch["x"] == 7).sum() == 40
    assert batch["collector", "mask"].all()
    td["collector", "mask"] = torch.zeros_like(mask)
    with pytest.raises(ValueError, match="no simulation has a valid transition"):
        EASICollector.sample(td, generator)


def test_nominal_parameters_collect_what_the_nominal_robot_does(simulate: Simulate, swing: Any) -> None:
    space = ParameterSpace()
    individuals = space.normalize(space.nominal).repeat(2, 1)
    transitions = collector(simulate(2), swing()).collect(individuals)
    log = record_robot_log(simulate(1), swing(), 100, generator=torch.Generator().manual_seed(0))
    expected = log.transitions()
    for key in ("measurement", "action", ("next", "measurement")):
        torch.testing.assert_close(transitions[0][key], expected[key][:12], atol=1e-5, rtol=1e-5)


def test_same_seed_same_result_with_any_threads(simulate: Simulate, swing: Any) -> None:
    def generation(num_threads: int) -> tuple[torch.Tensor, torch.Tensor]:
        torch.manual_seed(0)
        torch.set_num_threads(num_threads)
        try:
            space, generator = ParameterSpace(), torch.Generator().manual_seed(5)
            collecting = EASICollector(
                simulate(6, num_threads=num_threads), space, swing(), generator=generator, num_steps=15, noise=0.1
            )
            search = EvolutionStrategy([0.0] * 6, [1.0] * 6, population=6, generator=generator)
            real = None
            for _ in range(2):
                individuals = search.ask()
                transitions = collecting.collect(individuals)
                if real is None:
                    real = transitions.reshape(-1).exclude("individual", "collector", "is_init")
                    network = TransitionDiscriminator.from_transitions(real)
                    loss = TransitionDiscriminatorLoss(network)
                    optimizer = torch.optim.RMSprop(loss.parameters(), 3e-4)
                with one_thread():
                    for _ in range(2):
                        loss.clip_weights()
                        batch = {"expert": real, "policy": collecting.sample(transitions, generator, 400)}
                        loss(TensorDict(batch))["loss_discriminator"].backward()
                        optimizer.step()
                        optimizer.zero_grad()
                scores = collecting.score(network, transitions)
                search.tell(individuals, scores)
            return search.mean, scores
        finally:
            torch.set_num_threads(1)

    (mean, scores), (other_mean, other_scores) = generation(1), generation(2)
    assert torch.equal(scores, other_scores)
    assert torch.equal(mean, other_mean)


def test_torch_has_its_threads_back_afterwards() -> None:
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyError), one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


def test_it_resumes_bit_for_bit(simulate: Simulate, swing: Any) -> None:
    first = collector(simulate(3), swing(), noise=0.2)
    individuals = torch.rand(3, 6)
    first.collect(individuals)
    second = collector(simulate(3), swing(), seed=9, noise=0.2)
    second.load_state_dict(first.state_dict())
    one, two = first.collect(individuals), second.collect(individuals)
    assert all(torch.equal(one[key], two[key]) for key in one.keys(True, True))


def test_a_critic_that_knows_the_robot_ranks_the_truth_first(simulate: Simulate, swing: Any, log: RobotLog) -> None:
    """With the distance to the robot's own following state as D, the true parameters score best."""
    space = ParameterSpace()
    truth = space.normalize(space.nominal)
    individuals = torch.stack([truth, truth + 0.3, truth - 0.3, truth + torch.tensor([0.5, 0, 0, 0, 0, 0])])
    transitions = collector(simulate(4), swing()).collect(individuals)
    real = log.transitions()["next", "measurement"][:12]

    def closeness(td: TensorDictBase) -> TensorDictBase:
        return td.set("transition_logit", -(td["next", "measurement"] - real).square().sum(-1, keepdim=True))

    assert EASICollector.score(closeness, transitions).argmax() == 0


def test_the_wrong_number_of_individuals_is_refused(simulate: Simulate, swing: Any) -> None:
    with pytest.raises(ValueError, match="each of the 2 simulations"):
        collector(simulate(2), swing()).collect(torch.rand(3, 6))
