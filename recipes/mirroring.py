"""Let a controller that turns well to one side turn as well to the other: there it acts in a mirror.

Nothing in reinforcement learning keeps a policy symmetric, even if robot, ground and motion are: one trotted along a
radius of 0.4 m to the left, and of 0.8 m to the right. A teacher for ``bbc_distill.py``. Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import COMMANDS
from agility_rl.envs.mirror import mirror
from agility_rl.go2.mirror import mirror_joints

Side = Literal["left", "right"]
TURN = COMMANDS.index("yaw_rate")


def mirrored(act: Callable[[TensorDictBase], Tensor], side: Side) -> Callable[[TensorDictBase], Tensor]:
    """Mean actions ``[B, 12]`` of a controller that is asked only for turns to the given side.

    Where the other side is commanded, it is shown the mirror image and what it says is mirrored back.
    """
    sign = 1.0 if side == "left" else -1.0

    def both(observation: TensorDictBase) -> Tensor:
        seen = observation.select(keys.PROPRIOCEPTION, keys.PRIVILEGED, keys.COMMAND, keys.PEAK)
        other = sign * seen[keys.COMMAND][:, TURN] < 0.0
        said = act(torch.where(other, mirror(seen), seen))
        return torch.where(other[:, None], mirror_joints(said), said)

    return both
