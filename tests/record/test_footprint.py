"""Outlines from above, by areas and extents that are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from agility_rl.record.footprint import footprint
from agility_rl.record.scene import Shape

HALF = math.sqrt(0.5)


def area(outline: Tensor) -> float:
    x, y = outline.double().unbind(-1)
    return 0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum().item()


def test_a_turned_box_keeps_its_area_and_a_tilted_one_its_shadow() -> None:
    turned = footprint(Shape("box", (2.0, 1.0, 3.0), quaternion=(math.cos(0.2), 0.0, 0.0, math.sin(0.2))))
    assert turned.shape == (4, 2) and area(turned) == pytest.approx(2.0, rel=1e-5)
    direction = turned[(turned[:, 0]).argmax()] - turned[(turned[:, 1]).argmax()]
    assert direction.norm().item() == pytest.approx(1.0, rel=1e-5)  # its short side
    tilt = 0.3  # about y: length 2 cos + 3 sin, width unchanged
    shadow = footprint(Shape("box", (2.0, 1.0, 3.0), quaternion=(math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0)))
    assert area(shadow) == pytest.approx(2.0 * math.cos(tilt) + 3.0 * math.sin(tilt), rel=1e-5)


def test_round_shapes() -> None:
    upright = footprint(Shape("cylinder", (0.2, 0.2, 1.0), (3.0, 4.0, 0.5)))
    assert area(upright) == pytest.approx(math.pi * 0.01, rel=5e-3)
    torch.testing.assert_close(upright.mean(0), torch.tensor([3.0, 4.0]), atol=1e-3, rtol=0)
    lying = footprint(Shape("cylinder", (0.2, 0.2, 1.0), quaternion=(HALF, HALF, 0.0, 0.0)))  # axis along y
    torch.testing.assert_close(lying.amax(0), torch.tensor([0.1, 0.5]), atol=1e-3, rtol=0)
    assert area(lying) == pytest.approx(0.2, rel=5e-3)
    ball = footprint(Shape("sphere", (0.4, 0.4, 0.4), (1.0, 0.0, 9.0)))
    torch.testing.assert_close((ball - torch.tensor([1.0, 0.0])).norm(dim=-1), torch.full((len(ball),), 0.2))
