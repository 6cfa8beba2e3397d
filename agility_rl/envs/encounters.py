"""What lies in the way of robots that follow commands: bars where they canter, bars and boxes where they jump, ramps
before the others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.behaviours import COMMANDS, JUMP, NUM_BEHAVIOURS, command_bounds, skill_index
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.obstacles import BOX_HALF, RAMP_LENGTH, bar_shape, box_shape, ramp_height, ramp_shapes
from agility_rl.simulation import Piece, Simulator
from agility_rl.simulation.scenery import PARKED_DEPTH
from agility_rl.tensors import worthwhile

NOTHING, BAR, RAMP, BOX = range(4)
HALF_WIDTH = 1.0
"""Half width of bar, ramp and box [m]: wider than on a course, for nobody steers onto them."""
PIECES = (
    Piece("encounter_bar", (bar_shape(HALF_WIDTH),)),
    Piece("encounter_ramp", ramp_shapes(HALF_WIDTH)),
    Piece("encounter_box", (box_shape(HALF_WIDTH),)),
)
LIFT = (0.03, 0.20)
"""Height of a bar's axis [m]; a course has 0.05 to 0.20."""
BOX_HEIGHT = (0.10, 0.30)
"""Height of a box's top [m], as on a course; it is sunk into the ground for the rest."""
STRAIGHT = 0.3
"""Commanded turn rate up to which a robot meets a ramp [rad/s], and of one that meets a box: who turns would fall off
its side."""
DISTANCE = (0.8, 2.5)
"""Way to the near side [m]."""
BOX_DISTANCE = (0.85, 1.05)
"""Way to the near side of a box [m]: a leap out of a trot has its front feet up after 0.85 m."""
EDGE, CLEAR = 0.12, 0.04
"""From so far before the near side on [m] feet ought to be so much higher than a box's top [m]."""
BOX_SPEED, BOX_JUMP = 1.5, 0.50
"""Who meets a box is told to go at least so fast [m/s] and to jump at least so high [m]."""
BEARING, YAW = 0.2, 0.2
"""How far to the side it lies, and how far it is turned, at most [rad]."""
HALF_LENGTH = (0.0, 0.0, RAMP_LENGTH, BOX_HALF[0])
"""From the middle to the near side [m]."""
REACH = (0.0, 0.7, RAMP_LENGTH + 0.5, BOX_HALF[0] + 0.5)
"""A robot nearer to the middle, along the way through, is at it [m]."""
ASTRAY = 5.0
"""Who is so far away will not come any more [m]."""
NUM_OBSERVED, SEEN = 7, 3.0
"""What a critic is told of an encounter, and how far away it may seem [m]."""
PATIENCE = 3.0
"""Seconds for which a robot before or on a box is told the same, at most."""
_BUFFERS = ("kind", "position", "yaw", "lift", "jumped")


