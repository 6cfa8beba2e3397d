"""A memory that knows how far the robot has gone: dead reckoning between what a network says of its place."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from agility_rl.go2 import features
from agility_rl.modules.mlp import mlp
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT

NUM_PLACE = 8
"""Way-point, the next one, and the robot's place at the obstacle (:data:`agility_rl.keys.PLACE`)."""
REACHED = 0.45
"""Distance at which a student's way-point is reached [m] (method notes, section 5.5)."""
GAIN = -1.5
"""Added to the gains' logits: at the start a fifth of what the network says is believed at each decision."""

_ROLL_PITCH = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "roll_pitch")
_ANGULAR = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "angular_velocity")
_LINEAR = features.layout_slice(features.EXPLICIT_LAYOUT, "linear_velocity")


class PlacedMemory(nn.Module):
    r"""Remember, and know the place in metres by a filter whose gains a GRU learns.

    .. math:: \bar p_t &= T_{t - 1/2}^{t}\, p^+_{t - 1}, \qquad
              \tilde p_t = (1 - s_t)\, \bar p_t + s_t\, S \bar p_t, \\
              p_t &= \tilde p_t + k_t \odot (m_t - \tilde p_t), \qquad
              p^+_t = T_{t}^{t + 1/2}\, p_t

    T moves a place by half a decision's motion, as gyroscope, attitude and estimated velocity give it
    (:func:`planar_motion`, :func:`moved`). S puts the next way-point in the first one's place, where that one is
    :func:`reached` or the GRU says so. The gains k and s in (0, 1) and the place m are read from a GRU, which sees the
    image's feature, proprioception and :math:`\bar p_t`. What the feature says by itself, by a linear map (``glance``),
    is added to terrain latent, obstacle and m. For the way-points m is a mean of what was said and of those of the
    likeliest obstacle as they lie from its place (:func:`seen_from`), with shares that the GRU gives (:func:`chosen`).
    Who has seen nothing has a place of zeros, that no robot can have, since sine and cosine are 0.

    Source: ours; prediction and correction are those of a Kalman filter (Kalman 1960, doi:10.1115/1.3662552). Sizes of
    fusion and GRU: method notes, section 5.9.

    Args:
        features: of an image.
        measured: numbers of proprioception.
        hidden_size: units of the GRU.
        num_obstacles: types of obstacles.
        period: of a decision [s].
        way_points: ``[K, W, 2]``, of every type of obstacle, in its frame [m].

    Attributes:
        size: of the memory: units of the GRU, and the place after half a decision more.

    Example:
        >>> memory = PlacedMemory(32, 45, 16, 7, 0.04, torch.zeros(7, 4, 2))
        >>> outputs = memory(torch.zeros(5, 3, 32), torch.zeros(5, 3, 45), torch.zeros(5, 3, 4),
        ...     torch.zeros(5, 3, 24), torch.zeros(5, 3, 1, dtype=torch.bool))
        >>> [tuple(output.shape) for output in outputs]
        [(5, 3, 32), (5, 3, 2), (5, 3, 7), (5, 3, 24), (5, 3, 8)]
    """

    way_points: Tensor

    def __init__(
        self,
        features: int,
        measured: int,
        hidden_size: int,
        num_obstacles: int,
        period: float,
        way_points: Tensor,
    ) -> None:
        super().__init__()
        self.size, self.hidden_size, self.period = hidden_size + NUM_PLACE, hidden_size, period
        self.fusion = mlp(features + measured + NUM_PLACE, (128,), 32)
        self.cell = nn.GRUCell(32, hidden_size)
        self.register_buffer("way_points", way_points, persistent=False)
        shares = 2 * (way_points.shape[1] + 1)
        self.sizes = (NUM_TERRAIN_LATENT + num_obstacles + NUM_PLACE, NUM_PLACE + 1, shares)
        self.head = mlp(hidden_size, (), sum(self.sizes))
        self.glance = mlp(features, (), self.sizes[0])

    def forward(
        self, feature: Tensor, proprioception: Tensor, estimate: Tensor, hidden: Tensor, is_init: Tensor
    ) -> tuple[Tensor, ...]:
        """Steps of ``[T, *B]``: terrain latent, heading errors [rad], obstacle logits, memory after each step, place.

        Of ``hidden`` only the first step's counts; it begins with zeros where ``is_init`` says so.
        """
        state, steps = hidden[0], []
        for measured in zip(feature, proprioception, estimate, is_init, strict=True):
            state = state.masked_fill(measured[-1], 0.0)
            steps.append(self.step(*measured[:-1], state))
            state = steps[-1][3]
        return tuple(torch.stack(outputs) for outputs in zip(*steps, strict=True))

    def step(self, feature: Tensor, proprioception: Tensor, estimate: Tensor, hidden: Tensor) -> tuple[Tensor, ...]:
        """One step of ``[*B]``, with outputs as :meth:`forward`."""
        remembered, place = hidden.split((self.hidden_size, NUM_PLACE), -1)
        motion = 0.5 * self.period * planar_motion(proprioception, estimate)
        place = moved(place, motion)
        fused = self.fusion(torch.cat((feature, proprioception, place.detach()), -1))
        batch = fused.shape[:-1]
        remembered = self.cell(fused.reshape(-1, 32), remembered.reshape(-1, self.hidden_size)).reshape(*batch, -1)
        known, gains, shares = self.head(remembered).split(self.sizes, -1)
        latent, logits, said = (known + self.glance(feature)).tensor_split((NUM_TERRAIN_LATENT, -NUM_PLACE), -1)
        gain, switch = (gains + GAIN).split((NUM_PLACE, 1), -1)
        gain, switch = gain.sigmoid(), (switch + reached(place)).sigmoid()
        place = torch.lerp(place, torch.cat((place[..., 2:4], place[..., 2:]), -1), switch)
        obstacle = torch.lerp(place[..., 4:], said[..., 4:], gain[..., 4:])
        candidates = seen_from(obstacle, self.way_points[logits.argmax(-1)])
        goals = torch.lerp(place[..., :4], chosen(shares, candidates, said[..., :4]), gain[..., :4])
        place = torch.cat((goals, obstacle), -1)
        after = torch.cat((remembered, moved(place, motion)), -1)
        return latent.tanh(), bearings(place), logits, after, place


