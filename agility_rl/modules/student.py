"""The Task-Specific Controller's student: from depth images and memory to what the teacher knows, and its actions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from agility_rl import keys
from agility_rl.go2 import constants, features
from agility_rl.modules.adaptation import HistoryEncoder
from agility_rl.modules.behaviour_controller import NUM_LATENT
from agility_rl.modules.depth_encoder import DepthEncoder
from agility_rl.modules.distance_field import Solid
from agility_rl.modules.estimator import StateEstimator
from agility_rl.modules.hybrid_actor import HybridActor
from agility_rl.modules.mlp import mlp
from agility_rl.modules.placed_memory import NUM_PLACE, PlacedMemory
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT
from agility_rl.modules.teacher import NUM_HEADING, Teacher

HEADING_SCALE = 1.5
"""Factor on the predicted heading errors (method notes, section 5.9)."""
HEADING_GATE = 0.6
"""Heading errors beyond this are given, not predicted, while the student is trained [rad] (section 5.9)."""

NUM_FEATURES = 32
"""Numbers that the depth encoder makes of an image (supplement, section S6)."""

PERCEIVED_HEADING: NestedKey = ("perceived", keys.HEADING_ERROR)
PERCEIVED_OBSTACLE: NestedKey = ("perceived", keys.OBSTACLE)
PERCEIVED_PLACE: NestedKey = ("perceived", keys.PLACE)
NEXT_HIDDEN: NestedKey = ("memory", keys.HIDDEN)
"""What the student writes for itself: heading, obstacle and place as its actor reads them, and its next memory."""


class RecurrentStudent(nn.Module):
    """A behaviour and its parameters from depth images and what the robot measures.

    The feature of the present image and the proprioception are fused and remembered by a GRU, which infers the
    teacher's terrain latent, the heading errors and the type of obstacle. Where the teacher reads its place (ours), the
    student infers that too, and from it the heading errors (:class:`~agility_rl.modules.placed_memory.PlacedMemory`).
    The actor, the estimator and the history encoder are the teacher's (:meth:`from_teacher`).

    Source: kernels, GRU of 512 units, actor {512, 256, 128}: supplement, section S6; fusion 128 and 32, heads, factor
    1.5, gate 0.6: released code (method notes, section 5.9). Ours: the terrain latent passes tanh, as the teacher's
    does; the actor's gradient passes neither the predicted heading nor the predicted place; the memory is reset with
    the episode (the release carries it on).

    Keys read: ``depth`` [*B, 58, 87], ``proprioception`` [*B, 45], ``history`` [*B, 10, 45], ``hidden`` [*B, 512]
    (with ``num_place`` 7 more, one for every way-point of the course, 7 and two for every type of obstacle, and one for
    every type at every slot of the course), ``is_init`` bool [*B, 1], true in the first step of an episode; with
    ``num_place`` also ``image_age`` [*B, 1] [s]; with assistance ``heading_error`` [*B, 2] too, and with ``num_place``
    also ``progress`` [*B, S], of which the first of an episode counts.
    Keys written: ``depth_feature`` [*B, F], ``terrain_latent`` [*B, 32], ``heading_estimate`` [*B, 2],
    ``obstacle_logits`` [*B, 7], ``(memory, hidden)`` [*B, 512], ``(perceived, heading_error)``,
    ``(perceived, obstacle)``, with ``num_place`` also ``place_estimate`` [*B, 8], ``progress_logits`` [*B, S],
    ``scan_match`` [*B, 21] and ``(perceived, place)``,
    ``estimate``, ``latent`` and those of :class:`~agility_rl.modules.HybridActor`.

    Args:
        num_obstacles: types of obstacles.
        hidden: sizes of the actor's hidden layers.
        initial_std: standard deviation of the parameters at the start.
        min_std: its floor.
        allowed: indices of the behaviours that it may choose; ``None`` for all.
        num_place: size of ``place``, as its teacher's: 0 or 8.
        memory: units of the GRU.
        encoder_channels: of the depth encoder's convolutions.
        encoder_hidden: units of its hidden linear layer.
        encoder_features: numbers that it makes of an image.
        glance_hidden: units of the hidden layers that read a place from those; who infers the place has them.
        heading_gate: see :data:`HEADING_GATE`.
        period: of a decision [s]; who infers the place counts what it has gone meanwhile.
        way_points: ``[K][W][2]``, of every type of obstacle in its frame [m]; who infers the place knows them.
        routes: ``[R][L][3]``, where the obstacles of the course stand (:attr:`agility_rl.envs.Course.legs`); who infers
            the place knows that too, but for the jitter.
        solids: ``[K][...]``, what every type of obstacle is made of; who infers the place and knows them matches them
            with what images measure.
        stock: ``[K]``, how many obstacles of every type the course has (:attr:`agility_rl.envs.Course.stock`). Who
            infers the place and knows that finds a type unlikely once all of it were met; without, no type is.
        estimator_history: whether the state estimator reads the history (ours): then it is the student's own, and not
            the teacher's, which reads the present alone. By its velocity the way is counted.

    Raises:
        ValueError: if ``num_place`` is another number, or way-points, solids or stock are those of too few types.

    Example:
        >>> from tensordict import TensorDict
        >>> student = RecurrentStudent(memory=16)
        >>> td = TensorDict({"depth": torch.zeros(3, 58, 87), "proprioception": torch.zeros(3, 45),
        ...     "history": torch.zeros(3, 10, 45), "hidden": student.initial_hidden(3),
        ...     "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
        >>> student.policy()(td)["action", "parameters"].shape
        torch.Size([3, 5, 6])
    """

    def __init__(
        self,
        num_obstacles: int = 7,
        hidden: Sequence[int] = (512, 256, 128),
        initial_std: float = 1.0,
        min_std: float = 0.1,
        allowed: Sequence[int] | None = None,
        num_place: int = 0,
        *,
        memory: int = 512,
        encoder_channels: Sequence[int] = (32, 64),
        encoder_hidden: int = 128,
        encoder_features: int = NUM_FEATURES,
        glance_hidden: Sequence[int] = (128,),
        heading_gate: float = HEADING_GATE,
        period: float = constants.CONTROL_DT,
        way_points: Sequence[Sequence[Sequence[float]]] = (),
        routes: Sequence[Sequence[Sequence[float]]] = (((0.0, 0.0, 0.0),),),
        solids: Sequence[Sequence[Solid]] = (),
        stock: Sequence[int] = (),
        estimator_history: bool = False,
    ) -> None:
        super().__init__()
        if num_place not in (0, NUM_PLACE):
            raise ValueError(f"num_place must be 0 or {NUM_PLACE}, got {num_place}")
        if num_place and len(way_points) != num_obstacles:
            raise ValueError(f"expected way_points of {num_obstacles} types of obstacles, got {len(way_points)}")
        if solids and len(solids) != num_obstacles:
            raise ValueError(f"expected solids of {num_obstacles} types of obstacles, got {len(solids)}")
        if stock and len(stock) != num_obstacles:
            raise ValueError(f"expected stock of {num_obstacles} types of obstacles, got {len(stock)}")
        self.settings: dict[str, Any] = {
            "num_obstacles": num_obstacles,
            "hidden": list(hidden),
            "initial_std": initial_std,
            "min_std": min_std,
            "allowed": None if allowed is None else list(allowed),
            "num_place": num_place,
            "memory": memory,
            "encoder_channels": list(encoder_channels),
            "encoder_hidden": encoder_hidden,
            "encoder_features": encoder_features,
            "heading_gate": heading_gate,
            "estimator_history": estimator_history,
            **({"period": period, "way_points": way_points, "routes": routes} if num_place else {}),
            **({"glance_hidden": list(glance_hidden), "solids": solids, "stock": list(stock)} if num_place else {}),
        }
        self.depth_encoder = DepthEncoder(encoder_features, channels=encoder_channels, hidden=encoder_hidden)
        frames, read = (features.HISTORY, keys.HISTORY) if estimator_history else (1, keys.PROPRIOCEPTION)
        self.estimator = StateEstimator(frames * features.NUM_PROPRIOCEPTION, features.NUM_EXPLICIT, in_keys=(read,))
        self.history_encoder = HistoryEncoder(features.NUM_PROPRIOCEPTION, out_features=NUM_LATENT)
        sizes = (encoder_features, features.NUM_PROPRIOCEPTION, memory, num_obstacles)
        self.memory: Memory | PlacedMemory = (
            PlacedMemory(*sizes, period, torch.tensor(way_points), routes, glance_hidden, solids, stock)
            if num_place
            else Memory(*sizes)
        )
        self.measured = [keys.PROPRIOCEPTION, *([keys.ESTIMATE, keys.DEPTH, keys.IMAGE_AGE] if num_place else [])]
        self.heading_gate = heading_gate
        inputs: dict[NestedKey, int] = {
            keys.PROPRIOCEPTION: features.NUM_PROPRIOCEPTION,
            PERCEIVED_HEADING: NUM_HEADING,
            PERCEIVED_OBSTACLE: num_obstacles,
            keys.TERRAIN_LATENT: NUM_TERRAIN_LATENT,
            keys.ESTIMATE: features.NUM_EXPLICIT,
            keys.LATENT: NUM_LATENT,
            **({PERCEIVED_PLACE: num_place} if num_place else {}),
        }
        self.actor = HybridActor(
            sum(inputs.values()),
            in_keys=list(inputs),
            hidden=hidden,
            initial_std=initial_std,
            min_std=min_std,
            allowed=allowed,
        )

    @classmethod
    def from_teacher(cls, teacher: Teacher, **options: Any) -> RecurrentStudent:
        """A student with a teacher's sizes and copies of its actor and history encoder, and of its estimator unless the
        student has one of its own.
        """
        student = cls(**teacher.settings, **options)
        own_estimator = student.settings["estimator_history"]
        for name in ("actor", "history_encoder", *([] if own_estimator else ["estimator"])):
            getattr(student, name).load_state_dict(getattr(teacher, name).state_dict())
        return student

    def initial_hidden(self, num_robots: int) -> Tensor:
        """Memory of robots that have not seen anything, ``[N, M]``."""
        return torch.zeros(num_robots, self.memory.size, device=next(self.parameters()).device)

    def policy(self, *, assisted: bool = False, sequence: bool = False, seen: bool = False) -> TensorDictSequential:
        """The policy, sharing this student's parameters.

        Args:
            assisted: take heading errors beyond the gate from ``heading_error``, as in training, and the
                way-point where an episode starts from ``progress``. Without, episodes start before the first obstacle.
            sequence: for batches ``[T, *B]`` of consecutive steps, time first, instead of one step ``[*B]``; of
                ``hidden`` only the first step's counts.
            seen: read the images' ``depth_feature``, and ``scan_match``, instead of the images.
        """
        remember = self.memory if sequence else _OneStep(self.memory, 1 + len(self.measured))
        start = [keys.PROGRESS] if assisted and self.settings["num_place"] else []
        perceive = _Perception(self.heading_gate if assisted else None)
        placed = self.settings["num_place"] > 0
        measured = [keys.SCAN_MATCH if seen and name == keys.DEPTH else name for name in self.measured]
        return TensorDictSequential(
            *([] if seen else [self.depth_encoder]),
            self.estimator,
            TensorDictModule(Tensor.detach, [keys.ESTIMATE], [keys.ESTIMATE]),  # imitation does not bend measurements
            TensorDictModule(
                remember,
                in_keys=[keys.DEPTH_FEATURE, *measured, keys.HIDDEN, "is_init", *start],
                out_keys=[
                    *(keys.TERRAIN_LATENT, keys.HEADING_ESTIMATE, keys.OBSTACLE_LOGITS, NEXT_HIDDEN),
                    *([keys.PLACE_ESTIMATE, keys.PROGRESS_LOGITS, keys.SCAN_MATCH] if placed else []),
                ],
            ),
            TensorDictModule(
                perceive,
                in_keys=[keys.HEADING_ESTIMATE, keys.OBSTACLE_LOGITS, *([keys.HEADING_ERROR] if assisted else [])],
                out_keys=[PERCEIVED_HEADING, PERCEIVED_OBSTACLE],
            ),
            *([TensorDictModule(Tensor.detach, [keys.PLACE_ESTIMATE], [PERCEIVED_PLACE])] if placed else []),
            self.history_encoder,
            self.actor,
        )


class Memory(nn.Module):
    """Fuse feature and proprioception, remember, and infer terrain latent, heading errors and obstacle.

    Args:
        features: of an image.
        measured: numbers of proprioception.
        hidden_size: units of the GRU.
        num_obstacles: types of obstacles.

    Attributes:
        size: of the memory.

    Example:
        >>> memory = Memory(32, 45, 16, 7)
        >>> first = torch.zeros(5, 3, 1, dtype=torch.bool)
        >>> outputs = memory(torch.zeros(5, 3, 32), torch.zeros(5, 3, 45), torch.zeros(5, 3, 16), first)
        >>> [tuple(output.shape) for output in outputs]
        [(5, 3, 32), (5, 3, 2), (5, 3, 7), (5, 3, 16)]
    """

    def __init__(self, features: int, measured: int, hidden_size: int, num_obstacles: int) -> None:
        super().__init__()
        self.size = hidden_size
        self.fusion = mlp(features + measured, (128,), 32)
        self.cell = nn.GRU(32, hidden_size)
        self.sizes = (NUM_TERRAIN_LATENT, NUM_HEADING, num_obstacles)
        self.head = mlp(hidden_size, (), sum(self.sizes))

    def forward(self, feature: Tensor, proprioception: Tensor, hidden: Tensor, is_init: Tensor) -> tuple[Tensor, ...]:
        """Steps of ``[T, *B]``: terrain latent, heading errors [rad], obstacle logits, memory after each step.

        Of ``hidden`` only the first step's counts; it begins with zeros where ``is_init`` says so.
        """
        time, batch = feature.shape[0], feature.shape[1:-1]
        fused = self._fuse(feature, proprioception)
        first = is_init.reshape(time, -1, 1)
        state = hidden[0].reshape(1, -1, self.size)
        # One call of the GRU from each step in which somebody begins an episode to the next.
        edges = sorted({0, time, *first.flatten(1).any(1).nonzero()[:, 0].tolist()})
        pieces = []
        for start, end in itertools.pairwise(edges):
            state = state.masked_fill(first[start][None], 0.0)
            piece, state = self.cell(fused[start:end], state)
            pieces.append(piece)
        return self._infer(torch.cat(pieces).reshape(time, *batch, self.size))

    def begun(self, hidden: Tensor, is_init: Tensor) -> Tensor:
        """Memory ``[*B, M]``, empty where a bool mask ``[*B, 1]`` says that an episode begins."""
        return hidden.masked_fill(is_init, 0.0)

    def step(self, feature: Tensor, proprioception: Tensor, hidden: Tensor) -> tuple[Tensor, ...]:
        """One step of ``[*B]``, with outputs as :meth:`forward`."""
        fused = self._fuse(feature[None], proprioception[None])
        _, after = self.cell(fused, hidden.reshape(1, -1, self.size))
        return self._infer(after.reshape(*feature.shape[:-1], self.size))

    def _fuse(self, feature: Tensor, proprioception: Tensor) -> Tensor:
        return self.fusion(torch.cat((feature, proprioception), -1)).reshape(len(feature), -1, 32)

    def _infer(self, remembered: Tensor) -> tuple[Tensor, ...]:
        latent, heading, logits = self.head(remembered).split(self.sizes, -1)
        return latent.tanh(), HEADING_SCALE * heading, logits, remembered


class _OneStep(nn.Module):
    """A memory for one step of ``[*B]``, that may be an episode's first.

    It takes feature and measurements, then the memory, whether an episode begins and, if that is told, on which leg.
    """

    def __init__(self, memory: Memory | PlacedMemory, num_measured: int) -> None:
        super().__init__()
        self.memory: Any = memory
        self.num_measured = num_measured

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        measured, state = inputs[: self.num_measured], inputs[self.num_measured :]
        outputs: tuple[Tensor, ...] = self.memory.step(*measured, self.memory.begun(*state))
        return outputs


class _Perception(nn.Module):
    """What the actor reads: predicted heading errors, true ones beyond the gate, and the likeliest obstacle."""

    def __init__(self, gate: float | None) -> None:
        super().__init__()
        self.gate = gate

    def forward(self, estimate: Tensor, logits: Tensor, truth: Tensor | None = None) -> tuple[Tensor, Tensor]:
        heading = estimate.detach()
        if truth is not None and self.gate is not None:
            heading = torch.where(truth.abs() < self.gate, heading, truth)
        return heading, nn.functional.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits.dtype)
