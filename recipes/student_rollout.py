"""What a student sees and decides on its course, written down: inputs and answers that an export is checked with."""

from __future__ import annotations

from pathlib import Path

import torch
from rollouts import Controller
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tsc_artifacts import Trained, load_bbc_of
from tsc_setup import course_of, frozen

from agility_rl import keys
from agility_rl.deploy import task
from agility_rl.envs import AgilityEnv
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.student import NEXT_HIDDEN

ROBOTS = 4
SAID = ("logits", "loc", keys.HEADING_ESTIMATE, keys.OBSTACLE_LOGITS, NEXT_HIDDEN)
"""What it answers, in the order of :data:`agility_rl.deploy.task.OUTPUTS`."""


def recorded_steps(trained: Trained, bbc: Path | None, steps: int, seed: int) -> tuple[TensorDictBase, TensorDictBase]:
    """Inputs (:data:`agility_rl.deploy.task.INPUTS`) and answers (:data:`SAID`), ``[steps x 4]``, on drawn courses.

    Of the first step of an episode the memory is empty, as on the robot.
    """
    student = trained.network
    assert isinstance(student, RecurrentStudent)
    controller: Controller = load_bbc_of(trained, bbc)
    env = AgilityEnv(
        ROBOTS,
        frozen(controller),
        course_of(trained.course),
        simulator_options={"num_threads": 1, "friction_loss": controller.friction_loss},
        decision_steps=trained.decision_steps,
        fastest_canter=trained.fastest_canter,
        depth={},
        seed=seed,
    )
    policy, td = student.policy(), env.reset()
    hidden, first = student.initial_hidden(ROBOTS), torch.ones(ROBOTS, 1, dtype=torch.bool)
    seen, said = [], []
    for _ in range(steps):
        td.update({keys.HIDDEN: hidden.masked_fill(first, 0.0), "is_init": first})
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = policy(td)
        seen.append(td.select(*task.INPUTS).clone())
        said.append(TensorDict({name: td[name].clone() for name in SAID}, [ROBOTS]))
        hidden = td[NEXT_HIDDEN]
        full, td = env.step_and_maybe_reset(td)
        first = full["next", "done"]
    env.close()
    return torch.cat(seen), torch.cat(said)  # type: ignore[return-value]
