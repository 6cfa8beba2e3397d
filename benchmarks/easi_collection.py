"""What share of the bare physics engine's speed is left in ``EASICollector.collect``?

Bare ``mujoco.batch.Batch.step`` and the collector run in turns, with the same model, individuals, start states and
actions, so that their ratio does not depend on what else the machine does. A turn of the collector is a whole
collection: parameters, reset, sensors, falls, transitions. With ``--policy RUN`` a third contender asks a trained
controller for its actions, whose network costs as much in any collector.

    python benchmarks/easi_collection.py --robots 300 --steps 200 --threads 2
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
import turns
from tensordict import TensorDictBase
from torch import Tensor

from agility_rl.collectors import EASICollector, ParameterSpace, standing_states
from agility_rl.collectors.rollout import START_ENTRIES, MeasuredPolicy
from agility_rl.go2 import constants
from agility_rl.simulation import BatchSimulator

SPREAD = 0.1
"""Width of the individuals about the middle of the range: all stand, so that all contenders have the same contacts."""


def bare(simulator: BatchSimulator, space: ParameterSpace, individuals: Tensor, actions: Tensor) -> Callable[[], None]:
    """The engine alone: write the targets, step."""
    everyone = torch.ones(simulator.num_simulations, dtype=torch.bool)
    simulator.set_parameters(everyone, **space.fields(space.denormalize(individuals)))
    start = {name: standing_states()[name].expand(simulator.num_simulations, -1) for name in START_ENTRIES}
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
    targets = (pose + scale * actions).numpy()
    control = simulator.batch.bind("ctrl")

    def run() -> None:
        simulator.reset(everyone, **start)
        for target in targets:
            control[:] = target
            simulator.batch.step(nstep=simulator.substeps)

    return run


def collector(
    simulator: BatchSimulator, space: ParameterSpace, individuals: Tensor, steps: int, policy: MeasuredPolicy
) -> Callable[[], None]:
    """One collection of the same individuals."""
    made = EASICollector(simulator, space, policy, generator=torch.Generator().manual_seed(0), num_steps=steps)

    def run() -> None:
        made.collect(individuals)

    return run


def play(actions: Tensor) -> MeasuredPolicy:
    """The table of actions ``[T, N, 12]`` from the start of every collection."""
    step = 0

    def policy(measured: TensorDictBase) -> Tensor:
        nonlocal step
        step = 0 if bool(measured["is_init"].all()) else step + 1
        return actions[step]

    return policy


def main() -> None:
    """Run all contenders in turns and print their rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=300)
    parser.add_argument("--steps", type=int, default=200, help="control steps of a collection")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--rounds", type=int, default=5, help="turns that each contender gets")
    parser.add_argument("--policy", type=Path, default=None, help="run or artifact folder of a BBC")
    options = parser.parse_args()
    robots, steps, threads = options.robots, options.steps, options.threads
    generator = torch.Generator().manual_seed(0)
    space = ParameterSpace()
    individuals = 0.5 + SPREAD * (torch.rand(robots, len(space), generator=generator) - 0.5)
    # Robots that shift their weight about the default pose keep four feet on the ground.
    actions = 0.2 * torch.randn(steps, robots, constants.NUM_JOINTS, generator=generator)
    simulator = BatchSimulator(robots, num_threads=threads)
    contenders = {
        "bare Batch.step": bare(simulator, space, individuals, actions),
        "EASICollector": collector(simulator, space, individuals, steps, play(actions)),
    }
    if options.policy is not None:
        sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
        from log_policy import make_actor

        actor = make_actor(options.policy, ("walk", "trot"), 1.0)
        contenders["the same with a BBC"] = collector(simulator, space, individuals, steps, actor.policy)
    timed = {name: partial(turns.seconds, run) for name, run in contenders.items()}
    found = turns.in_turns(timed, options.rounds)
    print(turns.circumstances(robots, threads))
    turns.print_rates(found, robots * steps, "steps")


if __name__ == "__main__":
    main()
