"""How far points are from an obstacle, from the solids that it is made of."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from agility_rl import rotations

Solid = Sequence[Any]
"""``(kind, size, position, quaternion, (low, high))``: as a shape of a simulation, in an obstacle's frame on the
ground, lifted to some unknown height of that range [m]."""

LOW, HIGH = (-2.6, -1.5, -0.25), (2.6, 1.5, 1.7)
"""Corners of what a field covers [m]: obstacles, and what stands less than half a metre beside them."""
CELL = 0.05
"""Distance of the points at which it is known [m]."""
LIFTS = 6
"""So many heights stand for all those to which a solid may be lifted."""


def _box(points: Tensor, size: Sequence[float]) -> Tensor:
    beyond = points.abs() - points.new_tensor(size)
    outside: Tensor = torch.linalg.vector_norm(beyond.clamp(min=0.0), dim=-1)
    return outside + beyond.amax(-1).clamp(max=0.0)


def _sphere(points: Tensor, size: Sequence[float]) -> Tensor:
    distance: Tensor = torch.linalg.vector_norm(points, dim=-1)
    return distance - size[0]


def _capsule(points: Tensor, size: Sequence[float]) -> Tensor:
    x, y, z = points.unbind(-1)
    return _sphere(torch.stack((x, y, z - z.clamp(-size[1], size[1])), -1), size)


def _cylinder(points: Tensor, size: Sequence[float]) -> Tensor:
    across = torch.linalg.vector_norm(points[..., :2], dim=-1)
    return _box(torch.stack((across, points[..., 2]), -1), size)


_KINDS: dict[str, Callable[[Tensor, Sequence[float]], Tensor]] = {
    "box": _box,
    "sphere": _sphere,
    "capsule": _capsule,
    "cylinder": _cylinder,
}


def signed_distance(solid: Solid, points: Tensor) -> Tensor:
    """Distance of points to the surface of a solid, negative within.

    Source: exact distances of primitives (Quilez, "Distance functions"); a solid that may be lifted is the union of
    what it is at six heights.

    Args:
        solid: see :data:`Solid`.
        points: ``[*B, 3]``, in the obstacle's frame [m].

    Returns:
        ``[*B]`` [m].

    Raises:
        ValueError: if there is no such kind of solid.

    Example:
        >>> box = ("box", (1.0, 1.0, 0.5), (0.0, 0.0, 0.5), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0))
        >>> signed_distance(box, torch.tensor([[3.0, 0.0, 0.5], [0.0, 0.0, 0.9], [4.0, 5.0, 0.2]]))
        tensor([ 2.0000, -0.1000,  5.0000])
    """
    kind, size, position, quaternion, (low, high) = solid
    if kind not in _KINDS:
        raise ValueError(f"a solid must be one of {', '.join(_KINDS)}, got {kind!r}")
    steps = LIFTS if high > low else 1
    distances = []
    for step in range(steps):
        middle = points.new_tensor(position)
        middle[2] += low + (high - low) * step / max(1, steps - 1)
        local = rotations.rotate_inverse(points.new_tensor(quaternion), points - middle)
        distances.append(_KINDS[kind](local, size))
    return torch.stack(distances).amin(0)


@functools.cache
def _values(types: tuple[tuple[Solid, ...], ...]) -> Tensor:
    """Signed distances at the points of the grid, ``[K, X, Y, Z]``, of every type and the ground below it."""
    axes = [low + CELL * torch.arange(round((high - low) / CELL) + 1) for low, high in zip(LOW, HIGH, strict=True)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    fields = []
    for solids in types:
        distances = (signed_distance(solid, points) for solid in solids)
        fields.append(functools.reduce(torch.minimum, distances, points[..., 2]))
    return torch.stack(fields)


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, (list, tuple)) else value


class DistanceField(nn.Module):
    """Signed distance to the surface of an obstacle and of the ground it stands on, and its gradient.

    Known at the points of a grid, linear between them; so looking it up costs the same for a bar and for a tunnel.

    Source: ours; signed distance fields for aligning depth images with a known shape: Fitzgibbon 2003
    (doi:10.1016/j.imavis.2003.09.004).

    Args:
        types: the solids of every type of obstacle, ``[K][...]``.

    Attributes:
        count: K.

    Raises:
        ValueError: if there is no such kind of solid.

    Example:
        >>> ball = ("sphere", (0.4,), (0.0, 0.0, 0.4), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0))
        >>> field = DistanceField([[ball]])
        >>> points = torch.tensor([[[1.0, 0.0, 0.4], [-2.0, 1.0, 0.1], [9.0, 0.0, 0.0]]])
        >>> distance, gradient, covered = field(torch.tensor([0]), points)
        >>> distance[0, :2].round(decimals=2), covered
        (tensor([0.4000, 0.1000]), tensor([[ True,  True, False]]))
        >>> gradient[0, 1].round(decimals=2)  # of a point just above the ground
        tensor([0., 0., 1.])
    """

    values: Tensor
    low: Tensor
    last: Tensor
    strides: Tensor
    corners: Tensor

    def __init__(self, types: Sequence[Sequence[Solid]]) -> None:
        super().__init__()
        values = _values(_frozen(types))
        self.count = len(values)
        self.size, *strides = values.stride()
        steps = torch.tensor(list(itertools.product((0, 1), repeat=3)))
        for name, value in {
            "values": values.flatten(),
            "low": torch.tensor(LOW),
            "last": torch.tensor(values.shape[1:]) - 1,
            "strides": torch.tensor(strides),
            "corners": (steps * torch.tensor(strides)).sum(-1),  # of a cell, from its first
        }.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, kind: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distances ``[N, P]`` [m], gradients ``[N, P, 3]``, and whether they are known, of types int64 ``[N]`` at
        points ``[N, P, 3]``."""
        cells = (points - self.low) / CELL
        covered = ((cells >= 0.0) & (cells <= self.last)).all(-1)
        corner = torch.minimum(cells.clamp(min=0.0), self.last - 1e-3).long()
        share = cells - corner
        first = kind[:, None] * self.size + (corner * self.strides).sum(-1)
        at = self.values[first[..., None] + self.corners].to(points.dtype).unflatten(-1, (2, 2, 2))
        along_z, along_y, along_x = share[..., None, None, 2], share[..., None, 1], share[..., 0]
        on_z = torch.lerp(at[..., 0], at[..., 1], along_z)
        on_y = torch.lerp(on_z[..., 0], on_z[..., 1], along_y)
        distance = torch.lerp(on_y[..., 0], on_y[..., 1], along_x)
        rise_y = on_z[..., 1] - on_z[..., 0]
        along = at[..., 1] - at[..., 0]
        rise_z = torch.lerp(along[..., 0], along[..., 1], along_y)
        slopes = (
            on_y[..., 1] - on_y[..., 0],
            torch.lerp(rise_y[..., 0], rise_y[..., 1], along_x),
            torch.lerp(rise_z[..., 0], rise_z[..., 1], along_x),
        )
        return distance, torch.stack(slopes, -1) / CELL, covered