def seen_from(obstacle: Tensor, points: Tensor) -> Tensor:
    """Points of an obstacle's frame in the frame of a robot there.

    Source: ours; a shift and a turn of the plane.

    Args:
        obstacle: ``[*B, 4]``: x, y [m], sine and cosine of the robot's yaw, in the obstacle's frame.
        points: ``[*B, W, 2]`` [m].

    Returns:
        ``[*B, W, 2]``, ahead and to the left [m].

    Example:
        >>> seen_from(torch.tensor([-2.0, 0.0, 1.0, 0.0]), torch.tensor([[1.0, 0.5]]))  # turned to the left
        tensor([[ 0.5000, -3.0000]])
    """
    x, y = (points - obstacle[..., None, :2]).unbind(-1)
    sine, cosine = obstacle[..., None, 2], obstacle[..., None, 3]
    return torch.stack((cosine * x + sine * y, cosine * y - sine * x), -1)


def chosen(shares: Tensor, candidates: Tensor, said: Tensor) -> Tensor:
    r"""The way-point and the next one, means of candidates and of what was said.

    .. math:: g_i = \sum_w a_{iw} c_w + a_{i, W + 1}\, m_i, \qquad a_i = \mathrm{softmax}(\ell_i)

    Source: ours.

    Args:
        shares: ``[*B, 2 (W + 1)]``, logits; those of what was said come last.
        candidates: ``[*B, W, 2]`` [m].
        said: ``[*B, 4]`` [m].

    Returns:
        ``[*B, 4]`` [m].

    Example:
        >>> candidates, said = torch.tensor([[1.0, 0.0], [2.0, 0.0]]), torch.tensor([0.0, 0.0, 0.0, 7.0])
        >>> chosen(torch.tensor([99.0, 0.0, 0.0, 0.0, 0.0, 99.0]), candidates, said).round(decimals=3)
        tensor([1., 0., 0., 7.])
    """
    weights = shares.unflatten(-1, (2, -1)).softmax(-1)  # [*B, 2, W + 1]
    return (weights[..., :-1] @ candidates + weights[..., -1:] * said.unflatten(-1, (2, 2))).flatten(-2)


