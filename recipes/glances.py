"""What single images tell: the depth encoder learns from what is asked of each image by itself.

An image is asked for what the teacher's scandots are encoded to, for the obstacle ahead, for the robot's place at it
and for its progress on the course.
Consecutive images of a window are nearly the same, and the encoder takes most of an iteration's time: images drawn from
all that was seen lately teach it as much in a fraction of that, and the imitation then trains memory and actor on
features alone. Ours: the sources train the encoder from nothing, within the imitation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from learning_rates import half_cosine, set_learning_rate
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from training_run import finite
from tsc_student_config import GlanceConfig

from agility_rl import keys
from agility_rl.collectors import DAggerCollector
from agility_rl.envs import AgilityEnv
from agility_rl.envs.course import Course
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2.camera import dequantize
from agility_rl.modules import DepthAugmentation, RecurrentStudent, Teacher
from agility_rl.modules.glance import EXPECTED, NUM_POSE, Glance
from agility_rl.modules.placed_memory import PlacedMemory
from agility_rl.modules.planar import inverted, moved
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT
from agility_rl.training import distributed

ERRORS = (
    "error_latent",
    "loss_obstacle",
    "loss_place",
    "error_place",
    "loss_progress",
    "accuracy_obstacle",
    "accuracy_progress",
)
"""What is measured: mean squared error, cross-entropy, negative log-likelihood by its scale, mean absolute error [m],
cross-entropy, two shares."""
WEIGHTS = (1.0, 1.0, 4.0, 0.0, 1.0, 0.0, 0.0)
"""Of each in what the encoder descends: each number of the place counts about once."""
LEVERS = (1.0, 1.0, 3.0, 3.0)
"""Of x, y, sine and cosine of the yaw in the place's: who is turned by a radian too much at what stands 3 m ahead errs
by 3 m across it, and the yaw is what robots err by before an obstacle (docs/student_experiments.md)."""
ROUND = 20
"""Steps of one learning rate, where it falls along half a cosine."""
Represent = Callable[[Tensor], dict[str, Tensor]]
"""One step of another loss of the encoder, on stored images."""


class Newest:
    """The newest rows of all that were given.

    A replay buffer of torchrl that holds nothing cannot be saved, and a run is saved before it has seen anything.

    Attributes:
        rows: ``[M]``, oldest first; ``None`` before any were given.

    Args:
        most: M at most.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.rows: TensorDictBase | None = None

    def extend(self, rows: TensorDictBase) -> None:
        """Add rows ``[K]``, and forget the oldest."""
        rows = rows[-self.most :]
        left = self.most - len(rows)
        if self.rows is None or left == 0:
            self.rows = rows.clone()
        else:
            self.rows = torch.cat((self.rows[-left:], rows))  # type: ignore[arg-type]

    def draw(self, count: int, generator: torch.Generator) -> TensorDictBase:
        """So many rows; one may come several times."""
        assert self.rows is not None
        return self.rows[torch.randint(len(self.rows), (count,), generator=generator, device=generator.device)]

    def state_dict(self) -> dict[str, Any]:
        """The rows, as nested dicts of tensors."""
        return {} if self.rows is None else {"rows": self.rows.to_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        rows = state.get("rows")
        self.rows = None if rows is None else TensorDict(rows, [len(rows[keys.DEPTH])])


@dataclass
class Glances:
    """What the encoder is asked with, and the images that it is asked about.

    Attributes:
        encoder: of the student.
        head: reads its features; part of a student that infers its place.
        optimizer: of both.
        images: those seen lately, in 8 or 16 bits, each with what it should have told.
        batch: so many of them are a step's.
        augmentation: disturbs them.
        generator: draws them.
        points: way-points of an obstacle, in the count of the progress.
    """

    encoder: nn.Module
    head: Glance
    optimizer: torch.optim.Optimizer
    images: Newest
    batch: int
    augmentation: DepthAugmentation
    generator: torch.Generator
    points: int

    @classmethod
    def of(
        cls,
        student: RecurrentStudent,
        course: Course,
        cfg: GlanceConfig,
        augmentation: DepthAugmentation,
        generator: torch.Generator,
    ) -> Glances:
        """Of a student on a course."""
        memory, encoder = student.memory, student.depth_encoder.module
        device = next(student.parameters()).device
        points, legs = course.most_way_points, sum(map(len, course.routes))
        known = (NUM_TERRAIN_LATENT, len(OBSTACLES), points * legs)
        features = student.settings["encoder_features"]
        head = memory.glance if isinstance(memory, PlacedMemory) else Glance(features, known, legs).to(device)
        optimizer = torch.optim.Adam([*encoder.parameters(), *head.parameters()], lr=cfg.learning_rate)
        return cls(encoder, head, optimizer, Newest(cfg.kept), cfg.batch, augmentation, generator, points)

    def learn(self, steps: int, iteration: int, represent: Represent | None = None) -> dict[str, float]:
        """So many gradient steps on images drawn from those remembered; returns the means of :data:`ERRORS`."""
        found = []
        for _ in range(steps):
            sample = self.images.draw(self.batch, self.generator)
            errors = self.errors(sample, self.augmentation.augment(dequantize(sample[keys.DEPTH])))
            self.optimizer.zero_grad(set_to_none=True)
            total = torch.stack([weight * error for weight, error in zip(WEIGHTS, errors, strict=True) if weight]).sum()
            finite(total, "the encoder", iteration).backward()
            distributed.average_gradients(distributed.optimized(self.optimizer))
            self.optimizer.step()
            found.append(torch.stack(errors).detach())
            if represent is not None and self.batch > 1:
                represent(sample[keys.DEPTH])
        means = torch.stack(found).mean(0).tolist()
        return {f"glance/{name}": value for name, value in zip(ERRORS, means, strict=True)}

    @torch.no_grad()
    def measure(self, test: TensorDictBase) -> dict[str, float]:
        """:data:`ERRORS` of images ``[M]`` as they are, on average."""
        parts = test.split(self.batch)
        found = torch.stack([len(part) * torch.stack(self.errors(part, part[keys.DEPTH])) for part in parts])
        return dict(zip(ERRORS, (found.sum(0) / len(test)).tolist(), strict=True))

    def errors(self, sample: TensorDictBase, depth: Tensor) -> tuple[Tensor, ...]:
        """:data:`ERRORS` on images ``[M, 58, 87]``."""
        feature = self.encoder(depth)
        latent, logits, stages = self.head.what(feature).split(self.head.known, -1)
        kind, stage, ahead = sample[keys.OBSTACLE], sample[keys.PROGRESS], inverted(sample[keys.PLACE][..., -NUM_POSE:])
        error = (latent.tanh() - sample[keys.TERRAIN_LATENT]).square().mean()
        noise = torch.randn(*stage.shape, len(EXPECTED), generator=self.generator, device=ahead.device)
        expected = moved(ahead, noise * noise.new_tensor(EXPECTED))
        said, scale = self.head.where(feature, expected, stage // self.points)
        distance = (said - ahead).abs()
        # Laplace's likelihood; sine and cosine share a scale. Weighted by its scale: what is hard to see would else
        # hardly be learned (Seitzer et al. 2022, arXiv:2203.09168, beta = 1).
        scale = torch.cat((scale, scale[..., 2:]), -1)
        surprise = scale.exp().detach() * (distance * (-scale).exp() + scale)
        return (
            error,
            nn.functional.cross_entropy(logits, kind),
            (surprise * surprise.new_tensor(LEVERS)).mean(),
            distance.mean(),
            nn.functional.cross_entropy(stages, stage),
            (logits.argmax(-1) == kind).to(distance.dtype).mean(),
            (stages.argmax(-1) == stage).to(distance.dtype).mean(),
        )


@torch.no_grad()
def known_terrain(teacher: Teacher, seen: TensorDictBase) -> Tensor:
    """What a teacher encodes the ``scandots`` [*B, 132] of observations to, ``[*B, 32]``."""
    latent: Tensor = teacher.scandots_encoder(seen.select(keys.SCANDOTS))[keys.TERRAIN_LATENT]
    return latent


def asked(seen: TensorDictBase, latent: Tensor) -> TensorDictBase:
    """Images with what they should tell: ``terrain_latent`` [*B, 32], ``obstacle`` int64 [*B], ``place`` [*B, 8],
    ``progress`` int64 [*B]."""
    kept = {
        keys.DEPTH: seen[keys.DEPTH],
        keys.TERRAIN_LATENT: latent,
        keys.OBSTACLE: seen[keys.OBSTACLE].argmax(-1),
        keys.PLACE: seen[keys.PLACE],
        keys.PROGRESS: seen[keys.PROGRESS].argmax(-1),
    }
    return TensorDict(kept, seen.batch_size)


@torch.no_grad()
def collect_images(env: AgilityEnv, teacher: Teacher, cfg: GlanceConfig, bits: int) -> TensorDictBase:
    """Let the teacher walk and keep every ``every``-th decision's images: :func:`asked`, ``[N, T]``."""
    # The teacher has no memory: what the collector carries for it is a number that stays what it is.
    remember = TensorDictModule(nn.Identity(), in_keys=[keys.HIDDEN], out_keys=[("memory", keys.HIDDEN)])
    walker = DAggerCollector(
        env,
        TensorDictSequential(*teacher.privileged_policy(), remember),
        teacher.privileged_policy(),
        cfg.every,
        initial_hidden=torch.zeros(env.num_robots, 1, device=env.device),
        bits=16 if bits == 16 else 8,
        keep=(keys.DEPTH, keys.SCANDOTS, keys.OBSTACLE, keys.PLACE, keys.PROGRESS),
    )
    images, count = None, -(-cfg.images // env.num_robots)
    for time in range(count):
        seen = walker.collect()[0]
        row = asked(seen, known_terrain(teacher, seen))
        images = row.new_empty((env.num_robots, count)) if images is None else images
        images[:, time] = row
    assert images is not None
    return images


def pretrain(
    glances: Glances, env: AgilityEnv, teacher: Teacher, cfg: GlanceConfig, bits: int, represent: Represent | None
) -> dict[str, float]:
    """Collect images where the teacher walks, learn from most robots', measure on the others'.

    The learning rate falls along half a cosine. Some of the images remain among the newest.

    Returns:
        How many, and :data:`ERRORS` of those held out.
    """
    images = collect_images(env, teacher, cfg, bits)
    robots = len(images)
    apart = min(max(1, round(cfg.held_out * robots)), robots - 1)
    train, test = images[apart:].flatten(), images[:apart].flatten()
    newest, glances.images = glances.images, Newest(len(train))
    glances.images.rows = train  # not extended: they are gigabytes, and would be copied
    metrics: dict[str, float] = {"pretrain/images": float(len(train))}
    steps = max(1, len(train) // cfg.batch)
    for epoch in range(cfg.epochs):
        for step in range(epoch * steps, (epoch + 1) * steps, ROUND):
            share = step / (cfg.epochs * steps)
            set_learning_rate(glances.optimizer, half_cosine(cfg.pretrain_learning_rate, share, step))
            glances.learn(min(ROUND, (epoch + 1) * steps - step), 0, represent)
        metrics |= {f"pretrain/{name}": value for name, value in glances.measure(test).items()}
        shown = "  ".join(f"{name} {metrics[f'pretrain/{name}']:.3g}" for name in ERRORS)
        print(
            f"pre-training {epoch + 1}/{cfg.epochs} on {len(train)} images; {len(test)} held out: {shown}", flush=True
        )
    newest.extend(glances.images.draw(min(newest.most, len(train)), glances.generator))
    glances.images = newest
    return metrics
