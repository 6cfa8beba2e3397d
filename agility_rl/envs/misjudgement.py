"""How wrong a robot may be about where it stands, as one that has only images is."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations

SEEN = (0.027, 0.013, 0.0065)
"""Deviations of an obstacle that has been in view: ahead, aside [m], yaw [rad] (docs/student_experiments.md)."""
SPREAD = 0.7
"""Deviation of the logarithm of how wrong a robot is about an obstacle in view: of one much, of most little."""
LASTING = 0.6
"""Time in which such an error falls to 1/e [s]: images in a row err alike, and what has been counted wrong stays so."""
UNSEEN = (0.09, 0.125, 0.04)
"""Deviations of one that has not: how far it stands from where it is expected, along, across [m], and turned [rad];
behind U-turns (docs/student_experiments.md)."""
GUESSED = 0.95
"""Share of such obstacles whose type is known, since they were seen from afar."""
VIEW_DISTANCE, VIEW_ANGLE = 3.0, 0.7
"""Nearer than this [m], and by less than this [rad] beside where the robot looks, an obstacle is in view."""
RECOGNITION = 0.25
"""Time in view in which what was unknown of an obstacle falls to 1/e [s]."""
_ERRORS = ("seen", "unseen", "upcoming")
_OTHERS = ("scale", "unknown", "guessed", "foreseen")


class Misjudgement:
    r"""Errors of the place of ``N`` robots: they think their obstacle is where it is not, and turned as it is not.

    .. math:: \hat p &= R(c\, u_\psi)\,(p + c\, u_{xy}), \quad \hat\psi = \psi + c\, u_\psi, \qquad
              \hat o' = \hat o + e_{xy}, \quad \hat\psi' = \hat\psi + e_\psi \\
              c_{t + 1} &= \begin{cases} e^{-\Delta t / 0.25\,\mathrm{s}}\, c_t & \text{in view} \\
              c_t & \text{else} \end{cases}, \qquad
              e_{t + 1} = a\, e_t + \sqrt{1 - a^2}\, \sigma \odot \xi, \quad a = e^{-\Delta t / 0.6\,\mathrm{s}}

    p and :math:`\psi` are the robot's place and yaw in its obstacle's frame, o is where it sees the obstacle. Until it
    has been in view, the obstacle stands for the robot u away from where it does, and is of no type unless that could
    be guessed; afterwards it is seen e beside where it is. The deviations of e are scaled anew for each obstacle
    (:data:`SPREAD`): who holds one post for another does so until he is through. All sizes are multiplied by the
    factor besides. All else that is said of the place follows from there, and the terrain is what lies
    around there. The obstacle after it is unseen, too.

    Source: ours; the sizes are those of a student that matches shapes (docs/student_experiments.md). A teacher that
    learns with them chooses what is good for whoever knows his place no better, and no earlier.

    Args:
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        factor: on all sizes.
        period: of a decision [s].

    Attributes:
        seen: ``[N, 3]``, e in units of its deviations.
        scale: ``[N]``, by which those are scaled for the present obstacle.
        unseen: ``[N, 3]``, u in units of its deviations.
        upcoming: ``[N, 3]``, that of the obstacle after this one.
        kept: a, the share of e that is left after a decision.
        unknown: ``[N]``, c: how much of what is known of an obstacle in view is unknown of this one, from 1 to 0.
        guessed: bool ``[N]``, whose type is known before it is in view.
        foreseen: bool ``[N]``, the same of the obstacle after this one.

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
        self.generator, device = generator, generator.device
        self.kept, self._forgotten = math.exp(-period / LASTING), math.exp(-period / RECOGNITION)
        self._sizes = factor * torch.tensor([SEEN, UNSEEN], device=device)
        self.seen, self.unseen, self.upcoming = torch.zeros(3, num_robots, 3, device=device)
        self.scale, self.unknown = torch.ones(2, num_robots, device=device)
        self.guessed, self.foreseen = torch.zeros(2, num_robots, dtype=torch.bool, device=device)

    def untyped(self) -> tuple[Tensor, Tensor]:
        """How much of the type is unknown, of the obstacle and of the one after it, each ``[N]`` from 1 to 0."""
        return self.unknown * ~self.guessed, (~self.foreseen).float()

    def _drawn(self, errors: int) -> Tensor:
        return torch.randn(errors, *self.seen.shape, generator=self.generator, device=self.seen.device)

    def _meet(self, mask: Tensor, guessed: Tensor) -> None:
        """Where a bool mask ``[N]`` says so, the obstacle is another one, of known type where ``guessed`` says that."""
        scale = (SPREAD * torch.randn(len(mask), generator=self.generator, device=mask.device)).exp()
        self.scale, self.guessed = torch.where(mask, scale, self.scale), torch.where(mask, guessed, self.guessed)
        self.foreseen = torch.where(mask, self._guess(), self.foreseen)
        self.unknown = self.unknown.masked_fill(mask, 1.0)

    def _guess(self) -> Tensor:
        return torch.rand(len(self.unknown), generator=self.generator, device=self.unknown.device) < GUESSED

    def begin(self, mask: Tensor) -> None:
        """Draw the errors of the rows of a bool mask ``[N]`` anew."""
        for name, drawn in zip(_ERRORS, self._drawn(3), strict=True):
            setattr(self, name, torch.where(mask[:, None], drawn, getattr(self, name)))
        self._meet(mask, self._guess())

    def advance(self, changed: Tensor, local: Tensor, turned: Tensor) -> None:
        """One decision later.

        Args:
            changed: bool ``[N]``, whose obstacle is another than before.
            local: where robots stand, ``[N, 2]`` in its frame [m].
            turned: by how much they are turned there, ``[N]`` [rad].
        """
        seen, upcoming = self._drawn(2)
        self.seen = self.kept * self.seen + math.sqrt(1.0 - self.kept**2) * seen
        ahead, aside = rotations.turn(-local, -turned).unbind(-1)
        near = torch.linalg.vector_norm(local, dim=-1) < VIEW_DISTANCE
        in_view = near & (torch.atan2(aside, ahead).abs() < VIEW_ANGLE)
        self.unknown = torch.where(in_view, self._forgotten * self.unknown, self.unknown)
        self._meet(changed, self.foreseen)
        self.unseen = torch.where(changed[:, None], self.upcoming, self.unseen)
        self.upcoming = torch.where(changed[:, None], upcoming, self.upcoming)

    def expected(self, axis: Tensor) -> Tensor:
        """How far the next obstacle, of an axis ``[N]`` [rad], is thought to be from where it is, ``[N, 2]`` [m].

        By how much it is thought to be turned counts only when it is the present one.
        """
        return -rotations.turn((self._sizes[1] * self.upcoming)[:, :2], axis)

    def misjudged(self, local: Tensor, turned: Tensor) -> tuple[Tensor, Tensor]:
        """Where robots at ``[N, 2]`` [m] in their obstacle's frame, turned by ``[N]`` [rad] there, think they are."""
        along, across, turn = (self._sizes[1] * self.unknown[:, None] * self.unseen).unbind(-1)
        local, turned = rotations.turn(local + torch.stack((along, across), -1), turn), turned + turn
        ahead, aside, yaw = (self._sizes[0] * self.scale[:, None] * self.seen).unbind(-1)
        believed = turned + yaw
        # The obstacle is seen at -R(turned)^T local, and thought to be there and a bit beside.
        seen = torch.stack((ahead, aside), -1) - rotations.turn(local, -turned)
        return -rotations.turn(seen, believed), believed

    def state_dict(self) -> dict[str, Any]:
        """The errors."""
        return {name: getattr(self, name).clone() for name in (*_ERRORS, *_OTHERS)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is that of other errors.
        """
        own = self.state_dict().keys()
        if state.keys() != own:
            raise ValueError(
                f"expected the errors {', '.join(own)} of a misjudged place, got {', '.join(state)}; the run began "
                "with another kind of errors and cannot be resumed: begin another one with --init-from"
            )
        for name, value in state.items():
            setattr(self, name, value.clone())
