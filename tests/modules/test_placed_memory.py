from __future__ import annotations

import math

import pytest
import torch

from agility_rl.go2 import camera, features
from agility_rl.modules.kalman import FREEDOM
from agility_rl.modules.placed_memory import ALIKE, DRIFT, START, PlacedMemory
from agility_rl.modules.planar import inverted, moved
from agility_rl.modules.preview import NEXT, STRONGEST
from agility_rl.modules.scan_matching import NOTHING, ScanMatcher
from agility_rl.modules.stock import NOTED
from tests.placed_memories import BACK, FIRST, POINTS, STRAIGHT, silent, still

UNSEEN = torch.tensor([0.0, 0.0, 0.0, 1.0, *(NOTHING,) * 3])
"""A match that says nothing."""


def said(memory: PlacedMemory, present: torch.Tensor, coming: torch.Tensor) -> torch.Tensor:
    """What an image said of the present obstacle and of the next one, ``[1, 21]``."""
    return torch.cat((present, coming))[None]


@torch.no_grad()
def test_who_sees_nothing_only_counts_the_way() -> None:
    """Half a turn to the left at 1 m/s in 5 s: a circle whose radius is 5 / pi."""
    memory, _ = silent()
    steps = 100
    proprioception, estimate = torch.zeros(steps, 1, 45), torch.zeros(steps, 1, 4)
    proprioception[..., 4] = math.pi / 5.0 * features.ANGULAR_VELOCITY_SCALE
    estimate[..., 1] = 1.0 * features.LINEAR_VELOCITY_SCALE
    begun = torch.tensor([-9.0, 0.0, 0.0, 1.0])
    hidden = still(memory, begun.tolist())[-1]
    first = torch.zeros(steps, 1, 1, dtype=torch.bool)
    *_, after, place, _, _ = memory(
        torch.zeros(steps, 1, 32),
        proprioception,
        estimate,
        torch.zeros(steps, 1, 58, 87),
        torch.full((steps, 1, 1), camera.LATENCY),
        hidden[None],
        first,
    )
    expected = torch.tensor([-9.0, 10.0 / math.pi, 0.0, -1.0])
    torch.testing.assert_close(after[-1, 0, 8:12] + memory.starts[0], expected, atol=0.06, rtol=0.0)
    torch.testing.assert_close(place[0, 0, 4:], moved(begun, torch.tensor([0.025, 0.0, math.pi / 200.0])))


@torch.no_grad()
def test_a_place_is_corrected_by_as_much_as_it_is_unsure_and_credible() -> None:
    """Images that count one each, and are off by 0.1 m, 0.2 m and 0.05 on average; an episode has just begun.

    The robot stands 1 m before the obstacle and 0.1 m to its left, which is said to be nearer, and turned; or 4 m away.
    """
    memory, bias = silent()
    bias["alike"].fill_(-ALIKE)
    bias["scale"].copy_(torch.tensor([0.1, 0.2, 0.05]).log())
    variance = torch.tensor(START) + 0.05 * torch.tensor(DRIFT)
    gain = variance / (variance + 2.0 * torch.tensor([0.1, 0.2, 0.05]) ** 2)
    for closer in (0.5, -4.0):
        bias["correction"].copy_(torch.tensor([-closer, 0.0, 0.0, 0.0]))
        *_, after, place, _, _ = memory.step(*still(memory, [-1.0, 0.1, 0.0, 1.0], 1))
        share = gain / (1.0 + closer**4)
        expected = torch.tensor([-1.0 + share[0].item() * closer, 0.1, 0.0, 1.0])
        torch.testing.assert_close(place[0, 4:], expected)
        torch.testing.assert_close(after[0, 12:15] + torch.tensor(START), (1.0 - share) * variance)


@torch.no_grad()
def test_a_match_corrects_what_a_glance_has_left() -> None:
    """An obstacle 1 m ahead is said to be 0.2 m nearer, by what is as sure as the memory.

    Half of that would count if it were no surprise: it is off by 0.94 deviations.
    """
    memory, _ = silent()
    *seen, hidden = still(memory, [-1.0, 0.0, 0.0, 1.0], 1)
    variance = torch.tensor(START) + 0.05 * torch.tensor(DRIFT)
    present = torch.cat((torch.tensor([0.8, 0.0, 0.0, 1.0]), variance))
    seen[3] = said(memory, present, torch.cat((UNSEEN, torch.zeros(7))))
    *_, after, place, _, match = memory.step(*seen, hidden)
    gain = 1.0 / (2.0 + 0.2**2 / (2.0 * variance[0].item()) / FREEDOM)
    expected = torch.tensor([-1.0 + 0.2 * gain, 0.0, 0.0, 1.0])
    torch.testing.assert_close(place[0, 4:], expected, atol=2e-4, rtol=0.0)
    torch.testing.assert_close(after[0, 12:15] + torch.tensor(START), (1.0 - gain) * variance, rtol=2e-3, atol=0.0)
    assert torch.equal(match, seen[3])


