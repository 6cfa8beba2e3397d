"""How many depth images a second does the camera take on the full course, beside bare ``mj_multiRay``?

The camera with all robots on its threads, and bare ``mj_multiRay`` on one thread with rays, poses and the model of the
physics prepared, run in turns in one process, so that their ratio does not depend on what else the machine does.

    python benchmarks/depth.py --robots 256 --threads 2
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable

import mujoco
import numpy as np
import torch
import turns

from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.go2 import camera


def bare(env: AgilityEnv, robots: int) -> Callable[[], None]:
    """One cast of all rays for each robot on the model of the physics, everything else done before."""
    simulator = env.simulator
    model, trunk = simulator.model, simulator.model.body("trunk").id
    directions = camera.pixel_directions().double().numpy().reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    scenes = []
    for row in range(robots):
        data = mujoco.MjData(model)
        for field in ("qpos", "mocap_pos", "mocap_quat"):
            getattr(data, field)[:] = simulator.batch.bind(field)[row]
        mujoco.mj_kinematics(model, data)
        turn = data.xmat[trunk].reshape(3, 3)
        rays = np.ascontiguousarray(directions @ turn.T).reshape(-1)
        scenes.append((data, data.xpos[trunk] + turn @ np.array(camera.POSITION), rays))
    number = len(directions)
    geom, distance = np.zeros(number, dtype=np.int32), np.zeros(number)

    def cast() -> None:
        for data, origin, rays in scenes:
            mujoco.mj_multiRay(model, data, origin, rays, None, 1, trunk, geom, distance, None, number, mujoco.mjMAXVAL)

    return cast


def main() -> None:
    """Run both in turns and print their rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=256)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--course", choices=sorted(COURSES), default="full")
    parser.add_argument("--rounds", type=int, default=5, help="turns that each contender gets")
    options = parser.parse_args()
    robots = options.robots
    env = AgilityEnv(
        robots,
        lambda td: td,
        COURSES[options.course],
        simulator_options={"num_threads": options.threads},
        depth={},
    )
    env.reset()
    assert env.depth is not None
    eye, everyone, few = env.depth.camera, torch.ones(robots, dtype=torch.bool), min(robots, 32)
    noisy, cast = env.depth, bare(env, few)
    contenders: dict[str, Callable[[], float]] = {
        "bare mj_multiRay, one thread": lambda: turns.seconds(cast) / few,
        f"camera, {options.threads} threads": lambda: turns.seconds(lambda: eye.render(everyone)) / robots,
        "camera, noise, normalisation": lambda: turns.seconds(lambda: noisy.begin(everyone)) / robots,
    }
    found = turns.in_turns(contenders, options.rounds)
    load = os.getloadavg()[0]
    print(f"{robots} robots, course {options.course}, {eye.model.ngeom} shapes before the camera, load {load:.1f}")
    reference = found["bare mj_multiRay, one thread"]
    for name, times in found.items():
        ratio = turns.speed_up(reference, times)
        print(f"{name:32} {1.0 / statistics.median(times):8.0f} images/s {ratio:8.2f} x bare")
    env.close()


if __name__ == "__main__":
    main()
