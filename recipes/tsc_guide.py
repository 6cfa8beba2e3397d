"""A guide that knows where robots stand: it leads them onto the axis of the obstacle ahead, and over it.

What a handler does with a young dog. A teacher may copy it before it learns by itself (``--cloning.script guide``), and
``evaluate_course.py --script guide`` shows how far a controller gets that is led as well as geometry can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import behaviours, keys, rotations
from agility_rl.behaviours import FASTEST_CANTER, command_bounds, skill_index
from agility_rl.envs.decisions import NUM_PARAMETERS
from agility_rl.envs.obstacles import OBSTACLES, POLE_SPACING
from agility_rl.tensors import constant


@dataclass(frozen=True)
class Passage:
    """How an obstacle is passed.

    Attributes:
        start: local x before which the robot must be on the axis [m].
        behaviour: shown on the obstacle.
        speed: there [m/s].
        tolerance: how far aside it may begin [m].
        run_up: metres before :attr:`start` where :attr:`behaviour` begins.
        beside: how far beside the axis it begins, to the right [m].
    """

    start: float
    behaviour: str = "pace"
    speed: float = 1.0
    tolerance: float = 0.12
    run_up: float = 0.0
    beside: float = 0.0


SWAY = 0.7
"""Distance beside a pole that it heads for [m]; it comes to about half of that, for it heads for the next one early."""
PASSAGES: dict[str, Passage] = {
    "bar_jump": Passage(-0.5, "canter", 1.6, 0.3, 1.6),
    "a_frame": Passage(-1.5, speed=1.1),
    "weave_poles": Passage(-1.5, "trot", 0.5, beside=0.4),
    "seesaw": Passage(-1.5, speed=0.9),
    "tire_jump": Passage(-0.5, "canter", 1.6, 0.15, 1.6),
    "tunnel": Passage(-1.1, "trot", 0.7, run_up=0.3),
    "box_jump": Passage(-0.8, "jump", 1.4, 0.4, 0.6),
}
LEAPS: dict[str, Passage] = {
    **PASSAGES,
    "bar_jump": Passage(-1.25, "jump", 1.8, 0.3),
    "tire_jump": Passage(-1.25, "jump", 1.8, 0.15),
    "box_jump": Passage(-1.75, "jump", 1.7, 0.3),
}
"""Over hurdles and onto boxes by a leap out of a trot, for controllers whose jump passes them (docs/agility.md,
"A guide, and leaps")."""
USUAL = "trot"
"""Behaviour between obstacles."""
CRUISE, SLOW = 1.0, 0.5
"""Speed between obstacles, and in turns [m/s]."""
LOOK_AHEAD, LEAST_LOOK_AHEAD = 0.9, 0.35
"""Distance of the point on the axis that it heads for [m], far from the obstacle and close to it."""
BESIDE, MISSED, ROOM = 0.5, 0.3, 0.7
"""Who is farther beside the axis, or farther beyond a way-point before the obstacle, heads for that, at least so far
before the obstacle [m]."""
FORESIGHT = 0.2
"""So far before a pole it heads for the next [m], since a robot turns late."""
CLEAR, PAST = 0.34, 0.1
"""Its middle stays so far beside a pole [m] until it is so far past it [m]."""
STEERING = 2.5
"""Turn rate that is commanded for each radian of heading error [1/s]."""
SIDEWAYS = 1.0
"""Sideways speed for each metre beside the axis [1/s]."""
LANDED = 0.13
"""So far behind the middle of a hurdle a sprint begins [m]: a leap's forefeet come down, and its speed is not lost
yet. Later, robots are slower by 0.1 m/s in the end."""
SPRINT, SPURT = 3.1, 0.7
"""What a sprint commands where it begins [m/s], and how much more with every metre [1/s], as far as canters go: a
controller that is told to go 1 m/s faster than it goes speeds up, one that is told much more stumbles."""
SPRINT_STEERING = 2.0
"""Turn rate of a sprint for each radian of heading error [1/s]."""
ALIGNED = 0.25
"""Heading error up to which it runs as fast as it may [rad]."""


class Guide:
    """Decisions from ``keys.PLACE`` and the type of the obstacle; deterministic, without memory.

    Args:
        passages: of every type of obstacle.
        fastest_canter: what the canter's range ends at where its decisions go [m/s].

    Attributes:
        complete: it says something before every obstacle.
        behaviours: those that it chooses.

    Example:
        >>> place = torch.tensor([[1.0, 0.0, 2.0, 0.0, -3.0, 0.0, 0.0, 1.0]])  # on the axis, 3 m before the middle
        >>> td = TensorDict({"place": place, "obstacle": torch.eye(7)[1:2]}, [1])  # of an A-frame
        >>> Guide().decide(td)["action", "behaviour"]
        tensor([2])
    """

    complete = True

    def __init__(self, passages: Mapping[str, Passage] = PASSAGES, fastest_canter: float = FASTEST_CANTER) -> None:
        command_bounds(fastest_canter=fastest_canter)  # whoever gives an impossible one hears it at once
        self._fastest_canter = fastest_canter
        self.behaviours = tuple(sorted({USUAL, *(passage.behaviour for passage in passages.values())}))
        ordered = [passages[name] for name in OBSTACLES]
        self._figures = tuple((p.start, p.speed, p.tolerance, p.run_up, p.beside) for p in ordered)
        self._skill = tuple(skill_index(p.behaviour) for p in ordered)

    def decide(self, td: TensorDictBase) -> TensorDictBase:
        """Decisions of ``N`` robots under ``action``.

        Source: ours; heading for a point ahead on a line is pure pursuit (Coulter 1992, CMU-RI-TR-92-01).

        Args:
            td: ``place`` [N, 8] [m] and ``obstacle`` [N, 7] (:mod:`agility_rl.keys`).
        """
        kind, place = td[keys.OBSTACLE].argmax(-1), td[keys.PLACE]
        start, speed, tolerance, run_up, beside = constant(self._figures, place.device)[kind].unbind(-1)
        ahead, aside = place[:, :2].unbind(-1)  # of the way-point, in the robot's frame
        x, y, sine, cosine = place[:, 4:].unbind(-1)
        goal_x = x + cosine * ahead - sine * aside
        heading, left = torch.atan2(sine, cosine), start - x  # ``left``: way that is left to come onto the axis
        line = torch.where(x > 0.0, beside, -beside)  # poles: begun on their right side, left on their left
        off = y - line
        coming = goal_x < start + 0.1  # the next way-point lies before the obstacle, not on it
        far = coming & ((off.abs() > BESIDE) | (x > goal_x + MISSED))
        aim = x + (0.6 * left).clamp(LEAST_LOOK_AHEAD, LOOK_AHEAD)
        before = torch.minimum(goal_x, start - ROOM)
        wanted = torch.where(far, torch.atan2(line - y, before - x), torch.atan2(-off, aim - x))
        weaving = (beside > 0.0) & ~coming & (x < -start)  # the poles end where they began, mirrored
        wanted = torch.where(weaving, self._to_next_pole(x, y), wanted)
        error = rotations.wrap_angle(wanted - heading)
        on_line = (off.abs() < tolerance) & (error.abs() < ALIGNED)
        passing = weaving | ((left < 0.0) & ~far) | ((left < run_up) & on_line)
        skill = torch.where(passing, constant(self._skill, place.device, torch.int64)[kind], skill_index(USUAL))
        calm = torch.exp(-((error.abs() - ALIGNED).clamp(min=0.0) / 0.4).square())
        late = torch.where(off.abs() > tolerance, (left / 0.8).clamp(0.0, 1.0), 1.0)  # beside the axis: slowly
        cruise = torch.where(run_up > 0.0, CRUISE, (speed + left.clamp(min=0.0)).clamp(max=CRUISE))
        forward = torch.where(passing, speed, SLOW + (cruise - SLOW) * calm * late)
        sideways = -SIDEWAYS * off * ((error.abs() < 2 * ALIGNED) & ~weaving)
        return td.set(keys.ACTION, _decision(skill, forward, sideways, STEERING * error, self._fastest_canter))

    @staticmethod
    def _to_next_pole(x: Tensor, y: Tensor) -> Tensor:
        """Heading [rad] to where the next pole is passed; the first on the right, the second on the left, and so on."""
        place = x / POLE_SPACING + 1.5  # 0 beside the first pole, 1 beside the second
        following, beside = (place + FORESIGHT).floor().add(1).clamp(0, 3), place.round().clamp(0, 3)
        along = (following - 1.5) * POLE_SPACING - x
        wanted = torch.atan2(_side(following) * SWAY - y, along.clamp(min=LEAST_LOOK_AHEAD))
        rest = (beside - 1.5) * POLE_SPACING + PAST - x
        side = _side(beside)  # not across before the pole is behind
        least = torch.atan2(side * CLEAR - y, rest.clamp(min=0.05))
        return torch.where(rest > 0.0, side * torch.maximum(side * wanted, side * least), wanted)


class Sprint:
    """Runs off behind an obstacle, in a canter that is told to go faster and faster; before and on it, it says nothing.

    A teacher that passes the obstacle decides the rest (``--cloning.script sprint`` with ``--init-from``).

    Args:
        fastest_canter: what the canter's range ends at where its decisions go [m/s].

    Attributes:
        complete: it does not say something everywhere.
        behaviours: those that it chooses.

    Example:
        >>> place = torch.tensor([[0.5, 0.0, 2.0, 0.0, x, 0.0, 0.0, 1.0] for x in (-0.2, 0.4)])
        >>> td = TensorDict({"place": place, "heading_error": torch.zeros(2, 2)}, [2])
        >>> Sprint().decide(td)["action", "behaviour"]
        tensor([-1,  3])
    """

    complete = False
    behaviours = ("canter",)

    def __init__(self, fastest_canter: float = FASTEST_CANTER) -> None:
        command_bounds(fastest_canter=fastest_canter)  # whoever gives an impossible one hears it at once
        self._fastest_canter = fastest_canter

    def decide(self, td: TensorDictBase) -> TensorDictBase:
        """Decisions of ``N`` robots under ``action``; the behaviour is -1 where it says nothing.

        Source: ours.

        Args:
            td: ``place`` [N, 8] [m] and ``heading_error`` [N, 2] [rad] (:mod:`agility_rl.keys`).
        """
        beyond, error = td[keys.PLACE][:, 4], td[keys.HEADING_ERROR][:, 0]
        skill = torch.where(beyond > LANDED, skill_index("canter"), -1)
        forward = SPRINT + SPURT * (beyond - LANDED)
        sideways = torch.zeros_like(beyond)
        return td.set(keys.ACTION, _decision(skill, forward, sideways, SPRINT_STEERING * error, self._fastest_canter))


def _decision(skill: Tensor, speed: Tensor, sideways: Tensor, turn: Tensor, fastest_canter: float) -> TensorDict:
    """Parameters of all behaviours that come as near to speeds [m/s] and turn rates [rad/s] as their ranges allow."""
    low, high = command_bounds(skill.device, fastest_canter)
    parameters = torch.zeros(len(skill), behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS, device=skill.device)
    for index, value in enumerate((speed, sideways, turn)):
        span = (high - low)[:, index]
        parameters[..., index] = (2.0 * (value[:, None] - low[:, index]) / span - 1.0).clamp(-1.0, 1.0)
    parameters[:, behaviours.JUMP, behaviours.COMMANDS.index("jump_height")] = 1.0  # as high as may be commanded
    return TensorDict({keys.BEHAVIOUR: skill, keys.PARAMETERS: parameters}, [len(skill)])


def _side(pole: Tensor) -> Tensor:
    """1 where a pole is passed on the left, -1 on the right."""
    return torch.where(pole % 2 == 0, -1.0, 1.0)
