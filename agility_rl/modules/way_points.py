"""Which way-point is the present one: what the place and what images say of it."""

from __future__ import annotations

import torch
from torch import Tensor

NEAR = 0.42
"""Distance at which a way-point is taken for reached [m]; see :func:`reached`."""
FAR = 0.58
"""Distance at which one ahead is not reached [m]; see :func:`to_come`."""


def shifted(belief: Tensor, logit: Tensor, to: Tensor) -> Tensor:
    """Belief ``[*B, N]`` of which shares, as logits ``[*B, N]``, go from each state to another one, int64 ``[N]``.

    Source: the prediction of a hidden Markov model's forward algorithm (Rabiner 1989, doi:10.1109/5.18626, Eq. 20).

    Example:
        >>> shifted(torch.tensor([0.2, 0.8]), torch.tensor([0.0, -20.0]), torch.tensor([1, 1]))
        tensor([0.1000, 0.9000])
    """
    return (belief * (-logit).sigmoid()).index_add(-1, to, belief * logit.sigmoid())


def told_of(belief: Tensor, evidence: Tensor, possible: Tensor) -> Tensor:
    r"""Belief in way-points after evidence, which speaks for another obstacle only where the robot can be at that one.

    .. math:: b(l, w) \propto \bar b(l)\, g(l)\, \bar b_e(w \mid l), \qquad
              g_e(l) = \sum_w \bar b(w \mid l)\, e^{e(l, w)}, \qquad
              g(l) = \begin{cases} g_e(l) & l \text{ possible} \\ \min(g_e(l), g_e(\hat l)) \end{cases}

    :math:`\hat l` is the likeliest obstacle, :math:`\bar b_e(w \mid l)` the belief in the way-points of one after the
    evidence. An image shows much that is the same at several obstacles; and in another arena than that of the training
    it may speak for a wrong one with every frame, by what lies behind the obstacle ahead (docs/student_experiments.md).
    Of one's way-points all after the first count as the one that it speaks for most: an image tells whether an obstacle
    is entered, but which of its way-points is next is known better from the place (:func:`reached`).

    Source: ours.

    Args:
        belief: ``[*B, L W]``, in W way-points of each of L obstacles; positive.
        evidence: ``[*B, L W]``, logarithms.
        possible: bool ``[*B, L]``.

    Returns:
        ``[*B, L, W]``, log-probabilities.

    Example:
        >>> belief, evidence = torch.tensor([0.4, 0.4, 0.1, 0.1]), torch.tensor([0.0, 0.0, 2.0, 2.0])
        >>> told_of(belief, evidence, torch.tensor([True, False])).exp()
        tensor([[0.4000, 0.4000],
                [0.1000, 0.1000]])
        >>> told_of(belief, evidence, torch.tensor([True, True])).exp().sum(-1)
        tensor([0.3512, 0.6488])
    """
    shape = (*possible.shape, belief.shape[-1] // possible.shape[-1])
    before = belief.log().view(shape)
    first, others = evidence.reshape(shape).split((1, shape[-1] - 1), -1)
    after = before + torch.cat((first, others.amax(-1, keepdim=True).expand_as(others)), -1)
    leg = before.logsumexp(-1)
    gain = after.logsumexp(-1) - leg
    gain_now = gain.take_along_dim(leg.argmax(-1, keepdim=True), -1)
    gain = torch.where(possible, gain, torch.minimum(gain, gain_now))
    told = (leg + gain)[..., None] + after.log_softmax(-1)
    return told - told.flatten(-2).logsumexp(-1)[..., None, None]


def reached(offset: Tensor) -> Tensor:
    r"""How much speaks for it that a way-point is reached, as a logit: it is near, or just behind.

    .. math:: \max\left(0.42 - d,\ \min(-x - 0.15,\ 0.4 - |y|)\right) / 0.02 \quad \text{within} \pm 8

    The radius is 0.45 m (method notes, section 5.5); a little less, since belief begins to go over before. A way-point
    that is 0.15 m behind and less than 0.4 m aside was within it a moment ago, where it was passed straight on. Who has
    passed one farther aside has to go back to it.

    Source: ours.

    Args:
        offset: ``[*B, 2]``, from the robot to it, along and across the obstacle [m].

    Returns:
        ``[*B]``, without gradient.

    Example:
        >>> reached(torch.tensor([[0.0, 0.4], [0.45, 0.0], [-0.17, 0.38], [-3.0, 0.9]])).round(decimals=3)
        tensor([ 1.0000, -1.5000,  1.0000, -8.0000])
    """
    offset = offset.detach()
    near = NEAR - torch.linalg.vector_norm(offset, dim=-1)
    behind = torch.minimum(-offset[..., 0] - 0.15, 0.4 - offset[..., 1].abs())
    return (torch.maximum(near, behind) / 0.02).clamp(-8.0, 8.0)


def to_come(offset: Tensor) -> Tensor:
    r"""How much speaks for it that a way-point is not reached yet, as a logit: it is ahead, and far.

    .. math:: \min\left(d - 0.58,\ x - 0.1\right) / 0.04 \quad \text{within} \pm 8

    As long as the type of an obstacle is not seen its first way-point is expected where that of most is; that of weave
    poles lies half a metre behind and beside there. Who has taken it for reached has to go back to it.

    Source: ours.

    Args:
        offset: as :func:`reached`, as is what it returns.

    Example:
        >>> to_come(torch.tensor([[0.6, 0.0], [0.4, 0.5], [0.5, 0.0], [-0.6, 0.0]])).round(decimals=3)
        tensor([ 0.5000,  1.5080, -2.0000, -8.0000])
    """
    offset = offset.detach()
    far = torch.linalg.vector_norm(offset, dim=-1) - FAR
    return (torch.minimum(far, offset[..., 0] - 0.1) / 0.04).clamp(-8.0, 8.0)