def reached(place: Tensor) -> Tensor:
    r"""How much speaks for the next way-point, as a logit.

    .. math:: (0.45 - \| p_{1:2} \|) / 0.04 \quad \text{within} \pm 8

    Source: ours; the radius is that in which a student's way-point is reached (method notes, section 5.5).

    Args:
        place: ``[*B, 8]``.

    Returns:
        ``[*B, 1]``, without gradient.

    Example:
        >>> reached(torch.tensor([0.0, 0.41, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0])).round(decimals=3)
        tensor([1.])
    """
    distance = torch.linalg.vector_norm(place[..., :2].detach(), dim=-1, keepdim=True)
    return ((REACHED - distance) / 0.04).clamp(-8.0, 8.0)


def planar_motion(proprioception: Tensor, estimate: Tensor) -> Tensor:
    r"""Velocity of a robot over the ground, in the frame of its heading.

    .. math:: v_{xy} = (R_y(\theta) R_x(\phi) v)_{xy}, \qquad
              \dot\psi = (\omega_y \sin\phi + \omega_z \cos\phi) / \cos\theta

    Source: kinematics of Euler angles (yaw, pitch, roll); ours.

    Args:
        proprioception: ``[*B, 45]``: roll and pitch [rad], angular velocity in the base frame.
        estimate: ``[*B, 4]``: linear velocity in the base frame (:data:`agility_rl.keys.ESTIMATE`).

    Returns:
        ``[*B, 3]``: forward and to the left [m/s], yaw rate [rad/s].

    Example:
        >>> proprioception, estimate = torch.zeros(45), torch.tensor([0.3, 0.5, 0.0, 0.0])  # 1 m/s forward
        >>> planar_motion(proprioception, estimate)
        tensor([1., 0., 0.])
    """
    roll, pitch = proprioception[..., _ROLL_PITCH].unbind(-1)
    _, rate_y, rate_z = (proprioception[..., _ANGULAR] / features.ANGULAR_VELOCITY_SCALE).unbind(-1)
    x, y, z = (estimate[..., _LINEAR] / features.LINEAR_VELOCITY_SCALE).unbind(-1)
    down = roll.sin() * y + roll.cos() * z
    yaw_rate = (rate_y * roll.sin() + rate_z * roll.cos()) / pitch.cos().clamp(min=0.2)  # nobody walks so steeply
    return torch.stack((pitch.cos() * x + pitch.sin() * down, roll.cos() * y - roll.sin() * z, yaw_rate), -1)


def moved(place: Tensor, motion: Tensor) -> Tensor:
    """A place after the robot has moved: turned and shifted.

    Source: ours; a rotation and a translation of the plane.

    Args:
        place: ``[*B, 8]`` (:data:`agility_rl.keys.PLACE`).
        motion: ``[*B, 3]``: forward and to the left [m], counterclockwise [rad].

    Example:
        >>> ahead = torch.tensor([2.0, 0.0, 3.0, 1.0, -2.0, 0.0, 0.0, 1.0])  # 2 m before an obstacle, on its axis
        >>> moved(ahead, torch.tensor([0.5, 0.0, 0.0]))
        tensor([ 1.5000,  0.0000,  2.5000,  1.0000, -1.5000,  0.0000,  0.0000,  1.0000])
    """
    forward, left, turn = motion.unbind(-1)
    x, y, next_x, next_y, at, aside, sine, cosine = place.unbind(-1)
    cos, sin = turn.cos(), turn.sin()

    def turned(ahead: Tensor, beside: Tensor) -> tuple[Tensor, Tensor]:
        ahead, beside = ahead - forward, beside - left
        return cos * ahead + sin * beside, cos * beside - sin * ahead

    return torch.stack(
        (
            *turned(x, y),
            *turned(next_x, next_y),
            *(at + cosine * forward - sine * left, aside + sine * forward + cosine * left),
            *(sine * cos + cosine * sin, cosine * cos - sine * sin),
        ),
        -1,
    )


def bearings(place: Tensor) -> Tensor:
    """Heading errors to the way-points of a place ``[*B, 8]``, ``[*B, 2]`` [rad]; without gradient.

    Source: definition of the heading error (method notes, section 5.5).

    Example:
        >>> bearings(torch.tensor([1.0, 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
        tensor([0.7854, 0.0000])
    """
    place = place.detach()
    return torch.atan2(place[..., 1:4:2], place[..., 0:3:2])
