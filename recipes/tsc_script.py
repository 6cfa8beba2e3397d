"""A script that decides on a course: for each obstacle a behaviour and a speed, turned towards the way-point.

The baseline that a teacher has to beat, and what a teacher may copy before it learns by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tsc_guide import LEAPS, PASSAGES, Guide, Sprint

from agility_rl import behaviours, keys
from agility_rl.envs.decisions import NUM_PARAMETERS
from agility_rl.envs.obstacles import OBSTACLES

STEERING = 2.0
"""Turn rate that is commanded for each radian of heading error [1/s]."""
OWN = "own"
"""In place of a decision: the teacher decides as it did before, and the script says nothing."""
ASIDE = 0.5
"""Heading error from which the second decision of ``FIRST/SECOND`` holds [rad]."""
TURN = behaviours.COMMANDS.index("yaw_rate")


GUIDES: dict[str, Callable[[float], Guide | Sprint]] = {
    "guide": partial(Guide, PASSAGES),
    "leap": partial(Guide, LEAPS),
    "sprint": Sprint,
}
"""In place of a script or a decision, by the fastest canter [m/s]: :class:`Guide`, which knows where robots stand;
``leap`` leaps over hurdles; :class:`Sprint` decides behind an obstacle only."""


def read(
    text: str, option: str = "--script", fastest_canter: float = behaviours.FASTEST_CANTER
) -> Script | Guide | Sprint:
    """What leads robots: one of :data:`GUIDES`, or a script (:meth:`Script.parse`).

    Raises:
        ValueError: if it is neither, or there is no such canter.
    """
    if text in GUIDES:
        return GUIDES[text](fastest_canter)
    return Script.parse(text, option, fastest_canter)


@dataclass(frozen=True)
class Script:
    """A behaviour and a speed for each type of obstacle, straight ahead and while the way-point is aside.

    Attributes:
        skill: int64 ``[2, 7]``, behaviour before each of :data:`OBSTACLES`; -1 where it says nothing. The second row
            holds while the way-point is more than :data:`ASIDE` off the heading.
        parameters: ``[2, 7, 5, 6]``, forward speed of the chosen behaviour, everything else in the middle of its range.
        guides: who decides before an obstacle in place of these, by its name.
    """

    skill: Tensor
    parameters: Tensor
    guides: dict[str, Guide | Sprint] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str, option: str = "--script", fastest_canter: float = behaviours.FASTEST_CANTER) -> Script:
        """Read ``BEHAVIOUR:SPEED``, speed in m/s, and after commas what differs, ``OBSTACLE=BEHAVIOUR:SPEED``.

        ``FIRST/SECOND`` in place of a decision turns by the second towards way-points that are far aside, as a canter
        cannot. ``own`` in place of a decision says nothing, ``OBSTACLE=guide`` or ``OBSTACLE=leap`` asks a guide.

        Raises:
            ValueError: if it is no such text, there is no such obstacle, or the behaviour has no such speed.
        """
        bounds = behaviours.command_bounds(fastest_canter=fastest_canter)

        def pair(decision: str) -> tuple[tuple[int, float], tuple[int, float]]:
            """What to do straight ahead, and while the way-point is aside."""
            first, slash, second = decision.partition("/")
            ahead = _read(first, text, option, bounds)
            return ahead, _read(second, text, option, bounds) if slash else ahead

        usual, *others = text.split(",")
        chosen, guides = dict.fromkeys(OBSTACLES, pair(usual)), {}
        for other in others:
            name, _, decision = other.partition("=")
            if name not in OBSTACLES:
                raise ValueError(f"{option}: unknown obstacle {name!r} in {text!r}, expected {', '.join(OBSTACLES)}")
            if decision in GUIDES:
                guides[name] = GUIDES[decision](fastest_canter)
            else:
                chosen[name] = pair(decision)
        skill = torch.tensor([[skill for skill, _ in told] for told in chosen.values()]).T
        parameters = torch.zeros(2, len(OBSTACLES), behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS)
        for row, told in enumerate(chosen.values()):
            for case, (index, speed) in enumerate(told):
                if index >= 0:
                    parameters[case, row, index, 0] = speed
        return cls(skill, parameters, guides)

    @property
    def behaviours(self) -> tuple[str, ...]:
        """Those that it chooses."""
        own = {behaviours.BEHAVIOURS[index] for index in self.skill.unique().tolist() if index >= 0}
        own.update(*(guide.behaviours for guide in self.guides.values()))
        return tuple(name for name in behaviours.BEHAVIOURS if name in own)

    @property
    def complete(self) -> bool:
        """Whether it says something before every obstacle."""
        told = {name: guide.complete for name, guide in self.guides.items()}
        spoken = (self.skill >= 0).all(0).tolist()
        return all(told.get(name, own) for name, own in zip(OBSTACLES, spoken, strict=True))

    def decide(self, td: TensorDictBase) -> TensorDictBase:
        """Decisions of ``N`` robots under ``action``; each behaviour's turn rate leads to the way-point. Where it says
        nothing, the behaviour is -1."""
        kind, error = td[keys.OBSTACLE].argmax(-1), td[keys.HEADING_ERROR][:, :1]
        case = (error[:, 0].abs() > ASIDE).long()
        _, fastest = behaviours.command_bounds(kind.device)
        parameters = self.parameters.to(kind.device)[case, kind]
        parameters[..., TURN] = (STEERING * error / fastest[:, TURN]).clamp(-1.0, 1.0)
        skill = self.skill.to(kind.device)[case, kind]
        for name, guide in self.guides.items():
            rows = kind == list(OBSTACLES).index(name)
            told = guide.decide(td[rows])[keys.ACTION]
            skill, parameters[rows] = skill.masked_scatter(rows, told[keys.BEHAVIOUR]), told[keys.PARAMETERS]
        return td.set(keys.ACTION, TensorDict({keys.BEHAVIOUR: skill, keys.PARAMETERS: parameters}, td.batch_size))


def _read(decision: str, text: str, option: str, bounds: tuple[Tensor, Tensor]) -> tuple[int, float]:
    """Behaviour and the parameter that stands for its speed; -1 for ``own``."""
    if decision == OWN:
        return -1, 0.0
    name, _, number = decision.partition(":")
    try:
        skill, speed = behaviours.skill_index(name), float(number)
    except ValueError as error:
        raise ValueError(f"{option}: expected BEHAVIOUR:SPEED such as trot:1.2, got {text!r} ({error})") from None
    low, high = bounds
    slowest, fastest = low[skill, 0].item(), high[skill, 0].item()
    source = "Table S2" if fastest == behaviours.command_bounds()[1][skill, 0].item() else "as its fastest is set"
    if not slowest - 1e-6 <= speed <= fastest + 1e-6:
        raise ValueError(f"{option}: {name} goes at {slowest:g} to {fastest:g} m/s ({source}), got {number} m/s")
    return skill, 2.0 * (speed - slowest) / (fastest - slowest) - 1.0
