"""The obstacles of the agility course as data: shapes, way-points, perceived heights, edges, difficulty.

An obstacle's frame lies on the ground under its middle; the robot passes along +x, y points to its left.

Source of all measures: method notes, section 5.7 (released code), unless a comment says that they are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from agility_rl.simulation import Hinge, Piece, Shape

Points = tuple[tuple[float, float], ...]
Profile = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Heights ``base + gain * parameter`` [m] at local (x, y); the parameter is the difficulty, or a hinge's tangent."""

WALK_SPEED = 0.4
"""Speed towards the goal that is worth the full reward [m/s] (section 5.6)."""
JUMP_SPEED = 2.5
"""The same before a jump [m/s] (section 5.6)."""
GATE_DEPTH = 0.2
"""Depth of a bar in the perceived heights [m]: five times the real one, so that no grid of 0.1 m misses it."""

_RED, _WHITE, _BLUE = (0.82, 0.22, 0.18, 1.0), (0.93, 0.93, 0.9, 1.0), (0.2, 0.4, 0.75, 1.0)
_YELLOW, _GREEN, _BLACK = (0.93, 0.75, 0.2, 1.0), (0.3, 0.6, 0.35, 1.0), (0.16, 0.16, 0.18, 1.0)
_ALONG_X, _ALONG_Y = (0.5**0.5, 0.0, 0.5**0.5, 0.0), (0.5**0.5, 0.5**0.5, 0.0, 0.0)


class Difficulty(NamedTuple):
    """Height [m] of the lifted piece: the released range, and the hardest that is offered."""

    low: float
    high: float
    hardest: float


class Zone(NamedTuple):
    """Rectangle in an obstacle's frame: middle and half extents [m]."""

    x: float
    y: float
    half_x: float
    half_y: float


@dataclass(frozen=True)
class Obstacle:
    """One type of obstacle.

    Attributes:
        name: in courses, observations and logs.
        pieces: what stands in the arena, each placed at the obstacle's pose.
        way_points: where the robot shall pass, in order, local (x, y) [m].
        half_extents: of the footprint, in x and y [m].
        passage: half width of the way through or over its middle [m]; who crosses outside has walked around it.
        profile: perceived heights; for gates and tubes of the lower half only, through which the robot goes.
        difficulty: range of the height to which the piece :attr:`lifted` is lifted; ``None`` if there is none.
        lifted: index of that piece.
        supports: the robot may stand on it, so the trunk's height counts from its surface.
        edges: where no foot should stand.
        target_speed: speed towards the goal worth the full reward [m/s].

    Example:
        >>> OBSTACLES["bar_jump"].difficulty
        Difficulty(low=0.05, high=0.2, hardest=0.3)
    """

    name: str
    pieces: tuple[Piece, ...]
    way_points: Points
    half_extents: tuple[float, float]
    profile: Profile
    difficulty: Difficulty | None = None
    lifted: int | None = None
    supports: bool = False
    passage: float = math.inf
    edges: tuple[Zone, ...] = ()
    target_speed: float = WALK_SPEED

    def solids(self) -> list[list[Any]]:
        """What it is made of, as :class:`~agility_rl.modules.distance_field.DistanceField` reads it: kind, size and
        position [m], quaternion (w, x, y, z), and the range of heights [m] to which that may be lifted, in the
        obstacle's frame; a hinge as nobody stands on it.

        Example:
            >>> OBSTACLES["bar_jump"].solids()[-1]
            ['capsule', [0.03, 0.6], [0.0, 0.0, 0.0], [0.7071, 0.7071, 0.0, 0.0], [0.05, 0.2]]
        """
        made: list[list[Any]] = []
        for number, piece in enumerate(self.pieces):
            lift = self.difficulty[:2] if self.difficulty is not None and number == self.lifted else (0.0, 0.0)
            still = [(shape, shape.position, shape.quaternion) for shape in piece.shapes]
            for shape, *pose in (*still, *(() if piece.hinge is None else piece.hinge.resting())):
                rounded = ([round(value, 4) for value in values] for values in pose)
                made.append([shape.kind, list(shape.size), *rounded, list(lift)])
        return made


def _turned(angle: float, axis: str) -> tuple[float, float, float, float]:
    sine = math.sin(angle / 2)
    return (math.cos(angle / 2), sine * (axis == "x"), sine * (axis == "y"), sine * (axis == "z"))


# Bar jump ------------------------------------------------------------------------------------------------------------

