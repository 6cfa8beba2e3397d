"""A memory that knows where the robot stands: dead reckoning, corrected by what images say."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from agility_rl.go2.camera import LATENCY
from agility_rl.modules.distance_field import Solid
from agility_rl.modules.glance import NUM_POSE, NUM_SCALES, Glance
from agility_rl.modules.kalman import corrected, doubted
from agility_rl.modules.mlp import mlp
from agility_rl.modules.planar import (
    bearings,
    inverse,
    inverted,
    moved,
    planar_motion,
    seen_earlier,
    seen_from,
    within,
)
from agility_rl.modules.preview import Preview, preview_parts
from agility_rl.modules.scan_matching import NOTHING, NUM_MATCH, ScanMatcher
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT
from agility_rl.modules.stock import ANY, noted, remaining
from agility_rl.modules.way_points import reached, shifted, to_come, told_of

NUM_PLACE = 8
"""Way-point, the next one, and the robot's place at the obstacle (:data:`agility_rl.keys.PLACE`)."""
DRIFT = (0.05**2, 0.05**2, 0.01**2)
"""Variance that counting the way adds in a second: ahead, aside [m^2], yaw [rad^2]; measured (docs/student.md)."""
START = (0.15**2, 0.45**2, 0.2**2)
"""Variance where an episode starts, 2 m before an obstacle and up to 0.4 rad turned: that of the draw, twice as wide as
the released one (method notes, section 5.7)."""
ALIKE = 3.2
"""Logarithm of how many images in a row count as one at the start: their errors are alike."""
CREDIT = -4.0
"""Added to the logit of the evidence's share: at the start a second of images, much alike, counts as half of one."""
LEAVING = 0.6
"""So far before its last way-point an obstacle may have been left [m]."""
DOUBT = 1e-3
"""Share of the belief in a way-point that goes to each neighbour, so that what is seen later can speak for that."""
CERTAIN = 8.0
"""Logit of the way-point where an episode starts."""


def memory_parts(hidden_size: int, legs: int, points: int, types: int) -> tuple[int, int, int, int, int, int]:
    """Numbers of the memory: of the GRU, the pose, its uncertainty, the way-points that it may be on the way to,
    what is known of the next obstacle, and of which types those were that it has met.

    Example:
        >>> memory_parts(256, legs=6, points=4, types=7)
        (256, 4, 3, 24, 21, 42)
    """
    return hidden_size, NUM_POSE, NUM_SCALES, legs * points, sum(preview_parts(types)), legs * types


