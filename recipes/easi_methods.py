"""Identification methods that EASI is compared with, on one log and with one budget of simulated control steps.

* ``cma_es``: CMA-ES (``cmaes``) on the squared open-loop prediction error of ``collectors/windows.py``.
* ``cma_es_robust``: the same search on EASI's units, a fixed distance in the place of EASI's critic.
* ``sysid``: Gauss-Newton of MuJoCo's own toolbox (``mujoco.sysid``) on the same residuals.
* ``uniform``: no identification; the first range as it is, as in uniform domain randomisation.
* ``easi``: the search of ``easi.py``.

One control step of one robot counts as one step of the budget, whoever simulates it.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import easi
import easi_config
import numpy as np
import torch
from cmaes import CMA
from easi_report import physical
from easi_toolbox import toolbox_comparison, toolbox_parameters, toolbox_trajectories
from mujoco import sysid
from torch import Tensor

from agility_rl.collectors import ParameterSpace, Windows
from agility_rl.collectors.windows import predict
from agility_rl.go2.model import build_spec
from agility_rl.simulation import make_simulator

UNIFORM_STD = 1.0 / math.sqrt(12.0)
"""Deviation of a uniform distribution on [0, 1], the first range in search coordinates."""
DIFFERENCE = 1e-4
"""Step of the finite differences of ``mujoco.sysid`` in search coordinates; its default of 1.5e-8 falls below what the
contact solver's tolerance leaves of a gradient."""
TOLERANCE = 1e-4
"""``mujoco.sysid`` has converged when its relative step is smaller."""
MIN_EVALUATIONS = 64
"""``mujoco.sysid`` uses as many windows as let it evaluate its residual so often within the budget: eight iterations
or more of six differences and a line search."""


@dataclass(frozen=True)
class Problem:
    """One log as the methods see it, and what they may spend.

    Attributes:
        space: names and first range of the parameters.
        windows: the log, cut up.
        easi: configuration of the search, with the log's path, noise and latency.
        friction_loss: dry friction of the simulator's joints [N m].
        budget: control steps of single robots.
        population: individuals of CMA-ES.
        seed: of everything random.
    """

    space: ParameterSpace
    windows: Windows
    easi: easi_config.Config
    friction_loss: float
    budget: int
    population: int
    seed: int

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Bounds of a search vector ``[D]``, as EASI has them."""
        low, high = torch.zeros(len(self.space)).double(), torch.ones(len(self.space)).double()
        return (low, high) if self.easi.search.bounded else self.space.limits


@dataclass(frozen=True)
class Outcome:
    """What a method found: centre and deviation in physical units ``[D]``, control steps spent, seconds taken."""

    centre: Tensor
    spread: Tensor
    steps: int
    seconds: float


def run_easi(problem: Problem) -> tuple[Tensor, Tensor, int]:
    """Algorithm S2; nothing of the truth reaches it."""
    cfg = problem.easi
    parts = easi.build(cfg)
    for _ in range(cfg.generations):
        easi.evolve(parts, cfg)
    parts.simulator.close()
    centre, spread = physical(parts.search, parts.space)
    return centre, spread, cfg.generations * cfg.num_robots * parts.collector.num_steps


def squares(windows: Windows, predicted: Tensor) -> Tensor:
    """Squared misses in deviations, ``[N, W, H - skip, 29]``."""
    return windows.residual(predicted).square()


def clipped_medians(windows: Windows, predicted: Tensor) -> Tensor:
    """Misses in their own medians, clipped where EASI's critic clips them, ``[N, W, H - skip, 29]``."""
    miss = (predicted - windows.measured)[..., windows.skip :, :].abs().nan_to_num(math.inf)
    return (miss / miss.flatten(0, -2).median(0).values.clamp_min(1e-9)).clamp(max=easi_config.CPU.critic.clip)


