r"""The ground bent to a curve: what leads straight ahead on the one leads along an arc on the other.

With :math:`x` along a straight line, :math:`y` to its left and the curvature :math:`\kappa`, a point goes to

.. math:: x' = (1/\kappa - y) \sin \kappa x, \quad y' = 1/\kappa - (1/\kappa - y) \cos \kappa x

The line itself becomes a circle of radius :math:`1/|\kappa|` that leaves the origin in the direction of the line.

Source: elementary geometry.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

TIGHTEST = 2.0
"""Largest curvature [1/m] that a robot of this size is led along: half a metre is a little more than its length."""
STRAIGHT = 1e-5
"""Smaller curvatures [1/m] are taken as this when an arc is straightened: over a metre they move a point by 10 um."""


def bend_points(points: Tensor, curvature: Tensor | float) -> Tensor:
    """Where points of the straight world lie in the bent one; heights stay.

    Args:
        points: ``[*B, 2 or 3]`` [m].
        curvature: broadcast against ``[*B]`` [1/m], positive to the left.

    Example:
        >>> quarter = math.pi / 2
        >>> bend_points(torch.tensor([quarter, 0.0]), 1.0).round(decimals=4)
        tensor([1., 1.])
    """
    x, y = points[..., 0], points[..., 1]
    angle = curvature * x
    # Written without 1 / curvature, which a straight line has none of.
    along = x * torch.sinc(angle / math.pi) - y * angle.sin()
    left = x * (angle / 2).sin() * torch.sinc(angle / (2 * math.pi)) + y * angle.cos()
    return torch.cat((torch.stack((along, left), -1), points[..., 2:]), -1)


def straighten_points(points: Tensor, curvature: Tensor | float) -> Tensor:
    """The inverse of :func:`bend_points`, for points that are nearer to the origin than half around the circle.

    Example:
        >>> straighten_points(torch.tensor([1.0, 1.0]), 1.0).round(decimals=4)
        tensor([1.5708, 0.0000])
    """
    x, y = points[..., 0], points[..., 1]
    curvature = torch.as_tensor(curvature, dtype=points.dtype, device=points.device)
    curvature = torch.where(curvature.abs() < STRAIGHT, STRAIGHT, curvature)
    along = torch.atan2(curvature * x, 1 - curvature * y) / curvature
    # The distance to the centre without the difference of two large numbers: d = (r^2 - |p - c|^2) / (r + |p - c|).
    away = ((curvature * x).square() + (1 - curvature * y).square()).sqrt()
    left = (2 * y - curvature * (x.square() + y.square())) / (1 + away)
    return torch.cat((torch.stack((along, left), -1), points[..., 2:]), -1)
