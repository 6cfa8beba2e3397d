from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2 import camera, features
from agility_rl.modules.planar import inverted
from agility_rl.modules.scan_matching import (
    FLOOR,
    NOTHING,
    ScanMatcher,
    _seen_variance,
    _turned,
    inverted_spd,
    on_grid,
    swept,
)

ROBOTS = 24
SOLIDS = [kind.solids() for kind in OBSTACLES.values()]
TAUGHT = [name for name in OBSTACLES if name != "box_jump"]
BLOCK = ("box", (0.4, 1.4, 0.8), (0.0, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0))


@pytest.fixture(scope="module")
def matcher() -> ScanMatcher:
    return ScanMatcher(SOLIDS)


def standing(name: str, noise: float = 0.0, walls: bool = True) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """What robots that have just been stood before an obstacle measure, where they see it, and its type."""
    camera_errors = {"pitch": noise * camera.PITCH_JITTER, "offset_noise": 0.05 * noise, "pixel_noise": 0.05 * noise}
    env = AgilityEnv(
        ROBOTS,
        lambda td: td.set("action", torch.zeros(ROBOTS, 12)),
        COURSES[name] if walls else replace(COURSES[name], wall_height=None),
        depth=camera_errors,
        start_spread=2.0,
        observation_noise=0.0,
        simulator_options={"num_threads": 2},
        seed=3,
    )
    td = env.reset()
    estimate = torch.cat((env.simulator.root_position[:, 2:], torch.zeros(ROBOTS, 3)), -1)
    seen = inverted(td[keys.PLACE][:, 4:])
    env.close()
    return (td[keys.DEPTH], td[keys.PROPRIOCEPTION], estimate, td[keys.IMAGE_AGE]), seen, td[keys.OBSTACLE].argmax(-1)


def beside(seen: Tensor, seed: int = 0) -> Tensor:
    """The same, expected up to 0.15 m and 0.06 rad elsewhere."""
    off = 2.0 * torch.rand(len(seen), 3, generator=torch.Generator().manual_seed(seed)) - 1.0
    yaw = torch.atan2(seen[:, 2], seen[:, 3]) + 0.06 * off[:, 2]
    return torch.cat((seen[:, :2] + 0.15 * off[:, :2], yaw.sin()[:, None], yaw.cos()[:, None]), -1)


def errors(match: Tensor, seen: Tensor) -> Tensor:
    """Of x, y [m] and yaw [rad], ``[N, 3]``."""
    yaw = torch.asin((match[:, 2] * seen[:, 3] - match[:, 3] * seen[:, 2]).clamp(-1.0, 1.0))
    return torch.cat((match[:, :2] - seen[:, :2], yaw[:, None]), -1).abs()


@pytest.mark.parametrize("name", TAUGHT)
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_an_obstacle_is_found_where_it_stands(matcher: ScanMatcher, name: str, noise: float) -> None:
    """Nearer to it than it was expected, without errors of the camera and with all of them."""
    measured, seen, kind = standing(name, noise)
    expected = beside(seen)
    match = matcher(*measured, expected, kind)
    found = match[:, 4] < NOTHING
    assert found.float().mean() > 0.7
    before, after = (errors(place, seen)[found].median(0).values for place in (expected, match))
    assert (after < torch.tensor([0.9, 0.5, 0.8]) * before).all(), (before, after)
    assert (after < torch.tensor([0.07, 0.03, 0.03])).all(), after
    deviation = match[found, 4:].sqrt()
    assert (deviation >= torch.tensor(FLOOR)).all() and (deviation.median(0).values < 0.2).all()


