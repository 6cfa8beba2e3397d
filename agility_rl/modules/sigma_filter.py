"""Depths of noisy images without their noise, and with their edges."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from agility_rl.go2.camera import DEPTH_FAR, DEPTH_NEAR
from agility_rl.tensors import worthwhile

ALIKE = 0.2
"""Depths of neighbours that differ by less are of the same surface [m]. White noise as students are trained with, of
0.02 of the range (method notes, section 5.10), is 0.074 m, and the difference of two such pixels 0.105 m."""
ROUGH = 0.07
"""Median of mixed differences of depths above which an image is noisy [m]. Of normal noise it is 0.674 times twice the
deviation, which is 0.052 m then; the camera's own is 0.029 m at most (uniform within 0.05 m: method notes, section
5.8)."""
MARGIN = 0.1
"""Nearer than this [m] to what depths are clipped at they do not count, for there is little noise left."""
LEAST = 150
"""So many of those differences, or more: of what is hardly in view nothing can be said."""


def smoothed(metres: Tensor) -> Tensor:
    """Depths ``[N, H, W]`` [m], of images that are noisy by :func:`sigma_filter`; of others as they are.

    Source: ours. What is averaged rounds the edges of shapes, which clear images show better.

    Example:
        >>> clear = torch.full((1, 58, 87), 2.0)
        >>> noisy = clear + 0.074 * torch.randn(1, 58, 87, generator=torch.Generator().manual_seed(0))
        >>> [round((smoothed(depths) - 2.0).std().item(), 3) for depths in (clear, noisy)]
        [0.0, 0.032]
    """
    noisy = is_noisy(metres)
    if torch.compiler.is_exporting() or worthwhile(noisy):
        return torch.where(noisy[:, None, None], sigma_filter(metres), metres)
    return metres


def is_noisy(metres: Tensor) -> Tensor:
    r"""Whether pixels of images differ from each other as those of no surface do.

    .. math:: \mathrm{median}\,\lvert z_{ij} - z_{i, j+1} - z_{i+1, j} + z_{i+1, j+1} \rvert > r

    Such a difference is 0 on planes that only rise or only turn, and at edges along rows or columns of the image; of
    noise it has twice the deviation. Depths that are clipped do not count; where few are left, nothing is noisy.

    Source: ours; the median as a measure of noise: Donoho and Johnstone 1994 (doi:10.1093/biomet/81.3.425).

    Args:
        metres: depths ``[N, H, W]`` [m].

    Returns:
        bool ``[N]``.

    Example:
        >>> noise = torch.randn(2, 58, 87, generator=torch.Generator().manual_seed(0))
        >>> is_noisy(2.0 + torch.tensor([0.029, 0.074])[:, None, None] * noise)
        tensor([False,  True])
    """
    known = (metres > DEPTH_NEAR + MARGIN) & (metres < DEPTH_FAR - MARGIN)
    known = known[:, :-1, :-1]
    across = metres.diff(dim=-1)
    rough = (across.diff(dim=-2).abs() > ROUGH) & known
    count = known.sum((-1, -2))
    return (count >= LEAST) & (2 * rough.sum((-1, -2)) > count)


def sigma_filter(metres: Tensor, alike: float = ALIKE) -> Tensor:
    r"""Mean of a pixel and of those of its eight neighbours that are of the same surface, by their depth.

    .. math:: \hat z = \frac{\sum_j z_j\,[|z_j - z| < a]}{\sum_j [|z_j - z| < a]}

    Source: Lee 1983 (doi:10.1016/0734-189X(83)90047-6).

    Args:
        metres: depths ``[N, H, W]`` [m]; at the rim pixels stand for their missing neighbours.
        alike: a [m].

    Example:
        >>> edge = torch.tensor([1.0, 1.125, 3.0]).expand(1, 3, -1)
        >>> sigma_filter(edge)[0, 1]
        tensor([1.0417, 1.0625, 3.0000])
    """
    height, width = metres.shape[-2:]
    padded = nn.functional.pad(metres[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    total, count = torch.zeros_like(metres), torch.zeros_like(metres)
    for row in range(3):
        for column in range(3):
            neighbour = padded[:, row : row + height, column : column + width]
            same = (neighbour - metres).abs() < alike
            total, count = total + neighbour * same, count + same
    return total / count
