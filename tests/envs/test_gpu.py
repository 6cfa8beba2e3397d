"""What runs on a GPU alone: environments on its tensors, and physics as the same engine computes it on a CPU."""

from __future__ import annotations

import warnings

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


def test_nobody_waits_for_it_in_a_rollout() -> None:
    """Robots fall, time out, and begin anew in every step; the host asks for nothing of that."""
    env = LocomotionEnv(256, simulator_options={"name": "warp", "device": DEVICE}, episode_length=0.2)
    actions = torch.zeros(256, 12, device=DEVICE)
    carrier = env.reset()
    for _ in range(20):  # what is made once is made by then
        carrier = env.step_and_maybe_reset(carrier.set("action", actions))[1]
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")  # also that this mode is a prototype
        torch.cuda.set_sync_debug_mode("warn")
        try:
            for _ in range(40):
                carrier = env.step_and_maybe_reset(carrier.set("action", actions))[1]
        finally:
            torch.cuda.set_sync_debug_mode("default")
    waits = [str(note.message) for note in noted if "called a synchronizing" in str(note.message)]
    assert len(waits) <= 2, "now and then something is made anew; not in every step"
    assert not bool(carrier["done"].any())
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
