"""What students see before obstacles, where the obstacle is in it, and what they remember at that moment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from deciders import Decider
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tsc_setup import frozen

from agility_rl import keys
from agility_rl.envs import AgilityEnv, Course
from agility_rl.go2 import camera
from agility_rl.modules import RecurrentStudent
from agility_rl.modules.student import NEXT_HIDDEN
from agility_rl.simulation.scenery import PARKED_DEPTH
from agility_rl.simulation.simulator import Camera

VISIBLE = 0.02
"""An obstacle's pixels are those whose depth, clipped as the network's is, changes by more than this without it [m]."""


@dataclass(frozen=True)
class Scenes:
    """Moments before obstacles.

    Attributes:
        images: ``[M, 58, 87]``, normalised, without noise.
        mask: bool ``[M, 58, 87]``, pixels of the obstacle ahead.
        kind: int64 ``[M]``, its type.
        contexts: for each student what it reads besides the image, ``[M]``.
    """

    images: Tensor
    mask: Tensor
    kind: Tensor
    contexts: tuple[TensorDictBase, ...]


def obstacle_pixels(env: AgilityEnv, eye: Camera) -> tuple[Tensor, Tensor]:
    """Depth images ``[N, 58, 87]`` [m], and which pixels of them show the obstacle ahead (bool).

    The obstacle is taken out of the simulations, the images are taken again, and everything is put back.
    """
    simulator, layout = env.simulator, env.arena.layout
    everyone = torch.ones(env.num_robots, dtype=torch.bool)
    seen = eye.render(everyone)
    saved = simulator.state_dict()
    position, quaternion, _ = layout.poses()
    ahead = layout.owners == env.arena.progress.obstacle[:, None]  # [N, P]
    position = position.clone()
    position[..., 2] += PARKED_DEPTH * ahead
    simulator.place(everyone, position, quaternion, simulator.hinge_angle)
    without = eye.render(everyone)
    simulator.load_state_dict(saved)
    near, far = camera.DEPTH_NEAR, camera.DEPTH_FAR
    return seen, (seen.clamp(near, far) - without.clamp(near, far)).abs() > VISIBLE


def collect_scenes(
    course: Course,
    deciders: Sequence[Decider],
    *,
    wanted: int,
    robots: int,
    every: int,
    least: float,
    seed: int,
    num_threads: int | None,
) -> Scenes:
    """Let the first student walk, all of them look, and keep moments in which the obstacle ahead is in the image.

    Args:
        course: where.
        deciders: students.
        wanted: M, moments.
        robots: simulated at once.
        every: decisions between two moments of a robot.
        least: share of the pixels that the obstacle must have.
        seed: of the courses.
        num_threads: of the simulator.

    Raises:
        ValueError: if the robots hardly ever see an obstacle.
    """
    first = deciders[0]
    env = AgilityEnv(
        robots,
        frozen(first.controller),
        course,
        simulator_options={"num_threads": num_threads, "friction_loss": first.controller.friction_loss},
        decision_steps=first.decision_steps,
        command_noise=(1.0, 1.0),
        fastest_canter=first.fastest_canter,
        start="first",  # where a student believes itself that nobody has told anything else
        seed=seed,
    )
    eye = env.simulator.make_camera()
    students = [network(decider) for decider in deciders]
    hidden = [student.initial_hidden(robots) for student in students]
    is_init = torch.ones(robots, 1, dtype=torch.bool)
    td = env.reset()
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    own: list[list[TensorDictBase]] = [[] for _ in students]
    count = looked = 0
    while count < wanted:
        if looked > 10 * every * -(-wanted // robots):
            raise ValueError(f"only {count} of {wanted} moments show an obstacle; lower --least or --images")
        seen, mask = obstacle_pixels(env, eye)
        images = camera.normalize_depth(seen)
        td[keys.IMAGE_AGE] = torch.zeros(robots, 1)
        contexts, decisions = [], []
        for index, (decider, student) in enumerate(zip(deciders, students, strict=True)):
            read = [key for key in student.policy().in_keys if key not in (keys.DEPTH, keys.HIDDEN, "is_init")]
            context = td.select(*read).set(keys.HIDDEN, hidden[index]).set("is_init", is_init).set(keys.DEPTH, images)
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                written = decider.decide(context.clone())
            hidden[index] = written[NEXT_HIDDEN]
            decisions.append(written[keys.ACTION].select(keys.BEHAVIOUR, keys.PARAMETERS))
            contexts.append(context)
        if looked % every == 0:
            rows = mask.flatten(1).float().mean(-1) >= least
            kind = td[keys.OBSTACLE].argmax(-1)
            kept.append((images[rows], mask[rows], kind[rows]))
            for moments, context in zip(own, contexts, strict=True):
                moments.append(context[rows])
            count += int(rows.sum())
        looked += 1
        full, td = env.step_and_maybe_reset(TensorDict({keys.ACTION: decisions[0]}, [robots]))
        is_init = full["next", "done"]
    env.close()
    images, mask, kind = (torch.cat(parts)[:wanted] for parts in zip(*kept, strict=True))
    return Scenes(images, mask, kind, tuple(torch.cat(moments)[:wanted] for moments in own))


def network(decider: Decider) -> RecurrentStudent:
    """The student of a decider."""
    assert decider.student is not None
    return decider.student


def objective(name: str, student: RecurrentStudent, context: TensorDictBase, kind: Tensor) -> Callable | None:
    """What Grad-CAM asks for: from features ``[M, 32]`` to one number an image.

    Args:
        name: ``feature``, the length of the feature vector; ``obstacle``, the logit of the obstacle that is there;
            ``behaviour``, the largest logit of a behaviour.
        student: whose features they are.
        context: what it reads besides the image.
        kind: type of the obstacle.
    """
    if name == "feature":
        return None
    rest = TensorDictSequential(*student.policy().module[1:])

    def value(features: Tensor) -> Tensor:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = rest(context.clone().set(keys.DEPTH_FEATURE, features))
        if name == "behaviour":
            return td["logits"].amax(-1)
        return td[keys.OBSTACLE_LOGITS].gather(-1, kind[:, None])[:, 0]

    return value
