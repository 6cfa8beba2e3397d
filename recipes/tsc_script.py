"""A script that decides on a course: for each obstacle a behaviour and a speed, turned towards the way-point.

The baseline that a teacher has to beat, and what a teacher may copy before it learns by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import behaviours, keys
from agility_rl.envs.decisions import NUM_PARAMETERS
from agility_rl.envs.obstacles import OBSTACLES

STEERING = 2.0
"""Turn rate that is commanded for each radian of heading error [1/s]."""
OWN = "own"
"""In place of a decision: the teacher decides as it did before, and the script says nothing."""
TURN = behaviours.COMMANDS.index("yaw_rate")


@dataclass(frozen=True)
class Script:
    """A behaviour and a speed for each type of obstacle.

    Attributes:
        skill: int64 ``[7]``, behaviour before each of :data:`OBSTACLES`; -1 where it says nothing.
        parameters: ``[7, 5, 6]``, forward speed of the chosen behaviour, everything else in the middle of its range.
    """

    skill: Tensor
    parameters: Tensor

    @classmethod
    def parse(cls, text: str, option: str = "--script") -> Script:
        """Read ``BEHAVIOUR:SPEED``, speed in m/s, and after commas what differs, ``OBSTACLE=BEHAVIOUR:SPEED``.

        ``own`` in place of the first says something about the others only.

        Raises:
            ValueError: if it is no such text, there is no such obstacle, or the behaviour has no such speed.
        """
        usual, *others = text.split(",")
        chosen = dict.fromkeys(OBSTACLES, (-1, 0.0) if usual == OWN else _read(usual, text, option))
        for other in others:
            name, _, decision = other.partition("=")
            if name not in OBSTACLES:
                raise ValueError(f"{option}: unknown obstacle {name!r} in {text!r}, expected {', '.join(OBSTACLES)}")
            chosen[name] = _read(decision, text, option)
        parameters = torch.zeros(len(OBSTACLES), behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS)
        for row, (skill, speed) in enumerate(chosen.values()):
            if skill >= 0:
                parameters[row, skill, 0] = speed
        return cls(torch.tensor([skill for skill, _ in chosen.values()]), parameters)

    @property
    def behaviours(self) -> tuple[str, ...]:
        """Those that it chooses."""
        return tuple(behaviours.BEHAVIOURS[index] for index in self.skill.unique().tolist() if index >= 0)

    @property
    def complete(self) -> bool:
        """Whether it says something before every obstacle."""
        return bool((self.skill >= 0).all())

    def decide(self, td: TensorDictBase) -> TensorDictBase:
        """Decisions of ``N`` robots under ``action``; each behaviour's turn rate leads to the way-point. Where it says
        nothing, the behaviour is -1."""
        kind = td[keys.OBSTACLE].argmax(-1)
        _, fastest = behaviours.command_bounds()
        parameters = self.parameters[kind].clone()
        turn = STEERING * td[keys.HEADING_ERROR][:, :1] / fastest[:, TURN]
        parameters[..., TURN] = turn.clamp(-1.0, 1.0)
        decision = {keys.BEHAVIOUR: self.skill[kind], keys.PARAMETERS: parameters}
        return td.set(keys.ACTION, TensorDict(decision, td.batch_size))


def _read(decision: str, text: str, option: str) -> tuple[int, float]:
    """Behaviour and the parameter that stands for its speed."""
    name, _, number = decision.partition(":")
    try:
        skill, speed = behaviours.skill_index(name), float(number)
    except ValueError as error:
        raise ValueError(f"{option}: expected BEHAVIOUR:SPEED such as trot:1.2, got {text!r} ({error})") from None
    low, high = behaviours.command_bounds()
    slowest, fastest = low[skill, 0].item(), high[skill, 0].item()
    if not slowest - 1e-6 <= speed <= fastest + 1e-6:
        raise ValueError(f"{option}: {name} goes at {slowest:g} to {fastest:g} m/s (Table S2), got {number} m/s")
    return skill, 2.0 * (speed - slowest) / (fastest - slowest) - 1.0
