"""What replayed windows say about parameters that nobody simulated: their linear responses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from agility_rl import keys
from agility_rl.collectors.easi import one_thread
from agility_rl.collectors.evolution import EvolutionStrategy
from agility_rl.collectors.replay import MATCHED


class ResponseMemory:
    r"""Remember how windows respond to the parameters, and climb to where the critic likes all of them best.

    Ranks use one number of an individual, its score, and windows that are drawn anew shift where it is best. But all
    individuals of a generation play the same windows, so that a regression gives every entry of every measurement as a
    function of the parameters:

    .. math:: s'(\xi) \approx \hat s' + J (\xi - m), \qquad
              (\hat s', J) = \arg\min \sum_j \| s'_j - \hat s' - J (\xi_j - m) \|^2

    with m the mean about which the generation was drawn. In these responses the critic can judge any parameters, in the
    windows of many generations at once, and not one control step is simulated for it:

    .. math:: \xi^* = \arg\max_\xi \sum_{\text{windows}} \tilde D(s, a, s'(\xi))

    and the mean goes towards it, as far as :math:`\| C^{-1/2} (\xi - m) \| = \text{trust}` at most, where C is the
    covariance with which the last generation was drawn: further away nothing says that the response is linear.
    Remembered are the later generations, a fixed share of them; the first ones are drawn too wide.

    Source: ours, not the paper's, which moves the mean to that of the survivors
    (:class:`agility_rl.collectors.EvolutionStrategy`).

    Keys read (of :meth:`remember`, ``[N, T]``; the critic reads the same, ``[T]`` of every remembered generation):
        measurement                  float32 ``[N, T, 29]``  state in the log, the same for all individuals [SI units]
        action                       float32 ``[N, T, 12]``  action taken in it [action units]
        (next, measurement)          float32 ``[N, T, 29]``  what followed in the simulation [SI units]
        (next, matched_measurement)  float32 ``[N, T, 29]``  what followed in the log [SI units]
        (collector, mask)            bool ``[N, T]``         false where an individual diverged

    Args:
        share: share of the generations, counted from the last, whose windows are remembered.
        trust: farthest step in deviations of the last generation.
        iterations: of L-BFGS in a climb.

    Raises:
        ValueError: if an option is out of range.

    Example:
        >>> from agility_rl.modules import TransitionDiscriminator
        >>> search = EvolutionStrategy([0.0], [1.0], population=8, generator=torch.Generator().manual_seed(0))
        >>> individuals = search.ask()
        >>> after = individuals.float()[:, None].expand(8, 5, 29)  # every entry is the parameter
        >>> transitions = TensorDict({
        ...     "measurement": torch.zeros(8, 5, 29), "action": torch.zeros(8, 5, 12),
        ...     "next": {"measurement": after, "matched_measurement": torch.full((8, 5, 29), 0.7)},
        ...     "collector": {"mask": torch.ones(8, 5, dtype=torch.bool)},
        ... }, [8, 5])
        >>> critic = TransitionDiscriminator.from_transitions(transitions, clip=3.0, matched_key=MATCHED)
        >>> memory = ResponseMemory()
        >>> memory.remember(individuals, transitions, search.mean)
        >>> round(float(memory.climb(critic, search)), 2)
        0.7
    """

    def __init__(self, *, share: float = 0.75, trust: float = 2.0, iterations: int = 20) -> None:
        if not 0.0 < share <= 1.0 or trust <= 0.0 or iterations < 1:
            raise ValueError(
                "expected share from above 0 to 1, trust above 0 and iterations from 1, got "
                f"{share}, {trust} and {iterations}"
            )
        self.share, self.trust, self.iterations = share, trust, iterations
        self.generation = 0
        """Generations seen, remembered or not."""
        self._responses: list[dict[str, Tensor]] = []

    def __len__(self) -> int:
        """Generations remembered."""
        return len(self._responses)

    @one_thread()
    @torch.no_grad()
    def remember(self, individuals: Tensor, transitions: TensorDictBase, mean: Tensor) -> None:
        """Add the responses of a generation, and forget what is too old.

        Args:
            individuals: ``[N, D]``, normalised search vectors.
            transitions: ``[N, T]``, theirs, of :meth:`agility_rl.collectors.ReplayCollector.collect`.
            mean: ``[D]``, about which they were drawn.
        """
        valid = transitions["collector", "mask"].all(1)
        if bool(valid.any()):
            state, action, real = (transitions[key][0] for key in (keys.MEASUREMENT, keys.ACTION, MATCHED))
            miss = (transitions["next", keys.MEASUREMENT] - transitions[MATCHED])[valid].double().flatten(1)
            away = individuals[valid].double() - mean
            # Columns of size 1, and the solution of least norm: fewer individuals than parameters are no error.
            scale = away.std(0, correction=0).clamp_min(1e-12)
            columns = torch.cat((torch.ones_like(away[:, :1]), away / scale), 1)
            solution = torch.linalg.lstsq(columns, miss, driver="gelsd").solution
            slope = (solution[1:] / scale[:, None]).mT.unflatten(0, real.shape)
            found = {"offset": solution[0].view_as(real).float(), "slope": slope.float()}
            self._responses.append({"state": state, "action": action, "real": real, "mean": mean.clone(), **found})
        self.generation += 1
        keep = max(round(self.share * self.generation), 1)
        self._responses = self._responses[-keep:]

    @one_thread()
    def climb(self, critic: TensorDictModuleBase, search: EvolutionStrategy) -> Tensor:
        """Where the critic likes the remembered windows best, or ``trust`` deviations of the way there, ``[D]``.

        Args:
            critic: reads what a replayed transition has, and writes its logit first.
            search: before it is told the last generation's scores.
        """
        if not self._responses:
            return search.mean.clone()
        state, action, real = (torch.cat([entry[name] for entry in self._responses]) for name in _LOG)
        # In deviations of the search every direction is about equally steep, and the trust region is a ball.
        root = search.root
        offset = torch.cat([_at(search.mean, entry) for entry in self._responses])
        slope = torch.cat([entry["slope"] for entry in self._responses]) @ root.float()
        step = torch.zeros(len(search.mean), requires_grad=True)
        optimizer = torch.optim.LBFGS([step], max_iter=self.iterations, line_search_fn="strong_wolfe")

        def dislike() -> Tensor:
            after = {keys.MEASUREMENT: real + offset + slope @ step, MATCHED[1]: real}
            judged = critic(
                TensorDict(
                    {keys.MEASUREMENT: state, keys.ACTION: action, "next": TensorDict(after, state.shape[:1])},
                    state.shape[:1],
                )
            )
            loss = -judged[critic.out_keys[0]].mean()
            (step.grad,) = torch.autograd.grad(loss, step)
            return loss.detach()

        with torch.enable_grad():
            optimizer.step(dislike)
        moved = step.detach() * (self.trust / step.detach().norm().clamp_min(self.trust))
        return search.mean + root @ moved.double()

    def state_dict(self) -> dict[str, Any]:
        """Number of generations seen, and the remembered responses, stacked: ``offset [G, T, 29]``, ``slope``
        ``[G, T, 29, D]``, ``mean [G, D]``, and the log's ``state``, ``action`` and ``real`` ``[G, T, ...]``.
        """
        names = self._responses[0] if self._responses else ()
        stacked = {name: torch.stack([entry[name] for entry in self._responses]) for name in names}
        return {"generation": self.generation, "responses": stacked}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.generation = int(state["generation"])
        stacked = dict(state["responses"])
        count = len(stacked["mean"]) if stacked else 0
        self._responses = [{name: values[i].clone() for name, values in stacked.items()} for i in range(count)]


_LOG = ("state", "action", "real")
"""Of a response, what is the log's own."""


def _at(mean: Tensor, response: Mapping[str, Tensor]) -> Tensor:
    """By how much a window misses the log at other parameters than those it was drawn about, ``[T, 29]``."""
    return response["offset"] + response["slope"] @ (mean - response["mean"]).float()
