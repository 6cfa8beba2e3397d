"""What a single image says by itself: what stands there, and where it stands if not where it was expected."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from agility_rl.modules.mlp import mlp

NUM_POSE = 4
"""x, y [m], sine and cosine of the yaw."""
NUM_SCALES = 3
"""Uncertainties of x, y and yaw."""
SCALES = (-4.0, 1.5)
"""Least and most logarithm of a scale."""
EXPECTED = (0.5, 0.5, 0.2)
"""Deviation of the places from which a glance learns to correct: x, y [m], yaw [rad]."""


class Glance(nn.Module):
    """What a single image says by itself.

    Where that is it says by how much an expected place is wrong: who cannot tell from an image says nothing, rather
    than what is usual. It is trained with places that are expected much less well than they are
    (:data:`EXPECTED`), so that it looks rather than believes.

    Source: ours.

    Args:
        features: of an image.
        known: numbers of terrain latent, obstacle and progress.
        legs: obstacles of the course.
        hidden: units of the layers between the feature with an expected place and the correction; where an obstacle
            stands from there is a turn and a shift, which several layers say much better than one
            (docs/student_experiments.md).

    Example:
        >>> glance = Glance(32, (32, 7, 24), legs=6)
        >>> feature, leg = torch.randn(5, 32), torch.tensor([0, 0, 1, 1, 5])
        >>> place, scale = glance.where(feature, torch.zeros(5, 4), leg)
        >>> glance.what(feature).shape, place.shape, scale.shape
        (torch.Size([5, 63]), torch.Size([5, 4]), torch.Size([5, 3]))
    """

    def __init__(self, features: int, known: Sequence[int], legs: int, hidden: Sequence[int] = (128,)) -> None:
        super().__init__()
        self.known, self.legs = tuple(known), legs
        self.linear = mlp(features, (), sum(known))
        self.correction = mlp(features + NUM_POSE + legs, hidden, NUM_POSE + NUM_SCALES)
        for parameter in self.correction[-1].parameters():  # who has learned nothing corrects nothing
            nn.init.zeros_(parameter)

    def what(self, feature: Tensor) -> Tensor:
        """Of features ``[*B, F]``: terrain latent before tanh, logits of the obstacle and of the progress."""
        out: Tensor = self.linear(feature)
        return out

    def where(
        self, feature: Tensor, expected: Tensor, leg: Tensor, then: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Where the obstacle of a leg, int64 ``[*B]``, is seen, ``[*B, 4]``, and logarithms of scales, ``[*B, 3]``.

        Args:
            feature: of the images, ``[*B, F]``.
            expected: where it is expected, ``[*B, 4]``.
            leg: which obstacle of the course, int64 ``[*B]``.
            then: ``[*B, 4]``, where it was expected when the image was taken, if that is longer ago than in training.
        """
        shown = expected if then is None else then
        known = torch.cat((feature, shown, nn.functional.one_hot(leg, self.legs).to(feature.dtype)), -1)
        correction, scale = self.correction(known).split((NUM_POSE, NUM_SCALES), -1)
        return expected + correction, scale.clamp(*SCALES)