BAR_RADIUS, BAR_WIDTH = 0.03, 1.2
WING_HEIGHT, WINGS_WIDTH = 0.42, 2.04


def bar_shape(half_width: float) -> Shape:
    """A bar across the way, at the height to which its piece is lifted.

    Args:
        half_width: half of its length [m].
    """
    return Shape("capsule", (BAR_RADIUS, half_width), quaternion=_ALONG_Y, colour=_RED)


def _bar_jump() -> Obstacle:
    half, reach = BAR_WIDTH / 2, WINGS_WIDTH / 2
    wing = (0.02, (reach - half) / 2, WING_HEIGHT / 2)  # 4 cm thick: ours
    wings = tuple(
        Shape("box", wing, (0.0, side * (reach + half) / 2, WING_HEIGHT / 2), colour=_WHITE) for side in (1.0, -1.0)
    )

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        deep = x.abs() <= GATE_DEPTH / 2
        over = deep & (y.abs() <= half)
        beside = deep & (y.abs() > half) & (y.abs() <= reach)
        return torch.where(over, BAR_RADIUS, 0.0) + torch.where(beside, WING_HEIGHT, 0.0), over.float()

    return Obstacle(
        "bar_jump",
        (Piece("wings", wings), Piece("bar", (bar_shape(half),))),
        ((-1.8, 0.0), (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0)),
        (GATE_DEPTH / 2, reach),
        profile,
        Difficulty(0.05, 0.20, 0.30),
        lifted=1,
        passage=half,
        edges=(Zone(0.0, 0.0, GATE_DEPTH / 2, half),),
        target_speed=JUMP_SPEED,
    )


# A-frame -------------------------------------------------------------------------------------------------------------

RAMP_WIDTH, RAMP_LENGTH, APEX_HEIGHT, RAMP_THICKNESS = 0.6, 1.4625, 0.333, 0.03
EDGE_WIDTH = 0.05


def _side_strips(half_length: float, half_width: float) -> tuple[Zone, ...]:
    """Strips of 5 cm along both long sides."""
    middle = half_width - EDGE_WIDTH / 2
    return tuple(Zone(0.0, side * middle, half_length, EDGE_WIDTH / 2) for side in (1.0, -1.0))


def ramp_shapes(half_width: float) -> tuple[Shape, ...]:
    """The two boards of an A-frame.

    Args:
        half_width: of the boards [m].
    """
    slope = math.atan2(APEX_HEIGHT, RAMP_LENGTH)
    board = (math.hypot(APEX_HEIGHT, RAMP_LENGTH) / 2, half_width, RAMP_THICKNESS / 2)
    shapes = []
    for side in (1.0, -1.0):  # the tops of the boards meet at the apex
        x = side * (RAMP_LENGTH / 2 - RAMP_THICKNESS / 2 * math.sin(slope))
        z = APEX_HEIGHT / 2 - RAMP_THICKNESS / 2 * math.cos(slope)
        shapes.append(Shape("box", board, (x, 0.0, z), _turned(side * slope, "y"), _BLUE if side > 0 else _YELLOW))
    return tuple(shapes)


def ramp_height(x: Tensor) -> Tensor:
    """Height of an A-frame's boards at local x [m]; 0 beside them."""
    return (APEX_HEIGHT * (1.0 - x.abs() / RAMP_LENGTH)).clamp(min=0.0)


def _a_frame() -> Obstacle:
    half = RAMP_WIDTH / 2

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(y.abs() <= half, ramp_height(x), 0.0), torch.zeros_like(x)

    return Obstacle(
        "a_frame",
        (Piece("boards", ramp_shapes(half)),),
        ((-RAMP_LENGTH - 0.7, 0.0), (-RAMP_LENGTH, 0.0), (0.0, 0.0), (RAMP_LENGTH, 0.0)),
        (RAMP_LENGTH, half),
        profile,
        supports=True,
        passage=half,
        edges=_side_strips(RAMP_LENGTH, half),
    )


# Weave poles ---------------------------------------------------------------------------------------------------------

POLE_RADIUS, POLE_HEIGHT, POLE_SPACING, POLE_FOOT = 0.03, 1.0, 1.0, 0.11
WEAVE_OFFSET = 0.5