@torch.no_grad()
def test_what_is_matched_is_the_shape_of_the_likeliest_obstacle() -> None:
    """A block begins 1.6 m before the camera, so its middle is 2.305 m ahead; all other obstacles are pebbles."""
    upright = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0)
    block, pebble = (("box", size, (0.0, 0.0, size[2]), *upright) for size in ((0.4, 1.4, 0.8), (0.02, 0.02, 0.02)))
    ground = (0.27 + camera.POSITION[2]) / (-camera.pixel_directions()[..., 2]).clamp(min=1e-6)
    image = camera.normalize_depth(ground.clamp(max=1.6))[None]
    for likeliest, there in ((3, True), (0, False)):
        memory, bias = silent()
        memory.matcher = ScanMatcher([[pebble]] * 3 + [[block]] + [[pebble]] * 3)
        bias["obstacle"][likeliest] = 20.0
        feature, proprioception, _, _, age, hidden = still(memory, [-2.2, 0.0, 0.0, 1.0], 1)
        *_, match = memory.step(feature, proprioception, torch.tensor([[0.27, 0.0, 0.0, 0.0]]), image, age, hidden)
        assert bool(match[0, 4] < NOTHING) == there and bool(match[0, 11] == NOTHING)
        assert (match[0, 0].item() == pytest.approx(2.305, abs=0.01)) == there


@torch.no_grad()
def test_a_glance_is_asked_about_where_the_obstacle_was_when_the_image_was_taken() -> None:
    """At 1 m/s and 2 rad/s, an image that is 0.1 s older than in training: 0.1 m nearer since, and turned by 0.2."""
    memory, _ = silent()
    asked = []
    memory.glance.correction.register_forward_hook(lambda _, inputs, __: asked.append(inputs[0]))
    for age in (camera.LATENCY, camera.LATENCY + 0.1):
        feature, proprioception, estimate, image, _, hidden = still(memory, [-1.0, 0.0, 0.0, 1.0], 1)
        proprioception[:, 4] = 2.0 * features.ANGULAR_VELOCITY_SCALE
        estimate[:, 1] = 1.0 * features.LINEAR_VELOCITY_SCALE
        *_, place, _, _ = memory.step(feature, proprioception, estimate, image, torch.full((1, 1), age), hidden)
    now, then = (known[:, 32:36] for known in asked)
    torch.testing.assert_close(inverted(place[:, 4:]), now)
    torch.testing.assert_close(moved(inverted(then), torch.tensor([[0.1, 0.0, 0.2]])), inverted(now))
    assert then[0, 0] - now[0, 0] > 0.08


@torch.no_grad()
def test_who_turns_does_so_about_the_obstacle() -> None:
    """An obstacle 1 m ahead is said to be turned by 0.5: it stays ahead, so the robot stands elsewhere at it."""
    memory, bias = silent()
    bias["alike"].fill_(-200.0)
    bias["correction"].copy_(torch.tensor([0.0, 0.0, math.sin(0.5), math.cos(0.5) - 1.0]))
    *_, place, _, _ = memory.step(*still(memory, [-1.0, 0.0, 0.0, 1.0], 1))
    expected = torch.tensor([-math.cos(0.5), math.sin(0.5), -math.sin(0.5), math.cos(0.5)])
    torch.testing.assert_close(place[0, 4:], expected)


@torch.no_grad()
def test_many_images_are_as_good_as_their_mean_and_no_better_than_alike() -> None:
    """100 images, of which 10 count as one, leave the variance of a mean of ten, and of what was known before."""
    memory, bias = silent()
    memory.drift.zero_()
    bias["alike"].fill_(math.log(10.0) - ALIKE)
    bias["scale"].fill_(math.log(0.3))
    inputs = still(memory, [-1.5, 0.0, 0.0, 1.0], 1)
    state = inputs[-1]
    for _ in range(100):
        state = memory.step(*inputs[:-1], state)[3]
    expected = 1.0 / (1.0 / torch.tensor(START) + 10.0 / (2.0 * 0.3**2))
    torch.testing.assert_close(state[0, 12:15] + torch.tensor(START), expected, rtol=1e-3, atol=0.0)


@torch.no_grad()
def test_the_next_obstacle_may_stand_elsewhere() -> None:
    """What is known of the place at one obstacle is known of that at the next but for the jitter of both."""
    memory, _ = silent((FIRST, STRAIGHT))
    *_, after, _, _, _ = memory.step(*still(memory, [3.5, 3.1, 0.0, 1.0], 3))
    added = torch.tensor(NEXT) + 0.05 * torch.tensor(DRIFT)
    torch.testing.assert_close(after[0, 12:15], added)