class Encounters:
    """A bar, a ramp or a box ahead of each of ``N`` robots, anew whenever it lies behind or another command is drawn.

    A box lies where a jump begins, not before a robot that is jumping anyway: where its feet are then is settled, which
    whoever tells it to jump can make use of, and the robot need not see it. It is told to go straight on, fast and
    high, until the box is behind it.

    Nobody sees them: a controller that gets over them has learned to lift its feet, to land on what is not level, and
    to go on after a stumble.

    Source: ours. The shapes are those of the course (method notes, section 5.7); height fields, the usual way to rough
    ground, cannot hold bars, and feet catch on their edges (``docs/bbc_experiments.md``).

    Args:
        num_robots: N.
        generator: source of randomness; where it is, the tensors are.
        share: of the commands on which a bar or a ramp lies in the way.
        boxes: share of the jumps that begin before a box.

    Attributes:
        kind: int64 ``[N]``, :data:`NOTHING`, :data:`BAR`, :data:`RAMP` or :data:`BOX`.
        position: ``[N, 2]``, its middle [m].
        yaw: ``[N]``, direction of the way over it [rad].
        lift: ``[N]``, height of the bar's axis or of the box's top [m].
        jumped: bool ``[N]``, it was told to jump in the step before.
        box_height: lowest and highest box that is put there from now on [m]; assign for a curriculum.

    Raises:
        ValueError: if a share is not between 0 and 1.

    Example:
        >>> from agility_rl.simulation import make_simulator
        >>> simulator = make_simulator(num_simulations=2, num_threads=1, scenery=PIECES)
        >>> encounters = Encounters(2, torch.Generator(), share=1.0)
        >>> commands = CommandSampler(2, torch.Generator(), None)  # both walk straight on
        >>> encounters.place(torch.ones(2, dtype=torch.bool), simulator, commands)
        >>> encounters.kind.tolist()
        [2, 2]
    """

    def __init__(self, num_robots: int, generator: torch.Generator, share: float, boxes: float = 0.0) -> None:
        for name, value in (("encounters", share), ("boxes", boxes)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name}: expected a share from 0 to 1, got {value}")
        self.generator, self.share, self.boxes, device = generator, share, boxes, generator.device
        self.box_height: tuple[float, float] = BOX_HEIGHT
        n = num_robots
        leaping = [index in (skill_index("canter"), skill_index("jump")) for index in range(NUM_BEHAVIOURS)]
        self._leaping = torch.tensor(leaping, device=device)
        self._reach = torch.tensor(REACH, device=device)
        self._half_length = torch.tensor(HALF_LENGTH, device=device)
        self.kind = torch.zeros(n, dtype=torch.int64, device=device)
        self.position, self.yaw = torch.zeros(n, 2, device=device), torch.zeros(n, device=device)
        self.lift = torch.zeros(n, device=device)
        self.jumped = torch.zeros(n, dtype=torch.bool, device=device)
        low, high = command_bounds(device)
        self._slowest, self._fastest = low[JUMP], high[JUMP]

    def place(self, mask: Tensor, simulator: Simulator, commands: CommandSampler) -> None:
        """Put something before the robots of the rows of a bool mask ``[N]``, where they stand and head for now."""
        if not worthwhile(mask):
            return
        n, device = len(mask), mask.device
        there, far, aside, turned, high, which = torch.rand(6, n, generator=self.generator, device=device)
        straight = commands.command[:, COMMANDS.index("yaw_rate")].abs() <= STRAIGHT
        leaping = self._leaping[commands.skill]
        kind = torch.where(leaping, BAR, torch.where(straight, RAMP, NOTHING))
        kind = torch.where(there < self.share, kind, NOTHING)
        kind = torch.where(commands.jumping & ~self.jumped & (which < self.boxes), BOX, kind)
        boxed = kind == BOX
        _, _, heading = rotations.to_euler(simulator.root_quaternion)
        bearing = heading + BEARING * (2.0 * aside - 1.0)
        distance = torch.where(boxed, _between(BOX_DISTANCE, far), _between(DISTANCE, far)) + self._half_length[kind]
        way = torch.stack((bearing.cos(), bearing.sin()), -1)
        lift = torch.where(boxed, _between(self.box_height, high), _between(LIFT, high))
        commands.command = torch.where((mask & boxed)[:, None], self._determined(commands.command), commands.command)
        # New tensors, because a state of an earlier step may still refer to the old ones.
        self.kind = torch.where(mask, kind, self.kind)
        self.position = torch.where(
            mask[:, None], simulator.root_position[:, :2] + distance[:, None] * way, self.position
        )
        self.yaw = torch.where(mask, bearing + YAW * (2.0 * turned - 1.0), self.yaw)
        self.lift = torch.where(mask, lift, self.lift)
        self.show(mask, simulator)

    def show(self, mask: Tensor, simulator: Simulator) -> None:
        """Put the pieces of the rows of a bool mask where the attributes say."""
        level = torch.zeros_like(self.yaw)
        quaternion = rotations.from_euler(level, level, self.yaw)[:, None].expand(-1, len(PIECES), -1)
        lifted = ((BAR, self.lift), (RAMP, level), (BOX, self.lift))  # in the order of the pieces
        height = torch.stack([torch.where(self.kind == kind, lift, PARKED_DEPTH) for kind, lift in lifted], -1)
        position = torch.cat((self.position[:, None].expand(-1, len(PIECES), -1), height[..., None]), -1)
        simulator.place(mask, position, quaternion, torch.zeros(len(mask), 0, device=mask.device))

    def holding(self, simulator: Simulator, commands: CommandSampler) -> Tensor:
        """Bool ``[N]``: before or on a box, where the same command goes on, for :data:`PATIENCE` seconds at most.

        Other behaviours are not asked to get down from where a jump has brought the robot.
        """
        along, across = self._local(simulator.root_position[:, :2]).unbind(-1)
        coming = (along < self._reach[BOX]) & (across.abs() < HALF_WIDTH)
        return (self.kind == BOX) & coming & (commands.age * simulator.control_dt < PATIENCE)

    def advance(self, simulator: Simulator, commands: CommandSampler) -> None:
        """After a control step: what lies behind, or before another command, moves, but not from under a robot."""
        along, across = self._local(simulator.root_position[:, :2]).unbind(-1)
        reach = self._reach[self.kind]
        at_it = (along.abs() < reach) & (across.abs() < HALF_WIDTH + 0.5)
        behind = (self.kind != NOTHING) & ((along >= reach) | (along.square() + across.square() > ASTRAY**2))
        self.place(~at_it & (behind | (commands.age == 0)), simulator, commands)
        self.jumped = commands.jumping

    def begin(self, mask: Tensor, simulator: Simulator, commands: CommandSampler) -> None:
        """Episodes of the rows of a bool mask ``[N]`` begin; no box in them yet, as who jumps is in mid-air."""
        self.jumped = self.jumped | mask
        self.place(mask, simulator, commands)
        self.jumped = torch.where(mask, commands.jumping, self.jumped)

    def _determined(self, command: Tensor) -> Tensor:
        """Jumps ``[N, 5]`` straight on, fast and high: the same share of a smaller range."""
        low, high = self._slowest.clone(), self._fastest.clone()
        for name, least in (("velocity_x", BOX_SPEED), ("jump_height", BOX_JUMP), ("yaw_rate", -STRAIGHT)):
            low[COMMANDS.index(name)] = least
        high[COMMANDS.index("yaw_rate")] = STRAIGHT
        span = (self._fastest - self._slowest).clamp(min=1e-6)
        return low + (high - low) * (command - self._slowest) / span

    def ground(self, position: Tensor) -> Tensor:
        """Height [m] of ramps and boxes above the ground under horizontal positions ``[N, 2]``, as ``[N]``; bars have
        none."""
        along, across = self._local(position).unbind(-1)
        height = torch.where(self.kind == RAMP, ramp_height(along), 0.0)
        height = torch.where((self.kind == BOX) & (along.abs() <= BOX_HALF[0]), self.lift, height)
        return torch.where(across.abs() <= HALF_WIDTH, height, 0.0)

    def low_feet(self, feet: Tensor) -> Tensor:
        """By how much feet at ``[N, 4, 3]`` [m] that come to a box are lower than its top, of all together ``[N]``."""
        along, across = self._local(feet[..., :2].transpose(0, 1)).unbind(-1)  # [4, N]
        to_edge = -BOX_HALF[0] - along
        coming = (self.kind == BOX) & (to_edge >= 0.0) & (to_edge <= EDGE) & (across.abs() <= HALF_WIDTH)
        return ((self.lift + CLEAR - feet[..., 2].T).clamp(min=0.0) * coming).sum(0)

    def observe(self, simulator: Simulator) -> Tensor:
        """What lies in the way of each robot, ``[N, 7]`` (:data:`agility_rl.keys.ENCOUNTER`); zero where nothing is."""
        along, across = self._local(simulator.root_position[:, :2]).clamp(-SEEN, SEEN).unbind(-1)
        _, _, heading = rotations.to_euler(simulator.root_quaternion)
        what = [(self.kind == kind).float() for kind in (BAR, RAMP, BOX)]
        there = torch.stack((*what, self.lift, along, across, (heading - self.yaw).sin()), -1)
        return there * (self.kind != NOTHING)[:, None]

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


def _between(span: tuple[float, float], share: Tensor) -> Tensor:
    return span[0] + (span[1] - span[0]) * share
