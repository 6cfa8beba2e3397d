from __future__ import annotations

import math

import pytest
import torch

from agility_rl.bending import bend_points, straighten_points


def test_a_line_becomes_a_circle_and_distances_to_it_stay() -> None:
    """Points beside the line lie on circles around the same centre, as far from the line's as before."""
    line = torch.linspace(-1.0, 1.0, 21, dtype=torch.float64)
    for curvature in (0.7, -1.3):
        centre = torch.tensor([0.0, 1 / curvature], dtype=torch.float64)
        for left in (-0.2, 0.0, 0.15):
            bent = bend_points(torch.stack((line, torch.full_like(line, left)), -1), curvature)
            radius = torch.full_like(line, abs(1 / curvature - left))
            torch.testing.assert_close((bent - centre).norm(dim=-1), radius)
            lengths = bent.diff(dim=0).norm(dim=-1)
            chord = 2 * abs(1 / curvature - left) * math.sin(abs(curvature) * 0.05)
            torch.testing.assert_close(lengths, torch.full_like(lengths, chord))


def test_no_curvature_changes_nothing_and_a_small_one_little() -> None:
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(bend_points(points, 0.0), points)
    torch.testing.assert_close(straighten_points(points, 0.0), points, atol=1e-4, rtol=1e-4)
    # To first order y' = y + curvature x^2 / 2 and x' = x - curvature x y.
    moved = bend_points(points, 1e-3) - points
    x, y = points[:, 0], points[:, 1]
    torch.testing.assert_close(moved, torch.stack((-1e-3 * x * y, 5e-4 * x * x, 0 * x), -1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("curvature", [-2.0, -0.4, 1e-7, 0.9, 2.0])
def test_straightening_is_the_inverse(curvature: float) -> None:
    generator = torch.Generator().manual_seed(1)
    points = 0.4 * (2 * torch.rand(200, 3, generator=generator, dtype=torch.float64) - 1)
    torch.testing.assert_close(straighten_points(bend_points(points, curvature), curvature), points, atol=1e-5, rtol=0)


def test_each_row_has_a_curvature_of_its_own_and_gradients_are_finite_at_none() -> None:
    points = torch.tensor([[0.3, 0.1, 0.2]]).repeat(3, 1).requires_grad_()
    curvature = torch.tensor([0.0, 1.0, -1.0])
    for function in (bend_points, straighten_points):
        result = function(points, curvature)
        assert result[1, 1] != result[2, 1] and torch.equal(result[:, 2], points[:, 2])
        (gradient,) = torch.autograd.grad(result.sum(), points)
        assert gradient.isfinite().all()