def _weave_poles() -> Obstacle:
    places = tuple(POLE_SPACING * (index - 1.5) for index in range(4))
    shapes = []
    for x in places:
        shapes.append(Shape("cylinder", (POLE_RADIUS, POLE_HEIGHT / 2), (x, 0.0, POLE_HEIGHT / 2), colour=_RED))
        shapes.append(Shape("sphere", (POLE_FOOT,), (x, 0.0, 0.0), colour=_WHITE))  # its upper half is the domed foot

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        base = torch.zeros_like(x)
        for place in places:
            square = (x - place).square() + y.square()
            foot = (POLE_FOOT**2 - square).clamp(min=0.0).sqrt()
            base = torch.maximum(base, torch.where(square <= POLE_RADIUS**2, POLE_HEIGHT, foot))
        return base, torch.zeros_like(x)

    return Obstacle(
        "weave_poles",
        (Piece("poles", tuple(shapes)),),
        tuple((x, WEAVE_OFFSET * (-1.0 if index % 2 == 0 else 1.0)) for index, x in enumerate(places)),
        (places[-1] + POLE_FOOT, POLE_FOOT),
        profile,
    )


# Seesaw --------------------------------------------------------------------------------------------------------------

PLANK_WIDTH, PLANK_LENGTH, PLANK_THICKNESS, PLANK_MASS = 0.6, 3.0, 0.03, 10.0
PIVOT_HEIGHT = 0.26
SEESAW_TILT = -math.asin(0.25 / (PLANK_LENGTH / 2))
"""Angle of the hinge while nobody stands on it [rad]: the near end is down."""


def _seesaw() -> Obstacle:
    half = PLANK_WIDTH / 2
    plank = Shape("box", (PLANK_LENGTH / 2, half, PLANK_THICKNESS / 2), colour=_YELLOW)
    # Stops instead of a contact with the ground: the same two ends, at no cost. Friction none, as in the release.
    hinge = Hinge((plank,), PLANK_MASS, (0.0, 0.0, PIVOT_HEIGHT), limits=(SEESAW_TILT, -SEESAW_TILT))
    trestle = Shape("box", (0.04, half, 0.1), (0.0, 0.0, 0.1), colour=_BLUE)  # ours

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        on = (x.abs() <= PLANK_LENGTH / 2 * math.cos(SEESAW_TILT)) & (y.abs() <= half)
        return torch.where(on, PIVOT_HEIGHT + PLANK_THICKNESS / 2, 0.0), torch.where(on, -x, 0.0)

    return Obstacle(
        "seesaw",
        (Piece("seesaw", (trestle,), hinge),),
        ((-2.2, 0.0), (-1.5, 0.0), (0.0, 0.0), (1.5, 0.0)),
        (PLANK_LENGTH / 2, half),
        profile,
        supports=True,
        passage=half,
        edges=_side_strips(PLANK_LENGTH / 2, half),
    )


# Tire jump -----------------------------------------------------------------------------------------------------------

TIRE_INNER, TIRE_OUTER, TIRE_SEGMENTS = 0.391, 0.451, 16  # of round segments: 0.060 thick, released: 0.058
GANTRY_SIZE, GANTRY_FOOT = 1.5, 0.6
_POST = 0.025  # half thickness of the gantry's bars: ours


def _tire_jump() -> Obstacle:
    step = 2.0 * math.pi / TIRE_SEGMENTS
    # A polygon whose corners lie as far outside the true circle as its sides lie inside.
    corner = (TIRE_INNER + TIRE_OUTER) / (1.0 + math.cos(step / 2))
    middle, side = corner * math.cos(step / 2), corner * math.sin(step / 2)
    ring = []
    for index in range(TIRE_SEGMENTS):
        angle = step * index  # about x, from straight below
        place = (0.0, middle * math.sin(angle), -middle * math.cos(angle))
        turn = _turned(angle + math.pi / 2, "x")
        colour = _BLACK if index % 2 else _YELLOW
        ring.append(Shape("capsule", ((TIRE_OUTER - TIRE_INNER) / 2, side), place, turn, colour))
    reach = GANTRY_SIZE / 2
    gantry = [Shape("box", (_POST, reach, _POST), (0.0, 0.0, GANTRY_SIZE - _POST), colour=_WHITE)]
    for at in (reach, -reach):
        gantry.append(Shape("box", (_POST, _POST, GANTRY_SIZE / 2), (0.0, at, GANTRY_SIZE / 2), colour=_WHITE))
        gantry.append(Shape("box", (GANTRY_FOOT / 2, _POST, _POST), (0.0, at, _POST), colour=_WHITE))

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        deep = x.abs() <= GATE_DEPTH / 2
        through = deep & (y.abs() <= TIRE_OUTER)
        post = (y.abs() - reach).abs() <= _POST
        base = torch.where(through, -(TIRE_INNER**2 - y.square()).clamp(min=0.0).sqrt(), 0.0)
        base = base + torch.where(deep & post, GANTRY_SIZE, 0.0)
        return base + torch.where(~deep & post & (x.abs() <= GANTRY_FOOT / 2), 2 * _POST, 0.0), through.float()

    return Obstacle(
        "tire_jump",
        (Piece("gantry", tuple(gantry)), Piece("tire", tuple(ring))),
        ((-1.8, 0.0), (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0)),
        (GANTRY_FOOT / 2, reach + _POST),
        profile,
        Difficulty(0.40, 0.55, 0.65),
        lifted=1,
        passage=TIRE_INNER,
        edges=(Zone(0.0, 0.0, GATE_DEPTH / 2, TIRE_OUTER),),
        target_speed=JUMP_SPEED,
    )


