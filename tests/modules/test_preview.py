"""What is known of the next obstacle before the present one is left."""

from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import camera
from agility_rl.modules.preview import ALIKE, EVIDENCE, NEXT, STRONGEST, VIEW_ANGLE, VIEW_DISTANCE, Preview
from agility_rl.modules.scan_matching import FLOOR, NOTHING, ScanMatcher

UPRIGHT = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0)
BLOCK, PEBBLE = (("box", size, (0.0, 0.0, size[2]), *UPRIGHT) for size in ((0.4, 0.8, 0.8), (0.02, 0.02, 0.02)))
STANDING = torch.tensor([[0.27, 0.0, 0.0, 0.0]])
AGE = torch.full((1, 1), camera.LATENCY)


def block_ahead() -> torch.Tensor:
    """An image of a block that begins 1.6 m before the camera, so its middle is 2.305 m ahead."""
    ground = (0.27 + camera.POSITION[2]) / (-camera.pixel_directions()[..., 2]).clamp(min=1e-6)
    return camera.normalize_depth(ground.clamp(max=1.6))[None]


def known(preview: Preview, rows: int = 1) -> torch.Tensor:
    """A memory with something in it."""
    memory = torch.zeros(rows, preview.size)
    memory[:, :4] = torch.tensor([0.2, -0.1, math.sin(0.3), math.cos(0.3) - 1.0])
    memory[:, 7:] = torch.arange(float(preview.size - 7))
    return memory


def evenly(preview: Preview, memory: torch.Tensor) -> torch.Tensor:
    """No type is likelier beforehand than another."""
    return torch.zeros_like(preview.hints(memory)[0])


def test_the_likeliest_type_is_matched_where_its_shape_fits() -> None:
    """A block in view, expected 0.1 m too near; the other two types are pebbles."""
    preview, matcher = Preview(3), ScanMatcher([[PEBBLE], [BLOCK], [PEBBLE]])
    memory, place = torch.zeros(1, preview.size), torch.tensor([[-2.2, 0.0, 0.0, 1.0]])
    measured = block_ahead(), torch.zeros(1, 45), STANDING, AGE
    said = preview.look(matcher, torch.tensor([True]), *measured, memory, place, evenly(preview, memory))
    assert said.shape == (1, preview.said) and said[0, 0].item() == pytest.approx(2.305, abs=0.03)
    assert bool((said[0, 4:7] < 0.1**2).all())
    assert 0.8 * EVIDENCE < said[0, 8].item() < EVIDENCE and said[0, [7, 9]].max() < 0.1
    after = preview.told(memory, place, said)
    hints, present = preview.hints(after)
    assert int(hints.argmax()) == 1 and not present.any()
    # It stands beyond its slot, by as much as its variance and that of a match say.
    gain = NEXT[0] / (NEXT[0] + ALIKE[0] + said[0, 4].item())
    assert after[0, 0].item() == pytest.approx(gain * (said[0, 0].item() - 2.2), abs=0.01)
    assert preview.variance(after)[0, 0].item() == pytest.approx((1.0 - gain) * NEXT[0], rel=0.01)
    for _ in range(200):
        after = preview.told(after, place, said)
    assert preview.place(after, place)[0, 0].item() == pytest.approx(-said[0, 0].item(), abs=0.01)
    hints = preview.hints(after)[0]
    assert (hints[0, 1] - hints[0, [0, 2]]).tolist() == pytest.approx([STRONGEST] * 2)
    assert bool((said[0, 4:7] >= torch.tensor(FLOOR).square()).all())


def test_a_type_that_is_unlikely_beforehand_is_not_matched() -> None:
    """Evidence is what it was, but the pebble is what it is taken for, and that fits nowhere."""
    preview, matcher = Preview(2), ScanMatcher([[PEBBLE], [BLOCK]])
    memory, place = torch.zeros(1, preview.size), torch.tensor([[-2.2, 0.0, 0.0, 1.0]])
    inputs = matcher, torch.tensor([True]), block_ahead(), torch.zeros(1, 45), STANDING, AGE, memory, place
    even = preview.look(*inputs, evenly(preview, memory))
    pebble = preview.look(*inputs, torch.tensor([[0.0, -1.0]]))
    assert torch.equal(even[:, 7:], pebble[:, 7:])
    assert bool((even[0, 4:7] < 0.1**2).all()) and bool((pebble[0, 4:7] == NOTHING).all())


