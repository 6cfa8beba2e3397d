"""How wrong a robot may be about where it stands, as one that has only images is."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations

NEARBY = (0.05, 0.05, 0.03)
"""Deviations of an obstacle that is close: ahead, aside [m], yaw [rad]; near one, an image says where the robot stands
to 0.04 m (median; docs/student.md)."""
A_METRE = (0.04, 0.04, 0.02)
"""What each metre to the obstacle's middle adds; at 2 m images err by 0.13 m (median), the yaw by 0.06 rad."""
LASTING = 1.0
"""Time in which an error falls to 1/e [s]: images in a row err alike, and what has been counted wrong stays so."""


class Misjudgement:
    r"""Errors of the place of ``N`` robots: they see their obstacle where it is not, and turned as it is not.

    .. math:: z_{t + 1} = a z_t + \sqrt{1 - a^2}\, \xi, \quad a = e^{-\Delta t / 1\,\mathrm{s}}, \quad
              \hat o = o + m\,(\sigma_0 + \sigma_1 |o|) \odot z

    o is where the obstacle ahead is seen, in the robot's frame, with the robot's yaw at it. All else that is said of
    the place follows from there.

    Source: ours; the sizes are those of our first student that passes whole courses. A teacher that learns with them
    chooses what is good for whoever knows his place no better.

    Args:
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        factor: m, on all sizes.
        period: of a decision [s].

    Raises:
        ValueError: if the factor is not from 0 to 10.

    Example:
        >>> errors = Misjudgement(2, torch.Generator().manual_seed(0), 1.0, 0.04)
        >>> errors.begin(torch.ones(2, dtype=torch.bool))
        >>> local, turned = errors.misjudged(torch.tensor([[-2.0, 0.0], [-0.5, 0.1]]), torch.zeros(2))
        >>> local.shape, turned.shape
        (torch.Size([2, 2]), torch.Size([2]))
    """

    def __init__(self, num_robots: int, generator: torch.Generator, factor: float, period: float) -> None:
        if not 0.0 <= factor <= 10.0:
            raise ValueError(f"misjudgement must be a factor from 0 to 10, got {factor}")
        self.generator, self.kept, device = generator, math.exp(-period / LASTING), generator.device
        self.error = torch.zeros(num_robots, 3, device=device)
        self._nearby, self._a_metre = (factor * torch.tensor(sizes, device=device) for sizes in (NEARBY, A_METRE))

    def _drawn(self) -> Tensor:
        return torch.randn(self.error.shape, generator=self.generator, device=self.error.device)

    def begin(self, mask: Tensor) -> None:
        """Draw the errors of the rows of a bool mask ``[N]`` anew."""
        self.error = torch.where(mask[:, None], self._drawn(), self.error)

    def advance(self) -> None:
        """One decision later."""
        self.error = self.kept * self.error + math.sqrt(1.0 - self.kept**2) * self._drawn()

    def misjudged(self, local: Tensor, turned: Tensor) -> tuple[Tensor, Tensor]:
        """Where robots at ``[N, 2]`` [m] in their obstacle's frame, turned by ``[N]`` [rad] there, think they are."""
        distance = torch.linalg.vector_norm(local, dim=-1, keepdim=True)
        ahead, aside, yaw = ((self._nearby + self._a_metre * distance) * self.error).unbind(-1)
        believed = turned + yaw
        # The obstacle is seen at -R(turned)^T local, and thought to be there and a bit beside.
        seen = torch.stack((ahead, aside), -1) - rotations.turn(local, -turned)
        return -rotations.turn(seen, believed), believed

    def state_dict(self) -> dict[str, Any]:
        """The errors."""
        return {"error": self.error.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.error = state["error"].clone()
