"""Real environments that are closed after the test, and a neutral state for the functions of a state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch

from agility_rl.envs import LocomotionEnv
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import constants


@pytest.fixture
def build() -> Iterator[Callable[..., LocomotionEnv]]:
    """Make a :class:`LocomotionEnv` on one thread; options as its constructor takes them."""
    made: list[LocomotionEnv] = []

    def make(num_robots: int = 4, **options: Any) -> LocomotionEnv:
        if "simulator" not in options:
            options.setdefault("simulator_options", {"num_threads": 1})
        made.append(LocomotionEnv(num_robots, **options))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)


@pytest.fixture
def neutral() -> Callable[..., LocomotionState]:
    """Make the state of robots that stand still without any force; fields given by name replace those."""

    def make(n: int = 2, **changes: Any) -> LocomotionState:
        pose = torch.tensor(constants.DEFAULT_POSE).repeat(n, 1)
        joints = (
            "joint_velocity",
            "previous_joint_velocity",
            "torque",
            "previous_torque",
            "action",
            "previous_action",
        )
        fields: dict[str, Any] = {
            "root_height": torch.full((n, 1), constants.STANDING_HEIGHT),
            **{name: torch.zeros(n) for name in ("roll", "pitch", "yaw", "mean_yaw_rate")},
            **{name: torch.zeros(n) for name in ("trunk_contact", "peak_height")},
            **{name: torch.zeros(n, 3) for name in ("linear_velocity", "mean_velocity", "angular_velocity")},
            "joint_position": pose,
            **{name: torch.zeros(n, 12) for name in joints},
            **{f"{link}_contact": torch.zeros(n, 4) for link in ("hip", "thigh", "calf", "foot")},
            "command": torch.zeros(n, 5),
            "jumping": torch.zeros(n, dtype=torch.bool),
            "rhythm": torch.zeros(n),
            "low_feet": torch.zeros(n),
            "unstable": torch.zeros(n, dtype=torch.bool),
            "dt": 0.02,
        }
        return LocomotionState(**(fields | changes))

    return make


@pytest.fixture
def on_course(neutral: Callable[..., LocomotionState]) -> Callable[..., AgilityState]:
    """Make the state of robots that stand one metre before their goal; fields given by name replace those."""

    def make(n: int = 2, **changes: Any) -> AgilityState:
        fields: dict[str, Any] = {
            "robot": neutral(n),
            "position": torch.tensor([0.0, 0.0, constants.STANDING_HEIGHT]).repeat(n, 1),
            "velocity": torch.zeros(n, 2),
            "goal_distance": torch.ones(n),
            "goal_direction": torch.tensor([1.0, 0.0]).repeat(n, 1),
            "heading_error": torch.zeros(n, 2),
            "target_speed": torch.full((n,), 0.4),
            "at_goal": torch.zeros(n, dtype=torch.bool),
            "foot_on_edge": torch.zeros(n, 4, dtype=torch.bool),
            "behaviours": torch.zeros(n, 3, dtype=torch.int64),
            "parameters": torch.zeros(n, 2, 5, 6),
            "applied": torch.zeros(n, 2, 6),
        }
        return AgilityState(**(fields | changes))

    return make