# Tunnel --------------------------------------------------------------------------------------------------------------

TUNNEL_INNER, TUNNEL_OUTER, TUNNEL_AXIS, TUNNEL_LENGTH, TUNNEL_SEGMENTS = 0.385, 0.435, 0.42, 2.05, 12
"""Inner radius at the middle of a side; with twelve sides the corners lie at 0.399 m (source: 0.385 to 0.40)."""


def _tunnel() -> Obstacle:
    step, half = 2.0 * math.pi / TUNNEL_SEGMENTS, TUNNEL_LENGTH / 2
    size = (half, TUNNEL_OUTER * math.tan(step / 2), (TUNNEL_OUTER - TUNNEL_INNER) / 2)
    middle = (TUNNEL_INNER + TUNNEL_OUTER) / 2
    shapes = []
    for index in range(TUNNEL_SEGMENTS):
        angle = step * index  # about x, from straight below
        place = (0.0, middle * math.sin(angle), TUNNEL_AXIS - middle * math.cos(angle))
        shapes.append(Shape("box", size, place, _turned(angle, "x"), _GREEN if index % 2 else _BLUE))

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        on = (x.abs() <= half) & (y.abs() <= TUNNEL_OUTER)
        return torch.where(
            on, TUNNEL_AXIS - (TUNNEL_INNER**2 - y.square()).clamp(min=0.0).sqrt(), 0.0
        ), torch.zeros_like(x)

    return Obstacle(
        "tunnel",
        (Piece("tube", tuple(shapes)),),
        # "entrance -1.0, entrance -0.5, middle +1.0, exit +0.5"
        ((-half - 1.0, 0.0), (-half - 0.5, 0.0), (1.0, 0.0), (half + 0.5, 0.0)),
        (half, TUNNEL_OUTER),
        profile,
        supports=True,
        passage=TUNNEL_INNER,
    )


# Box jump ------------------------------------------------------------------------------------------------------------

BOX_HALF = (0.8, 0.6, 0.25)
"""Half extents [m] (ours): long enough to land on; the supplement (Fig. S3) only says that it is 30 cm high."""


def box_shape(half_width: float) -> Shape:
    """A block whose top is at the height to which its piece is lifted.

    Args:
        half_width: half of its width, across the way [m].
    """
    return Shape("box", (BOX_HALF[0], half_width, BOX_HALF[2]), (0.0, 0.0, -BOX_HALF[2]), colour=_BLUE)


def _box_jump() -> Obstacle:

    def profile(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        on = (x.abs() <= BOX_HALF[0]) & (y.abs() <= BOX_HALF[1])
        return torch.zeros_like(x), on.float()

    return Obstacle(
        "box_jump",
        (Piece("box", (box_shape(BOX_HALF[1]),)),),
        ((-2.0, 0.0), (-1.2, 0.0), (0.0, 0.0), (0.4, 0.0)),  # ours: done when standing on it
        BOX_HALF[:2],
        profile,
        Difficulty(0.10, 0.30, 0.40),  # 0.30 m: supplement, Fig. S3; the rest ours
        lifted=0,
        supports=True,
        passage=BOX_HALF[1],
        target_speed=JUMP_SPEED,
    )


OBSTACLES: dict[str, Obstacle] = {
    make.name: make
    for make in (_bar_jump(), _a_frame(), _weave_poles(), _seesaw(), _tire_jump(), _tunnel(), _box_jump())
}
"""The challenge's six obstacles in the order of the released one-hot, then the box; a type's index is its place."""
