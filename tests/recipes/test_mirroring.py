"""A controller that acts in a mirror where the other side is commanded."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import command_vector
from agility_rl.envs.mirror import mirror
from agility_rl.go2 import features
from agility_rl.go2.mirror import mirror_joints

TURNS = torch.tensor([-1.0, 0.0, 0.4, -0.2])


@pytest.fixture
def mirroring(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("mirroring")


def observation() -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    command = torch.tensor([1.0, 0.1, 0.0, 0.0, 0.3]).repeat(4, 1)
    command[:, 2] = TURNS
    return TensorDict(
        {
            keys.PROPRIOCEPTION: torch.randn(4, features.NUM_PROPRIOCEPTION, generator=generator),
            keys.PRIVILEGED: torch.randn(4, features.NUM_PRIVILEGED, generator=generator),
            keys.COMMAND: command_vector(torch.full((4,), 2), command, torch.zeros(4, 1)),
            keys.PEAK: torch.zeros(4, 1),
        },
        [4],
    )


def lopsided(td: TensorDictBase) -> Tensor:
    """A controller with another answer for every side."""
    mixed = torch.cat([td[key] for key in (keys.PROPRIOCEPTION, keys.PRIVILEGED, keys.COMMAND)], -1)
    return mixed @ torch.linspace(-1.0, 1.0, mixed.shape[-1] * 12).reshape(-1, 12)


@pytest.mark.parametrize(("side", "itself"), [("left", (1, 2)), ("right", (0, 1, 3))])
def test_its_own_side_is_left_alone(mirroring: ModuleType, side: str, itself: tuple[int, ...]) -> None:
    td = observation()
    said, own = mirroring.mirrored(lopsided, side)(td), lopsided(td)
    for row in range(4):
        assert torch.equal(said[row], own[row]) == (row in itself)


def test_mirrored_robots_do_mirrored_things(mirroring: ModuleType) -> None:
    td, act = observation(), mirroring.mirrored(lopsided, "left")
    turning = TURNS != 0.0
    image = mirror(td)
    torch.testing.assert_close(act(image)[turning], mirror_joints(act(td))[turning])
    assert torch.equal(td[keys.COMMAND][:, 2], TURNS), "what was given stays as it was"
