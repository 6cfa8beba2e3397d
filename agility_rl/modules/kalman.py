"""The correction of a Kalman filter: where an obstacle is seen after something was said of it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

FREEDOM = 9.0
"""Degrees of freedom of Student's distribution in :func:`doubted`: three deviations off, a variance counts twice."""


def corrected(expected: Tensor, variance: Tensor, said: Tensor, unsure: Tensor) -> tuple[Tensor, Tensor]:
    r"""Where an obstacle is seen and the variance of that, after something was said of it, with how sure that is.

    .. math:: k = \frac{\bar P}{\bar P + R}\, c(m, \bar o), \qquad o = \bar o + k\, (m - \bar o), \qquad
              P = (1 - k)\, \bar P

    Sine and cosine of the yaw share a variance. What is said of a place far from the one expected is of another
    obstacle: c is how :func:`credible` it is.

    Source: Kalman 1960 (doi:10.1115/1.3662552). A glance's R is :math:`2 e^{2 s}`, the variance of Laplace's
    distribution.

    Args:
        expected: ``[*B, 4]``: x, y [m], sine and cosine of the yaw of the obstacle, seen by the robot.
        variance: ``[*B, 3]``, of x, y [m^2] and yaw [rad^2].
        said: ``[*B, 4]``, as the first.
        unsure: ``[*B, 3]``, variance of that, R.

    Example:
        >>> here, there = torch.tensor([2.0, 0.0, 0.0, 1.0]), torch.tensor([2.1, 0.1, 0.0, 1.0])
        >>> place, variance = corrected(here, torch.full((3,), 0.02), there, torch.tensor([0.02, 0.18, 2.0]))
        >>> place.round(decimals=2), variance.round(decimals=3)
        (tensor([2.0500, 0.0100, 0.0000, 1.0000]), tensor([0.0100, 0.0180, 0.0200]))
    """
    gain = variance / (variance + unsure) * credible(said, expected)
    position, yaw = torch.lerp(expected, said, torch.cat((gain, gain[..., 2:]), -1)).split(2, -1)
    return torch.cat((position, nn.functional.normalize(yaw, dim=-1)), -1), (1.0 - gain) * variance


def credible(said: Tensor, expected: Tensor) -> Tensor:
    r"""How far something said of an obstacle's place is believed, by its distance from what was expected.

    .. math:: 1 / (1 + d^4 / 1\,\mathrm{m}^4)

    Source: ours; a soft form of the validation gate of target tracking.

    Args:
        said: ``[*B, 4]``: x, y [m] first.
        expected: ``[*B, 4]``, as the first.

    Returns:
        ``[*B, 1]``, without gradient.

    Example:
        >>> here = torch.tensor([0.0, 0.0, 0.0, 1.0])
        >>> [round(credible(torch.tensor([x, 0.0, 0.0, 1.0]), here).item(), 3) for x in (0.3, 1.0, 4.0)]
        [0.992, 0.5, 0.004]
    """
    distance = torch.linalg.vector_norm((said - expected)[..., :2].detach(), dim=-1, keepdim=True)
    return 1.0 / (1.0 + distance**4)


def doubted(expected: Tensor, variance: Tensor, said: Tensor, unsure: Tensor) -> Tensor:
    r"""Variance of something said of a place, larger the more it surprises: a wrong match claims to be as sure as a
    right one.

    .. math:: R' = R\,(1 + m^2 / 9), \qquad m^2 = \sum_{x, y} \frac{(m_i - \bar o_i)^2}{\bar P_i + R_i}

    Who knows where he is is not led astray by one such match; who does not know has a large P, and is not surprised;
    and what goes on being said is believed in the end.

    Source: ours; the weight of an observation in Student's distribution (Lange et al. 1989,
    doi:10.1080/01621459.1989.10478852), without its constant.

    Args:
        expected: ``[*B, 4]``, as :func:`corrected`, as are the next three.
        variance: ``[*B, 3]``.
        said: ``[*B, 4]``.
        unsure: ``[*B, 3]``.

    Returns:
        ``[*B, 3]``; no gradient passes through the surprise.

    Example:
        >>> here, there = torch.tensor([2.0, 0.0, 0.0, 1.0]), torch.tensor([2.0, 0.3, 0.0, 1.0])
        >>> doubted(here, torch.full((3,), 0.005), there, torch.full((3,), 0.005))  # three deviations off
        tensor([0.0100, 0.0100, 0.0100])
    """
    off = (said - expected)[..., :2].square() / (variance + unsure)[..., :2]
    return unsure * (1.0 + off.sum(-1, keepdim=True).detach() / FREEDOM)
