from __future__ import annotations

import math

import pytest
import torch

from agility_rl.modules.distance_field import CELL, DistanceField, Solid, signed_distance

STILL = (0.0, 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
SIDEWAYS = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
"""What stood along z lies along y."""
CAPSULE: Solid = ("capsule", (0.1, 0.6), (0.0, 0.0, 0.3), SIDEWAYS, STILL)
CYLINDER: Solid = ("cylinder", (0.1, 0.5), (1.0, 0.0, 0.5), UPRIGHT, STILL)
BOX: Solid = ("box", (0.3, 0.2, 0.25), (-1.0, 0.0, 0.25), UPRIGHT, STILL)


@pytest.mark.parametrize(
    ("solid", "point", "distance"),
    [
        (CAPSULE, (0.5, 0.3, 0.3), 0.4),
        (CAPSULE, (0.0, 0.9, 0.7), 0.4),  # 0.3 beyond its end and 0.4 above it: 0.5 less the radius
        (CAPSULE, (0.05, -0.2, 0.3), -0.05),
        (CYLINDER, (1.3, 0.4, 0.2), 0.4),
        (CYLINDER, (1.4, 0.0, 1.4), 0.5),  # 0.3 beside the rim of its top and 0.4 above it
        (CYLINDER, (1.0, 0.0, 0.97), -0.03),
        (BOX, (-1.0, 0.5, 0.9), 0.5),
        (BOX, (-1.0, 0.15, 0.25), -0.05),
    ],
)
def test_distances_by_hand(solid: Solid, point: tuple[float, ...], distance: float) -> None:
    assert signed_distance(solid, torch.tensor(point)).item() == pytest.approx(distance, abs=1e-6)


def test_what_may_be_lifted_is_at_every_height() -> None:
    bar = (*CAPSULE[:2], (0.0, 0.0, 0.0), SIDEWAYS, (0.1, 0.4))
    ahead = torch.tensor([[0.3, 0.0, height] for height in (0.1, 0.25, 0.4)])
    torch.testing.assert_close(signed_distance(bar, ahead), torch.full((3,), 0.2), atol=0.005, rtol=0.0)
    assert signed_distance(bar, torch.tensor([0.0, 0.0, 0.8])).item() == pytest.approx(0.3)


def test_a_field_is_the_nearest_surface_or_the_ground() -> None:
    generator = torch.Generator().manual_seed(0)
    kind = torch.tensor([0, 1]).repeat(50)
    points = torch.rand(100, 40, 3, generator=generator) * torch.tensor([4.0, 2.4, 1.5]) - torch.tensor([2.0, 1.2, 0.1])
    distance, gradient, covered = DistanceField([[CAPSULE, CYLINDER], [BOX]])(kind, points)
    assert covered.all()
    ground = points[..., 2]
    first = torch.stack((signed_distance(CAPSULE, points), signed_distance(CYLINDER, points), ground)).amin(0)
    second = torch.minimum(signed_distance(BOX, points), ground)
    expected = torch.where((kind == 0)[:, None], first, second)
    assert (distance - expected).abs().max() < 0.5 * CELL and (distance - expected).abs().mean() < 0.05 * CELL
    steps = 0.2 * CELL * torch.eye(3)
    field = DistanceField([[CAPSULE, CYLINDER], [BOX]])
    change = torch.stack([field(kind, points + step)[0] - field(kind, points - step)[0] for step in steps], -1)
    within = ((points - field.low) / CELL % 1.0 - 0.5).abs().amax(-1) < 0.25  # the same cell on both sides
    torch.testing.assert_close(gradient[within], (change / (0.4 * CELL))[within], atol=2e-3, rtol=0.0)
    assert gradient.norm(dim=-1).max() < math.sqrt(3.0)


def test_what_lies_outside_is_said_to_and_an_unknown_solid_is_refused() -> None:
    points = torch.tensor([[[0.0, 0.0, 0.1], [0.0, 3.0, 0.1], [0.0, 0.0, 5.0]]])
    assert DistanceField([[BOX]])(torch.tensor([0]), points)[2].tolist() == [[True, False, False]]
    with pytest.raises(ValueError, match="a solid must be one of box, sphere, capsule, cylinder, got 'cone'"):
        DistanceField([[("cone", *BOX[1:])]])
