"""How fast is a training of stage 1 at several sizes, on either engine, and where does it wait for a GPU?

In turns: the bare engine (``Batch.step``, or ``mujoco_warp.step`` captured as a graph) from where the simulator's
robots are, our simulator, ``LocomotionEnv.step``, a roll-out with policy and critic; then whole iterations, and on a
CPU those of a plain PyTorch loop in float32 (``plain_ppo.py``); as a preset of ``recipes/bbc_pretrain.py`` trains, on
synthetic gaits. On a GPU at last every place of the package where steps and roll-outs wait for it
(``torch.cuda.set_sync_debug_mode``).

    python benchmarks/training.py --robots 256 1024 4096
    python benchmarks/training.py --simulator warp --robots 1024 4096 16384
"""

from __future__ import annotations

import argparse
import gc
import math
import statistics
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from types import ModuleType
from typing import Any

import torch
import turns
from mujoco.batch import Batch
from plain_ppo import PHASES, Plain, load_recipe
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.go2 import constants
from agility_rl.simulation import BatchSimulator

SHOWN = ("bare", "simulator", "env.step", "roll-out", "iteration", "plain loop")
START = 400
"""First iteration; by then all ramps are over."""
OURS = ("agility_rl", "recipes")


@contextmanager
def waits() -> Iterator[Counter[str]]:
    """Count the places of the package at which the host waits for the GPU."""
    places: Counter[str] = Counter()

    def note(message: Warning | str, *where: Any, **options: Any) -> None:
        if "called a synchronizing" in str(message):
            frames = traceback.extract_stack()[:-1]
            ours = [frame for frame in frames if set(OURS) & set(Path(frame.filename).parts)] or frames
            places[f"{Path(ours[-1].filename).name}:{ours[-1].lineno} {ours[-1].line}"] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield places
        finally:
            torch.cuda.set_sync_debug_mode("default")


Bare = tuple[Callable[[Tensor], None], Callable[[], None]]
"""A control step of an engine alone, and what puts its robots where a simulator's are."""


def bare_batch(env: LocomotionEnv) -> Bare:
    """MuJoCo's own batch on the same model and threads."""
    simulator = env.simulator
    batch = Batch(simulator.model, env.num_robots, simulator.num_threads)
    control = batch.bind("ctrl")

    def step(target: Tensor) -> None:
        control[:] = target.numpy()
        batch.step(nstep=simulator.substeps)

    def begin() -> None:
        batch.state[:] = simulator.batch.state

    return step, begin


def bare_warp(env: LocomotionEnv) -> Bare:
    """Mujoco-warp on the same model and device."""
    import engines  # needs mujoco-warp

    step, position, velocity = engines.bare_warp(env.num_robots, env.device, env.simulator.model)

    def begin() -> None:
        state = env.simulator
        position.copy_(torch.cat((state.root_position, state.root_quaternion, state.joint_position), -1))
        velocity.copy_(torch.cat((state.root_linear_velocity, state.root_angular_velocity, state.joint_velocity), -1))

    return step, begin


def contenders(parts: Any, steps: int) -> tuple[dict[str, Callable[[], object]], Callable[[], None]]:
    """What is timed in turns; each takes so many control steps, the roll-out those of its preset.

    Beside them what comes before each turn: the bare engine's robots are put where the simulator's are.
    """
    env, robots = parts.env, parts.env.num_robots
    bare, begin = (bare_batch if isinstance(env.simulator, BatchSimulator) else bare_warp)(env)
    pose = torch.tensor(constants.DEFAULT_POSE, device=env.device)
    scale = torch.tensor(constants.ACTION_SCALE, device=env.device)
    targets = turns.shifting_weight(steps, robots).to(env.device)
    policy = parts.bbc.privileged_policy()
    env.reset()

    def every(step: Callable[[Tensor], object]) -> Callable[[], object]:
        return lambda: [step(target) for target in targets]

    def step_env(target: Tensor) -> None:
        env.step(TensorDict({keys.ACTION: (target - pose) / scale}, [robots]))

    return {
        "bare": every(bare),
        "simulator": every(env.simulator.step),
        "env.step": every(step_env),
        "roll-out": lambda: parts.rollout.collect(policy),
    }, begin


def measure(recipe: ModuleType, cfg: Any, args: argparse.Namespace, look: bool) -> None:
    """Print the figures of one number of robots; ``look`` for waits too."""
    parts, robots = recipe.build(cfg), cfg.env.num_robots
    device = parts.env.device
    works, begin = contenders(parts, args.steps)

    def after_begin(work: Callable[[], object]) -> float:
        begin()
        return turns.seconds(work, device)

    found = turns.in_turns({name: partial(after_begin, work) for name, work in works.items()}, args.rounds)
    steps = dict.fromkeys(works, args.steps) | {"roll-out": cfg.ppo.steps}
    rate = {name: robots * steps[name] / statistics.median(times) for name, times in found.items()}
    share = turns.speed_up(found["bare"], found["env.step"])
    loops = {"iteration": lambda number: recipe.iterate(parts, cfg, number)}
    if cfg.simulator == "batch":
        own = recipe.build(cfg)
        loops["plain loop"] = Plain(cfg, own.env, own.dataset).iterate
    laps: dict[str, list[dict[str, float]]] = {name: [] for name in loops}
    times: dict[str, list[float]] = {name: [] for name in loops}
    for number in range(START, START + args.rounds + 1):
        for name, iterate in loops.items():
            times[name].append(
                turns.seconds(lambda run=iterate, at=number, lap=laps[name]: lap.append(run(at)), device)
            )
    rate |= {name: robots * cfg.ppo.steps / statistics.median(spent[1:]) for name, spent in times.items()}
    most = torch.cuda.max_memory_allocated() if device.type == "cuda" else 1024 * getrusage(RUSAGE_SELF).ru_maxrss
    print(
        f"{robots:8}"
        + "".join(f"{rate.get(name, math.nan):12.0f}" for name in SHOWN)
        + f"{share:12.1%}{most / 2**30:8.1f}"
    )
    last = laps["iteration"][-1]
    print("         an iteration, s: " + ", ".join(f"{name} {last[f'time/{name}']:.3f}" for name in PHASES), flush=True)
    for name in ("env.step", "roll-out") if look else ():
        with waits() as places:
            works[name]()
        print(f"waits in {steps[name]} steps of {name}: {sum(places.values())}")
        for place, count in places.most_common(25):
            print(f"  {count:4}  {place}")
    parts.env.close()


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, nargs="+", default=[256, 1024, 4096])
    parser.add_argument("--simulator", choices=("batch", "warp"), default="batch", help="engine")
    parser.add_argument("--device", default="cuda", help="of warp and of everything else with it")
    parser.add_argument("--preset", default="cpu", help="preset of bbc_pretrain.py")
    parser.add_argument("--steps", type=int, default=24, help="control steps of a turn")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each contender")
    args = parser.parse_args()
    recipe, there = load_recipe(), args.simulator == "warp" and torch.device(args.device).type == "cuda"
    name = torch.cuda.get_device_name() if there else f"CPU, {torch.get_num_threads()} threads"
    print(name, f"- torch {torch.__version__}, control steps a second")
    print(f"{'robots':>8}" + "".join(f"{name:>12}" for name in SHOWN) + f"{'env/bare':>12}{'GiB':>8}")
    for robots in args.robots:
        preset = recipe.PRESETS[args.preset]
        sized = replace(preset.env, num_robots=robots)
        cfg = replace(preset, simulator=args.simulator, device=args.device, env=sized)
        measure(recipe, cfg, args, look=there and robots == args.robots[-1])
        gc.collect()
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
