from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from agility_rl.collectors import (
    EvolutionStrategy,
    ParameterSpace,
    ReplayCollector,
    ResponseMemory,
    RobotLog,
    cut_windows,
)
from agility_rl.collectors.replay import MATCHED
from agility_rl.modules import TransitionDiscriminator
from agility_rl.simulation import BatchSimulator

SIZE = 3


class Closeness(TensorDictModuleBase):
    """A critic that knows the robot."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["measurement", "action", ("next", "measurement"), MATCHED], ["transition_logit"]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        miss = td["next", "measurement"] - td[MATCHED]
        return td.set("transition_logit", -miss.square().sum(-1, keepdim=True))


def search(size: int = SIZE, population: int = 20, **options: object) -> EvolutionStrategy:
    generator = torch.Generator().manual_seed(0)
    return EvolutionStrategy([0.0] * size, [1.0] * size, population=population, generator=generator, **options)


def windows_of(response: Callable[[Tensor], Tensor], individuals: Tensor, rows: int = 7) -> TensorDict:
    """Transitions whose misses are a function of the parameters, ``[N, rows, 29]``."""
    miss = response(individuals).float()
    shape = miss.shape[:2]
    real = torch.linspace(-1.0, 1.0, rows * 29).view(rows, 29).expand(*shape, 29)
    return TensorDict(
        {
            "measurement": torch.zeros(*shape, 29),
            "action": torch.zeros(*shape, 12),
            "next": {"measurement": real + miss, "matched_measurement": real},
            "collector": {"mask": torch.ones(shape, dtype=torch.bool)},
        },
        shape,
    )


def linear(target: Tensor, seed: int = 0, rows: int = 7) -> Callable[[Tensor], Tensor]:
    slope = torch.randn(rows, 29, len(target), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return lambda x: torch.einsum("rmd,nd->nrm", slope, x.double() - target)


def test_the_response_is_that_of_least_squares() -> None:
    es, memory = search(), ResponseMemory()
    individuals = es.ask()
    generator = torch.Generator().manual_seed(1)
    td = windows_of(lambda x: torch.randn(len(x), 7, 29, generator=generator), individuals)
    memory.remember(individuals, td, es.mean)
    columns = np.concatenate((np.ones((20, 1)), (individuals - es.mean).numpy()), 1)
    miss = (td["next", "measurement"] - td[MATCHED]).double().flatten(1).numpy()
    expected = np.linalg.solve(columns.T @ columns, columns.T @ miss)
    found = memory.state_dict()["responses"]
    np.testing.assert_allclose(found["offset"][0].flatten().numpy(), expected[0], atol=1e-5)
    np.testing.assert_allclose(found["slope"][0].flatten(0, 1).T.numpy(), expected[1:], atol=1e-5)


def test_it_climbs_to_the_weighted_least_squares_of_all_windows() -> None:
    """Two generations of windows that want different parameters: the best point by the normal equations."""
    es, memory = search(), ResponseMemory(share=1.0, trust=100.0, iterations=50)
    targets = torch.tensor([[0.4, 0.5, 0.6], [0.5, 0.7, 0.3]], dtype=torch.float64)
    left, right = np.zeros((SIZE, SIZE)), np.zeros(SIZE)
    for seed, target in enumerate(targets):
        individuals = es.ask() + 0.1 * seed  # drawn about another mean
        response = linear(target, seed)
        memory.remember(individuals, windows_of(response, individuals), es.mean + 0.1 * seed)
        slope = (response(torch.eye(SIZE)) - response(torch.zeros(1, SIZE))).flatten(1).numpy()
        left += slope @ slope.T
        right += slope @ slope.T @ target.numpy()
    np.testing.assert_allclose(memory.climb(Closeness(), es).numpy(), np.linalg.solve(left, right), atol=1e-3)


def test_no_step_is_farther_than_the_trust() -> None:
    es, memory = search(covariance="full"), ResponseMemory(trust=0.5)
    individuals = es.ask()
    target = torch.tensor([5.0, 0.5, 0.5], dtype=torch.float64)
    memory.remember(individuals, windows_of(linear(target), individuals), es.mean)
    step = memory.climb(Closeness(), es) - es.mean
    distance = torch.linalg.solve(es.covariance, step) @ step
    assert float(distance.sqrt()) == pytest.approx(0.5, rel=1e-4)
    assert float(step[0]) > 0.0


def test_old_generations_are_forgotten() -> None:
    es, memory = search(), ResponseMemory(share=0.5)
    lengths = []
    for generation in range(6):
        individuals = es.ask()
        memory.remember(individuals, windows_of(linear(torch.full((3,), float(generation))), individuals), es.mean)
        lengths.append(len(memory))
    assert lengths == [1, 1, 2, 2, 2, 3]  # round() of halves goes to the even number
    remembered = memory.state_dict()["responses"]["offset"]
    expected = linear(torch.full((3,), 5.0))(es.mean[None])[0]
    torch.testing.assert_close(remembered[-1], expected.float(), atol=1e-4, rtol=1e-4)


def test_who_diverged_is_left_out_and_nobody_at_all_is_no_error() -> None:
    es, target = search(), torch.tensor([0.4, 0.5, 0.6], dtype=torch.float64)
    individuals = es.ask()
    td = windows_of(linear(target), individuals)
    td["next", "measurement"][3] = td[MATCHED][3]
    td["collector", "mask"][3] = False
    memory = ResponseMemory(trust=10.0)
    memory.remember(individuals, td, es.mean)
    torch.testing.assert_close(memory.climb(Closeness(), es), target, atol=1e-3, rtol=0)
    td["collector", "mask"][:] = False
    empty = ResponseMemory()
    empty.remember(individuals, td, es.mean)
    assert len(empty) == 0 and empty.generation == 1
    assert torch.equal(empty.climb(Closeness(), es), es.mean)


def test_fewer_individuals_than_parameters_stay_near_their_mean() -> None:
    es, memory = search(population=2, survival_rate=1.0), ResponseMemory()
    individuals = es.ask()
    memory.remember(individuals, windows_of(linear(torch.tensor([0.4, 0.5, 0.6])), individuals), es.mean)
    assert bool(memory.climb(Closeness(), es).isfinite().all())


def test_the_critic_is_not_touched() -> None:
    es, memory = search(), ResponseMemory()
    individuals = es.ask()
    td = windows_of(linear(torch.tensor([0.4, 0.5, 0.6])), individuals)
    network = torch.nn.Linear(29, 1)

    class Judge(Closeness):
        def forward(self, td: TensorDictBase) -> TensorDictBase:
            return td.set("transition_logit", network((td["next", "measurement"] - td[MATCHED]).abs()))

    memory.remember(individuals, td, es.mean)
    memory.climb(Judge(), es)
    assert network.weight.grad is None and network.bias.grad is None


def test_a_restored_memory_climbs_to_the_same_point() -> None:
    es, memory = search(), ResponseMemory()
    for seed in range(4):
        individuals = es.ask()
        memory.remember(individuals, windows_of(linear(torch.rand(3).double(), seed), individuals), es.mean)
    other = ResponseMemory()
    other.load_state_dict(memory.state_dict())
    assert torch.equal(other.climb(Closeness(), es), memory.climb(Closeness(), es))
    assert other.generation == 4 and len(other) == len(memory)
    fresh = ResponseMemory()
    fresh.load_state_dict(ResponseMemory().state_dict())
    assert len(fresh) == 0


def test_in_the_engine_one_climb_finds_gains_that_no_individual_has(
    simulate: Callable[..., BatchSimulator], log: RobotLog
) -> None:
    """The log is of the nominal robot; individuals are spread about other gains."""
    space, generator = ParameterSpace(), torch.Generator().manual_seed(0)
    truth = space.normalize(space.nominal)
    collector = ReplayCollector(simulate(40), space, cut_windows(log, 3, skip=1), num_windows=39, generator=generator)
    es = EvolutionStrategy((truth - 0.09).tolist(), (truth + 0.01).tolist(), population=40, generator=generator)
    individuals = es.ask()
    transitions = collector.collect(individuals)
    critic = TransitionDiscriminator.from_transitions(collector.real, clip=3.0, matched_key=MATCHED)
    critic.rescale(transitions)
    memory = ResponseMemory(trust=3.0)
    memory.remember(individuals, transitions, es.mean)
    found = memory.climb(critic, es)
    assert float((found - truth).abs().mean()) < 0.25 * float((es.mean - truth).abs().mean())
    assert float((individuals - truth).abs().mean(1).min()) > float((found - truth).abs().mean())


@pytest.mark.parametrize("option", [{"share": 0.0}, {"share": 1.5}, {"trust": 0.0}, {"iterations": 0}])
def test_errors(option: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected share from above 0 to 1, trust above 0 and iterations from 1"):
        ResponseMemory(**option)
