"""The obstacle after the present one, as far as it is in view already: of which type it is, and where it stands."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from agility_rl.modules.glance import NUM_POSE, NUM_SCALES
from agility_rl.modules.kalman import corrected
from agility_rl.modules.planar import composed, inverted
from agility_rl.modules.scan_matching import NOTHING, ScanMatcher

NEXT = (0.2**2, 0.29**2, 0.07**2)
"""Variance of where the next obstacle stands, seen from the present one, by the jitter of both (method notes, section
5.7): 0.15 m along, 0.25 m across and 0.087 rad at most, of each; what stands 4 m behind one that is turned so far is
0.35 m aside."""
VIEW_DISTANCE, VIEW_ANGLE = 4.2, 0.8
"""Nearer than this [m], and by less than this [rad] beside where the robot looks, it is looked for: parts of it may be
within the 4 m (method notes, section 5.8) and 0.66 rad of an image (:mod:`agility_rl.go2.camera`)."""
ALIKE = (0.2**2, 0.2**2, 0.08**2)
"""Variance of a match, beside its own: images in a row err alike."""
EVIDENCE = 0.5
"""By so much an image speaks for a type that explains all of it more than for one that explains nothing [nat]."""
STRONGEST = 4.0
"""A type is held for that much less likely than the likeliest at most [nat], so that what is seen later can speak."""


def preview_parts(types: int) -> tuple[int, int, int, int]:
    """Numbers that are remembered of the next obstacle: how far it stands beside its slot, the variance of that, what
    speaks for each type; and what spoke for those of the present one.

    Example:
        >>> preview_parts(7)
        (4, 3, 7, 7)
    """
    return NUM_POSE, NUM_SCALES, types, types


class Preview(nn.Module):
    r"""Know the next obstacle before the present one is left, by how its shape fits what images measure beside it.

    .. math:: \bar o = \delta^{-1} q, \qquad \delta \leftarrow q \circ o^{-1}, \qquad
              h_k \leftarrow \max\left(h_k + \tfrac12 s_k,\ \max_j h_j - 4\right)

    q is the robot's place at the next slot of the course, as what is known of the present obstacle says, and
    :math:`\delta` by how much the obstacle stands beside that slot. While it is in view, the shape of each type is
    laid onto the image (:meth:`~agility_rl.modules.scan_matching.ScanMatcher.compare`): types are believed in by the
    share s of the points that they explain, and the likeliest one's match corrects where the obstacle is seen, o
    (:func:`~agility_rl.modules.kalman.corrected`). On an S-shaped course the obstacle behind a U-turn is in view across
    the open field while the one before it is approached, and not again until the turn is over.

    Source: ours; landmarks that are initialized before they are needed: Durrant-Whyte and Bailey 2006
    (doi:10.1109/MRA.2006.1638022).

    Args:
        types: K, of obstacles.

    Attributes:
        size: of the memory ``[*B, 4 + 3 + K + K]``: :math:`\delta` and its variance, each less what it is at the
            start, h, and h of the present obstacle, as it was when that became the present one.
        said: numbers of what an image says: match of the likeliest type, and evidence for each.

    Example:
        >>> preview = Preview(7)
        >>> memory, place = torch.zeros(2, preview.size), torch.tensor([[-2.5, 0.0, 0.0, 1.0], [9.0, 0.0, 0.0, 1.0]])
        >>> torch.equal(preview.place(memory, place), place), preview.in_view(inverted(place))
        (True, tensor([ True, False]))
    """

    start: Tensor
    jitter: Tensor
    alike: Tensor

    def __init__(self, types: int) -> None:
        super().__init__()
        self.parts = preview_parts(types)
        self.size = sum(self.parts)
        self.said = NUM_POSE + NUM_SCALES + types
        for name, value in {
            "start": torch.tensor([0.0, 0.0, 0.0, 1.0]),
            "jitter": torch.tensor(NEXT),
            "alike": torch.tensor(ALIKE),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def hints(self, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of the types of the next obstacle and of the present one, each ``[*B, K]``."""
        _, _, coming, present = memory.split(self.parts, -1)
        return coming, present

    def place(self, memory: Tensor, at_slot: Tensor) -> Tensor:
        """The robot's place at the next obstacle, ``[*B, 4]``, from that at its slot."""
        return composed(inverted(memory[..., :NUM_POSE] + self.start), at_slot)

    def variance(self, memory: Tensor) -> Tensor:
        """Of where the next obstacle stands, ``[*B, 3]``: x, y [m^2], yaw [rad^2]."""
        return memory.split(self.parts, -1)[1] + self.jitter

    def in_view(self, seen: Tensor) -> Tensor:
        """Whether obstacles at ``[*B, 4]`` in the robots' frames may be within the image, bool ``[*B]``."""
        bearing = torch.atan2(seen[..., 1], seen[..., 0])
        return (torch.linalg.vector_norm(seen[..., :2], dim=-1) < VIEW_DISTANCE) & (bearing.abs() < VIEW_ANGLE)

    def arrived(self, memory: Tensor, onwards: Tensor) -> Tensor:
        """Memory ``[*B, M]`` when another obstacle has become the present one; bool ``[*B, 1]``: the next one has."""
        coming, _ = self.hints(memory)
        empty = torch.zeros_like(memory[..., : -coming.shape[-1]])
        return torch.cat((empty, coming * onwards), -1)

    def silence(self, memory: Tensor, at_slot: Tensor) -> Tensor:
        """What images say that show nothing of it, ``[*B, 7 + K]``: that it is where it was expected, of any type."""
        expected, hints = inverted(self.place(memory, at_slot)), self.hints(memory)[0]
        nothing = torch.full_like(expected[..., :NUM_SCALES], NOTHING)
        return torch.cat((expected, nothing, torch.zeros_like(hints)), -1)

    @torch.no_grad()
    def look(
        self,
        matcher: ScanMatcher,
        is_next: Tensor,
        depth: Tensor,
        proprioception: Tensor,
        estimate: Tensor,
        age: Tensor,
        memory: Tensor,
        at_slot: Tensor,
        likely: Tensor,
    ) -> Tensor:
        """What images say of the next obstacle, ``[N, 7 + K]``: a match, and evidence for its types.

        Args:
            matcher: of the shapes of the K types.
            is_next: bool ``[N]``, whether there is one.
            depth: as the matcher's.
            proprioception: ``[N, 45]``.
            estimate: ``[N, 4]``.
            age: ``[N, 1]``.
            memory: ``[N, M]``.
            at_slot: the robot's place at the next slot, ``[N, 4]``.
            likely: how likely types are beforehand, logits ``[N, K]``.
        """
        silence = self.silence(memory, at_slot)
        expected = silence[:, :NUM_POSE]
        visible = is_next & self.in_view(expected)
        # An exported network cannot choose rows; elsewhere most are spared K fits.
        every = torch.arange(len(visible), device=visible.device)
        rows = every if torch.compiler.is_exporting() else every[visible]
        measured = [part[rows] for part in (depth, proprioception, estimate, age, expected, inverted(at_slot))]
        matches, share = matcher.compare(*measured)
        evidence = EVIDENCE * share
        likeliest = ((self.hints(memory)[0] + likely)[rows] + evidence).argmax(-1)
        match = matches.take_along_dim(likeliest[:, None, None], 1)[:, 0]
        said = silence.index_copy(0, rows, torch.cat((match, evidence), -1))
        return torch.where(visible[:, None], said, silence)

    def told(self, memory: Tensor, at_slot: Tensor, said: Tensor) -> Tensor:
        """Memory ``[*B, M]`` after what images said, ``[*B, 7 + K]``, of robots at ``[*B, 4]`` at the next slot."""
        match, unsure, evidence = said.split((NUM_POSE, NUM_SCALES, said.shape[-1] - NUM_POSE - NUM_SCALES), -1)
        coming, present = self.hints(memory)
        expected = inverted(self.place(memory, at_slot))
        seen, variance = corrected(expected, self.variance(memory), match, unsure + self.alike)
        offset = composed(at_slot, seen) - self.start
        coming = coming + evidence
        coming = torch.maximum(coming, coming.amax(-1, keepdim=True) - STRONGEST)
        return torch.cat((offset, variance - self.jitter, coming, present), -1)
