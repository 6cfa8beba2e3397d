"""Do the two simulators agree, and what do their wrappers cost?

1. Short: both start from one state and hold the same targets, on the plane, on rough ground and on the full course.
   Printed is how far apart their trunks are after some control steps.
2. Long: a controller, every behaviour at its middle command, in an environment of each. Printed are falls, speed,
   reward and the share of time in which a foot is on the ground, with 95 % intervals over robots.
3. Speed: each engine alone, our simulator, and the environment, in turns in one run.

    python benchmarks/engines.py                      # Warp's CPU device: right, and slow
    python benchmarks/engines.py --device cuda --robots 4096
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco.batch
import mujoco_warp
import torch
import turns
import warp
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys, rotations
from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS, command_bounds
from agility_rl.envs import COURSES, LocomotionEnv
from agility_rl.envs.layout import CourseLayout
from agility_rl.envs.robots import CLEARANCE
from agility_rl.go2 import constants, features
from agility_rl.go2.model import build_spec
from agility_rl.simulation import Simulator, make_simulator, rough_pyramids, simulator_device

sys.path.insert(0, str(Path(__file__).parents[1] / "recipes"))
from rollouts import drive, load_controller

SHOWN = (1, 2, 5, 10, 25, 50)
POSE = torch.tensor(constants.DEFAULT_POSE)
START = torch.tensor([0.0, 0.0, constants.STANDING_HEIGHT + CLEARANCE, 1.0, 0.0, 0.0, 0.0, *constants.DEFAULT_POSE])
SUBSTEPS = round(constants.CONTROL_DT / constants.SIM_DT)


def options_of(engine: str, args: argparse.Namespace) -> dict[str, Any]:
    """What makes a simulator of one engine."""
    return (
        {"name": "batch", "num_threads": args.threads} if engine == "batch" else {"name": "warp", "device": args.device}
    )


def apart(args: argparse.Namespace, ground: str) -> list[Tensor]:
    """Distances ``[N]`` [m] of the trunks after each step."""
    generator, robots = torch.Generator().manual_seed(args.seed), 64
    everyone = torch.ones(robots, dtype=torch.bool)
    place, yaw = torch.zeros(robots, 2), torch.zeros(robots)
    extra: dict[str, Any] = {}
    layout = None
    if ground == "rough":
        extra["terrain"] = rough_pyramids(generator, tiles=2)
        place = 8.0 * torch.rand(robots, 2, generator=generator) - 4.0
    elif ground == "course":
        layout = CourseLayout(COURSES["full"], robots, generator)
        layout.draw(everyone)
        extra["scenery"] = layout.pieces
        which = torch.arange(robots) % len(layout.kinds)
        place = layout.world(which, torch.tensor([-0.5, 0.0]).expand(robots, 2))
        yaw = layout.yaw[torch.arange(robots), which]
    commanded = POSE + 0.25 * torch.randn(max(SHOWN), robots, 12, generator=generator)
    paths = []
    for engine in ("batch", "warp"):
        simulator: Simulator = make_simulator(num_simulations=robots, **options_of(engine, args), **extra)
        device = simulator.root_position.device
        height = simulator.ground_height(place.to(device)).cpu()
        if layout is not None:
            simulator.place(everyone.to(device), *(part.to(device) for part in layout.poses()))
        state = {
            "root_position": torch.cat((place, 0.34 + height[:, None]), -1),
            "root_quaternion": rotations.from_euler(0.0 * yaw, 0.0 * yaw, yaw),
            "root_linear_velocity": torch.zeros(robots, 3),
            "root_angular_velocity": torch.zeros(robots, 3),
            "joint_position": POSE.repeat(robots, 1),
            "joint_velocity": torch.zeros(robots, 12),
        }
        simulator.reset(everyone.to(device), **{name: value.to(device) for name, value in state.items()})
        path = []
        for target in commanded.to(device):
            simulator.step(target)
            path.append(simulator.root_position.cpu())
        simulator.close()
        paths.append(path)
    return [torch.linalg.vector_norm(ours - theirs, dim=-1) for ours, theirs in zip(*paths, strict=True)]


def statistics_of(args: argparse.Namespace, engine: str, rough: bool) -> dict[str, Tensor]:
    """Figures of each robot ``[N]`` under the controller."""
    controller = load_controller(args.controller)
    robots = args.episodes * NUM_BEHAVIOURS
    extra: dict[str, Any] = {}
    if rough:
        extra["terrain"] = rough_pyramids(torch.Generator().manual_seed(args.seed), tiles=2)
    env = LocomotionEnv(
        robots,
        simulator_options={**options_of(engine, args), "friction_loss": controller.friction_loss, **extra},
        episode_length=1e6,
        resample_period=None,
        seed=args.seed,
    )
    skill = torch.arange(NUM_BEHAVIOURS).repeat_interleave(args.episodes)
    low, high = command_bounds()
    command = ((low + high) / 2.0)[skill]
    fell = torch.zeros(robots, dtype=torch.bool)
    sums = {name: torch.zeros(robots) for name in ("speed, m/s", "reward", "feet on the ground")}
    alive = torch.zeros(robots)
    feet = list(constants.FOOT_GROUPS)
    steps = round(args.seconds / constants.CONTROL_DT)
    for td in drive(controller.bbc.to(env.device), env, [(steps, skill, command)]):
        fell |= td["terminated"][:, 0].cpu()
        up = (~fell).float()
        alive += up
        velocity = rotations.rotate_inverse(env.simulator.root_quaternion, env.simulator.root_linear_velocity)
        sums["speed, m/s"] += up * velocity[:, 0].cpu()
        sums["reward"] += up * td["reward"][:, 0].cpu()
        pressed = env.simulator.contact_force[:, feet] > features.FOOT_CONTACT_FORCE
        sums["feet on the ground"] += up * pressed.float().mean(-1).cpu()
    env.close()
    return {"fell": fell.float(), **{name: total / alive.clamp(min=1.0) for name, total in sums.items()}}


def contenders(args: argparse.Namespace) -> dict[str, Callable[[Tensor], None]]:
    """What is timed: bare engine, simulator and environment of each."""
    found: dict[str, Callable[[Tensor], None]] = {}
    for engine in ("batch", "warp"):
        found[f"{engine}, bare"] = (
            bare_batch(args.robots, args.threads)
            if engine == "batch"
            else bare_warp(args.robots, simulator_device("warp", args.device))[0]
        )
        found[f"{engine}, simulator"] = make_simulator(num_simulations=args.robots, **options_of(engine, args)).step
        env = LocomotionEnv(args.robots, simulator_options=options_of(engine, args))
        found[f"{engine}, env.step"] = env_step(env)
    return found


def bare_batch(robots: int, threads: int) -> Callable[[Tensor], None]:
    """MuJoCo's batch alone: write the targets, step."""
    batch = mujoco.batch.Batch(build_spec(sim_dt=constants.SIM_DT).compile(), robots, threads)
    batch.bind("qpos")[:] = START.numpy()
    control = batch.bind("ctrl")

    def step(target: Tensor) -> None:
        control[:] = target.numpy()
        batch.step(nstep=SUBSTEPS)

    return step