class PlacedMemory(nn.Module):
    r"""Remember, and know the place in metres: dead reckoning, corrected by a Kalman filter by what images say.

    .. math:: \bar p_t &= T_{t - 1/2}^{t}\, p^+_{t - 1}, \qquad \bar P_t = P_{t - 1} + Q, \qquad
              p^+_t = T_{t}^{t + 1/2}\, p_t \\
              \bar b_t &= \left(b_{t - 1} + (N - 1)\, \lambda_t \odot b_{t - 1}\right) D, \qquad
              b_t \propto \bar b_t \odot \exp(\kappa_t\, e_t)

    p is the robot's pose in the arena, P the variance of its numbers. T moves it by half a decision's motion, as
    gyroscope, attitude and estimated velocity give it (:func:`~agility_rl.modules.planar.planar_motion`,
    :func:`~agility_rl.modules.planar.moved`); Q is what that adds in uncertainty. A
    :class:`~agility_rl.modules.glance.Glance` says where the obstacle ahead is seen and how sure that is, by which the
    pose is :func:`~agility_rl.modules.kalman.corrected`; then by where the shape of that type of obstacle fits what the
    image measures, as far as it is in view (:class:`~agility_rl.modules.scan_matching.ScanMatcher`), the less the more
    that surprises (:func:`~agility_rl.modules.kalman.doubted`). A GRU, which sees
    the feature, proprioception, what is expected of the place, and b, says how many images in a row count as one, and
    adds to what the glance says of terrain latent, obstacle and e.

    The course is known but for its jitter and the order of its obstacles. b is the belief of a hidden Markov model in
    the way-point that is the present one, of all obstacles of all routes: N goes on to the next one, :math:`\lambda`
    says of each whether it is :func:`~agility_rl.modules.way_points.reached`, back again where the one before is
    :func:`~agility_rl.modules.way_points.to_come`, D leaves some doubt for its neighbours, and the evidence e counts by
    a share :math:`\kappa`, since images in a row are much alike, and for no obstacle where the robot cannot be
    (:func:`~agility_rl.modules.way_points.told_of`). The likeliest way-point says which obstacle the pose is
    seen from and corrected by, as if that stood where it should; and a :class:`~agility_rl.modules.preview.Preview`,
    where from there the next one stands, and of which type it is, as far as it has been in view when that becomes the
    present one. Types of which none is left, since they were met elsewhere, are unlikely beforehand
    (:func:`~agility_rl.modules.stock.remaining`). The place then is where the way-points of that type of obstacle lie
    from there (:func:`~agility_rl.modules.planar.seen_from`). Who has seen nothing stands before the first obstacle.

    Source: ours; prediction and correction are those of a Kalman filter (Kalman 1960, doi:10.1115/1.3662552) and of a
    hidden Markov model's forward algorithm (Rabiner 1989, doi:10.1109/5.18626, Eq. 19 and 20). Sizes of fusion and GRU:
    method notes, section 5.9.

    Args:
        features: of an image.
        measured: numbers of proprioception.
        hidden_size: units of the GRU.
        num_obstacles: types of obstacles.
        period: of a decision [s].
        way_points: ``[K, W, 2]``, of every type of obstacle, in its frame [m].
        routes: of every route of the course, where its obstacles stand in the arena: x, y [m], yaw [rad]
            (:attr:`agility_rl.envs.Course.legs`).
        glance_hidden: units of the glance's hidden layers.
        solids: ``[K][...]``, what every type of obstacle is made of; without, nothing is matched.
        stock: ``[K]``, how many obstacles of every type the course has; without, each may be of any.

    Attributes:
        size: of the memory: units of the GRU, the pose half a decision later, the variances of x, y and yaw, the
            belief in L x W way-points as logits, these three less what they are before the first obstacle, what is
            known of the next obstacle, and of which type that of each of the L slots was.

    Example:
        >>> memory = PlacedMemory(32, 45, 16, 7, 0.04, torch.zeros(7, 4, 2), [[(2.0, 3.0, 1.57), (2.0, 7.0, 1.57)]])
        >>> outputs = memory(torch.zeros(5, 3, 32), torch.zeros(5, 3, 45), torch.zeros(5, 3, 4),
        ...     torch.zeros(5, 3, 58, 87), torch.full((5, 3, 1), 0.02), torch.zeros(5, 3, memory.size),
        ...     torch.zeros(5, 3, 1, dtype=torch.bool))
        >>> [tuple(output.shape) for output in outputs]
        [(5, 3, 32), (5, 3, 2), (5, 3, 7), (5, 3, 66), (5, 3, 8), (5, 3, 8), (5, 3, 21)]
    """

    way_points: Tensor
    legs: Tensor
    arena: Tensor
    following: Tensor
    earlier: Tensor
    next_leg: Tensor
    doubt: Tensor
    prior: Tensor
    starts: Tensor
    drift: Tensor
    uncertain: Tensor
    stock: Tensor

    def __init__(
        self,
        features: int,
        measured: int,
        hidden_size: int,
        num_obstacles: int,
        period: float,
        way_points: Tensor,
        routes: Sequence[Sequence[Sequence[float]]] = (((0.0, 0.0, 0.0),),),
        glance_hidden: Sequence[int] = (128,),
        solids: Sequence[Sequence[Solid]] = (),
        stock: Sequence[int] = (),
    ) -> None:
        super().__init__()
        legs, points = sum(map(len, routes)), way_points.shape[1]
        count = legs * points
        ends = [points * sum(map(len, routes[: index + 1])) - 1 for index in range(len(routes))]
        firsts = [index == 0 or index - 1 in ends for index in range(count)]
        following = torch.tensor([index if index in ends else index + 1 for index in range(count)])
        preceding = torch.tensor([index if firsts[index] else index - 1 for index in range(count)])
        earlier = torch.tensor([index - (index % points > 0) for index in range(count)])
        self.hidden_size, self.period, self.points, self.types = hidden_size, period, points, num_obstacles
        self.preview = Preview(num_obstacles)
        self.parts = memory_parts(hidden_size, legs, points, num_obstacles)
        self.size = sum(self.parts)
        self.said = NUM_MATCH + self.preview.said
        self.fusion = mlp(features + measured + NUM_POSE + legs + points, (128,), 32)
        self.cell = nn.GRUCell(32, hidden_size)
        self.known = (NUM_TERRAIN_LATENT, num_obstacles, count)
        self.head = mlp(hidden_size, (), sum(self.known) + NUM_SCALES + 1)
        self.glance = Glance(features, self.known, legs, glance_hidden)
        self.matcher = ScanMatcher(solids) if solids else None

        stay, frames = torch.eye(count), torch.tensor([leg for route in routes for leg in route])
        before = torch.cat((way_points[:, 0].mean(0), torch.tensor([0.0, 1.0])))
        constants = {
            "way_points": way_points,
            "legs": frames,
            "arena": inverse(frames),
            "following": following,
            "earlier": earlier,
            "next_leg": following[points - 1 :: points] // points,
            "doubt": (1.0 - 2.0 * DOUBT) * stay + DOUBT * (stay[following] + stay[preceding]),
            "prior": CERTAIN * torch.tensor(firsts).float(),
            "starts": within(before, inverse(frames)),
            "drift": period * torch.tensor(DRIFT),
            "uncertain": torch.tensor(START),
            "stock": torch.tensor(stock or [ANY] * num_obstacles, dtype=frames.dtype),
        }
        for name, value in constants.items():
            self.register_buffer(name, value, persistent=False)

    def forward(
        self,
        feature: Tensor,
        proprioception: Tensor,
        estimate: Tensor,
        look: Tensor,
        age: Tensor,
        hidden: Tensor,
        is_init: Tensor,
        start: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Steps of ``[T, *B]``: latent, heading errors [rad], obstacle logits, memory after, place, progress, matches.

        Progress are log-probabilities. ``look`` is an image ``[58, 87]``, or what came of it: the match of the present
        obstacle, that of the next one, and what speaks for its types; ``age`` ``[1]`` is how old the image is [s].
        Of ``hidden`` only the first step's counts; it begins as :meth:`begun` does.
        """
        state, steps = hidden[0], []
        for time, measured in enumerate(zip(feature, proprioception, estimate, look, age, strict=True)):
            state = self.begun(state, is_init[time], None if start is None else start[time])
            steps.append(self.step(*measured, state))
            state = steps[-1][3]
        return tuple(torch.stack(outputs) for outputs in zip(*steps, strict=True))

    def begun(self, hidden: Tensor, is_init: Tensor, start: Tensor | None = None) -> Tensor:
        """Memory ``[*B, M]``, empty where a bool mask ``[*B, 1]`` says that an episode begins.

        It begins before the first obstacle, or with the way-point ``start``, one-hot ``[*B, L W]``.
        """
        if start is None:
            return hidden.masked_fill(is_init, 0.0)
        sizes = (self.hidden_size, NUM_SCALES, sum(self.parts[4:]))
        empty, unsure, unseen = (hidden.new_zeros(*hidden.shape[:-1], size) for size in sizes)
        pose = self._marginals(start)[0] @ self.starts - self.starts[0]
        return torch.where(
            is_init,
            torch.cat((empty, pose, unsure, CERTAIN * start - self.prior, unseen), -1),
            hidden,
        )

    def step(
        self, feature: Tensor, proprioception: Tensor, estimate: Tensor, look: Tensor, age: Tensor, hidden: Tensor
    ) -> tuple[Tensor, ...]:
        """One step of ``[*B]``, with outputs as :meth:`forward`."""
        remembered, pose, variance, belief, coming, met = hidden.split(self.parts, -1)
        met = met.unflatten(-1, (-1, self.types))
        belief = (belief + self.prior).softmax(-1)
        variance = (variance + self.uncertain).clamp(min=0.0) + self.drift
        velocity = planar_motion(proprioception, estimate)
        motion = 0.5 * self.period * velocity
        pose = moved(pose + self.starts[0], motion)
        at = within(pose, self.legs)  # at the obstacle of every leg
        before = belief.argmax(-1) // self.points
        expected = torch.cat((of_leg(at, before), *self._marginals(belief)), -1)
        remembered = self._remember(torch.cat((feature, proprioception, expected.detach()), -1), remembered)
        known, alike, weight = self.head(remembered).split((sum(self.known), NUM_SCALES, 1), -1)
        latent, seems, evidence = (known + self.glance.what(feature)).split(self.known, -1)
        points = self._way_points(seems + self.preview.hints(coming)[1] + remaining(met, before, self.stock))

        offset = points[..., None, :, :] - at[..., None, :2]
        belief = shifted(belief, reached(offset).flatten(-2), self.following)
        belief = shifted(belief, to_come(offset).flatten(-2)[..., self.earlier], self.earlier)
        belief = (belief @ self.doubt).clamp(min=1e-30)
        told = told_of(belief, (weight + CREDIT).sigmoid() * evidence, self._possible(belief, at, points))
        progress = told.flatten(-2)
        now = progress.argmax(-1)
        leg = now // self.points
        changed, onwards = (leg != before)[..., None], (leg == self.next_leg[before])[..., None]
        variance = torch.where(changed, variance + self.preview.variance(coming), variance)
        local = of_leg(at, leg)
        ahead = inverted(torch.where(changed & onwards, self.preview.place(coming, local), local))
        coming = torch.where(changed, self.preview.arrived(coming, onwards), coming)
        logits = seems + self.preview.hints(coming)[1] + remaining(met, leg, self.stock)
        met = noted(met, leg, logits)
        likely = remaining(met, self.next_leg[leg], self.stock)
        said, scale = self.glance.where(feature, ahead, leg, seen_earlier(ahead, (age - LATENCY) * velocity))
        ahead, variance = corrected(ahead, variance, said, 2.0 * (2.0 * scale + alike + ALIKE).exp())
        measured = look, proprioception, estimate, age
        match = self._match(*measured, ahead, logits.argmax(-1))
        fits, unsure = match.split((NUM_POSE, NUM_SCALES), -1)
        ahead, variance = corrected(ahead, variance, fits, doubted(ahead, variance, fits, unsure))
        obstacle = inverted(ahead)
        pose = of_leg(within(obstacle, self.arena), leg)
        slot = of_leg(within(pose, self.legs), self.next_leg[leg]).detach()
        sight = self._sight(*measured, coming, slot, likely, self.next_leg[leg] != leg)
        coming = self.preview.told(coming, slot, sight)
        entry = self._way_points(self.preview.hints(coming)[0] + likely)[..., :1, :]
        entered = seen_from(self.preview.place(coming, slot), entry)
        place = torch.cat((self._goals(now, obstacle, self._way_points(logits), entered), obstacle), -1)
        pose = moved(pose, motion) - self.starts[0]
        after = (remembered, pose, variance - self.uncertain, progress - self.prior, coming, met.flatten(-2))
        said = torch.cat((match, sight), -1)
        return latent.tanh(), bearings(place), logits, torch.cat(after, -1), place, progress, said

    def _match(
        self, look: Tensor, proprioception: Tensor, estimate: Tensor, age: Tensor, expected: Tensor, kind: Tensor
    ) -> Tensor:
        """What the shape of an obstacle says of where it stands, ``[*B, 7]``."""
        if look.shape[-1] == self.said:
            return look[..., :NUM_MATCH]
        if self.matcher is None:
            return torch.cat((expected, torch.full_like(expected[..., :NUM_SCALES], NOTHING)), -1).detach()
        rows = (part.reshape(-1, part.shape[-1]) for part in (proprioception, estimate, age, expected))
        match: Tensor = self.matcher(look.reshape(-1, *look.shape[-2:]), *rows, kind.reshape(-1))
        return match.reshape(*expected.shape[:-1], NUM_MATCH)

    def _sight(
        self,
        look: Tensor,
        proprioception: Tensor,
        estimate: Tensor,
        age: Tensor,
        coming: Tensor,
        slot: Tensor,
        likely: Tensor,
        is_next: Tensor,
    ) -> Tensor:
        """What shapes say of the next obstacle, ``[*B, 7 + K]``."""
        if look.shape[-1] == self.said:
            return look[..., NUM_MATCH:]
        if self.matcher is None:
            return self.preview.silence(coming, slot)
        images, going = look.reshape(-1, *look.shape[-2:]), is_next.reshape(-1)
        rows = (part.reshape(-1, part.shape[-1]) for part in (proprioception, estimate, age, coming, slot, likely))
        sight = self.preview.look(self.matcher, going, images, *rows)
        return sight.reshape(*slot.shape[:-1], -1)

    def _remember(self, inputs: Tensor, remembered: Tensor) -> Tensor:
        fused = self.fusion(inputs)
        cells = self.cell(fused.reshape(-1, fused.shape[-1]), remembered.reshape(-1, self.hidden_size))
        return cells.reshape(remembered.shape)

    def _way_points(self, logits: Tensor) -> Tensor:
        """Way-points of an obstacle in its frame ``[*B, W, 2]``, by the types that it may be."""
        return torch.einsum("...k,kwc->...wc", logits.detach().softmax(-1), self.way_points)

    def _goals(self, now: Tensor, obstacle: Tensor, points: Tensor, entered: Tensor) -> Tensor:
        """The way-point ``now`` and the one after it, seen from the robot: ``[*B, 4]``.

        After the last way-point of an obstacle comes where the next one is entered, ``[*B, 1, 2]``.
        """
        following = self.following[now]
        candidates = torch.cat((seen_from(obstacle, points), entered), -2)
        first = now % self.points
        second = torch.where(following == now, first, first + 1)
        return candidates.take_along_dim(torch.stack((first, second), -1)[..., None], -2).flatten(-2)

    def _possible(self, belief: Tensor, at: Tensor, points: Tensor) -> Tensor:
        """At which obstacles robots may be that have counted their way so far, bool ``[*B, L]``.

        At the likeliest; at the next one if that is about to be left; at the one before as long as no way-point of
        the likeliest is reached.
        """
        now = belief.argmax(-1)
        leg = (now // self.points)[..., None]
        legs = torch.arange(len(self.next_leg), device=belief.device)
        left = of_leg(at, leg[..., 0])[..., :1] > points[..., -1, :1] - LEAVING
        first = (now % self.points == 0)[..., None]
        return (legs == leg) | ((legs == self.next_leg[leg]) & left) | ((self.next_leg == leg) & first)

    def _marginals(self, belief: Tensor) -> tuple[Tensor, Tensor]:
        """Of legs ``[*B, L]``, and of how many way-points of an obstacle are reached ``[*B, W]``."""
        belief = belief.unflatten(-1, (-1, self.points))
        return belief.sum(-1), belief.sum(-2)


def of_leg(poses: Tensor, leg: Tensor) -> Tensor:
    """Of poses ``[*B, L, 4]`` that of a leg each, int64 ``[*B]``: ``[*B, 4]``."""
    return poses.take_along_dim(leg[..., None, None], -2)[..., 0, :]
