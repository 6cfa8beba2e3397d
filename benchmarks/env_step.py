"""What share of the bare physics engine's speed is left in ``LocomotionEnv``?

Bare ``mujoco.batch.Batch.step``, our simulator, the environment, and the environment with resets run in turns, with the
same model, robots, substeps, threads and targets, so that their ratio does not depend on what else the machine does.

    python benchmarks/env_step.py --robots 1024 --threads 2

With ``--peer PYTHON`` mjbatch's engine, which that other environment has (``peer.py``), takes its turns too.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
import torch
import turns
from peer import Peer
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import Randomization
from agility_rl.envs.rewards import LOCOMOTION_REWARDS, RewardTerm, rhythm, velocity_progress
from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.motion.gaits import synthetic_dataset_clips
from agility_rl.motion.stride_patterns import stride_patterns
from agility_rl.simulation import make_simulator

SIM_DT, CONTROL_DT = 0.005, 0.02
SUBSTEPS = round(CONTROL_DT / SIM_DT)


def bare(robots: int, threads: int) -> Callable[[Tensor], None]:
    """The engine alone: write the targets, step."""
    model = build_spec(sim_dt=SIM_DT).compile()
    batch = mujoco.batch.Batch(model, robots, threads)
    batch.bind("qpos")[:] = standing(model)
    batch.forward()
    control = batch.bind("ctrl")

    def step(target: Tensor) -> None:
        control[:] = target.numpy()
        batch.step(nstep=SUBSTEPS)

    return step


def standing(model: mujoco.MjModel) -> np.ndarray:
    """Where a robot begins."""
    position = model.qpos0.copy()
    position[2] = constants.STANDING_HEIGHT + 0.005
    position[[model.jnt_qposadr[model.joint(name).id] for name in constants.JOINT_NAMES]] = constants.DEFAULT_POSE
    return position


def mjbatch(python: Path, targets: Tensor, threads: int, folder: Path) -> Peer:
    """The engine of mjbatch, which has an earlier MuJoCo: a turn of it is all targets."""
    spec = build_spec(sim_dt=SIM_DT)
    model = spec.compile()
    # Position is what an actuator takes there; MuJoCo 4 says so, and earlier ones do not know the word.
    (folder / "model.xml").write_text(spec.to_xml().replace(' input="pos"', ""), encoding="utf-8")
    np.save(folder / "start.npy", standing(model))
    np.save(folder / "targets.npy", targets.numpy())
    return Peer(python, Path(__file__).with_name("peer_mjbatch.py"), str(folder), str(threads), str(SUBSTEPS))


def simulator(robots: int, threads: int) -> Callable[[Tensor], None]:
    """Our simulator: the same and the state as float32 tensors."""
    simulation = make_simulator(num_simulations=robots, num_threads=threads, sim_dt=SIM_DT, control_dt=CONTROL_DT)
    n = robots
    simulation.reset(
        torch.ones(n, dtype=torch.bool),
        root_position=torch.tensor([0.0, 0.0, constants.STANDING_HEIGHT + 0.005]).repeat(n, 1),
        root_quaternion=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        root_linear_velocity=torch.zeros(n, 3),
        root_angular_velocity=torch.zeros(n, 3),
        joint_position=torch.tensor(constants.DEFAULT_POSE).repeat(n, 1),
        joint_velocity=torch.zeros(n, 12),
    )
    return simulation.step


def as_trained() -> dict[str, Any]:
    """What the preset ``cpu`` of ``recipes/bbc_pretrain.py`` adds: half a second of motion, speed and rhythm.

    Dry friction, which it leaves out, is there in all contenders: without, the engine is faster.
    """
    terms = {"velocity_progress": RewardTerm(8.0, velocity_progress), "rhythm": RewardTerm(20.0, rhythm)}
    return {
        "motion_offsets": (0, 8, 16, 23, 24),
        "patterns": stride_patterns(synthetic_dataset_clips(0)[0]),
        "rewards": LOCOMOTION_REWARDS | terms,
    }


def environment(robots: int, threads: int, resets: bool = False, **options: Any) -> Callable[[Tensor], None]:
    """The environment: observations, rewards, commands."""
    env = LocomotionEnv(
        robots,
        simulator_options={"num_threads": threads, "sim_dt": SIM_DT, "control_dt": CONTROL_DT},
        **options,
    )
    carrier = env.reset()
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)

    def step(target: Tensor) -> None:
        nonlocal carrier
        action = (target - pose) / scale
        if resets:
            carrier[keys.ACTION] = action
            carrier = env.step_and_maybe_reset(carrier)[1]
        else:
            env.step(TensorDict({keys.ACTION: action}, [robots]))

    return step


def main() -> None:
    """Run all contenders in turns and print their rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--rounds", type=int, default=10, help="turns that each contender gets")
    parser.add_argument("--steps", type=int, default=25, help="control steps a turn")
    parser.add_argument("--peer", type=Path, help="Python of an environment with mjbatch")
    options = parser.parse_args()
    robots, threads = options.robots, options.threads
    disturbed = {"randomization": Randomization(), "observation_noise": 1.0, "push_interval": 8.0}
    contenders = {
        "bare Batch.step": bare(robots, threads),
        "simulator": simulator(robots, threads),
        "env.step": environment(robots, threads),
        "env.step, as the preset cpu trains": environment(robots, threads, **as_trained()),
        "env.step, noise, randomised, pushed": environment(robots, threads, **disturbed),
        "the same with resets": environment(robots, threads, resets=True, **disturbed),
    }
    targets = turns.shifting_weight(options.steps, robots)
    steppers = {name: turns.through(step, targets) for name, step in contenders.items()}
    with tempfile.TemporaryDirectory() as folder:
        peer = None
        if options.peer is not None:
            peer = mjbatch(options.peer, targets, threads, Path(folder))
            steppers["mjbatch's Batch.step"] = peer.ask
        found = turns.in_turns(steppers, options.rounds)
        if peer is not None:
            peer.close()
    print(turns.circumstances(robots, threads))
    turns.print_rates(found, robots * options.steps, "steps")


if __name__ == "__main__":
    main()
