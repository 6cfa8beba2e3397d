"""Whether the feet of a robot swing in the rhythm of the behaviour that it is told to show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import constants
from agility_rl.go2.features import in_stance

MEMORY = 0.6
"""Strides after which what a foot did counts 1/e: less blurs the phase and forgives a wrong stride frequency, more
pays nothing for coming nearer from far off."""
REST = 0.006
"""Fore-aft motion [m] beside which a standing robot's trembling is no stride, but a step on the spot is."""
STANCE_MEMORY = 2.0
"""Strides after which whether a foot stood counts 1/e."""
STANCE_WIDTH = 0.15
"""Miss of the duty factor that counts 1/e."""
SHARPNESS = 8.0
"""Of the agreement between phases: a twelfth of a stride aside counts a third."""

_FIGURES = ("frequency", "speed", "growth", "duty", "share")
_REAL = ("power", "mean", "last", "stance", "fresh")


class Rhythm:
    r"""Short memory of the fore-aft motion of the feet, and how much of it follows a dog's pattern.

    A resonator at the behaviour's stride frequency :math:`f = f_0 + g\,(|v^*| - v_0)`, at least :math:`f_0 / 2`,
    follows each foot's fore-aft position x about its mean,

    .. math:: \dot z_i = \left(2 \pi i f - \tfrac{f}{m}\right) z_i + \tfrac{f}{m}\,(x_i - \bar x_i),

    with a memory of m strides (:data:`MEMORY`), beside the mean square :math:`p_i` over the same time; :math:`d` is
    the share of the last two strides in which a foot stood (:func:`~agility_rl.go2.features.in_stance`). The share of
    the motion that has the frequency, beside the dogs' own share s, times the agreements of the duty factor and of the
    phases with the pattern's or its mirror image's, is

    .. math:: \min\left(1, \frac{1}{s} \frac{2 \sum |z_i|^2}{\sum p_i + 4 \cdot 0.006^2}\right)
              \exp\left(-\frac{(d - d^* - l)^2}{0.15^2}\right)
              \max_{\phi^*} \frac{1}{6} \sum_{ij} e^{8 (\cos 2\pi(\phi_{ij} - \phi^*_{ij}) - 1)},
              \quad \phi_{ij} = \tfrac{1}{2\pi} \arg z_i \bar z_j.

    Source: no equation of the paper (ours). A discriminator of short clips hardly hears by how much a stride is too
    fast, or feet that a dog sets down one after the other come together.

    Args:
        num_robots: N.
        patterns: ``[5]`` with ``frequency`` [Hz] :math:`f_0` at ``speed`` [m/s] :math:`v_0`, ``growth`` [1/m] g,
            ``duty`` :math:`d^*`, ``share`` s, ``phase`` and ``mirrored_phase`` [5, 6] [strides], as
            :func:`agility_rl.motion.stride_patterns.stride_patterns` makes them; where it is, the tensors are.

    Attributes:
        longer_stance: l of each behaviour, ``[5]``; 0 unless set.
        emphasis: by what the agreement of each behaviour is multiplied, ``[5]``; 1 unless set.

    Example:
        >>> from tensordict import TensorDict
        >>> pattern = {name: torch.ones(5) for name in ("frequency", "speed", "growth", "share")}
        >>> pattern |= {"duty": torch.full((5,), 0.5), "phase": torch.zeros(5, 6), "mirrored_phase": torch.zeros(5, 6)}
        >>> rhythm = Rhythm(1, TensorDict(pattern, [5]))
        >>> trot = torch.tensor([2])
        >>> for step in range(200):  # all feet together, once a second, on the spot
        ...     swing = torch.full((1, 4), 0.1 * math.sin(2 * math.pi * 0.02 * step))
        ...     heard = rhythm.hear(swing, torch.zeros(2, 1), trot, torch.ones(1), 0.02)
        >>> bool(heard > 0.8)
        True
    """

    def __init__(self, num_robots: int, patterns: TensorDictBase) -> None:
        device = patterns["frequency"].device
        self._figures = torch.stack([patterns[name] for name in _FIGURES], -1)  # [5, 5]
        self.longer_stance = torch.zeros(len(BEHAVIOURS), device=device)
        self.emphasis = torch.ones(len(BEHAVIOURS), device=device)
        self._images = torch.stack([patterns[name] for name in ("phase", "mirrored_phase")], 1)  # [5, 2, 6]
        self._swing = torch.zeros(num_robots, 4, dtype=torch.complex64, device=device)
        self._power, self._mean = (torch.zeros(num_robots, 4, device=device) for _ in range(2))
        self._last, self._stance = torch.zeros(num_robots, 4, device=device), torch.zeros(num_robots, device=device)
        self._fresh = torch.ones(num_robots, 1, dtype=torch.bool, device=device)
        first, second = zip(*constants.FOOT_PAIRS, strict=True)
        self._first, self._second = (torch.tensor(feet, device=device) for feet in (first, second))

    def begin(self, mask: Tensor) -> None:
        """Forget the past of the rows of a bool mask ``[N]``."""
        self._fresh = self._fresh | mask[:, None]

    def update(self, state: LocomotionState, skill: Tensor) -> Tensor:
        """Follow the feet for one control step, in behaviours int64 ``[N]``; returns the agreement ``[N]``, 0 to the
        behaviour's emphasis."""
        cosine, sine = state.pitch.cos()[:, None], state.pitch.sin()[:, None]
        level = state.feet[..., 0] * cosine + state.feet[..., 2] * sine
        forward = torch.stack((state.linear_velocity[:, 0], state.mean_velocity[:, 0]))
        return self.hear(level, forward, skill, state.command[:, :2].norm(dim=-1), state.dt)

    def hear(self, position: Tensor, forward: Tensor, skill: Tensor, speed: Tensor, dt: float) -> Tensor:
        """The same, of fore-aft positions ``[N, 4]`` [m] of the feet, ``dt`` [s] after the last ones; the trunk goes
        ``forward`` ``[2, N]`` [m/s], now and on the mean, and is told to go at speeds ``[N]`` [m/s]."""
        usual, usual_speed, growth, duty, dogs_share = self._figures[skill].unbind(-1)
        duty = duty + self.longer_stance[skill]
        step = dt * torch.maximum(usual + growth * (speed - usual_speed), 0.5 * usual)[:, None]
        self._swing = self._swing.masked_fill(self._fresh, 0.0)
        self._power = self._power.masked_fill(self._fresh, 0.0)
        mean = torch.where(self._fresh, position, self._mean)
        last = torch.where(self._fresh, position, self._last)
        stance = torch.where(self._fresh[:, 0], duty, self._stance)
        self._fresh, self._last = torch.zeros_like(self._fresh), position
        now, usually = forward[..., None]
        standing = in_stance((position - last) / dt + now, usually).float().mean(-1)
        self._stance = stance + (standing - stance) * step[:, 0] / STANCE_MEMORY
        decay = step / MEMORY
        self._mean = mean + (position - mean) * decay / 2.5
        aside = position - self._mean
        turn = torch.polar(torch.exp(-decay), 2.0 * math.pi * step)
        self._swing = self._swing * turn + aside * decay
        self._power = self._power + (aside.square() - self._power) * decay / 2.0
        share = 2.0 * self._swing.abs().square().mean(-1) / (self._power.mean(-1) + REST**2) / dogs_share
        phase = self._swing[:, self._first] * self._swing[:, self._second].conj()
        off = phase.angle()[:, None] - 2.0 * math.pi * self._images[skill]
        agreement = torch.exp(SHARPNESS * (torch.cos(off) - 1.0)).mean(-1)
        miss = (self._stance - duty) / STANCE_WIDTH
        return self.emphasis[skill] * share.clamp(max=1.0) * agreement.amax(-1) * torch.exp(-miss.square())

    def state_dict(self) -> dict[str, Any]:
        """The memory: ``swing [N, 4, 2]``, real and imaginary part [m]; ``power`` [m^2], ``mean`` and ``last`` [m]
        ``[N, 4]``; ``stance`` ``[N]``; ``fresh`` bool ``[N, 1]``, who has none yet."""
        swing = torch.view_as_real(self._swing).clone()
        return {"swing": swing} | {name: getattr(self, f"_{name}").clone() for name in _REAL}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self._swing = torch.view_as_complex(state["swing"].clone())
        for name in _REAL:
            setattr(self, f"_{name}", state[name].clone())
