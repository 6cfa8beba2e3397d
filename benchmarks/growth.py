"""How do costs grow with the number of robots, the size of the course and the size of the depth image?

Microseconds a robot and control step of ``LocomotionEnv`` and of ``AgilityEnv`` (50 decisions a second, no networks),
and microseconds a depth image. What is compared takes its turns in one run.

    python benchmarks/growth.py --threads 2
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable
from functools import partial
from unittest.mock import patch

import agility_speed
import env_step
import torch
import turns

from agility_rl.go2 import camera

COURSE_SIZES = ("tunnel", "bar_jump", "hurdles", "weave_poles", "box", "full", "full_walls")
IMAGE_SCALES = (0.5, 1.0, 2.0)
STEPS = 10
"""Control steps of a turn."""


def measured(contenders: dict[str, tuple[Callable[[], float], int]], rounds: int) -> dict[str, float]:
    """Median microseconds of each, divided by what it does at once."""
    found = turns.in_turns({name: run for name, (run, _) in contenders.items()}, rounds)
    return {name: 1e6 * statistics.median(times) / contenders[name][1] for name, times in found.items()}


def through(step: Callable[[torch.Tensor], None], robots: int) -> tuple[Callable[[], float], int]:
    """A turn of an environment, and how many steps of robots it is."""
    return turns.through(step, turns.shifting_weight(STEPS, robots)), STEPS * robots


def robots_grow(numbers: list[int], threads: int, rounds: int) -> dict[str, float]:
    """The locomotion environment as stage 1 trains in it."""
    return measured(
        {
            f"{robots} robots": through(env_step.environment(robots, threads, **env_step.as_trained()), robots)
            for robots in numbers
        },
        rounds,
    )


def courses_grow(robots: int, threads: int, rounds: int) -> dict[str, float]:
    """The agility environment on courses of one obstacle, and on those of all."""
    contenders, keep = {}, []
    for name in COURSE_SIZES:
        env, given = agility_speed.environment(robots, threads, name, 1)
        keep.append(env)
        shapes = env.simulator.model.ngeom
        contenders[f"{name}, {shapes} shapes"] = through(agility_speed.stepper(env, given), robots)
    found = measured(contenders, rounds)
    for env in keep:
        env.close()
    return found


def images_grow(robots: int, threads: int, rounds: int) -> dict[str, float]:
    """Depth images of all robots on the full course; rays through every pixel."""
    env, _ = agility_speed.environment(robots, threads, "full", 1)
    everyone, contenders = torch.ones(robots, dtype=torch.bool), {}
    for scale in IMAGE_SCALES:
        size = {
            "IMAGE_WIDTH": round(scale * camera.IMAGE_WIDTH),
            "IMAGE_HEIGHT": round(scale * camera.IMAGE_HEIGHT),
            "FOCAL_LENGTH": scale * camera.FOCAL_LENGTH,
            "PRINCIPAL_POINT": tuple(scale * x for x in camera.PRINCIPAL_POINT),
        }
        with patch.multiple(camera, **size):
            eye = env.simulator.make_camera()

        def render(eye=eye, size=size) -> None:
            with patch.multiple(camera, **size):
                eye.render(everyone)

        contenders[f"{size['IMAGE_WIDTH']} x {size['IMAGE_HEIGHT']} pixels"] = (partial(turns.seconds, render), robots)
    found = measured(contenders, rounds)
    env.close()
    return found


def main() -> None:
    """Measure the three and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[64, 256, 1024, 4096])
    parser.add_argument("--course-robots", type=int, default=256, help="robots on each course, and with a camera")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--rounds", type=int, default=5, help="turns that each contender gets")
    options = parser.parse_args()
    print(f"{options.threads} threads, {torch.get_num_threads()} torch threads, load {os.getloadavg()[0]:.1f}")
    few, threads, rounds = options.course_robots, options.threads, options.rounds
    tables = {
        "LocomotionEnv, a robot and step": lambda: robots_grow(options.robots, threads, rounds),
        f"AgilityEnv, {few} robots, a robot and step": lambda: courses_grow(few, threads, rounds),
        f"depth image, {few} robots on the full course": lambda: images_grow(few, threads, rounds),
    }
    for title, measure in tables.items():
        print(title)
        for name, microseconds in measure().items():
            print(f"  {name:28} {microseconds:8.1f} us")


if __name__ == "__main__":
    main()
