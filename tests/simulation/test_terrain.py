"""Height fields: interpolation, agreement with the engine, and the generator's statistics."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from agility_rl.go2.model import ROBOT_GROUP
from agility_rl.simulation import BatchSimulator, HeightField, ridges, rough_pyramids


def test_height_on_grid_points_and_between() -> None:
    heights = torch.tensor([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    field = HeightField(heights, (2.0, 1.0))
    # x = -2, 0, 2 are the columns; y = -1, 1 are the rows.
    assert field.height_at(torch.tensor([[-2.0, -1.0], [0.0, -1.0], [-2.0, 0.99]])).tolist() == pytest.approx(
        [0.0, 1.0, 2.985], abs=1e-2
    )
    assert field.height_at(torch.tensor([1.0, 0.0])).item() == pytest.approx(3.0)


def test_beyond_the_edge_is_the_edge() -> None:
    field = HeightField(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), (1.0, 1.0))
    assert field.height_at(torch.tensor([9.0, -9.0])).item() == pytest.approx(1.0, abs=2e-3)
    assert field.height_at(torch.tensor([-9.0, 0.0])).item() == 0.0


def test_ground_height_agrees_with_the_engine(generator: torch.Generator) -> None:
    field = rough_pyramids(generator, tiles=1)
    simulator = BatchSimulator(1, num_threads=1, terrain=field)
    position = (torch.rand(300, 2, generator=generator) - 0.5) * 9.0
    origin = torch.cat((position, torch.full((300, 1), 5.0)), -1)[None]
    distance = simulator.ray(origin, torch.tensor([0.0, 0.0, -1.0]).expand(1, 300, 3))[0]
    error = (5.0 - distance - simulator.ground_height(position)).abs()
    # The engine halves each 0.1 m cell into triangles, the interpolation is bilinear: they differ inside a cell.
    assert error.max() < 0.02 and error.mean() < 0.002


def test_robot_stands_on_the_height_field(generator: torch.Generator) -> None:
    field = HeightField(torch.full((3, 3), 0.7) + 0.001 * torch.eye(3), (5.0, 5.0))
    simulator = BatchSimulator(1, num_threads=1, terrain=field)
    pose = simulator.joint_position
    simulator.reset(
        torch.ones(1, dtype=torch.bool),
        root_position=torch.tensor([[0.0, 0.0, 1.0]]),
        root_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        root_linear_velocity=torch.zeros(1, 3),
        root_angular_velocity=torch.zeros(1, 3),
        joint_position=pose,
        joint_velocity=torch.zeros(1, 12),
    )
    for _ in range(50):
        simulator.step(pose)
    assert 0.9 < simulator.root_position[0, 2].item() < 0.99
    assert simulator.ground_extent == 3.0


def test_smooth_pyramids_are_flat_on_top_and_at_the_rim() -> None:
    field = rough_pyramids(torch.Generator().manual_seed(3), tiles=1, smooth_share=1.0, difficulties=(0.4,), noise=0.0)
    heights = field.heights
    rim = torch.cat((heights[0], heights[-1], heights[:, 0], heights[:, -1]))
    assert rim.abs().max() < 1e-6
    # 3.5 m of slope 0.16 from the rim to the platform, up for a hill and down for a pit.
    assert heights[50, 50].abs().item() == pytest.approx(0.56, abs=1e-5)
    assert (heights[36:65, 36:65] - heights[50, 50]).abs().max() < 1e-6


def test_rough_tiles_stay_within_the_noise() -> None:
    field = rough_pyramids(torch.Generator().manual_seed(0), tiles=1, smooth_share=0.0, difficulties=(0.0,))
    assert field.heights.abs().max() <= 0.05 + 1e-6
    # Uniform on +-0.05 m has a standard deviation of 0.029 m at the sampled points.
    assert field.heights[::2, ::2].std().item() == pytest.approx(0.0291, abs=0.002)


def test_one_seed_makes_one_terrain() -> None:
    first, again, other = (rough_pyramids(torch.Generator().manual_seed(s), tiles=2).heights for s in (5, 5, 6))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert first.shape == (201, 201)


def test_degenerate_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="rows >= 2"):
        HeightField(torch.zeros(1, 5), (1.0, 1.0))


def test_ridges_are_planes_of_the_given_slopes(generator: torch.Generator) -> None:
    field = ridges(generator, slope=0.2, spacing=3.0, half_size=30.0)
    assert field.half_size == (30.0, 30.0) and field.heights.shape == (21, 21)
    assert torch.equal(field.heights, field.heights[:1].expand(21, -1))  # they run along y
    slopes = (field.heights[0].diff() / 3.0).round(decimals=6).unique()
    torch.testing.assert_close(slopes, torch.tensor([-0.2, -0.1, 0.0, 0.1, 0.2]))
    x = torch.linspace(-29.9, 29.9, 997)
    heights = field.height_at(torch.stack((x, 7.0 * x.sin()), -1))
    expected = np.interp(x.numpy(), np.arange(21) * 3.0 - 30.0, field.heights[0].numpy())
    np.testing.assert_allclose(heights.numpy(), expected, atol=1e-5)
    with pytest.raises(ValueError, match=r"narrower than the field, got 9.0 m of 4.0 m"):
        ridges(generator, spacing=9.0, half_size=2.0)


def test_a_robot_on_a_ridge_stands_where_the_field_says(generator: torch.Generator) -> None:
    """Rays find the engine's ground at the heights that the field reports."""
    field = ridges(generator, slope=0.25, half_size=9.0)
    simulator = BatchSimulator(1, num_threads=1, terrain=field)
    data = mujoco.MjData(simulator.model)
    mujoco.mj_forward(simulator.model, data)
    ground = np.ones(6, dtype=np.uint8)
    ground[ROBOT_GROUP] = 0
    for x, y in ((-7.3, 2.0), (-1.1, -4.2), (0.4, 5.5), (6.6, -8.0)):
        geom = np.zeros(1, dtype=np.int32)
        distance = mujoco.mj_ray(
            simulator.model, data, np.array([x, y, 5.0]), np.array([0.0, 0.0, -1.0]), ground, 1, -1, geom, None
        )
        expected = field.height_at(torch.tensor([x, y])).item()
        assert 5.0 - distance == pytest.approx(expected, abs=1e-4)
