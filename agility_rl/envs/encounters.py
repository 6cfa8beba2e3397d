"""What lies in the way of robots that follow commands: bars where they canter or jump, ramps before the others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import COMMANDS, NUM_BEHAVIOURS, skill_index
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.obstacles import RAMP_LENGTH, bar_shape, ramp_height, ramp_shapes
from agility_rl.simulation import Piece, Simulator
from agility_rl.simulation.scenery import PARKED_DEPTH
from agility_rl.tensors import worthwhile

NOTHING, BAR, RAMP = range(3)
HALF_WIDTH = 1.0
"""Half width of bar and ramp [m]: wider than on a course, for nobody steers onto them."""
PIECES = (
    Piece("encounter_bar", (bar_shape(HALF_WIDTH),)),
    Piece("encounter_ramp", ramp_shapes(HALF_WIDTH)),
)
LIFT = (0.03, 0.20)
"""Height of a bar's axis [m]; a course has 0.05 to 0.20."""
STRAIGHT = 0.3
"""Commanded turn rate up to which a robot meets a ramp [rad/s]: who turns would fall off its side."""
DISTANCE = (0.8, 2.5)
"""Way to the near side [m]."""
BEARING, YAW = 0.2, 0.2
"""How far to the side it lies, and how far it is turned, at most [rad]."""
REACH = (0.0, 0.7, RAMP_LENGTH + 0.5)
"""A robot nearer to the middle, along the way through, is at it [m]."""
ASTRAY = 5.0
"""Who is so far away will not come any more [m]."""
_BUFFERS = ("kind", "position", "yaw", "lift")


class Encounters:
    """A bar or a ramp ahead of each of ``N`` robots, anew whenever it lies behind or another command comes.

    Nobody sees them: a controller that gets over them has learned to lift its feet, to land on what is not level, and
    to go on after a stumble.

    Source: ours. The shapes are those of the course (method notes, section 5.7); height fields, the usual way to rough
    ground, cannot hold bars, and feet catch on their edges (``docs/bbc.md``).

    Args:
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        share: of the commands on which something lies in the way.

    Attributes:
        kind: int64 ``[N]``, :data:`NOTHING`, :data:`BAR` or :data:`RAMP`.
        position: ``[N, 2]``, its middle [m].
        yaw: ``[N]``, direction of the way over it [rad].
        lift: ``[N]``, height of the bar's axis [m].

    Raises:
        ValueError: if the share is not between 0 and 1.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> simulator = make_simulator(num_simulations=2, num_threads=1, scenery=PIECES)
        >>> encounters = Encounters(2, torch.Generator(), share=1.0)
        >>> commands = CommandSampler(2, torch.Generator(), None)  # both walk straight on
        >>> encounters.place(torch.ones(2, dtype=torch.bool), simulator, commands)
        >>> encounters.kind.tolist()
        [2, 2]
    """

    def __init__(self, num_robots: int, generator: torch.Generator, share: float) -> None:
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"encounters: expected a share from 0 to 1, got {share}")
        self.generator, self.share, device = generator, share, generator.device
        n = num_robots
        leaping = [index in (skill_index("canter"), skill_index("jump")) for index in range(NUM_BEHAVIOURS)]
        self._leaping = torch.tensor(leaping, device=device)
        self._reach = torch.tensor(REACH, device=device)
        self.kind = torch.zeros(n, dtype=torch.int64, device=device)
        self.position, self.yaw = torch.zeros(n, 2, device=device), torch.zeros(n, device=device)
        self.lift = torch.zeros(n, device=device)

    def place(self, mask: Tensor, simulator: Simulator, commands: CommandSampler) -> None:
        """Put something before the robots of the rows of a bool mask ``[N]``, where they stand and head for now."""
        if not worthwhile(mask):
            return
        n, device = len(mask), mask.device
        there, far, aside, turned, high = torch.rand(5, n, generator=self.generator, device=device)
        straight = commands.command[:, COMMANDS.index("yaw_rate")].abs() <= STRAIGHT
        leaping = self._leaping[commands.skill]
        kind = torch.where(leaping, BAR, torch.where(straight, RAMP, NOTHING))
        kind = torch.where(there < self.share, kind, NOTHING)
        _, _, heading = rotations.to_euler(simulator.root_quaternion)
        bearing = heading + BEARING * (2.0 * aside - 1.0)
        distance = DISTANCE[0] + (DISTANCE[1] - DISTANCE[0]) * far + RAMP_LENGTH * (kind == RAMP)
        way = torch.stack((bearing.cos(), bearing.sin()), -1)
        # New tensors, because a state of an earlier step may still refer to the old ones.
        self.kind = torch.where(mask, kind, self.kind)
        self.position = torch.where(
            mask[:, None], simulator.root_position[:, :2] + distance[:, None] * way, self.position
        )
        self.yaw = torch.where(mask, bearing + YAW * (2.0 * turned - 1.0), self.yaw)
        self.lift = torch.where(mask, LIFT[0] + (LIFT[1] - LIFT[0]) * high, self.lift)
        level = torch.zeros_like(self.yaw)
        quaternion = rotations.from_euler(level, level, self.yaw)[:, None].expand(-1, len(PIECES), -1)
        bar = torch.where(self.kind == BAR, self.lift, PARKED_DEPTH)
        height = torch.stack((bar, torch.where(self.kind == RAMP, 0.0, PARKED_DEPTH)), -1)
        position = torch.cat((self.position[:, None].expand(-1, len(PIECES), -1), height[..., None]), -1)
        simulator.place(mask, position, quaternion, torch.zeros(n, 0, device=device))

    def advance(self, simulator: Simulator, commands: CommandSampler) -> None:
        """After a control step: what lies behind, or before another command, moves, but not from under a robot."""
        along, across = self._local(simulator.root_position[:, :2]).unbind(-1)
        reach = self._reach[self.kind]
        at_it = (along.abs() < reach) & (across.abs() < HALF_WIDTH + 0.5)
        behind = (self.kind != NOTHING) & ((along >= reach) | (along.square() + across.square() > ASTRAY**2))
        self.place(~at_it & (behind | (commands.age == 0)), simulator, commands)

    def ground(self, position: Tensor) -> Tensor:
        """Height [m] of ramps above the ground under horizontal positions ``[N, 2]``, as ``[N]``; bars have none."""
        along, across = self._local(position).unbind(-1)
        on = (self.kind == RAMP) & (across.abs() <= HALF_WIDTH)
        return torch.where(on, ramp_height(along), 0.0)

    def _local(self, position: Tensor) -> Tensor:
        x, y = (position - self.position).unbind(-1)
        cosine, sine = self.yaw.cos(), self.yaw.sin()
        return torch.stack((cosine * x + sine * y, cosine * y - sine * x), -1)

    def state_dict(self) -> dict[str, Any]:
        """What lies where; the simulator holds it too."""
        return {name: getattr(self, name).clone() for name in _BUFFERS}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name in _BUFFERS:
            setattr(self, name, state[name].clone())