def test_who_sees_nothing_is_told_nothing(matcher: ScanMatcher) -> None:
    (_, proprioception, estimate, age), seen, kind = standing("tunnel")
    estimate[:, 1] = 3.0 * features.LINEAR_VELOCITY_SCALE  # where it was expected, however fast the robot is
    far = torch.full((ROBOTS, camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH), 0.5)
    seen = on_grid(seen)
    match = matcher(far, proprioception, estimate, age, seen, kind)
    assert (match[:, 4:] == NOTHING).all()
    torch.testing.assert_close(match[:, :4], seen, atol=1e-4, rtol=0.0)


def test_robots_have_moved_since_an_image_was_taken(matcher: ScanMatcher) -> None:
    """In 0.02 s, 3.125 m/s forward are 0.0625 m, by which all is nearer now; 2 rad/s of roll or pitch are 0.04 rad.

    In 0.04 s half of that speed is as far.
    """
    (depth, proprioception, estimate, age), seen, kind = standing("tunnel")
    expected = on_grid(beside(seen))
    still = matcher(depth, proprioception, estimate, age, expected, kind)
    moving, nearer = estimate.clone(), torch.tensor([0.0625, 0.0, 0.0, 0.0])
    moving[:, 1] = 3.125 * features.LINEAR_VELOCITY_SCALE
    match = matcher(depth, proprioception, moving, age, expected - nearer, kind)
    torch.testing.assert_close(match[:, :4], still[:, :4] - nearer, atol=1e-4, rtol=0.0)
    moving[:, 1] /= 2.0
    torch.testing.assert_close(matcher(depth, proprioception, moving, 2.0 * age, expected - nearer, kind), match)
    for axis in (0, 1):
        leaning = proprioception.clone()
        leaning[:, axis] += 0.04
        leaning[:, 2 + axis] += 2.0 * features.ANGULAR_VELOCITY_SCALE
        match = matcher(depth, leaning, estimate, age, expected, kind)
        torch.testing.assert_close(match[:, :4], still[:, :4], atol=1e-4, rtol=0.0)


@pytest.mark.parametrize(
    ("expected", "columns", "counts"), [(2.3, 40, True), (2.3, 20, False), (3.0, 87, True), (3.2, 87, False)]
)
def test_what_explains_too_little_or_lies_too_far_off_does_not_count(
    expected: float, columns: int, counts: bool
) -> None:
    """A block begins 1.6 m before the camera, so its middle is 2.305 m ahead; something else hides columns of it.

    40 columns of 87 are 46 % of what is seen, 20 are 23 %: 30 % must be explained. It may lie 0.8 m off.
    """
    depth = torch.full((camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH), 0.8)
    depth[:, :columns] = 1.6
    ground = (0.27 + camera.POSITION[2]) / (-camera.pixel_directions()[..., 2]).clamp(min=1e-6)
    image = camera.normalize_depth(torch.minimum(ground, depth))[None]
    still, standing, place = torch.zeros(1, 45), torch.tensor([[0.27, 0.0, 0.0, 0.0]]), [[expected, 0.0, 0.0, 1.0]]
    age = torch.full((1, 1), camera.LATENCY)
    match = ScanMatcher([[BLOCK]])(image, still, standing, age, torch.tensor(place), torch.tensor([0]))[0]
    assert match[0].item() == pytest.approx(2.305, abs=0.01)
    assert bool((match[4:] < NOTHING).all()) == counts


def test_another_obstacle_is_not_taken_for_it(matcher: ScanMatcher) -> None:
    """A tunnel in view, a hurdle expected 2 m farther on."""
    measured, seen, kind = standing("tunnel")
    expected = seen + torch.tensor([2.0, 0.0, 0.0, 0.0])
    match = matcher(*measured, expected, torch.zeros_like(kind))
    assert (match[:, 4] == NOTHING).float().mean() > 0.7


