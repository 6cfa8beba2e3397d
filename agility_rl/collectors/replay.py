"""The collector that replays a robot log: its own actions are played from its own states, and no policy acts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys
from agility_rl.collectors.easi import EASICollector, one_thread
from agility_rl.collectors.parameters import ParameterSpace
from agility_rl.collectors.windows import Windows, predict
from agility_rl.simulation import Simulator

MATCHED = ("next", "matched_measurement")
"""float32 ``[*B, 29]``, what the robot measured after the same state and action."""


class ReplayCollector:
    r"""Replay short windows of a robot log with every individual, and score what follows.

    In a roll-out of a policy, state and action soon differ between robot and simulator, and the discriminator compares
    two distributions, in which a wrong damping hardly shows. Here they are the log's on both sides, all individuals of
    a generation play the same windows, and a transition differs from its robot's own only in what follows:

    .. math:: (s_t, a_t, s'_j), \quad s'_j = \mathrm{sim}_{\xi_j}(\hat s_k, a_k, \dots, a_t) \qquad\text{against}\qquad
              (s_t, a_t, s_{t+1})

    where k is the first row of the window, and the hidden part of its state is an estimate
    (:func:`agility_rl.collectors.windows.estimate_states`). ``matched_measurement`` holds the robot's own
    :math:`s_{t+1}`, which :class:`agility_rl.modules.TransitionDiscriminator` can take as the origin of s'. No noise is
    added and no latency: the windows have the latency taken out, and the noise of a matched pair, that of the log, is
    the same for all individuals, so that it cancels in their order.

    An individual that diverges in any window has no valid transition and scores minus infinity; masking the window
    alone would excuse it from the one that is hardest for it.

    Source: ours, not the paper's, whose individuals roll out the policy (Algorithm S2, lines 4 to 8;
    :class:`EASICollector`). Scores and batches are the paper's.

    Keys of a collection, ``[N, T]`` with T the number of windows x (H - skip): ``measurement`` [29] and ``action`` [12]
    of the log, ``("next", "measurement")`` of the simulation, ``("next", "matched_measurement")`` of the log,
    ``("collector", "mask")`` bool, and ``individual`` float32 ``[N, T, D]``, the normalised parameters, as a view.

    Args:
        simulator: any number of simulations; a multiple of the individuals is fastest. Its parameters are overwritten.
        space: what a search vector means.
        windows: the log, cut up.
        num_windows: windows of a generation, drawn without replacement; all of them if the log has fewer.
        generator: draws the windows; the state dict includes it.

    Raises:
        ValueError: if no window is asked for.

    Example:
        >>> from agility_rl.collectors import cut_windows, record_robot_log
        >>> from agility_rl.simulation import make_simulator
        >>> simulator, generator = make_simulator(num_simulations=4, num_threads=1), torch.Generator().manual_seed(0)
        >>> log = record_robot_log(
        ...     make_simulator(num_simulations=1, num_threads=1),
        ...     lambda measured: 0.3 * torch.randn(1, 12, generator=generator), 100, generator=generator,
        ... )
        >>> collector = ReplayCollector(
        ...     simulator, ParameterSpace(), cut_windows(log, 3, skip=1), num_windows=5, generator=generator)
        >>> transitions = collector.collect(torch.rand(4, 6, generator=generator))
        >>> transitions["next", "measurement"].shape, len(collector.real)
        (torch.Size([4, 10, 29]), 66)
    """

    def __init__(
        self,
        simulator: Simulator,
        space: ParameterSpace,
        windows: Windows,
        *,
        num_windows: int,
        generator: torch.Generator,
    ) -> None:
        if num_windows < 1:
            raise ValueError(f"num_windows must be at least 1, got {num_windows}")
        self.simulator, self.space, self.windows, self.generator = simulator, space, windows, generator
        self.num_windows = min(num_windows, len(windows))
        self.real = _transitions(windows, windows.measured[None]).reshape(-1)
        """The robot's own transitions in all windows, ``[M]``; what was measured matches itself."""

    @property
    def num_steps(self) -> int:
        """Control steps that an individual simulates in a collection, skipped ones included."""
        return self.num_windows * self.windows.steps

    @one_thread()
    @torch.no_grad()
    def collect(self, individuals: Tensor) -> TensorDict:
        """Transitions ``[N, T]`` of individuals ``[N, D]``, normalised search vectors, in newly drawn windows.

        Raises:
            ValueError: if the vectors have another length.
        """
        rows = torch.randperm(len(self.windows), generator=self.generator)[: self.num_windows]
        windows = self.windows.take(rows)
        predicted = predict(self.simulator, self.space, individuals, windows)
        valid = predicted.isfinite().flatten(1).all(1)
        transitions = _transitions(windows, torch.where(valid[:, None, None, None], predicted, windows.measured))
        count = transitions.shape[1]
        transitions["collector"] = TensorDict({"mask": valid[:, None].expand(-1, count)}, transitions.shape)
        return transitions.set("individual", individuals.float()[:, None].expand(-1, count, -1))

    score = staticmethod(EASICollector.score)
    sample = staticmethod(EASICollector.sample)

    def state_dict(self) -> dict[str, Any]:
        """Position of the generator; every window starts from a reset, so that there is nothing else."""
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.generator.set_state(state["generator"])


def _transitions(windows: Windows, following: Tensor) -> TensorDict:
    """Transitions ``[N, T]`` from measurements ``[N, W, H, 29]`` that followed the log's states and actions."""
    count = len(following)
    before = torch.cat((windows.first[:, None], windows.measured[:, :-1]), 1)

    def rows(entry: Tensor) -> Tensor:
        return entry[..., windows.skip :, :].flatten(-3, -2)

    def shared(entry: Tensor) -> Tensor:
        return rows(entry).expand(count, -1, -1)

    after = rows(following)
    return TensorDict(
        {
            keys.MEASUREMENT: shared(before),
            keys.ACTION: shared(windows.action),
            "next": TensorDict(
                {keys.MEASUREMENT: after, MATCHED[1]: shared(windows.measured)},
                after.shape[:2],
            ),
        },
        after.shape[:2],
    )
