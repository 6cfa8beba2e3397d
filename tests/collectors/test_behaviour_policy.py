from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl.collectors import BehaviourPolicy, RobotSensors, roll_out
from agility_rl.envs import LocomotionEnv
from agility_rl.modules import BasicBehaviourController
from agility_rl.simulation import BatchSimulator

COMMAND = torch.tensor([0.5, 0.1, -0.2, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])


class Watched:
    """Remembers what a policy is given."""

    def __init__(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self.policy, self.seen = policy, []

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        self.seen.append(td.clone())
        return self.policy(td)


def small() -> BasicBehaviourController:
    return BasicBehaviourController(hidden=(8,), initial_std=0.3)


def test_it_sees_what_the_environment_shows() -> None:
    """Same physics, same start, same controller: observations of the environment and of the measured policy agree."""
    bbc = small()
    env = LocomotionEnv(2, simulator_options={"num_threads": 1}, resample_period=None)
    env.set_commands(torch.tensor([2, 2]), COMMAND[:5].repeat(2, 1))
    td, shown = env.reset(), []
    deployable = bbc.deployable_policy()
    watched = Watched(deployable)
    policy = BehaviourPolicy(watched, COMMAND)
    simulator = BatchSimulator(2, num_threads=1)
    start = TensorDict(
        {
            name: getattr(env.simulator, name)[:1].clone()
            for name in (
                "root_position",
                "root_quaternion",
                "root_linear_velocity",
                "root_angular_velocity",
                "joint_position",
                "joint_velocity",
            )
        },
        [1],
    )
    generator = torch.Generator().manual_seed(0)
    rollout = roll_out(simulator, policy, 15, sensors=RobotSensors(2), generator=generator, start=start)
    for step in range(15):
        shown.append(td.select("proprioception", "history", "command"))
        td["action"] = rollout["action"][:, step]
        td = env.step_mdp(env.step(td))
    for step, observation in enumerate(shown):
        for name in ("proprioception", "history", "command"):
            torch.testing.assert_close(watched.seen[step][name], observation[name], atol=1e-5, rtol=1e-5)
    env.close()
    simulator.close()


def measured(value: float, is_init: list[bool]) -> TensorDict:
    n = len(is_init)
    sizes = {"roll_pitch": 2, "angular_velocity": 3, "joint_position": 12, "joint_velocity": 12, "action": 12}
    entries = {name: torch.full((n, size), value) for name, size in sizes.items()}
    entries |= {"foot_contact": torch.ones(n, 4, dtype=torch.bool), "is_init": torch.tensor(is_init)[:, None]}
    return TensorDict(entries, [n])


def test_a_reset_fills_the_history_of_that_robot_only() -> None:
    watched = Watched(small().deployable_policy())
    policy = BehaviourPolicy(watched, COMMAND)
    for value, is_init in ((1.0, [True, True]), (2.0, [False, False]), (3.0, [False, True])):
        policy(measured(value, is_init))
    roll = watched.seen[-1]["history"][..., 0]
    assert roll[0].tolist() == [1.0] * 8 + [2.0, 3.0]
    assert roll[1].tolist() == [3.0] * 10


def test_a_schedule_counts_the_steps_of_each_robot() -> None:
    def schedule(steps: Tensor) -> Tensor:
        return steps[:, None].float().expand(-1, 11)

    watched = Watched(small().deployable_policy())
    policy = BehaviourPolicy(watched, schedule)
    for is_init in ([True, True], [False, False], [False, True], [False, False]):
        policy(measured(0.0, is_init))
    assert [td["command"][:, 0].tolist() for td in watched.seen] == [[0, 0], [1, 1], [2, 0], [3, 1]]


def test_deterministic_or_drawn() -> None:
    bbc = small()
    same = [BehaviourPolicy(bbc.deployable_policy(), COMMAND)(measured(0.1, [True])) for _ in range(2)]
    drawn = [
        BehaviourPolicy(bbc.deployable_policy(), COMMAND, deterministic=False)(measured(0.1, [True])) for _ in range(2)
    ]
    assert torch.equal(same[0], same[1])
    assert not torch.equal(drawn[0], drawn[1])
    assert not same[0].requires_grad
