"""What runs on a GPU alone: environments on its tensors, and physics as the same engine computes it on a CPU."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from agility_rl.envs import AgilityEnv, LocomotionEnv
from agility_rl.envs.randomization import Randomization
from agility_rl.go2 import constants
from agility_rl.simulation import make_simulator

pytestmark = pytest.mark.gpu
DEVICE = "cuda"


def test_a_graph_steps_as_the_cpu_does() -> None:
    here, there = (make_simulator("warp", num_simulations=8, device=device) for device in ("cpu", DEVICE))
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        target = torch.tensor(constants.DEFAULT_POSE) + 0.2 * torch.randn(8, 12, generator=generator)
        here.step(target)
        there.step(target.to(there.device))
    torch.testing.assert_close(there.root_position.cpu(), here.root_position, atol=1e-4, rtol=0)
    torch.testing.assert_close(there.joint_position.cpu(), here.joint_position, atol=1e-3, rtol=0)


def test_locomotion_lives_there() -> None:
    env = LocomotionEnv(
        64,
        simulator_options={"name": "warp", "device": DEVICE},
        randomization=Randomization(action_delay=(0.0, 0.02)),
        observation_noise=1.0,
        resample_period=0.1,
        push_interval=0.2,
    )
    check_env_specs(env)
    td = env.rollout(20, break_when_any_done=False)
    assert all(value.device == env.simulator.device for value in td.values(True, True))
    env.close()


def test_a_course_with_cameras_lives_there() -> None:
    def stand(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", td["history"].new_zeros(*td.shape, 12))

    options = {"name": "warp", "device": DEVICE}
    env = AgilityEnv(16, stand, simulator_options=options, decision_steps=2, episode_length=0.2, depth={})
    check_env_specs(env)
    td = env.rollout(8, break_when_any_done=False)
    assert all(value.device == env.simulator.device for value in td.values(True, True))
    assert bool(td["next", "done"].any())
    env.close()
