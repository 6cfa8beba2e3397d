"""Where an obstacle of known shape stands, from the depths that one image measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from agility_rl.go2 import camera
from agility_rl.modules.distance_field import DistanceField, Solid
from agility_rl.modules.glance import NUM_POSE, NUM_SCALES
from agility_rl.modules.planar import attitude, inverted, moved, planar_motion, seen_from
from agility_rl.modules.sigma_filter import smoothed

NUM_MATCH = NUM_POSE + NUM_SCALES
"""Numbers of a match: where the obstacle is seen, and the variances of that."""
NEAREST, FARTHEST = 0.5, 3.9
"""Depths that count [m]: what is nearer may be the robot's own leg, what is farther nothing."""
RAISED, GROUND = 192, 64
"""So many points above the ground, and on it, are matched."""
COMPARED = 64
"""So many above it where every type is tried."""
ABOVE, BELOW = 0.06, 1.6
"""Heights above the ground of the former [m]."""
AROUND = (2.3, 1.1)
"""So far along and across where the middle of an obstacle is expected they lie at most [m]: what stands beside it in
the course begins 1.2 m from there."""
ABOUT_SLOT = (2.0, 0.9)
"""So far from a slot of the course, which is all that is known of where an obstacle stands that was not met yet [m].
It is seen from the one before, 4 m off, which stands up to 0.25 m aside and 0.087 rad turned (method notes, section
5.7): from there a wall 1.5 m beside a slot may be as near as 0.9 m, and a tunnel would be found in it."""
STEPS = 4
"""Of Gauss and Newton."""
WIDTH = (0.1, 0.04)
"""Distance to the surface at which a point counts for a quarter [m]: in the first step, in the last."""
DEVIATION = 0.05
"""Of a point's distance from the surface [m]; larger than that of a pixel, since neighbours err alike."""
EXPECTED = (0.5, 0.5, 0.05, 0.2, 0.05, 0.015, 0.029)
"""Deviations of what is expected: x, y of the robot at the obstacle and its height [m], its yaw, pitch with that of the
camera, and roll [rad], and what all depths of an image are off by [m] (uniform within 0.05, and the mounting angle
within 5 degrees: method notes, section 5.8)."""
PLANAR = [0, 1, 3]
"""x, y and yaw of these."""
GRID = 2.0**-5
"""Matching begins at multiples of this [m, rad]; see :func:`on_grid`."""
LEAST, SHARE, FAR = 15, 0.3, 0.8
"""A match counts if it explains so many of the raised points, such a share of them, and lies less than so far [m] from
where it was expected."""
ASIDE = 0.35
"""So far beside the expected place fits begin too, on either side [m]: from there alone who is that wrong holds a post
of a tire for the other (docs/student_experiments.md)."""
BETTER = (1.05, 2.0)
"""What such a fit explains must be more than this multiple of what the first does, and so many points more."""
FLOOR = (0.015, 0.015, 0.008)
"""Least deviation of a match: x, y [m], yaw [rad]."""
HELD = (1.0, 0.1, 0.1)
"""Factors on the variances of a match: edges hold it across and in yaw better than slopes at the solution tell, since
there points only begin to leave the surface (docs/student_experiments.md)."""
NOTHING = 1e6
"""Variance of what says nothing."""
FEW, MANY = 12, 60
"""With fewer raised points there nothing is said of its type; more than that say no more."""
_CROSS = (
    ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
)
"""What the cross products with the axes of yaw, pitch and roll do."""


class _Scan(NamedTuple):
    """Points that an image measures, and from where the obstacle is expected."""

    start: Tensor
    """Pose of the robot at the obstacle when the image was taken, ``[N, 7]``."""
    motion: Tensor
    """Since then, ``[N, 3]``."""
    points: Tensor
    """``[N, P, 3]``, in the trunk's frame [m]."""
    rays: Tensor
    """By which they were measured, ``[N, P, 3]``."""
    valid: Tensor
    """Which of them were, bool ``[N, P]``."""


class _Fit(NamedTuple):
    """Where an obstacle of some type fits them."""

    found: Tensor
    """Pose ``[N, 7]``."""
    covariance: Tensor
    """``[N, 7, 7]``."""
    explained: Tensor
    """How many raised points lie on it, ``[N]``."""
    there: Tensor
    """Of how many where it is known, ``[N]``."""


