"""Ground that robots walk on: a plane, or one height field that all simulations share."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class HeightField:
    """Heights on a regular grid centred at the origin.

    Attributes:
        heights: ``[rows, columns]`` [m]; rows run along y, columns along x.
        half_size: half extents in x and y [m].
    """

    heights: Tensor
    half_size: tuple[float, float]

    def __post_init__(self) -> None:
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ValueError(f"heights must be [rows >= 2, columns >= 2], got {list(self.heights.shape)}")

    def height_at(self, position: Tensor) -> Tensor:
        """Bilinear height [m] under horizontal positions ``[*B, 2]`` [m]; beyond the edge, that of the edge.

        Example:
            >>> field = HeightField(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), (1.0, 1.0))
            >>> field.height_at(torch.tensor([0.0, 0.5]))
            tensor(0.5000)
        """
        rows, columns = self.heights.shape
        x = ((position[..., 0] / self.half_size[0] + 1) / 2 * (columns - 1)).clamp(0, columns - 1.001)
        y = ((position[..., 1] / self.half_size[1] + 1) / 2 * (rows - 1)).clamp(0, rows - 1.001)
        column, row = x.long(), y.long()
        u, v = x - column, y - row
        h = self.heights
        low = h[row, column] * (1 - u) + h[row, column + 1] * u
        high = h[row + 1, column] * (1 - u) + h[row + 1, column + 1] * u
        return low * (1 - v) + high * v


def rough_pyramids(
    generator: torch.Generator,
    *,
    tiles: int = 4,
    tile_size: float = 10.0,
    resolution: float = 0.1,
    smooth_share: float = 0.2,
    noise: float = 0.05,
    noise_step: float = 0.005,
    noise_spacing: float = 0.2,
    slope: float = 0.4,
    difficulties: tuple[float, ...] = (0.0, 0.2, 0.4),
    platform: float = 3.0,
) -> HeightField:
    """Square tiles of smooth and rough pyramid slopes.

    Source: method notes, section 4.5 (released code): 20 % smooth pyramids, half of them pits; 80 % rough ones with
    uniform noise of +-0.05 m in steps of 0.005 m sampled every 0.2 m; slope 0.4 x difficulty in {0, 0.2, 0.4}; flat
    top of 3 m; tiles of 10 x 10 m on a 0.1 m grid. The released field has 10 x 10 tiles; fewer are the default here,
    because a height field's memory and load time grow with its area.

    MuJoCo tests a foot against each triangle of the grid by itself, so that a foot that sinks in a little is pushed
    sideways by the edges between them, even where the ground is flat: a controller that falls 0.2 times a minute on the
    plane falls 5.5 times on a flat field of 0.1 m cells, 2.0 times on 0.5 m, 0.9 times on 3 m. For slopes without that
    see :func:`ridges`.

    Args:
        generator: source of randomness.
        tiles: tiles along each side.
        tile_size: side of a tile [m].
        resolution: grid spacing [m].
        smooth_share: share of smooth tiles.
        noise: half-width of the roughness [m].
        noise_step: its quantum [m].
        noise_spacing: distance of its samples [m].
        slope: slope at difficulty 1.
        difficulties: drawn evenly.
        platform: side of the flat top [m].

    Example:
        >>> field = rough_pyramids(torch.Generator().manual_seed(0), tiles=1)
        >>> field.heights.shape, field.half_size
        (torch.Size([101, 101]), (5.0, 5.0))
    """
    cells = round(tile_size / resolution)
    heights = torch.zeros(tiles * cells + 1, tiles * cells + 1)
    axis = (torch.arange(cells + 1) * resolution - tile_size / 2).abs()
    ring = torch.maximum(axis[:, None], axis[None, :]).clamp(min=platform / 2)
    for row in range(tiles):
        for column in range(tiles):
            pick = int(torch.randint(len(difficulties), (1,), generator=generator))
            grade = slope * difficulties[pick]
            tile = grade * (tile_size / 2 - ring)
            if float(torch.rand(1, generator=generator)) < smooth_share:
                if float(torch.rand(1, generator=generator)) < 0.5:
                    tile = -tile
            else:
                samples = round(tile_size / noise_spacing) + 1
                levels = round(2 * noise / noise_step) + 1
                draw = torch.randint(levels, (1, 1, samples, samples), generator=generator) * noise_step - noise
                tile = tile + torch.nn.functional.interpolate(
                    draw, (cells + 1, cells + 1), mode="bilinear", align_corners=True
                ).reshape(cells + 1, cells + 1)
            heights[row * cells : (row + 1) * cells + 1, column * cells : (column + 1) * cells + 1] = tile
    half = tiles * tile_size / 2
    return HeightField(heights, (half, half))


def ridges(
    generator: torch.Generator,
    *,
    slope: float = 0.25,
    spacing: float = 1.5,
    half_size: float = 20.0,
) -> HeightField:
    """Ridges and valleys along y: strips that rise, fall or stay level, one and a half metres wide.

    Source: ours; the ramps of the A-frame are 1.46 m long with a slope of 0.23. Cells as large as the strips have few
    edges for a foot to be caught on, and are planes, so that the heights between are exact.

    Args:
        generator: source of randomness.
        slope: largest slope; strips rise or fall by all of it, by half of it, or not.
        spacing: width of a strip [m].
        half_size: half extent in x and y [m], rounded to whole strips.

    Raises:
        ValueError: if a strip is wider than the field.

    Example:
        >>> field = ridges(torch.Generator().manual_seed(0), slope=0.2, half_size=6.0)
        >>> field.heights.shape, field.half_size
        (torch.Size([9, 9]), (6.0, 6.0))
    """
    strips = round(2.0 * half_size / spacing)
    if strips < 1:
        raise ValueError(f"expected strips narrower than the field, got {spacing} m of {2.0 * half_size} m")
    rise = torch.randint(-2, 3, (strips,), generator=generator) / 2.0 * slope * spacing
    heights = torch.cat((torch.zeros(1), rise.cumsum(0)))
    half = strips * spacing / 2.0
    return HeightField(heights.expand(strips + 1, -1).clone(), (half, half))