def test_rows_do_not_mix_and_stored_images_say_the_same(matcher: ScanMatcher) -> None:
    (depth, proprioception, estimate, age), seen, kind = standing("tire_jump", 1.0)
    expected = beside(seen)
    match = matcher(depth, proprioception, estimate, age, expected, kind)
    alone = matcher(*(part[3:4] for part in (depth, proprioception, estimate, age, expected, kind)))
    torch.testing.assert_close(alone[0], match[3], rtol=1e-3, atol=1e-4)
    stored = matcher(camera.quantize(depth, 16), proprioception, estimate, age, expected, kind)
    assert errors(stored, match).median() < 1e-3
    assert not matcher(depth.requires_grad_(), proprioception, estimate, age, expected, kind).requires_grad


def test_points_are_turned_by_hand(matcher: ScanMatcher) -> None:
    """Roll lifts what is to the left, pitch lowers what is ahead, yaw turns that to the left."""
    sine, cosine = math.sin(0.1), math.cos(0.1)
    for angle, point, turned in (
        (5, (0.0, 1.0, 0.0), (0.0, cosine, sine)),
        (4, (1.0, 0.0, 0.0), (cosine, 0.0, -sine)),
        (3, (1.0, 0.0, 0.0), (cosine, sine, 0.0)),
    ):
        pose = torch.zeros(1, 7, dtype=torch.float64)
        pose[0, angle] = 0.1
        torch.testing.assert_close(_turned(pose, matcher.turns)[0][0] @ pose.new_tensor(point), pose.new_tensor(turned))


def test_axes_say_how_points_move_when_angles_change(matcher: ScanMatcher) -> None:
    pose = torch.tensor([[-2.0, 0.5, 0.3, 0.7, -0.4, 0.2, 0.0]], dtype=torch.float64)
    point = pose.new_tensor([0.3, -1.1, 0.6])
    moves = torch.autograd.functional.jacobian(lambda pose: _turned(pose, matcher.turns)[0][0] @ point, pose)[:, 0, 3:6]
    turn, axes = (part[0] for part in _turned(pose, matcher.turns))
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3).double())
    torch.testing.assert_close(moves, torch.linalg.cross(axes, (turn @ point)[:, None].expand(3, 3), dim=0))


def test_who_is_unsure_of_the_yaw_is_unsure_of_what_is_far() -> None:
    """An obstacle 2 m ahead and 0.5 m to the left: a yaw of variance 0.01 moves it by 0.5 along and by 2 across.

    With x and y that are as unsure and err with the yaw, 0.01 - 2 * 0.5 * 0.004 + 0.0025, 0.01 + 2 * 2 * 0.002 + 0.04.
    """
    robot, seen = torch.tensor([[-2.0, -0.5, 0.0, 1.0]]), torch.tensor([[2.0, 0.5, 0.0, 1.0]])
    yaw = torch.diag(torch.tensor([0.0, 0.0, 0.01]))
    together = torch.tensor([[0.01, 0.0, 0.004], [0.0, 0.01, 0.002], [0.004, 0.002, 0.01]])
    for covariance, variance in ((yaw, [0.0025, 0.04, 0.01]), (together, [0.0085, 0.058, 0.01])):
        torch.testing.assert_close(_seen_variance(covariance[None], robot, seen)[0], torch.tensor(variance))


def test_inverse_of_badly_scaled_matrices() -> None:
    factor = torch.randn(20, 7, 9, generator=torch.Generator().manual_seed(0))
    matrix = factor @ factor.mT + torch.diag(torch.tensor([4.0, 4.0, 25.0, 400.0, 400.0, 4444.0, 1189.0]))
    for inverse in (inverted_spd(matrix), swept(matrix)):
        torch.testing.assert_close(inverse @ matrix, torch.eye(7).expand(20, 7, 7), atol=1e-5, rtol=0.0)