class ScanMatcher(nn.Module):
    r"""Match the depths of an image with the known shape of an obstacle, from where that is expected.

    .. math:: \min_\xi \sum_i w_i\, d(T(\xi)\, p_i)^2 / \sigma^2 + (\xi - \xi_0)^\top \Sigma_0^{-1} (\xi - \xi_0),
              \qquad w_i = \left(1 + d_i^2 / c^2\right)^{-2}

    :math:`p_i` are points that the image measures, d their distance from the surface of obstacle and ground
    (:class:`~agility_rl.modules.distance_field.DistanceField`), and :math:`\xi` is the robot's pose at the obstacle
    with its height, roll and pitch and the image's common error. Four steps of Gauss and Newton with weights of Geman
    and McClure, whose width c falls, begin where the obstacle is expected and on either side of it; the fit that
    explains most counts. A network that reads a place from an image errs alike in image after image, and holds what is
    usual for seen; a shape that fits does neither. It has to be expected within some 0.5 m.

    Source: ours; scan matching against a distance field: Fitzgibbon 2003 (doi:10.1016/j.imavis.2003.09.004).

    Args:
        types: the solids of every type of obstacle, ``[K][...]``.

    Example:
        >>> block = ("box", (0.4, 1.4, 0.8), (0.0, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0))
        >>> matcher = ScanMatcher([[block]])
        >>> ground = (0.27 + camera.POSITION[2]) / (-camera.pixel_directions()[..., 2]).clamp(min=1e-6)
        >>> depth = camera.normalize_depth(ground.clamp(max=1.6))[None]  # 1.6 m before the camera a block begins
        >>> still, standing = torch.zeros(1, 45), torch.tensor([[0.27, 0.0, 0.0, 0.0]])
        >>> expected = torch.tensor([[2.2, 0.0, 0.0, 1.0]])  # its middle, which is 0.1 m farther on
        >>> match = matcher(depth, still, standing, torch.full((1, 1), 0.02), expected, torch.tensor([0]))
        >>> round(match[0, 0].item(), 1), bool(match[0, 4] < 0.1**2)
        (2.3, True)
    """

    rays: Tensor
    mount: Tensor
    order: Tensor
    expected: Tensor
    floor: Tensor
    held: Tensor
    around: Tensor
    about_slot: Tensor
    aside: Tensor
    turns: Tensor

    def __init__(self, types: Sequence[Sequence[Solid]]) -> None:
        super().__init__()
        self.field = DistanceField(types)
        rays = camera.pixel_directions().flatten(0, 1)
        shuffled = torch.rand(len(rays), generator=torch.Generator().manual_seed(0))
        cross = torch.tensor(_CROSS, dtype=torch.float64)
        for name, value in {
            "rays": rays,
            "mount": torch.tensor(camera.POSITION),
            "order": 0.5 * shuffled,  # which points are taken where there are too many
            "expected": torch.tensor(EXPECTED),
            "floor": torch.tensor(FLOOR),
            "held": torch.tensor(HELD),
            "around": torch.tensor(AROUND),
            "about_slot": torch.tensor(ABOUT_SLOT),
            "aside": ASIDE * torch.tensor([0.0, 1.0, -1.0])[:, None, None] * torch.eye(len(EXPECTED))[1],
            "turns": torch.stack((torch.eye(3).double().expand(3, -1, -1), cross, cross @ cross)),
        }.items():
            self.register_buffer(name, value, persistent=False)

    @torch.no_grad()
    def forward(
        self, depth: Tensor, proprioception: Tensor, estimate: Tensor, age: Tensor, expected: Tensor, kind: Tensor
    ) -> Tensor:
        """Where obstacles are seen, and how sure that is.

        Args:
            depth: images ``[N, 58, 87]``, normalised or as they are stored.
            proprioception: ``[N, 45]``.
            estimate: ``[N, 4]``, the robot's height and velocity (:data:`agility_rl.keys.ESTIMATE`).
            age: of the images, ``[N, 1]`` [s].
            expected: ``[N, 4]``: x, y [m], sine and cosine of the yaw of the obstacle, seen by the robot.
            kind: type of obstacle, int64 ``[N]``.

        Returns:
            ``[N, 7]``: as ``expected``, and variances of x, y [m^2] and yaw [rad^2], :data:`NOTHING` without a match.
        """
        scan = self._scan(depth, proprioception, estimate, age, expected, None, (RAISED, GROUND))
        return self._matches(scan, kind)[0]

    @torch.no_grad()
    def compare(
        self, depth: Tensor, proprioception: Tensor, estimate: Tensor, age: Tensor, expected: Tensor, slot: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Where an obstacle is seen if it is of each type, and how much of what stands there that explains.

        Args:
            depth: as :meth:`forward`, as are the next four.
            proprioception: ``[N, 45]``.
            estimate: ``[N, 4]``.
            age: ``[N, 1]``.
            expected: ``[N, 4]``.
            slot: ``[N, 4]``, as ``expected``: its place in the course, about which it may stand.

        Returns:
            Matches ``[N, K, 7]``, as :meth:`forward`; share of the raised points, less where they are few, ``[N, K]``.
        """
        count = self.field.count
        scan = self._scan(depth, proprioception, estimate, age, expected, slot, (COMPARED, GROUND))
        kinds = torch.arange(count, device=depth.device).repeat_interleave(len(depth))
        matches, fit = self._matches(_repeated(scan, count), kinds)
        enough = (fit.there / MANY).clamp(max=1.0) * (fit.there >= FEW)
        share = enough * fit.explained / fit.there.clamp(min=1)
        return matches.unflatten(0, (count, -1)).transpose(0, 1), share.unflatten(0, (count, -1)).mT

    def _matches(self, scan: _Scan, kind: Tensor) -> tuple[Tensor, _Fit]:
        """Where obstacles of types int64 ``[N]`` are seen, ``[N, 7]``, and how they fit."""
        count = len(self.aside)
        fits = self._fit(_repeated(scan, count), kind.repeat(count), (scan.start + self.aside).flatten(0, 1))
        fit = _best(_Fit(*(part.unflatten(0, (count, -1)) for part in fits)))
        x, y, yaw = fit.found[:, PLANAR].unbind(-1)
        pose = torch.stack((x, y, yaw.sin(), yaw.cos()), -1)
        seen = inverted(moved(pose, scan.motion))
        near = torch.linalg.vector_norm((fit.found - scan.start)[:, :2], dim=-1) < FAR
        counts = (fit.explained > LEAST) & (fit.explained > SHARE * fit.there) & near
        variance = self.held * _seen_variance(fit.covariance[:, PLANAR][..., PLANAR], pose, seen) + self.floor.square()
        return torch.cat((seen, torch.where(counts[:, None], variance, NOTHING)), -1), fit

    def _scan(
        self,
        depth: Tensor,
        proprioception: Tensor,
        estimate: Tensor,
        age: Tensor,
        expected: Tensor,
        slot: Tensor | None,
        most: tuple[int, int],
    ) -> _Scan:
        """At most so many points above the ground and on it, about the slot, or else where the obstacle is expected."""
        motion = age * planar_motion(proprioception, estimate)
        roll_pitch, rates = attitude(proprioception)
        roll, pitch = (roll_pitch - age * rates[..., :2]).unbind(-1)
        robot = moved(inverted(on_grid(expected)), -motion)
        middle = robot if slot is None else moved(inverted(on_grid(slot)), -motion)
        window = self.around if slot is None else self.about_slot
        height, yaw = estimate[:, 0], torch.atan2(robot[:, 2], robot[:, 3])
        start = torch.stack((robot[:, 0], robot[:, 1], height, yaw, pitch, roll, torch.zeros_like(roll)), -1)
        metres = smoothed(camera.metres(depth)).flatten(1)
        points = metres[..., None] * self.rays + self.mount
        up = torch.stack((-pitch.sin(), pitch.cos() * roll.sin(), pitch.cos() * roll.cos()), -1)
        above = (points @ up[..., None])[..., 0] + height[:, None]
        about = seen_from(inverted(middle), points[..., :2]).abs()
        measured = (metres > NEAREST) & (metres < FARTHEST) & (about < window).all(-1)
        raised = (above > ABOVE) & (above < BELOW)
        chosen = [
            (self.order + (measured & these)).topk(count, -1).indices
            for these, count in zip((raised, ~raised), most, strict=True)
        ]
        index = torch.cat(chosen, -1)
        fits = torch.cat((raised.gather(-1, chosen[0]), ~raised.gather(-1, chosen[1])), -1)
        rows = index[..., None].expand(-1, -1, 3)
        return _Scan(start, motion, points.gather(1, rows), self.rays[index], measured.gather(-1, index) & fits)

    def _fit(self, scan: _Scan, kind: Tensor, found: Tensor) -> _Fit:
        """Gauss-Newton from poses ``[N, 7]`` at obstacles of types int64 ``[N]``."""
        valid = scan.valid
        # A type that points are not of may fit them in two places: in doubles, rounding does not decide between those.
        start, found, points, rays = (part.double() for part in (scan.start, found, scan.points, scan.rays))
        stiff = (DEVIATION / self.expected.double()).square()
        prior = torch.diag(stiff)
        for step in range(STEPS):
            width = WIDTH[0] * (WIDTH[1] / WIDTH[0]) ** (step / (STEPS - 1))
            turn, axes = _turned(found, self.turns)
            ahead = (points + found[:, 6, None, None] * rays) @ turn.mT
            here = ahead + found[:, None, :3]
            distance, gradient, covered = self.field(kind, here)
            weight = (1.0 + (distance / width).square()).reciprocal().square() * (valid & covered)
            nearer = (rays * (gradient @ turn)).sum(-1, keepdim=True)
            slope = torch.cat((gradient, torch.linalg.cross(ahead, gradient) @ axes, nearer), -1)
            weighted = (slope * weight[..., None]).mT
            pull = (weighted @ distance[..., None])[..., 0] + stiff * (found - start)
            inverse = inverted_spd(weighted @ slope + prior)
            found = found - (inverse @ pull[..., None])[..., 0]
        raised = here[..., 2] > ABOVE
        explained, there = (weight * raised).sum(-1), (valid & covered & raised).sum(-1)
        return _Fit(found.float(), (DEVIATION**2 * inverse).float(), explained.float(), there)


def on_grid(place: Tensor) -> Tensor:
    """Places ``[*B, 4]`` (x, y, sine and cosine of the yaw) to 3 cm and 0.03 rad: rounding alone no longer tells them
    apart, and a shape that fits in two places is always found in the same one.

    Source: ours.

    Example:
        >>> on_grid(torch.tensor([1.001, -0.499, 0.001, 1.0]))
        tensor([ 1.0000, -0.5000,  0.0000,  1.0000])
    """
    yaw = torch.atan2(place[..., 2], place[..., 3])
    x, y, yaw = ((part / GRID).round() * GRID for part in (place[..., 0], place[..., 1], yaw))
    return torch.stack((x, y, yaw.sin(), yaw.cos()), -1)


def _repeated(scan: _Scan, count: int) -> _Scan:
    """Scans ``[N, ...]`` one after another as often as that: ``[S N, ...]``."""
    return _Scan(*(part.repeat(count, *(1,) * (part.dim() - 1)) for part in scan))


def _best(fits: _Fit) -> _Fit:
    """Of several fits ``[S, N, ...]`` the first one, or the one that explains clearly more: ``[N, ...]``."""
    more = (fits.explained[1:] - BETTER[1]) / BETTER[0]
    best = torch.cat((fits.explained[:1], more)).argmax(0, keepdim=True)
    return _Fit(*(part.take_along_dim(best.view(*best.shape, *(1,) * (part.dim() - 2)), 0)[0] for part in fits))


def _turned(pose: Tensor, turns: Tensor) -> tuple[Tensor, Tensor]:
    """What turns the trunk's frame into the obstacle's, ``[N, 3, 3]``, and the axes of yaw, pitch and roll there.

    Turned about axis k by an angle, with K what k x does: R = I + sin K + (1 - cos) K^2. Few operations matter here
    more than few multiplications: a robot alone waits for Python.
    """
    angles = pose[:, 3:6, None, None]
    unit, cross, square = turns
    yaw, pitch, roll = (unit + angles.sin() * cross + (1.0 - angles.cos()) * square).unbind(1)
    level = yaw @ pitch
    return level @ roll, torch.stack((unit[0, 2].expand(len(pose), -1), yaw[..., 1], level[..., 0]), -1)


def _seen_variance(covariance: Tensor, robot: Tensor, seen: Tensor) -> Tensor:
    """Variances ``[N, 3]`` of an obstacle as the robot sees it, from the covariance ``[N, 3, 3]`` of its pose there."""
    sine, cosine = robot[:, 2], robot[:, 3]
    zero = torch.zeros_like(sine)
    rows = ((-cosine, -sine, seen[:, 1]), (sine, -cosine, -seen[:, 0]), (zero, zero, zero - 1.0))
    lever = torch.stack([torch.stack(row, -1) for row in rows], -2)
    return ((lever @ covariance) * lever).sum(-1)


def inverted_spd(matrix: Tensor) -> Tensor:
    """Inverse of small symmetric positive definite matrices ``[*B, n, n]``; exported, in operations that ONNX has too.

    Source: sweep operator (Beaton 1964; Goodnight 1979, doi:10.1080/00031305.1979.10482685).

    Example:
        >>> inverted_spd(torch.tensor([[2.0, 1.0], [1.0, 3.0]]))
        tensor([[ 0.6000, -0.2000],
                [-0.2000,  0.4000]])
    """
    return swept(matrix) if torch.compiler.is_exporting() else torch.linalg.inv_ex(matrix).inverse


def swept(matrix: Tensor) -> Tensor:
    """The same of ``[*B, n, n]``, by sweeps over its columns.

    Source: as :func:`inverted_spd`.

    Example:
        >>> swept(torch.tensor([[2.0, 1.0], [1.0, 3.0]]))
        tensor([[ 0.6000, -0.2000],
                [-0.2000,  0.4000]])
    """
    size = matrix.shape[-1]
    unit = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    for index in range(size):
        column, axis = matrix[..., index], unit[index]
        pivot, others = column[..., index, None, None], (column * (1.0 - axis))[..., None]
        crossed = others * axis
        rest = (1.0 - axis) * (1.0 - axis)[:, None]
        matrix = rest * matrix + (crossed + crossed.mT - others * others.mT - axis[:, None] * axis) / pivot
    return -matrix
