"""Where the time of one iteration of the student's training goes: depth, networks, physics.

Untrained networks of the published sizes, but for teacher and actor (256-128-64, as ``cpu`` has), on the full course;
wall time, and the CPU time of all threads, which other work on the machine disturbs less.

    python benchmarks/student_iteration.py --robots 64 --threads 2
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from agility_rl.collectors import DAggerCollector
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.go2.camera import dequantize
from agility_rl.losses import BYOLLoss, StudentLoss
from agility_rl.modules import BYOL, BasicBehaviourController, DepthAugmentation, RecurrentStudent, Teacher

GROUPS = {
    "depth": ("camera",),
    "networks": ("student acts", "teacher labels", "imitation", "BYOL", "augmentation"),
    "physics and BBC": ("physics", "BBC"),
}


class Stopwatch:
    """Wall and CPU seconds by name, without what watched functions within spent."""

    def __init__(self) -> None:
        self.spent: dict[str, list[float]] = {}
        self._inner = [[0.0, 0.0]]

    def watch(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed."""

        def timed(*arguments: Any, **options: Any) -> Any:
            start = (time.perf_counter(), time.process_time())
            self._inner.append([0.0, 0.0])
            result = function(*arguments, **options)
            inner = self._inner.pop()
            whole = (time.perf_counter() - start[0], time.process_time() - start[1])
            own = self.spent.setdefault(name, [0.0, 0.0])
            for index in range(2):
                own[index] += whole[index] - inner[index]
                self._inner[-1][index] += whole[index]
            return result

        return timed


def main() -> None:
    """Run some iterations and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--steps", type=int, default=24, help="decisions of a window")
    parser.add_argument("--decision-steps", type=int, default=5, help="control steps of a decision")
    parser.add_argument("--minibatches", type=int, default=4)
    parser.add_argument("--byol-images", type=int, default=384, help="images of BYOL in an iteration; 0 for no BYOL")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--iterations", type=int, default=2, help="after one that warms up")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    watch, generator = Stopwatch(), torch.Generator().manual_seed(0)
    policy = BasicBehaviourController().deployable_policy()

    def controller(td: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(td)

    env = AgilityEnv(
        options.robots,
        watch.watch("BBC", controller),
        COURSES["full"],
        simulator_options={"num_threads": options.threads},
        decision_steps=options.decision_steps,
        depth={},
    )
    teacher = Teacher(hidden=(256, 128, 64))
    student = RecurrentStudent.from_teacher(teacher)
    student.depth_encoder.to(memory_format=torch.channels_last)
    acting, labelling = student.policy(assisted=True), teacher.privileged_policy()
    for target, method, name in (
        (env.simulator, "step", "physics"),
        (env.depth, "begin", "camera"),
        (env.depth, "advance", "camera"),
        (acting, "forward", "student acts"),
        (labelling, "forward", "teacher labels"),
    ):
        setattr(target, method, watch.watch(name, getattr(target, method)))
    hidden = student.initial_hidden(options.robots)
    collector = DAggerCollector(env, acting, labelling, options.steps, initial_hidden=hidden)
    loss, byol = StudentLoss(student.policy(assisted=True, sequence=True)), BYOLLoss(BYOL(student.depth_encoder))
    average = SoftUpdate(byol, eps=0.99)
    augmentation = DepthAugmentation(generator)
    augment = watch.watch("augmentation", lambda images: augmentation.augment(dequantize(images)))
    optimizer = torch.optim.Adam(student.parameters(), lr=1e-3)
    byol_optimizer = torch.optim.Adam([p for p in byol.parameters() if p.requires_grad], lr=3e-4)

    def imitate(window: TensorDictBase) -> None:
        for rows in torch.randperm(options.robots, generator=generator).chunk(options.minibatches):
            sample = window[:, rows]
            sample["depth"] = augment(sample["depth"])
            losses = loss(sample)
            optimizer.zero_grad()
            torch.stack([value for name, value in losses.items() if name.startswith("loss_")]).sum().backward()
            optimizer.step()

    def represent(window: TensorDictBase) -> None:
        images = window["depth"].flatten(0, 1)
        images = images[torch.randperm(len(images), generator=generator)[: options.byol_images]]
        views = {f"view_{n}": {"depth": augment(images)} for n in (1, 2)}
        byol_optimizer.zero_grad()
        byol(TensorDict(views, [len(images)]))["loss_byol"].backward()
        byol_optimizer.step()
        average.step()

    collect, represent = watch.watch("rest of the collection", collector.collect), watch.watch("BYOL", represent)
    imitate = watch.watch("imitation", imitate)
    for iteration in range(options.iterations + 1):
        if iteration == 1:
            watch.spent.clear()
        window = collect()
        imitate(window)
        if options.byol_images:
            represent(window)
    env.close()
    images, load = options.robots * options.steps, os.getloadavg()[0]
    wall, cpu = (sum(spent[index] for spent in watch.spent.values()) / options.iterations for index in range(2))
    print(f"{images} images, {images * options.decision_steps} control steps an iteration; load {load:.1f}")
    print(f"{'':24}{'wall s':>8}{'CPU s':>8}{'share of CPU':>14}")
    for name, spent in sorted(watch.spent.items(), key=lambda item: -item[1][1]):
        one, other = (seconds / options.iterations for seconds in spent)
        print(f"{name:24}{one:8.2f}{other:8.2f}{100.0 * other / cpu:12.0f} %")
    print(f"{'all':24}{wall:8.2f}{cpu:8.2f}")
    for name, members in GROUPS.items():
        share = sum(watch.spent[member][1] for member in members if member in watch.spent) / options.iterations / cpu
        print(f"{name}: {100.0 * share:.0f} %")


if __name__ == "__main__":
    main()
