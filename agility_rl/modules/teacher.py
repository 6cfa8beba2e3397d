"""The Task-Specific Controller's teacher: encoders of what only a simulation knows, and the hybrid actor on top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictSequential
from torch import Tensor, nn
from torch.nn.functional import pad

from agility_rl import keys
from agility_rl.behaviours import NUM_BEHAVIOURS, command_bounds, skill_index
from agility_rl.go2 import features
from agility_rl.modules.adaptation import HistoryEncoder, PrivilegedEncoder
from agility_rl.modules.behaviour_controller import NUM_LATENT
from agility_rl.modules.estimator import StateEstimator
from agility_rl.modules.hybrid_actor import HybridActor
from agility_rl.modules.scandots import NUM_TERRAIN_LATENT, ScandotsEncoder

NUM_HEADING = 2
"""Heading errors to the current and to the next way-point (method notes, section 5.4)."""

CANTER = skill_index("canter")


def widen_place(weights: Mapping[str, Tensor], more: int) -> dict[str, Tensor]:
    """Weights with an actor whose last input, ``place``, is larger by so many numbers, which count nothing yet.

    Source: no equation of the paper (ours).

    Args:
        weights: state dict of a teacher or of its actor.
        more: numbers to add.

    Example:
        >>> import torch
        >>> first = "trunk.layers.0.weight"
        >>> widen_place({first: torch.ones(16, 119)}, 8)[first].shape
        torch.Size([16, 127])
    """
    first = next(name for name in weights if name.endswith("trunk.layers.0.weight"))
    return {**weights, first: pad(weights[first], (0, more))}


def rescale_canter(weights: Mapping[str, Tensor], fastest: float, now: float) -> dict[str, Tensor]:
    """Weights whose canters are commanded as fast as before when another fastest canter is the end of the range.

    Speeds that the old range cut off at its end become others, and those beyond the end of the new one become that.

    Source: no equation of the paper (ours).

    Args:
        weights: state dict of a teacher or a student, or of its actor.
        fastest: what the canter's forward speed ended at [m/s].
        now: what it ends at from now on [m/s].

    Example:
        >>> import torch
        >>> last = "parameters_head.mean.0."
        >>> old = {last + "weight": torch.ones(30, 8), last + "bias": torch.ones(30)}  # 5 behaviours x 6 parameters
        >>> new = rescale_canter(old, 2.0, 3.2)  # half of the range is what all of it was
        >>> new[last + "weight"][18, 0].item(), round(new[last + "bias"][18].item(), 4)  # row of the canter's speed
        (0.5, 0.0)
    """
    low, high = (bound[CANTER, 0].item() for bound in command_bounds(fastest_canter=fastest))
    share = (high - low) / (command_bounds(fastest_canter=now)[1][CANTER, 0].item() - low)
    changed = {}
    for name, offset in (("weight", 0.0), ("bias", 1.0)):  # p becomes share * (p + 1) - 1
        key = next(key for key in weights if key.endswith(f"parameters_head.mean.0.{name}"))
        rows = weights[key].unflatten(0, (NUM_BEHAVIOURS, -1)).clone()
        rows[CANTER, 0] = share * (rows[CANTER, 0] + offset) - offset
        changed[key] = rows.flatten(0, 1)
    return {**weights, **changed}


class Teacher(nn.Module):
    """A behaviour and its parameters from proprioception, way-points, scandots and latent physical parameters.

    As in :class:`~agility_rl.modules.BasicBehaviourController`, the latent comes from the simulator's truth
    (:meth:`privileged_policy`) or from the history (:meth:`deployable_policy`).

    Source: supplement S6; inputs: method notes, sections 5.3 and 5.4.

    Keys read: ``proprioception`` [*B, 45], ``heading_error`` [*B, 2] [rad], ``obstacle`` [*B, 7], ``scandots``
    [*B, 132] [m], with ``num_place`` also ``place`` [*B, 8], and ``privileged`` [*B, 29] or ``history`` [*B, 10, 45].
    Keys written: ``estimate`` [*B, 4], ``latent`` [*B, 29], ``terrain_latent`` [*B, 32], and those of
    :class:`~agility_rl.modules.HybridActor`.

    Args:
        num_obstacles: types of obstacles in the one-hot.
        hidden: sizes of the actor's hidden layers.
        initial_std: standard deviation of the parameters at the start.
        min_std: its floor.
        allowed: indices of the behaviours that it may choose; ``None`` for all.
        num_place: size of ``place``, way-points and obstacle in metres, which it reads besides; the published teacher
            (0) knows in which directions its way-points lie and not how far.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> teacher = Teacher()
        >>> sizes = {"proprioception": 45, "heading_error": 2, "obstacle": 7, "scandots": 132, "privileged": 29}
        >>> td = TensorDict({name: torch.zeros(3, size) for name, size in sizes.items()}, [3])
        >>> teacher.privileged_policy()(td)["action", "parameters"].shape
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
    ) -> None:
        super().__init__()
        self.settings: dict[str, Any] = {
            "num_obstacles": num_obstacles,
            "hidden": list(hidden),
            "initial_std": initial_std,
            "min_std": min_std,
            "allowed": None if allowed is None else list(allowed),
            "num_place": num_place,
        }
        self.estimator = StateEstimator(features.NUM_PROPRIOCEPTION, features.NUM_EXPLICIT)
        self.privileged_encoder = PrivilegedEncoder(features.NUM_PRIVILEGED, NUM_LATENT)
        self.history_encoder = HistoryEncoder(features.NUM_PROPRIOCEPTION, out_features=NUM_LATENT)
        self.scandots_encoder = ScandotsEncoder()
        inputs = {
            keys.PROPRIOCEPTION: features.NUM_PROPRIOCEPTION,
            keys.HEADING_ERROR: NUM_HEADING,
            keys.OBSTACLE: num_obstacles,
            keys.TERRAIN_LATENT: NUM_TERRAIN_LATENT,
            keys.ESTIMATE: features.NUM_EXPLICIT,
            keys.LATENT: NUM_LATENT,
            **({keys.PLACE: num_place} if num_place else {}),
        }
        self.actor = HybridActor(
            sum(inputs.values()),
            in_keys=list(inputs),
            hidden=hidden,
            initial_std=initial_std,
            min_std=min_std,
            allowed=allowed,
        )

    def privileged_policy(self) -> TensorDictSequential:
        """Policy for roll-outs in training: estimator, privileged encoder, scandots encoder, actor."""
        return TensorDictSequential(self.estimator, self.privileged_encoder, self.scandots_encoder, self.actor)

    def deployable_policy(self) -> TensorDictSequential:
        """Policy that infers the physical parameters: estimator, history encoder, scandots encoder, actor."""
        return TensorDictSequential(self.estimator, self.history_encoder, self.scandots_encoder, self.actor)

    def trained_actor(self) -> ProbabilisticTensorDictSequential:
        """Encoders and actor, as a PPO loss takes them; the estimate is an input, so PPO does not move it."""
        return ProbabilisticTensorDictSequential(self.privileged_encoder, self.scandots_encoder, *self.actor)
