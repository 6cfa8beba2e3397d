"""Reference-state initialisation: episodes start in the middle of a recorded motion of their own behaviour."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import behaviours
from agility_rl.go2 import constants, features
from agility_rl.tensors import constant

STATE_ENTRIES = (
    "root_height",
    "root_quaternion",
    "root_linear_velocity",
    "root_angular_velocity",
    "joint_position",
    "joint_velocity",
)
PAST = "past_motion"
"""Discriminator frames before the state, oldest first."""


def standing_states(skill: Tensor, span: int = 0) -> TensorDict:
    """Standing in the default pose, for as long as discriminator frames look back.

    Source: ours; a robot that is switched on, or put before a course, starts like this and not in mid-stride.

    Args:
        skill: int64 ``[M]``, the behaviours that start from there.
        span: number of past motion frames [control steps].

    Returns:
        ``[M]`` with the entries of :class:`ReferenceStates`; ``past_motion`` ``[M, span, 49]`` if ``span`` is not 0.

    Example:
        >>> standing_states(torch.tensor([0, 4]), span=24)["past_motion"].shape
        torch.Size([2, 24, 49])
    """
    n, device = len(skill), skill.device
    upright = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device)
    states = TensorDict(
        {
            "root_height": torch.full((n, 1), constants.STANDING_HEIGHT, device=device),
            "root_quaternion": upright.repeat(n, 1),
            "root_linear_velocity": torch.zeros(n, 3, device=device),
            "root_angular_velocity": torch.zeros(n, 3, device=device),
            "joint_position": constant(constants.DEFAULT_POSE, device).repeat(n, 1),
            "joint_velocity": torch.zeros(n, constants.NUM_JOINTS, device=device),
        },
        [n],
    )
    height, *rest = (states[name] for name in STATE_ENTRIES)
    if span:
        states[PAST] = features.clip_frames(height[:, 0], *rest)[:, None].repeat(1, span, 1)
    return states.set("skill", skill)


class ReferenceStates:
    """States of recorded motion, sorted by skill, from which resets are drawn, and for each skill one that stands.

    Source: method notes, section 4.2 (a random time of a random labelled clip of the drawn class).

    Args:
        states: TensorDict ``[M]`` with ``skill`` int64, ``root_height`` [M, 1] [m], ``root_quaternion`` [M, 4],
            ``root_linear_velocity``, ``root_angular_velocity`` [M, 3] (world frame), ``joint_position``,
            ``joint_velocity`` [M, 12]; optionally ``past_motion`` [M, span, 49], the discriminator frames before.

    Attributes:
        states: ``[M + 5]``, sorted, the standing one the last of its skill, without the frames before.
        past_motion: those, ``[M + 5, span, 49]``, or ``None``.
        first: number of each skill's first state, int64 ``[5]``.
        count: how many of them move, int64 ``[5]``; the standing one comes after.

    Raises:
        ValueError: if an entry is missing or a behaviour has no state.

    Example:
        >>> reference = ReferenceStates.standing()
        >>> number = reference.draw(torch.tensor([0, 4]), torch.Generator())
        >>> number.tolist(), reference.states[number]["joint_position"].shape
        ([0, 8], torch.Size([2, 12]))
    """

    def __init__(self, states: TensorDictBase) -> None:
        needed = {"skill", *STATE_ENTRIES}
        if missing := needed - set(states.keys()):
            raise ValueError(f"reference states lack {', '.join(sorted(missing))}; they have {sorted(states.keys())}")
        self.count = torch.bincount(states["skill"], minlength=behaviours.NUM_BEHAVIOURS)
        empty = [name for name, number in zip(behaviours.BEHAVIOURS, self.count.tolist(), strict=True) if not number]
        if empty:
            raise ValueError(f"no reference state for {', '.join(empty)}; give at least one for each behaviour")
        self.first = torch.cumsum(self.count + 1, 0) - self.count - 1
        every = torch.arange(behaviours.NUM_BEHAVIOURS, device=states["skill"].device)
        entries = ("skill", *STATE_ENTRIES, *([PAST] if PAST in states.keys() else []))  # noqa: SIM118
        standing = standing_states(every, states[PAST].shape[1] if PAST in entries else 0)
        states = torch.cat([some.select(*entries).to_tensordict() for some in (states, standing)])
        by_skill = torch.argsort(states["skill"], stable=True)
        self.states = states.select(*STATE_ENTRIES)[by_skill]
        past = states.get(PAST, None)
        self.past_motion: Tensor | None = None if past is None else past[by_skill]

    def check_past(self, span: int) -> None:
        """Refuse states whose past is not of ``span`` frames; states without a past are welcome.

        Raises:
            ValueError: if it is of another length.
        """
        if self.past_motion is not None and self.past_motion.shape[1] != span:
            raise ValueError(
                f"the reference states bring {self.past_motion.shape[1]} past motion frames, expected {span}; "
                "give dataset and environment the same motion offsets"
            )

    @classmethod
    def standing(cls, device: torch.device | str = "cpu") -> ReferenceStates:
        """One state for all behaviours: standing in the default pose."""
        return cls(standing_states(torch.arange(behaviours.NUM_BEHAVIOURS, device=device)))

    def draw(self, skill: Tensor, generator: torch.Generator, standing: float = 0.0) -> Tensor:
        """The numbers int64 ``[N]`` of a random state of each given skill ``[N]``, by chance its standing one, for a
        share ``standing`` of them, 0 to 1."""
        fraction = torch.rand(skill.shape, generator=generator, device=skill.device) - standing
        moving = (fraction / max(1.0 - standing, 1e-6) * self.count[skill]).long()
        return self.first[skill] + torch.where(fraction < 0.0, self.count[skill], moving)