@torch.no_grad()
def test_who_reaches_the_last_way_point_stands_before_the_next_obstacle() -> None:
    """1.5 m behind an obstacle's middle; behind the second, the third is to the left and faces the other way.

    The third is the last: nothing follows it. The pose in the arena stays what it was.
    """
    memory, _ = silent((FIRST, STRAIGHT, BACK))
    for at, pose, follows, expected in (
        (3, [3.5, 3.1, 0.0, 1.0], 4, [-2.5, 0.1, 0.0, 1.0]),
        (7, [7.5, 3.1, 0.0, 1.0], 8, [-1.5, 1.9, 0.0, -1.0]),
        (11, [4.5, 4.9, 0.0, -1.0], 11, [1.5, 0.1, 0.0, 1.0]),
    ):
        inputs = still(memory, pose, at)
        *_, after, place, progress, _ = memory.step(*inputs)
        torch.testing.assert_close(place[0, 4:], torch.tensor(expected), atol=1e-5, rtol=0.0)
        torch.testing.assert_close(after[0, 8:12], inputs[-1][0, 8:12], atol=1e-5, rtol=0.0)
        assert progress.exp()[0, follows] > 0.99
        torch.testing.assert_close(progress.exp().sum(), torch.tensor(1.0))
        *_, twice, _ = memory.step(*inputs[:-1], after)
        assert int(twice.argmax()) == follows, "who has left an obstacle does not leave the next one too"


