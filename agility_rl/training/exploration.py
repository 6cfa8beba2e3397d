"""Noise that lasts: what a policy tries is held long enough to show what comes of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

Policy = Callable[[TensorDictBase], TensorDictBase]


class LastingNoise:
    r"""Draw a Gaussian policy's actions with noise that is correlated in time.

    .. math:: a_t = \mu_t + \sigma_t \epsilon_t, \qquad
              \epsilon_t = \rho \, \epsilon_{t-1} + \sqrt{1 - \rho^2} \, \xi_t, \quad \rho = e^{-dt / \tau}

    Every :math:`\epsilon_t` by itself is a standard normal number, so losses that look at single steps stay as they
    are. Of noise that is drawn anew at every step a slow system such as a trotting robot shows only the mean, which is
    nearly zero. The noise knows nothing of episodes and goes on across resets.

    Source: no equation of the paper; noise that lasts in off-policy learning: Eberhard et al. 2023 (ICLR, "Pink noise
    is all you need"), with PPO: Hollenstein et al. 2024 (AAAI, "Colored noise in PPO"). The process is Ornstein and
    Uhlenbeck's.

    Args:
        seconds: tau, time after which noise has fallen to 1/e [s].
        dt: time between two actions [s].
        generator: source of randomness; where it is, the noise is.
        action_key: where the actions stand, of the shape of ``loc`` and ``scale``; their log-density, summed over the
            last dimension, stands beside them with ``_log_prob`` appended, as TorchRL names it.

    Raises:
        ValueError: if a time is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> noise = LastingNoise(0.5, 0.1, torch.Generator().manual_seed(0))
        >>> act = noise.around(lambda td: td.update({"loc": torch.zeros(2, 1), "scale": torch.ones(2, 1)}))
        >>> steps = torch.stack([act(TensorDict({}, [2]))["action"] for _ in range(2000)])
        >>> round((steps[1:] * steps[:-1]).mean().item(), 1), round(math.exp(-0.2), 1)
        (0.8, 0.8)
    """

    def __init__(self, seconds: float, dt: float, generator: torch.Generator, action_key: NestedKey = "action") -> None:
        if not (seconds > 0.0 and dt > 0.0):
            raise ValueError(f"expected times above 0, got seconds {seconds} and dt {dt}")
        self.decay, self.generator = math.exp(-dt / seconds), generator
        *path, name = (action_key,) if isinstance(action_key, str) else action_key
        self.action_key, self.log_prob_key = action_key, (*path, f"{name}_log_prob")
        self.noise: Tensor | None = None

    def around(self, policy: Policy) -> Policy:
        """The same policy with lasting noise on its means."""

        def act(td: TensorDictBase) -> TensorDictBase:
            td = policy(td)
            mean, scale = td["loc"], td["scale"]
            noise = self._next(mean)
            td[self.action_key] = mean + scale * noise
            density = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi)
            td[self.log_prob_key] = density.sum(-1)
            return td

        return act

    def _next(self, like: Tensor) -> Tensor:
        fresh = torch.randn(like.shape, generator=self.generator, device=like.device, dtype=like.dtype)
        if self.noise is None:
            self.noise = fresh
        else:
            self.noise = self.decay * self.noise + math.sqrt(1.0 - self.decay**2) * fresh
        return self.noise

    def state_dict(self) -> dict[str, Any]:
        """The present noise; the generator belongs to whoever gave it."""
        return {} if self.noise is None else {"noise": self.noise.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.noise = state["noise"].clone() if "noise" in state else None
