"""The collector of EASI: every simulation its own physics, every physics its own score."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl.collectors.parameters import ParameterSpace
from agility_rl.collectors.rollout import MeasuredPolicy, fallen, roll_out
from agility_rl.collectors.sensors import RobotSensors
from agility_rl.keys import TRANSITION_LOGIT
from agility_rl.simulation import Simulator

NUM_SIMULATIONS = 300
"""Individuals of a generation (Table S3)."""
TRAJECTORY_LENGTH = 500
"""Control steps of a trajectory (Table S3)."""
BATCH_PER_SIMULATION = 16
"""Transitions of each simulation in one update of the discriminator (method notes, section 6.2)."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread for a while, so that results do not depend on how many it has.

    Matrix products and their gradients sum in another order on every number of threads, and a search magnifies the
    last bit. The collector uses it itself; wrap the updates of the discriminator, which are small, in it too. The
    simulator's threads are others, and do not change results.

    Example:
        >>> with one_thread():
        ...     torch.get_num_threads()
        1
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class EASICollector:
    r"""Roll a fixed policy out in simulations that each have their own parameters, and score those.

    .. math:: \tau_j \sim \pi, \xi_j \qquad f_j = \frac{1}{|\tau_j|} \sum_{(s, a, s') \in \tau_j} \tilde D(s, a, s')

    Falls, resets and diverged simulations are handled by :func:`agility_rl.collectors.rollout.roll_out`: they shorten
    a mean, and an individual without one valid transition scores minus infinity. Same generators, same result, with any
    number of threads: policy and discriminator run on one (:func:`one_thread`), the simulator's do not matter.

    Source: Algorithm S2, lines 3 to 8 and 13; N and trajectory length: Table S3; fitness: method notes, section 6.3.

    Keys of a collection: those of :func:`agility_rl.collectors.rollout.roll_out`, ``[N, T]``, and ``individual``
    float32 ``[N, T, D]``, the normalised parameters, as a view.

    Args:
        simulator: N simulations; its parameters are overwritten.
        space: what a search vector means.
        policy: fixed, from measurements to actions.
        generator: source of start states and noise; the state dict includes it.
        num_steps: T.
        start: start states, as ``roll_out`` takes them.
        noise: noise that the robot's sensors are known to have, as :class:`RobotSensors` takes it.
        latency: their known latency, in control steps.
        failure: when a robot is put back.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> simulator = make_simulator(num_simulations=4, num_threads=1)
        >>> generator = torch.Generator().manual_seed(0)
        >>> collector = EASICollector(simulator, ParameterSpace(), lambda measured: torch.zeros(4, 12),
        ...                           generator=generator, num_steps=5)
        >>> transitions = collector.collect(torch.rand(4, 6, generator=generator))
        >>> transitions["next", "measurement"].shape
        torch.Size([4, 5, 29])
        >>> def stiff(td):  # any module or function that writes a logit
        ...     return td.set("transition_logit", td["measurement"][..., :1])
        >>> collector.score(stiff, transitions).shape
        torch.Size([4])
    """

    def __init__(
        self,
        simulator: Simulator,
        space: ParameterSpace,
        policy: MeasuredPolicy,
        *,
        generator: torch.Generator,
        num_steps: int = TRAJECTORY_LENGTH,
        start: TensorDictBase | None = None,
        noise: float | Mapping[str, float] = 0.0,
        latency: int = 0,
        failure: Callable[[Simulator], Tensor] = fallen,
    ) -> None:
        self.simulator, self.space, self.policy = simulator, space, policy
        self.generator, self.num_steps, self.start, self.failure = generator, num_steps, start, failure
        self.sensors = RobotSensors(simulator.num_simulations, noise=noise, latency=latency, generator=generator)

    @one_thread()
    @torch.no_grad()
    def collect(self, individuals: Tensor) -> TensorDict:
        """Transitions ``[N, T]`` of individuals ``[N, D]``, normalised search vectors.

        Raises:
            ValueError: if their number is not that of the simulations.
        """
        n = self.simulator.num_simulations
        if len(individuals) != n:
            raise ValueError(f"expected one individual for each of the {n} simulations, got {list(individuals.shape)}")
        everyone = torch.ones(n, dtype=torch.bool)
        self.simulator.set_parameters(everyone, **self.space.fields(self.space.denormalize(individuals)))
        transitions = roll_out(
            self.simulator,
            self.policy,
            self.num_steps,
            sensors=self.sensors,
            generator=self.generator,
            start=self.start,
            failure=self.failure,
        )
        return transitions.set("individual", individuals.float()[:, None].expand(-1, self.num_steps, -1))

    @staticmethod
    @one_thread()
    @torch.no_grad()
    def score(
        discriminator: Callable[[TensorDictBase], TensorDictBase],
        transitions: TensorDictBase,
        *,
        logit_key: Any = TRANSITION_LOGIT,
        chunk: int = 32,
    ) -> Tensor:
        """Mean of D over the valid transitions of every individual, ``[N]``; minus infinity for who has none.

        Args:
            discriminator: writes a logit ``[*B, 1]`` into the TensorDict it is given.
            transitions: what :meth:`collect` returned.
            logit_key: where the logit is written.
            chunk: individuals judged at once: a limit on memory that does not change the result.
        """
        scores = []
        for first in range(0, len(transitions), chunk):
            part = transitions[first : first + chunk]
            valid = part["collector", "mask"]
            logit = discriminator(part.clone(False)).get(logit_key)[..., 0]
            total = torch.where(valid, logit, 0.0).sum(-1)
            count = valid.sum(-1)
            scores.append(torch.where(count > 0, total / count.clamp_min(1), -torch.inf))
        return torch.cat(scores)

    @staticmethod
    def sample(
        transitions: TensorDictBase, generator: torch.Generator, per_simulation: int = BATCH_PER_SIMULATION
    ) -> TensorDictBase:
        """Draw valid transitions, equally many of every individual that has any, with replacement: ``[M]``.

        Source: batch of EASI's release (method notes, section 6.2).

        Raises:
            ValueError: if no transition is valid.
        """
        valid = transitions["collector", "mask"]
        usable = valid.any(-1).nonzero()[:, 0]
        if not len(usable):
            raise ValueError("no simulation has a valid transition; look at the parameters and the start states")
        steps = torch.multinomial(valid[usable].float(), per_simulation, replacement=True, generator=generator)
        return transitions[usable[:, None].expand_as(steps), steps].reshape(-1)

    def state_dict(self) -> dict[str, Any]:
        """Position of the generator; every collection starts from a reset, so that there is nothing else."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.generator.set_state(state["generator"])