def test_what_only_rounding_tells_apart_is_matched_alike(matcher: ScanMatcher) -> None:
    """Whether robots are matched alone or together, also where a shape fits in two places, and with any type."""
    measured, seen, kind = standing("weave_poles", 1.0)
    inputs = (*measured, on_grid(beside(seen)))
    nearly = (*measured, inputs[-1] * (1.0 + 1e-6))
    compared, matched = matcher.compare(*inputs, inputs[-1]), matcher(*inputs, kind)
    for row in range(ROBOTS):
        alone = matcher.compare(*(values[row : row + 1] for values in (*nearly, nearly[-1])))
        for values, together in zip(alone, compared, strict=True):
            torch.testing.assert_close(values[0], together[row], rtol=1e-6, atol=1e-6)
        alone_matched = matcher(*(values[row : row + 1] for values in (*nearly, kind)))
        torch.testing.assert_close(alone_matched[0], matched[row], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", TAUGHT)
def test_an_obstacle_is_told_from_others_by_its_shape(matcher: ScanMatcher, name: str) -> None:
    """Of most robots before it, with all errors of the camera."""
    measured, seen, kind = standing(name, 1.0)
    expected = beside(seen)
    matches, share = matcher.compare(*measured, expected, expected)
    assert share.shape == (ROBOTS, len(SOLIDS)) and ((share >= 0.0) & (share <= 1.0)).all()
    assert (share.argmax(-1) == kind).float().mean() > 0.8
    assert matches.shape == (ROBOTS, len(SOLIDS), 7)
    off = errors(matches[range(ROBOTS), kind], matcher(*measured, expected, kind))
    assert off.median() < 0.02, off


def test_what_stands_beside_says_nothing_of_the_type(matcher: ScanMatcher) -> None:
    """A tunnel in view, an obstacle expected 2 m to its left."""
    measured, seen, _ = standing("tunnel", walls=False)
    beside_it = seen + torch.tensor([0.0, 2.0, 0.0, 0.0])
    assert (matcher.compare(*measured, beside_it, beside_it)[1] == 0.0).all()


@pytest.mark.parametrize(("aside", "counts"), [(0.8, True), (1.0, False)])
def test_a_wall_is_not_taken_for_what_a_slot_holds(matcher: ScanMatcher, aside: float, counts: bool) -> None:
    """It runs along the way, so far to its right; the obstacle is believed to stand there, its slot is straight on."""
    rays = camera.pixel_directions()
    ground = (0.27 + camera.POSITION[2]) / (-rays[..., 2]).clamp(min=1e-6)
    wall = (aside + camera.POSITION[1]) / (-rays[..., 1]).clamp(min=1e-6)
    measured = camera.normalize_depth(torch.minimum(ground, wall))[None], torch.zeros(1, 45)
    height, slot = torch.tensor([[0.27, 0.0, 0.0, 0.0]]), torch.tensor([[2.5, 0.0, 0.0, 1.0]])
    age = torch.full((1, 1), camera.LATENCY)
    _, share = matcher.compare(*measured, height, age, slot - torch.tensor([0.0, 0.6, 0.0, 0.0]), slot)
    assert bool((share > 0.2).any()) is counts and (counts or not share.any())


@pytest.mark.parametrize("name", ["tire_jump", "a_frame", "tunnel"])
@pytest.mark.parametrize("aside", [0.35, -0.35])
def test_an_obstacle_is_found_from_far_beside_it(matcher: ScanMatcher, name: str, aside: float) -> None:
    """Expected a tire's half width beside where it stands, where one of its posts looks like the other."""
    measured, seen, kind = standing(name)
    sine, cosine = seen[:, 2], seen[:, 3]  # the obstacle's own left, seen by the robot, is (-sine, cosine)
    expected = torch.cat((seen[:, :2] + aside * torch.stack((-sine, cosine), -1), seen[:, 2:]), -1)
    match = matcher(*measured, expected, kind)
    off = match[:, :2] - seen[:, :2]
    across = (cosine * off[:, 1] - sine * off[:, 0]).abs()[match[:, 4] < NOTHING]
    assert len(across) > 0.6 * ROBOTS
    assert (across < 0.12).float().mean() > 0.9, across
