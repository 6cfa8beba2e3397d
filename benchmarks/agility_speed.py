"""What share of the bare physics engine's speed is left in ``AgilityEnv``, without any network?

Bare ``mujoco.batch.Batch.step`` on the same course model, our simulator, and the environment run in turns, with the
same robots, course, substeps, threads and joint targets, so that their ratio does not depend on what else the machine
does. The controller of the environment only hands out given targets; robots shift their weight before their obstacles.

    python benchmarks/agility_speed.py --robots 1024 --threads 2
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

import torch
import turns
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import NUM_BEHAVIOURS
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.envs.decisions import NUM_PARAMETERS
from agility_rl.go2 import constants


class GivenTargets:
    """Stands where the Basic Behaviour Controller would: answers with the action that was put in."""

    def __init__(self) -> None:
        self.action = torch.zeros(0)

    def __call__(self, seen: TensorDictBase) -> TensorDictBase:
        return seen.set(keys.ACTION, self.action)


def environment(robots: int, threads: int, course: str, hold: int) -> tuple[AgilityEnv, GivenTargets]:
    """A course whose episodes nothing ends, so that all contenders simulate the same."""
    given = GivenTargets()
    env = AgilityEnv(
        robots,
        given,
        COURSES[course],
        simulator_options={"num_threads": threads},
        terminations={"never": lambda state: state.at_goal & False},
        decision_steps=hold,
        episode_length=1e6,
    )
    env.reset()
    return env, given


def stepper(env: AgilityEnv, given: GivenTargets) -> Callable[[Tensor], None]:
    """Control steps of the environment, one decision for as many of them as it is held."""
    decision = TensorDict(
        {
            keys.BEHAVIOUR: torch.full((env.num_robots,), 2),
            keys.PARAMETERS: torch.zeros(env.num_robots, NUM_BEHAVIOURS, NUM_PARAMETERS),
        },
        [env.num_robots],
    )
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
    count = 0

    def step(target: Tensor) -> None:
        nonlocal count
        given.action = (target - pose) / scale
        if count % env.decision_steps == 0:
            env.step(TensorDict({keys.ACTION: decision}, [env.num_robots]))
        count += 1

    return step


def main() -> None:
    """Run all contenders in turns and print their rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--course", choices=sorted(COURSES), default="full")
    parser.add_argument("--rounds", type=int, default=10, help="turns that each contender gets")
    parser.add_argument("--steps", type=int, default=20, help="control steps a turn, a multiple of 5")
    options = parser.parse_args()
    robots, threads = options.robots, options.threads
    first, given = environment(robots, threads, options.course, 1)
    fifth, given_fifth = environment(robots, threads, options.course, 5)
    kept = [environment(robots, threads, options.course, 1)[0] for _ in range(2)]  # an environment closes what it holds
    bare, plain = (env.simulator for env in kept)
    control, substeps = bare.batch.bind("ctrl"), bare.substeps

    def engine(target: Tensor) -> None:
        control[:] = target.numpy()
        bare.batch.step(nstep=substeps)

    contenders = {
        "bare Batch.step, course model": engine,
        "simulator": plain.step,
        "env.step, 50 decisions/s": stepper(first, given),
        "env.step, 10 decisions/s": stepper(fifth, given_fifth),
    }
    targets = turns.shifting_weight(options.steps, robots)
    steppers = {name: turns.through(step, targets) for name, step in contenders.items()}
    found = turns.in_turns(steppers, options.rounds)
    print(turns.circumstances(robots, threads))
    turns.print_rates(found, robots * options.steps, "control steps")


if __name__ == "__main__":
    main()
