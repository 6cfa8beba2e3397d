"""What shapes in the world look like from above."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.record.scene import Shape

_DIRECTIONS, _RIM = 720, 48


def footprint(shape: Shape) -> Tensor:
    """Outline of a shape from above: the convex hull of its projection, ``[M, 2]`` [m], counter-clockwise.

    Source: the farthest point of a convex body in a direction lies on its hull; here for 720 directions.

    Example:
        >>> corners = footprint(Shape("box", (2.0, 1.0, 0.5), (1.0, 0.5, 0.0)))
        >>> sorted(corners.tolist())
        [[0.0, 0.0], [0.0, 1.0], [2.0, 0.0], [2.0, 1.0]]
    """
    half = torch.tensor(shape.size, dtype=torch.float64) / 2
    angle = torch.arange(_RIM, dtype=torch.float64) * (2.0 * math.pi / _RIM)
    if shape.kind == "sphere":  # turned or not, the same from above
        return torch.tensor(shape.position[:2]) + (half[:2] * torch.stack((angle.cos(), angle.sin()), -1)).float()
    ends = torch.tensor([-1.0, 1.0], dtype=torch.float64)
    if shape.kind == "box":
        corners = torch.cartesian_prod(ends, ends, ends) * half
    else:
        rim = torch.stack((angle.cos(), angle.sin(), torch.ones_like(angle)), -1)
        corners = torch.cat([rim * torch.tensor([1.0, 1.0, end]) for end in ends.tolist()]) * half
    turned = rotations.rotate(torch.tensor(shape.quaternion, dtype=torch.float64), corners)[:, :2]
    # Half a step off the axes, so that no side of a straight box is seen edge-on.
    around = (torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5) * (2.0 * math.pi / _DIRECTIONS)
    farthest = (turned @ torch.stack((around.cos(), around.sin()))).argmax(0)
    keep = farthest != farthest.roll(1)
    return torch.tensor(shape.position[:2]) + turned[farthest[keep]].float()