@torch.no_grad()
def test_what_was_seen_of_the_next_obstacle_counts_when_that_is_the_present_one() -> None:
    """From 1 m behind the first obstacle's middle the next one is seen 3.2 m ahead and 0.1 m to the left, turned by 0.2
    instead of 3 m ahead, and taken for the fourth type; its way-points all lie 1 m further than others'.

    Where it is entered follows that at once. 0.6 m on, the last way-point is reached: the robot is 2.6 m before it and
    to the right, and turned to the other side.
    """
    memory, _ = silent((FIRST, STRAIGHT))
    memory.way_points[3, :, 0] += 1.0
    memory.preview.alike.zero_()
    *seen, state = still(memory, [3.0, 3.0, 0.0, 1.0], 3)
    there = torch.tensor([3.2, 0.1, math.sin(0.2), math.cos(0.2)])
    evidence = torch.tensor([0.0, 0.0, 0.0, 2.0 * STRONGEST, 0.0, 0.0, 0.0])
    coming = torch.cat((there, torch.full((3,), 1e-6), evidence))
    seen[3] = said(memory, UNSEEN, coming)
    *_, state, place, _, _ = memory.step(*seen, state)
    entry = -1.5 + 1.0 / (1.0 + 6.0 * math.exp(-STRONGEST))  # along its axis, by the types that it may be
    expected = there[:2] + entry * torch.tensor([math.cos(0.2), math.sin(0.2)])
    torch.testing.assert_close(place[0, 2:4], expected, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(place[0, 4:], torch.tensor([1.0, 0.0, 0.0, 1.0]), atol=1e-4, rtol=0.0)

    state[0, 8] += 0.6
    seen[3] = said(memory, UNSEEN, torch.cat((UNSEEN, torch.zeros(7))))
    _, _, logits, state, place, progress, _ = memory.step(*seen, state)
    assert int(progress.argmax()) == 4 and int(logits.argmax()) == 3
    assert float(logits[0, 3] - logits[0, 0]) == pytest.approx(STRONGEST)
    x, y = math.cos(0.2) * 2.6 + math.sin(0.2) * 0.1, math.cos(0.2) * 0.1 - math.sin(0.2) * 2.6
    expected = torch.tensor([-x, -y, -math.sin(0.2), math.cos(0.2)])
    torch.testing.assert_close(place[0, 4:], expected, atol=2e-3, rtol=0.0)
    doubted = 0.05**2 / (1.0 + 0.05**2)  # what lies 0.22 m from where it was expected
    known = 2.0 * 0.05 * torch.tensor(DRIFT) + doubted * torch.tensor(NEXT)
    torch.testing.assert_close(state[0, 12:15], known, atol=3e-6, rtol=0.0)
    torch.testing.assert_close(state[0, 23:37], torch.zeros(14), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(state[0, 37:44], evidence.clamp(min=STRONGEST))


@torch.no_grad()
def test_of_a_type_that_was_met_elsewhere_none_is_left() -> None:
    """One of each of three: slots 0 and 1 held types 0 and 2, so the one at slot 2 is of type 1, whatever it seems."""
    route, stock = (FIRST, STRAIGHT, BACK), (1, 1, 1, 0, 0, 0, 0)
    for counts, likeliest in ((stock, 1), ((), 2)):
        memory, bias = silent(route, stock=counts)
        bias["obstacle"].copy_(torch.tensor([1.0, 0.0, 2.0, 1.0, 1.0, 1.0, 1.0]))
        *seen, state = still(memory, [8.0, 5.0, 0.0, -1.0], 8)
        met = state.split(memory.parts, -1)[5].view(3, 7)
        met[0, 0] = met[1, 2] = 1.0
        *_, logits, after, _, _, _ = memory.step(*seen, state)
        assert int(logits.argmax()) == likeliest
        noted = after.split(memory.parts, -1)[5].view(3, 7)
        torch.testing.assert_close(noted[2], NOTED * logits[0].softmax(-1))
        assert torch.equal(noted[:2], met[:2])


@torch.no_grad()
def test_who_goes_back_knows_nothing_of_the_obstacle_before() -> None:
    """Evidence for the first of two, seen from the second: what was seen of the one after it says nothing of that."""
    memory, bias = silent((FIRST, STRAIGHT, BACK))
    bias["weight"].fill_(100.0)
    bias["progress"][3] = 40.0
    *seen, state = still(memory, [4.0, 3.0, 0.0, 1.0], 4)
    state.split(memory.parts, -1)[4].copy_(torch.rand(1, 21))
    *_, state, place, progress, _ = memory.step(*seen, state)
    assert int(progress.argmax()) == 3
    torch.testing.assert_close(state.split(memory.parts, -1)[4], torch.zeros(1, 21), atol=1e-6, rtol=0.0)
    torch.testing.assert_close(place[0, 4:], torch.tensor([2.0, 0.0, 0.0, 1.0]), atol=1e-4, rtol=0.0)


@torch.no_grad()
def test_way_points_are_those_of_the_likeliest_obstacle_and_then_where_the_next_is_entered() -> None:
    """Looking along two obstacles, 0.5 m to their left; of their type all way-points lie 1 m further and aside."""
    memory, bias = silent((FIRST, STRAIGHT))
    memory.way_points[3] += 1.0
    bias["obstacle"][3] = 20.0
    # The entry is the mean over the types: at -1.5 + 1/7 and 1/7 in the frame of the second obstacle, which is 4 m on.
    entry = [0.9 + 1.0 / 7.0, -0.5 + 1.0 / 7.0]
    for x, at, expected in (
        (2.0, 0, [-0.5, 0.5, 0.5, 0.5]),
        (3.6, 3, [0.9, 0.5, *entry]),
        (7.6, 7, [0.9, 0.5, 0.9, 0.5]),
    ):
        *_, place, _, _ = memory.step(*still(memory, [x, 3.5, 0.0, 1.0], at))
        torch.testing.assert_close(place[0, :4], torch.tensor(expected), atol=1e-5, rtol=0.0)


def test_gradients_reach_what_was_said_earlier() -> None:
    memory = PlacedMemory(32, 45, 8, 7, 0.04, POINTS)
    torch.nn.init.normal_(memory.glance.correction[-1].weight)
    feature = torch.randn(6, 2, 32, requires_grad=True)
    first = torch.zeros(6, 2, 1, dtype=torch.bool)
    first[3, 0] = True
    seen = torch.randn(6, 2, 45), torch.randn(6, 2, 4), torch.zeros(6, 2, 58, 87), torch.full((6, 2, 1), 0.05)
    *_, place, _, _ = memory(feature, *seen, torch.randn(1, 2, memory.size), first)
    place[5].sum().backward()
    assert (feature.grad[3:].abs().sum(-1) > 0).all() and (feature.grad[:3, 1].abs().sum(-1) > 0).all()
    assert (feature.grad[:3, 0] == 0).all(), "an episode does not remember the one before it"


def test_the_place_teaches_neither_the_obstacle_nor_what_was_expected_of_it() -> None:
    """The way-points of the likeliest obstacle are known, and the terrain is not what a place is learned from."""
    points = POINTS + torch.arange(7.0)[:, None, None]
    memory = PlacedMemory(32, 45, 8, 7, 0.04, points)
    torch.nn.init.normal_(memory.glance.correction[-1].weight)
    hidden = torch.randn(2, memory.size, requires_grad=True)
    seen = torch.randn(2, 32), torch.randn(2, 45), torch.randn(2, 4), torch.zeros(2, 58, 87), torch.full((2, 1), 0.05)
    latent, _, _, _, place, _, _ = memory.step(*seen, hidden)
    place.sum().backward(retain_graph=True)
    gradient = memory.head[0].weight.grad
    assert (gradient[32:39] == 0).all() and gradient[43:46].any(), "of the obstacle, and of how alike images are"
    hidden.grad = None
    latent.sum().backward()
    assert hidden.grad[:, :8].any() and (hidden.grad[:, 8:] == 0).all()