@pytest.mark.parametrize(("x", "is_next"), [(-2.2, False), (-VIEW_DISTANCE - 0.3, True), (2.2, True)])
def test_what_is_out_of_view_or_not_there_is_left_as_it_was(x: float, is_next: bool) -> None:
    preview, matcher = Preview(2), ScanMatcher([[BLOCK], [PEBBLE]])
    memory, place = known(preview), torch.tensor([[x, 0.0, 0.0, 1.0]])
    memory[:, 7:] = 0.0
    measured = block_ahead(), torch.zeros(1, 45), STANDING, AGE
    said = preview.look(matcher, torch.tensor([is_next]), *measured, memory, place, evenly(preview, memory))
    assert torch.equal(said, preview.silence(memory, place)) and (said[:, 4:7] == NOTHING).all()
    torch.testing.assert_close(preview.told(memory, place, said), memory, atol=1e-6, rtol=0.0)


def test_rows_do_not_mix() -> None:
    """Of four robots the second and the last look at the block; the others have it behind them."""
    preview, matcher = Preview(2), ScanMatcher([[BLOCK], [PEBBLE]])
    place = torch.tensor([[2.2, 0.0, 0.0, 1.0], [-2.2, 0.0, 0.0, 1.0], [2.2, 0.0, 0.0, 1.0], [-2.4, 0.0, 0.0, 1.0]])
    measured = block_ahead().expand(4, -1, -1), torch.zeros(4, 45), STANDING.expand(4, 4), AGE.expand(4, 1)
    memory, there = torch.zeros(4, preview.size), torch.ones(4, dtype=torch.bool)
    said = preview.look(matcher, there, *measured, memory, place, evenly(preview, memory))
    assert (said[:, 4] < NOTHING).tolist() == [False, True, False, True]
    torch.testing.assert_close(said[[1, 3], 0], torch.full((2,), 2.305), atol=0.03, rtol=0.0)
    alone = preview.look(
        matcher, there[3:], *(part[3:] for part in measured), memory[3:], place[3:], evenly(preview, memory[3:])
    )
    torch.testing.assert_close(alone[0], said[3], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(
    ("distance", "angle", "there"),
    [
        (VIEW_DISTANCE - 0.01, 0.0, True),
        (VIEW_DISTANCE + 0.01, 0.0, False),
        (2.0, VIEW_ANGLE - 0.01, True),
        (2.0, -VIEW_ANGLE - 0.01, False),
    ],
)
def test_the_bounds_of_what_is_in_view(distance: float, angle: float, there: bool) -> None:
    seen = torch.tensor([distance * math.cos(angle), distance * math.sin(angle), 0.6, 0.8])
    assert bool(Preview(2).in_view(seen)) == there


def test_a_place_is_that_at_the_obstacle() -> None:
    """It stands 0.2 m on and 0.1 m to the right of its slot, turned by 0.3: by complex numbers."""
    preview = Preview(2)
    place = preview.place(known(preview), torch.tensor([[-2.0, 0.5, 0.0, 1.0]]))[0]
    offset = (complex(-2.0, 0.5) - complex(0.2, -0.1)) * complex(math.cos(0.3), -math.sin(0.3))
    expected = torch.tensor([offset.real, offset.imag, -math.sin(0.3), math.cos(0.3)])
    torch.testing.assert_close(place, expected)


def test_what_was_known_of_the_next_one_is_known_of_the_present_one() -> None:
    preview = Preview(2)
    memory = known(preview, 2)
    after = preview.arrived(memory, torch.tensor([[True], [False]]))
    assert not after[:, :-2].any() and not after[1].any()
    assert torch.equal(preview.hints(after)[1][0], preview.hints(memory)[0][0])
