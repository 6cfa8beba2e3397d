from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl.collectors import RobotSensors, fallen, roll_out, standing_states
from agility_rl.go2 import constants
from agility_rl.simulation import BatchSimulator

Simulate = Callable[..., BatchSimulator]
POSE = torch.tensor(constants.DEFAULT_POSE)


def run(simulator: BatchSimulator, policy: Any, steps: int = 20, seed: int = 0, **options: Any) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    sensors = RobotSensors(simulator.num_simulations, generator=generator)
    return roll_out(simulator, policy, steps, sensors=sensors, generator=generator, **options)


def collapse(measured: TensorDictBase) -> Tensor:
    """The first robot lies down on its side, the others stand."""
    action = torch.zeros(len(measured), 12)
    action[0] = torch.tensor([8.0, 8.0, -3.0, 8.0, 8.0, -3.0] * 2)
    return action


def test_it_is_the_simulator_stepped_by_hand(simulate: Simulate, swing: Any) -> None:
    rollout = run(simulate(2), swing(), 10)
    assert rollout.shape == (2, 10)
    assert rollout.names == [None, "time"]
    by_hand, policy = simulate(2), swing()
    start = {name: value.expand(2, -1).clone() for name, value in standing_states().items()}
    by_hand.reset(torch.ones(2, dtype=torch.bool), **start)
    for step in range(10):
        assert torch.equal(rollout["measurement"][:, step, 5:17], by_hand.joint_position)
        is_init = torch.full((2, 1), step == 0)
        action = policy(TensorDict({"is_init": is_init}, [2]))
        assert torch.equal(rollout["action"][:, step], action)
        by_hand.step(POSE + torch.tensor(constants.ACTION_SCALE) * action)
        assert torch.equal(rollout["next", "measurement"][:, step, 17:29], by_hand.joint_velocity)


def test_what_follows_is_the_next_state(simulate: Simulate, swing: Any) -> None:
    rollout = run(simulate(2), swing(), 15)
    assert torch.equal(rollout["next", "measurement"][:, :-1], rollout["measurement"][:, 1:])
    assert rollout["is_init"][:, 0].all()
    assert not rollout["is_init"][:, 1:].any()
    assert rollout["collector", "mask"].all()


def test_no_transition_crosses_a_reset(simulate: Simulate) -> None:
    simulator = simulate(2)
    rollout = run(simulator, collapse, 60)
    down = rollout["next", "fallen"][0, :, 0]
    assert down.any()
    assert not rollout["next", "fallen"][1].any()
    assert torch.equal(rollout["is_init"][0, 1:, 0], down[:-1])
    first = rollout["measurement"][0, 0]
    for step in down[:-1].nonzero()[:, 0].tolist():
        before, after = rollout["next", "measurement"][0, step], rollout["measurement"][0, step + 1]
        torch.testing.assert_close(after, first)  # the start state
        assert (before - after).abs().max() > 0.3  # the state of the fall, as it was before the reset
    assert torch.equal(rollout["next", "measurement"][1, :-1], rollout["measurement"][1, 1:])


def test_the_policy_sees_its_last_action_and_its_resets(simulate: Simulate) -> None:
    seen: list[TensorDictBase] = []

    def policy(measured: TensorDictBase) -> Tensor:
        seen.append(measured)
        return collapse(measured)

    rollout = run(simulate(2), policy, 60)
    for step in range(1, 60):
        reset = rollout["is_init"][:, step]
        assert torch.equal(seen[step]["is_init"], reset)
        expected = rollout["action"][:, step - 1].masked_fill(reset, 0.0)
        assert torch.equal(seen[step]["action"], expected)
    assert torch.equal(seen[7]["joint_velocity"], rollout["measurement"][:, 7, 17:29])
    assert seen[7]["foot_contact"].dtype == torch.bool


def test_diverged_transitions_are_masked_and_finite(simulate: Simulate, swing: Any) -> None:
    simulator = simulate(2)

    class Spoiling(swing):
        count = 0

        def __call__(self, measured: TensorDictBase) -> Tensor:
            self.count += 1
            if self.count == 5:  # what a wrong parameter can do to a state
                simulator.batch.bind("qvel")[0, 3] = 1e12
            return super().__call__(measured)

    rollout = run(simulator, Spoiling(), 10)
    assert rollout["collector", "mask"][0].tolist() == [True] * 4 + [False] + [True] * 5
    assert rollout["next", "unstable"][0, 4]
    assert rollout["is_init"][0, 5]
    assert torch.equal(rollout["next", "measurement"][0, 4], rollout["measurement"][0, 4])
    assert all(value.isfinite().all() for value in rollout.values(True, True))
    assert rollout["collector", "mask"][1].all()


def test_start_states_are_drawn(simulate: Simulate, swing: Any) -> None:
    start = torch.cat([standing_states(), standing_states(0.5)])
    start["joint_position"][1] += 0.1
    rollout = run(simulate(12), swing(), 1, start=start)
    hips = rollout["measurement"][:, 0, 5]
    assert (10.0 * hips).round().unique().tolist() == [0.0, 1.0]


@pytest.mark.parametrize("threads", [1, 2])
def test_result_depends_on_the_seed_only(simulate: Simulate, swing: Any, threads: int) -> None:
    def noisy(num_threads: int, seed: int) -> TensorDict:
        generator = torch.Generator().manual_seed(seed)
        sensors = RobotSensors(5, noise=0.1, latency=1, generator=generator)
        simulator = simulate(5, num_threads=num_threads)
        return roll_out(simulator, collapse, 40, sensors=sensors, generator=generator)

    one, other = noisy(1, 3), noisy(threads, 3)
    assert all(torch.equal(one[key], other[key]) for key in one.keys(True, True))
    assert not torch.equal(noisy(1, 4)["measurement"], one["measurement"])


def test_standing_is_no_fall(simulate: Simulate) -> None:
    simulator = simulate(1)
    for _ in range(20):
        simulator.step(POSE[None])
    assert not fallen(simulator).any()


def test_errors(simulate: Simulate, swing: Any) -> None:
    simulator = simulate(2)
    with pytest.raises(ValueError, match="num_steps"):
        run(simulator, swing(), 0)
    with pytest.raises(ValueError, match="lack joint_velocity"):
        run(simulator, swing(), start=standing_states().exclude("joint_velocity"))
    with pytest.raises(ValueError, match=r"must return \[2, 12\], got \[12\]"):
        run(simulator, lambda measured: torch.zeros(12))
    with pytest.raises(ValueError, match=r"robots \[0, 1\] are not finite in step 0"):
        run(simulator, lambda measured: torch.full((2, 12), torch.nan))
