"""An evolution strategy on a bounded or unbounded real space; it knows nothing of robots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, Literal

import torch
from torch import Tensor


class EvolutionStrategy:
    r"""Search a Gaussian distribution of parameters by selection, in turns of :meth:`ask` and :meth:`tell`.

    The first generation is uniform in ``[low, high]``. Of every generation the best :math:`\mu = s N` survive, and the
    next Gaussian has their weighted mean and (co)variance:

    .. math:: w_r \propto \ln(\mu + \tfrac12) - \ln r, \qquad m' = \sum_r w_r x_r, \qquad
              C' = \sum_r w_r (x_r - c)(x_r - c)^\top

    With the paper's :math:`s = \tfrac12` the weights are :math:`\ln\frac{N + 1}{2} - \ln r`. The centre c is the new
    mean, which shrinks the distribution at every step and lets it settle; about the old mean it grows along the way it
    moves, so that a target far outside the first range is reached. Only ranks count: scores may have any scale.

    Source: Table S3 (300 individuals, survival rate 0.5), Algorithm S2; weights, variance about the new mean and
    clipping at the bounds: EASI's release (method notes, section 6.3). Not in the paper: full covariance, the old mean
    as centre, learning rate, least deviation, averaging.

    Args:
        low: ``[D]``, lower ends of the first generation.
        high: ``[D]``, upper ends of the first generation.
        population: N, individuals of a generation.
        survival_rate: s, share of them that counts.
        covariance: ``"diagonal"`` (EASI's release) or ``"full"``.
        centre: ``"new"`` (EASI's release) or ``"old"`` mean, about which the spread is taken.
        learning_rate: share of the new mean and covariance in the next distribution, in (0, 1]; 1 as released.
        min_std: least standard deviation of every coordinate, 0 as released; keeps a search alive.
        averaged: share of the generations, counted from the last, whose means :attr:`estimate` averages; with noisy
            scores that is nearer than the last mean alone (Polyak and Juditsky 1992). 0 as released.
        lower: ``[D]``, individuals are clipped to these; ``None`` for no bound. May lie below ``low``.
        upper: ``[D]``, the same from above.
        generator: source of randomness; the state dict includes it.

    Attributes:
        mean: float64 ``[D]``, about which individuals are drawn.
        means: float64 ``[generation, D]``, all of them.
        covariance: float64 ``[D, D]``.

    Raises:
        ValueError: if lengths differ, ranges are empty, the first range leaves the bounds, or an option is out of
            range.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> search = EvolutionStrategy([0.0, 0.0], [1.0, 1.0], population=64, generator=generator)
        >>> for _ in range(20):
        ...     x = search.ask()
        ...     search.tell(x, -(x - torch.tensor([0.25, 0.75])).square().sum(-1))
        >>> [round(value, 2) for value in search.mean.tolist()]
        [0.25, 0.75]
    """

    def __init__(
        self,
        low: Tensor | Sequence[float],
        high: Tensor | Sequence[float],
        *,
        population: int = 300,
        survival_rate: float = 0.5,
        covariance: Literal["diagonal", "full"] = "diagonal",
        centre: Literal["new", "old"] = "new",
        learning_rate: float = 1.0,
        min_std: float = 0.0,
        averaged: float = 0.0,
        lower: Tensor | Sequence[float] | None = None,
        upper: Tensor | Sequence[float] | None = None,
        generator: torch.Generator,
    ) -> None:
        self.low, self.high = _vector("low", low), _vector("high", high, low)
        unbounded = torch.full_like(self.low, math.inf)
        self.lower = -unbounded if lower is None else _vector("lower", lower, low)
        self.upper = unbounded if upper is None else _vector("upper", upper, low)
        if not bool(
            (self.lower <= self.low).all() and (self.low < self.high).all() and (self.high <= self.upper).all()
        ):
            raise ValueError(
                "expected lower <= low < high <= upper in every coordinate, got "
                f"{self.lower.tolist()}, {self.low.tolist()}, {self.high.tolist()}, {self.upper.tolist()}"
            )
        if covariance not in ("diagonal", "full") or centre not in ("new", "old"):
            raise ValueError(f"expected 'diagonal' or 'full' and 'new' or 'old', got {covariance!r} and {centre!r}")
        if not 0.0 < learning_rate <= 1.0 or min_std < 0.0:
            raise ValueError(f"expected 0 < learning_rate <= 1 and min_std >= 0, got {learning_rate} and {min_std}")
        if not 0.0 <= averaged <= 1.0:
            raise ValueError(f"expected averaged, a share of the generations, from 0 to 1, got {averaged}")
        survivors = round(population * survival_rate)
        if not 2 <= survivors <= population:
            raise ValueError(
                f"population * survival_rate must leave 2 to {population} survivors, got {population} * {survival_rate}"
            )
        self.population, self.form, self.centre = population, covariance, centre
        self.learning_rate, self.min_std, self.averaged, self.generator = learning_rate, min_std, averaged, generator
        rank = torch.arange(1, survivors + 1, dtype=torch.float64)
        weights = math.log(survivors + 0.5) - rank.log()
        self.weights = weights / weights.sum()
        self._begin()

    @property
    def generation(self) -> int:
        """How often :meth:`tell` was called."""
        return len(self.means)

    @property
    def estimate(self) -> Tensor:
        """What the search has found so far, ``[D]``: the average of the last means, or the last one."""
        last = max(round(self.averaged * self.generation), 1)
        return self.means[-last:].mean(0) if self.generation else self.mean

    @property
    def root(self) -> Tensor:
        """Square root ``[D, D]`` of the covariance; by eigenvalues, because one of few survivors may be singular."""
        if self.form == "diagonal":
            return torch.diag(self.std)
        values, vectors = torch.linalg.eigh(self.covariance)
        return vectors * values.clamp_min(0.0).sqrt()

    @property
    def std(self) -> Tensor:
        """Standard deviations of the present distribution, ``[D]``."""
        return self.covariance.diagonal().sqrt()

    @property
    def correlation(self) -> Tensor:
        """Correlations ``[D, D]`` of the present distribution; 0 with a coordinate that no longer varies."""
        scale = self.std[:, None] * self.std
        correlation = torch.where(scale > 0, self.covariance / scale.clamp_min(1e-300), torch.zeros_like(scale))
        return correlation.fill_diagonal_(1.0)

    def anew(self, generator: torch.Generator) -> EvolutionStrategy:
        """The same search before its first generation, with random numbers of its own; this one is left alone.

        Args:
            generator: source of its randomness.
        """
        other = copy(self)
        other.generator = generator
        other._begin()
        return other

    def _begin(self) -> None:
        self.mean = (self.low + self.high) / 2
        self.covariance = torch.diag((self.high - self.low).square() / 12)  # of the uniform distribution
        self.means = torch.empty(0, len(self.low), dtype=torch.float64)

    def ask(self) -> Tensor:
        """Draw the individuals of a generation, float64 ``[N, D]``."""
        if self.generation == 0:
            shape = (self.population, len(self.mean))
            draw = torch.rand(shape, generator=self.generator, dtype=torch.float64)
            return self.low + (self.high - self.low) * draw
        return self.sample(self.population, self.generator)

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw from the present Gaussian within the bounds, float64 ``[count, D]``: for use after the search."""
        normal = torch.randn((count, len(self.mean)), generator=generator, dtype=torch.float64)
        deviation = (normal[:, None, :] * self.root).sum(-1)
        return (self.mean + deviation).clamp(self.lower, self.upper)

    def tell(self, individuals: Tensor, scores: Tensor, mean: Tensor | None = None) -> None:
        """Move the distribution towards the individuals of high score.

        Args:
            individuals: ``[N, D]``, what :meth:`ask` returned.
            scores: ``[N]`` or ``[N, 1]``, higher is better; who has none that is finite does not survive.
            mean: ``[D]``, next mean, taken as it is, where a better one than the survivors' is known
                (:class:`agility_rl.collectors.ResponseMemory`); their spread is the next one in any case.

        Raises:
            ValueError: if a shape differs, an individual is not finite, or no score is finite.
        """
        expected = (self.population, len(self.mean))
        if tuple(individuals.shape) != expected or scores.numel() != self.population:
            raise ValueError(
                f"expected individuals {list(expected)} and {self.population} scores, "
                f"got {list(individuals.shape)} and {list(scores.shape)}"
            )
        individuals, scores = individuals.detach().double(), scores.detach().double().reshape(-1)
        if not bool(individuals.isfinite().all()):
            raise ValueError("individuals must be finite; tell what ask returned")
        finite = scores.isfinite()
        if not bool(finite.any()):
            raise ValueError(f"no score of generation {self.generation} is finite; look for NaN in what computes them")
        order = torch.where(finite, scores, -math.inf).argsort(descending=True, stable=True)[: len(self.weights)]
        weights = self.weights * finite[order]
        weights = (weights / weights.sum())[:, None]
        best = individuals[order]
        survivors = (weights * best).sum(0)
        deviation = best - (survivors if self.centre == "new" else self.mean)
        if self.form == "diagonal":
            covariance = torch.diag((weights * deviation.square()).sum(0))
        else:
            covariance = (weights[..., None] * deviation[:, :, None] * deviation[:, None, :]).sum(0)
        self.mean = torch.lerp(self.mean, survivors, self.learning_rate) if mean is None else mean.double()
        self.mean = self.mean.clamp(self.lower, self.upper)
        self.covariance = torch.lerp(self.covariance, covariance, self.learning_rate)
        variance = self.covariance.diagonal()
        variance.copy_(variance.clamp_min(self.min_std**2))  # a view: larger diagonals keep the matrix positive
        self.means = torch.cat((self.means, self.mean[None]))

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact continuation needs."""
        return {
            "covariance": self.covariance.clone(),
            "means": self.means.clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if the state has another number of parameters, or is of a version that kept the last mean only.
        """
        if "means" not in state:
            raise ValueError(
                "the search was saved by an earlier version, without the means of all generations; begin anew"
            )
        if state["covariance"].shape != self.covariance.shape:
            raise ValueError(f"the state has {len(state['covariance'])} parameters, expected {len(self.mean)}")
        self.means, self.covariance = state["means"].clone(), state["covariance"].clone()
        self.mean = self.means[-1].clone() if len(self.means) else (self.low + self.high) / 2
        self.generator.set_state(state["generator"])


def _vector(name: str, value: Tensor | Sequence[float], like: Tensor | Sequence[float] | None = None) -> Tensor:
    vector = torch.as_tensor(value, dtype=torch.float64).detach().clone()
    if vector.ndim != 1 or not len(vector) or vector.isnan().any() or (like is not None and len(vector) != len(like)):
        raise ValueError(f"{name} must be a vector, as long as the others, without NaN; got {vector.tolist()}")
    return vector
