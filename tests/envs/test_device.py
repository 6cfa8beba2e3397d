"""Nothing in an environment is made on the CPU by default: everything names the device of its simulator.

Without a GPU this is how it can be told that an environment would run on one.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from agility_rl import keys
from agility_rl.envs import AgilityEnv, LocomotionEnv
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.randomization import Randomization
from agility_rl.go2 import camera
from agility_rl.simulation import make_simulator
from tests.devices import NamesDevices


@pytest.fixture
def silent() -> Iterator[set[str]]:
    with NamesDevices() as mode:
        yield mode.silent


RANGES = Randomization(action_delay=(0.0, 0.02))


def test_the_check_finds_what_it_looks_for(silent: set[str]) -> None:
    camera.pixel_directions()
    assert [
        line for line in silent if line.startswith("agility_rl/go2/camera.py") and "torch.arange(IMAGE_WIDTH)" in line
    ]


def test_locomotion(silent: set[str]) -> None:
    simulator = make_simulator(num_simulations=4, num_threads=1)
    env = LocomotionEnv(
        4,
        simulator=simulator,
        randomization=RANGES,
        observation_noise=1.0,
        episode_length=0.06,
        resample_period=0.04,
        push_interval=0.04,
    )
    assert env.device == simulator.device == env.generator.device
    env.set_skill_probabilities(torch.full((5,), 0.2, device=env.device))
    td = env.rollout(8, break_when_any_done=False)
    assert bool(td["next", "done"].any())
    env.set_commands(td[keys.SKILL][:, -1], td[keys.COMMAND][:, -1, :5])
    assert not silent, "\n".join(sorted(silent))
    env.close()


@pytest.mark.parametrize("course", ["full", "bidirectional"])
def test_agility(silent: set[str], course: str) -> None:
    def stand(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.zeros(*td.shape, 12, device=td.device))

    env = AgilityEnv(
        4,
        stand,
        COURSES[course],
        simulator_options={"num_threads": 1},
        decision_steps=2,
        randomization=RANGES,
        observation_noise=1.0,
        episode_length=0.12,
        push_interval=0.04,
        depth={"latency": (0, 2), "frame_steps": 2},
    )
    env.set_curriculum(difficulty=0.5, obstacles=2, start_weights=env.arena.start_weights)
    td: TensorDictBase = env.rollout(4, break_when_any_done=False)
    assert bool(td["next", "done"].any())
    partial = TensorDict({"_reset": torch.tensor([[True], [False]] * 2, device=env.device)}, [4])
    env.reset(partial)
    assert not silent, "\n".join(sorted(silent))
    env.close()