def run_cma_es(problem: Problem, size_of: Callable[[Windows, Tensor], Tensor] = squares) -> tuple[Tensor, Tensor, int]:
    """CMA-ES; all individuals of a generation predict the same windows, drawn anew for every generation."""
    cfg, windows, space, population = problem.easi, problem.windows, problem.space, problem.population
    robots, size = cfg.num_robots, len(space)
    # As many windows as EASI's generation has steps for, in whole batches of robots.
    batch = robots // math.gcd(robots, population)
    wanted = min(robots * cfg.trajectory_length // (population * windows.steps), len(windows))
    count = max(wanted // batch * batch, 1)
    cost = -(-population * count // robots) * robots * windows.steps
    if cost > problem.budget:
        raise ValueError(
            f"a generation of CMA-ES takes {cost} control steps, the budget is {problem.budget}; lower --population or "
            "--window, or raise --easi.trajectory-length"
        )
    simulator = make_simulator(num_simulations=robots, num_threads=cfg.num_threads, friction_loss=problem.friction_loss)
    generator = torch.Generator().manual_seed(problem.seed)
    bounds = torch.stack(problem.bounds, -1).numpy()
    search = CMA(np.full(size, 0.5), UNIFORM_STD, bounds=bounds, seed=problem.seed, population_size=population)
    spent, individuals = 0, torch.full((1, size), 0.5).double()
    while spent + cost <= problem.budget and not search.should_stop():
        individuals = torch.from_numpy(np.stack([search.ask() for _ in range(population)]))
        chosen = windows.take(torch.randperm(len(windows), generator=generator)[:count])
        error = size_of(chosen, predict(simulator, space, individuals, chosen)).flatten(1).mean(-1)
        search.tell(list(zip(individuals.numpy(), error.tolist(), strict=True)))
        spent += cost
    simulator.close()
    centre = torch.from_numpy(search.mean)
    return *_physical(space, centre, individuals.std(0)), spent


class _BudgetSpentError(Exception):
    """The next evaluation would exceed the budget."""


def run_sysid(problem: Problem) -> tuple[Tensor, Tensor, int]:
    """Gauss-Newton of ``mujoco.sysid``: its models, roll-outs, finite differences, and the covariance of its result.

    It stops when it has converged or spent its budget; at the centre of the first range it starts.
    """
    space, windows = problem.space, problem.windows
    most = max(problem.budget // (MIN_EVALUATIONS * windows.steps), 1)
    if most < len(windows):
        order = torch.randperm(len(windows), generator=torch.Generator().manual_seed(problem.seed))
        windows = windows.take(order[:most].sort().values)
    spec = build_spec(friction_loss=problem.friction_loss)
    trajectories = toolbox_trajectories(spec.compile(), windows)
    threads = problem.easi.num_threads or len(os.sched_getaffinity(0))
    spent, error, best, at_best = 0, math.inf, np.full(len(space), 0.5), np.empty(0)

    def residual(x: np.ndarray, found: sysid.ParameterDict) -> tuple[list[np.ndarray], list[Any], list[Any]]:
        nonlocal spent, error, best, at_best
        points = x.reshape(len(space), -1)
        cost = points.shape[1] * len(windows) * windows.steps
        if spent + cost > problem.budget:
            raise _BudgetSpentError
        spent += cost
        values, _, _ = sysid.model_residual(
            points,
            found,
            lambda candidate: sysid.apply_param_modifiers(candidate, spec),
            trajectories,
            modify_residual=toolbox_comparison(windows),
            n_threads=threads,
            resample_true=False,
        )
        # The toolbox puts trajectories side by side, where its optimiser wants one column for every point.
        values = values.T.reshape(points.shape[1], -1).T
        errors = np.square(values).sum(0)
        if errors.min() < error:
            lowest = errors.argmin()
            error, best, at_best = errors[lowest], points[:, lowest].copy(), values[:, lowest].copy()
        return [values], [], []

    trace: list[Any] = []
    # When the next evaluation would be one too many, the best point so far is the answer.
    with contextlib.suppress(_BudgetSpentError):
        sysid.optimize(
            toolbox_parameters(space, problem.bounds),
            residual,
            optimizer="mujoco",
            verbose=False,  # it does not reach the optimiser, which prints by default; ``output`` does
            output=io.StringIO(),
            eps=DIFFERENCE,
            xtol=TOLERANCE,
            iter_callback=lambda steps: trace.append(steps[-1].jacobian),
        )
    deviation = np.full(len(space), math.nan)
    if trace:
        deviation = np.sqrt(np.diag(sysid.calculate_intervals([at_best], trace[-1])[0]))
    return *_physical(space, torch.from_numpy(best), torch.from_numpy(deviation)), spent


def run_uniform(problem: Problem) -> tuple[Tensor, Tensor, int]:
    """Centre and spread of the first range; nothing is simulated."""
    size = len(problem.space)
    centre = torch.full((size,), 0.5).double()
    return *_physical(problem.space, centre, torch.full((size,), UNIFORM_STD).double()), 0


def _physical(space: ParameterSpace, centre: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
    """Search coordinates in physical units; the spread is half the width of one deviation to either side."""
    low, high = space.denormalize(centre - deviation), space.denormalize(centre + deviation)
    return space.denormalize(centre), (high - low) / 2


METHODS: dict[str, Callable[[Problem], tuple[Tensor, Tensor, int]]] = {
    "easi": run_easi,
    "cma_es": run_cma_es,
    "cma_es_robust": partial(run_cma_es, size_of=clipped_medians),
    "sysid": run_sysid,
    "uniform": run_uniform,
}


def identify(method: str, problem: Problem) -> Outcome:
    """Run a method of :data:`METHODS` and take the time."""
    clock = time.perf_counter()
    centre, spread, steps = METHODS[method](problem)
    return Outcome(centre, spread, steps, time.perf_counter() - clock)
