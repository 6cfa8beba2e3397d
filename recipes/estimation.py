"""What a student's own state estimator learns from the history before the imitation: height and velocity."""

from __future__ import annotations

from dataclasses import replace

import torch
from course_metrics import set_course
from hardware import simulator_options
from held_fixed import fit
from learning_rates import annealed, set_learning_rate
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tsc_setup import make_env
from tsc_student_config import Config
from tsc_student_setup import Components

from agility_rl import keys
from agility_rl.deploy.task import fastest_canter
from agility_rl.envs import AgilityEnv
from agility_rl.losses import StateEstimationLoss
from agility_rl.modules import Teacher

KEPT = (keys.HISTORY, keys.EXPLICIT)


@torch.no_grad()
def walk(env: AgilityEnv, teacher: Teacher, decisions: int) -> TensorDictBase:
    """What robots measure, and how they move, where the teacher leads them: ``[N, decisions]`` of :data:`KEPT`."""
    policy, seen, rows = teacher.privileged_policy(), env.reset(), None
    for time in range(decisions):
        row = seen.select(*KEPT)
        rows = row.new_empty((env.num_robots, decisions)) if rows is None else rows
        rows[:, time] = row
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            _, seen = env.step_and_maybe_reset(policy(seen))
    assert rows is not None
    return rows


def learn_to_estimate(parts: Components, cfg: Config) -> None:
    """Let the teacher walk without cameras, and fit the student's estimator to it; one robot of eight measures."""
    own, course = cfg.estimation, cfg.env.course
    assert course is not None
    walkers = make_env(
        replace(cfg.env, num_robots=own.robots),
        parts.bbc,
        course,
        parts.env.decision_steps,
        simulator_options(cfg, cfg.env.num_threads),
        fastest_canter=fastest_canter(parts.teacher_artifact),
        seed=parts.seeds.integer("estimation"),
    )
    set_course(walkers, parts.curriculum)
    try:
        seen = walk(walkers, parts.teacher, own.decisions)
    finally:
        walkers.close()
    apart = max(1, own.robots // 8)
    estimator = parts.student.estimator.requires_grad_(True)
    loss, optimizer = StateEstimationLoss(estimator), torch.optim.Adam(estimator.parameters())
    train, test = seen[apart:], seen[:apart]
    for epoch in range(own.epochs):
        set_learning_rate(optimizer, annealed(own.learning_rate, 0.0, epoch, own.epochs))
        fit([loss], optimizer, train, max(1, train.numel() // own.batch), parts.generator)
    with torch.no_grad():
        error = loss(test)["error_estimation"].item()
    estimator.requires_grad_(False)
    print(f"state estimator on {train.numel()} decisions; error of {test.numel()} held out: {error:.4f}", flush=True)
