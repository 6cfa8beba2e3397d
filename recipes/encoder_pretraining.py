"""Before the imitation: the depth encoder learns from images that the teacher's robots see on the course.

A single image is asked for what the teacher's scandots are encoded to, for the obstacle ahead and for the robot's
place; with BYOL also that its disturbed views mean the same. Ours: the sources train the encoder from nothing, within
the imitation.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from tsc_student_config import Config
from tsc_student_setup import Components, finite

from agility_rl import keys
from agility_rl.collectors import DAggerCollector
from agility_rl.envs.arena import NUM_PLACE
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.go2.camera import dequantize
from agility_rl.modules.mlp import mlp
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT
from agility_rl.training.seeding import permutation


@torch.no_grad()
def collect_images(parts: Components, cfg: Config) -> TensorDictBase:
    """Let the teacher walk and keep every ``every``-th decision's images.

    Returns:
        TensorDict ``[T, N]``, T N not less than wanted: ``depth`` in 8 or 16 bits, ``terrain_latent`` [T, N, 32],
        ``obstacle`` int64 [T, N], ``place`` [T, N, 8].
    """
    own, env = cfg.pretrain, parts.env
    # The teacher has no memory: what the collector carries for it is a number that stays what it is.
    remember = TensorDictModule(nn.Identity(), in_keys=[keys.HIDDEN], out_keys=[("memory", keys.HIDDEN)])
    walker = DAggerCollector(
        env,
        TensorDictSequential(*parts.teacher.privileged_policy(), remember),
        parts.teacher.privileged_policy(),
        own.every,
        initial_hidden=torch.zeros(env.num_robots, 1, device=env.device),
        bits=cfg.bits,
        keep=(keys.DEPTH, keys.SCANDOTS, keys.OBSTACLE, keys.PLACE),
    )
    rows = []
    for _ in range(-(-own.images // env.num_robots)):
        seen = walker.collect()[0].clone()  # a view would keep the whole window
        latent = parts.teacher.scandots_encoder(seen.select(keys.SCANDOTS))[keys.TERRAIN_LATENT]
        kept = {
            keys.DEPTH: seen[keys.DEPTH],
            keys.TERRAIN_LATENT: latent,
            keys.OBSTACLE: seen[keys.OBSTACLE].argmax(-1),
            keys.PLACE: seen[keys.PLACE],
        }
        rows.append(TensorDict(kept, seen.batch_size))
    return torch.stack(rows)  # type: ignore[return-value, arg-type]


def pretrain(
    parts: Components, cfg: Config, represent: Callable[[Tensor], dict[str, Tensor]] | None
) -> dict[str, float]:
    """Collect images, train the encoder on those of most robots, measure on those of the others.

    Args:
        parts: of the run; student and generators change.
        cfg: its options.
        represent: one step of BYOL on stored images; ``None`` for none.
    """
    own, generator = cfg.pretrain, parts.generator
    images = collect_images(parts, cfg)
    robots = images.batch_size[1]
    apart = min(max(1, round(own.held_out * robots)), robots - 1)
    train, test = images[:, apart:].flatten(), images[:, :apart].flatten()
    sizes = (NUM_TERRAIN_LATENT, len(OBSTACLES), NUM_PLACE)
    head = mlp(32, (), sum(sizes)).to(parts.env.device)
    encoder = parts.student.depth_encoder.module
    optimizer = torch.optim.Adam([*encoder.parameters(), *head.parameters()], lr=own.learning_rate)

    def errors(sample: TensorDictBase, depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        latent, logits, place = head(encoder(depth)).split(sizes, -1)
        kind = sample[keys.OBSTACLE]
        error = (latent.tanh() - sample[keys.TERRAIN_LATENT]).square().mean()
        distance = (place - sample[keys.PLACE]).abs().mean()
        right = (logits.argmax(-1) == kind).float().mean()
        return error, nn.functional.cross_entropy(logits, kind), distance, right

    metrics: dict[str, float] = {"pretrain/images": float(len(train))}
    for epoch in range(own.epochs):
        for rows in permutation(len(train), generator).split(own.batch):
            sample = train[rows]
            latent, obstacle, place, _ = errors(sample, parts.augmentation.augment(dequantize(sample[keys.DEPTH])))
            optimizer.zero_grad(set_to_none=True)
            finite(latent + obstacle + place, "the pre-training", 0).backward()
            optimizer.step()
            if represent is not None and len(rows) > 1:
                metrics |= {f"pretrain/{name}": value.item() for name, value in represent(sample[keys.DEPTH]).items()}
        with torch.no_grad():
            pieces = [(len(part), *errors(part, part[keys.DEPTH])) for part in test.split(own.batch)]
        found = ("error_latent", "loss_obstacle", "error_place", "accuracy_obstacle")
        names = tuple(f"pretrain/{name}" for name in found)
        for index, name in enumerate(names, start=1):
            metrics[name] = sum(piece[0] * float(piece[index]) for piece in pieces) / len(test)
        shown = "  ".join(f"{name.removeprefix('pretrain/')} {metrics[name]:.3g}" for name in names)
        print(f"pre-training {epoch + 1}/{own.epochs} on {len(train)} images; {len(test)} held out: {shown}")
    return metrics
