"""How long does a whole control step take on one core: depth image, student, behaviour controller, safety checks?

The controller runs as it does on a robot, as fast as it can instead of at 50 Hz, on a bus whose robot stands before a
wall. The image is new in every step; a decision is due every step too (``--decision-steps`` makes it rarer). Memory is
read before and after, to see whether a long run grows.

    python benchmarks/control_step.py pretrained/bbc_leaping --task pretrained/student_leaping --steps 180000  # an hour
    python benchmarks/control_step.py pretrained/bbc_course             # a student with random weights of full size
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np
import torch

from agility_rl.deploy import Artifact, Controller, DeployedBBC, DeployedStudent, Mode, SafetyLimits, SharedControl
from agility_rl.deploy.artifact import build_manifest
from agility_rl.deploy.behaviour import torch_network
from agility_rl.deploy.controller import StepRecord
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.depth import Frame
from agility_rl.deploy.task import describe_camera, torch_student
from agility_rl.deploy.transport import FakeBus
from agility_rl.go2 import features
from agility_rl.modules import RecurrentStudent


class NoisyWall:
    """A new image for every step, with holes that must be filled."""

    def __init__(self, clock: ManualClock) -> None:
        generator = np.random.default_rng(0)
        images = generator.integers(500, 4000, (8, 480, 848)).astype(np.uint16)
        images[generator.random(images.shape) < 0.2] = 0
        self.images, self.clock = images, clock

    def latest(self) -> Frame:
        """One of eight images in turn."""
        now = self.clock.now()
        return Frame(now, self.images[round(now / 0.02) % len(self.images)])


def random_student(bbc: str) -> Artifact:
    """As large as the paper's."""
    student = RecurrentStudent()
    manifest = build_manifest("student", features.CONTROLLER_LAYOUTS, control_period=0.02)
    manifest |= {"network": student.settings, "camera": describe_camera(), "bbc": bbc}
    return Artifact(student.state_dict(), manifest, Path("random weights"))


def resident() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bbc", type=Path, help="artifact folder of the behaviour controller")
    parser.add_argument("--task", type=Path, help="artifact folder of a student; random weights without it")
    parser.add_argument("--decision-steps", type=int, default=1, help="control steps of a decision")
    parser.add_argument("--steps", type=int, default=3000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    artifact = Artifact.load(options.bbc, kind="bbc")
    weights = artifact.manifest["weights"]["sha256"]
    student = random_student(weights) if options.task is None else Artifact.load(options.task, kind="student")
    clock = ManualClock()
    task = DeployedStudent(torch_student(student), student, NoisyWall(clock), period=0.02, bbc_weights=weights)
    task.steps = options.decision_steps
    control = SharedControl(task, 0.0)
    bbc = DeployedBBC(torch_network(artifact), artifact)
    bus = FakeBus(clock)
    bus.follow = False
    limits = SafetyLimits.from_manifest(artifact.manifest, commanded_torque=1e9)  # nobody moves the joints
    controller = Controller(bus, bbc, control, limits=limits, clock=clock)

    def step() -> StepRecord:
        control.heard(clock.now())
        bus.sent.clear()
        return controller.step()

    controller.request(Mode.STAND_UP)
    while step().mode is not Mode.READY:
        if controller.fault is not None:
            raise SystemExit(f"fault: {controller.fault}")
    controller.request(Mode.RUN)
    for _ in range(500):  # whatever grows at first
        step()
    seconds = np.zeros(options.steps)
    before = resident()
    for number in range(options.steps):
        begin = time.perf_counter()
        record = step()
        seconds[number] = time.perf_counter() - begin
        if record.mode is not Mode.RUN:
            raise SystemExit(f"fault: {controller.fault}")
    after = resident()
    middle, late, longest = (1e3 * float(np.quantile(seconds, share)) for share in (0.5, 0.99, 1.0))
    print(f"{options.steps} control steps on one core, load {os.getloadavg()[0]:.1f}")
    print(f"one step: p50 {middle:.2f} ms, p99 {late:.2f} ms, longest {longest:.1f} ms")
    print(f"memory: {before:.1f} MB before, {after:.1f} MB after")


if __name__ == "__main__":
    main()