def bare_warp(robots: int, device: torch.device, model: Any = None) -> tuple[Callable[[Tensor], None], Tensor, Tensor]:
    """Mujoco-warp alone, on a GPU as a CUDA graph; beside it positions and velocities of its robots.

    The model must be that of what it is compared with: dry friction alone is 12 constraints more for every robot.
    """
    with warp.ScopedDevice(warp.device_from_torch(device)):
        model = build_spec(sim_dt=constants.SIM_DT).compile() if model is None else model
        there = mujoco_warp.put_model(model)
        data = mujoco_warp.make_data(model, robots, nconmax=48, njmax=306)
        position, velocity, command = (warp.to_torch(array) for array in (data.qpos, data.qvel, data.ctrl))
        position.copy_(START.expand_as(position))
        mujoco_warp.step(there, data)  # compiles
        graph = None
        if device.type == "cuda":
            with warp.ScopedCapture() as capture:
                mujoco_warp.step(there, data)
            graph = capture.graph

    def step(target: Tensor) -> None:
        command.copy_(target)
        with warp.ScopedDevice(warp.device_from_torch(device)):
            for _ in range(SUBSTEPS):
                if graph is None:
                    mujoco_warp.step(there, data)
                else:
                    warp.capture_launch(graph)

    return step, position, velocity


def env_step(env: LocomotionEnv) -> Callable[[Tensor], None]:
    """Observations and rewards too, without resets."""
    env.reset()
    pose, scale = POSE.to(env.device), torch.tensor(constants.ACTION_SCALE, device=env.device)

    def step(target: Tensor) -> None:
        env.step(TensorDict({keys.ACTION: (target - pose) / scale}, [env.num_robots]))

    return step


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--controller", type=Path, default=Path("pretrained/bbc_joined"))
    parser.add_argument("--device", default="cpu", help="of Warp")
    parser.add_argument("--robots", type=int, default=256, help="of the speed")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--episodes", type=int, default=20, help="robots of each behaviour")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each episode")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each contender; 0 leaves the speed out")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print("distance of the trunks, mm: median (90 %) of 64 robots, random targets")
    print("ground    " + "".join(f"{f'{step} steps':>20}" for step in SHOWN))
    for ground in ("plane", "rough", "course"):
        found = [1e3 * apart_at for apart_at in apart(args, ground)]
        cells = [f"{found[step - 1].median():.3g} ({found[step - 1].quantile(0.9):.3g})" for step in SHOWN]
        print(f"{ground:10}" + "".join(f"{cell:>20}" for cell in cells), flush=True)
    print(f"\n{args.controller}, {args.episodes} robots each of {', '.join(BEHAVIOURS)}, {args.seconds:g} s")
    for rough in (False, True):
        for engine in ("batch", "warp"):
            figures = statistics_of(args, engine, rough)
            cells = [
                f"{name} {values.mean():.3f} ± {1.96 * values.std() / math.sqrt(len(values)):.3f}"
                for name, values in figures.items()
            ]
            print(f"{'rough' if rough else 'plane':6} {engine:6} {', '.join(cells)}", flush=True)
    if args.rounds:
        speed(args)


def speed(args: argparse.Namespace) -> None:
    """Steps a second of all contenders, in turns."""
    steps = 10
    targets = turns.shifting_weight(steps, args.robots, args.seed)
    there = {"batch": turns.CPU, "warp": torch.device(args.device)}
    steppers = {}
    for name, step in contenders(args).items():
        device = there[name.split(",")[0]]
        steppers[name] = turns.through(step, targets.to(device), device)
    found = turns.in_turns(steppers, args.rounds)
    print(f"\n{turns.circumstances(args.robots, args.threads)}, Warp on {args.device}")
    for engine in there:
        own = {name: times for name, times in found.items() if name.startswith(engine)}
        turns.print_rates(own, args.robots * steps, "steps")


if __name__ == "__main__":
    main()
