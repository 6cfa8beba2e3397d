"""The discriminator of EASI: does a transition come from the robot or from the simulator?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from agility_rl.go2 import constants, features
from agility_rl.keys import ACTION, MEASUREMENT, TRANSITION_LOGIT
from agility_rl.modules.mlp import mlp
from agility_rl.modules.normalization import FeatureNormalizer

NORMALIZED_TRANSITION = "normalized_transition"
"""float32 ``[*B, 2 S + A]``, what the network sees: the gradient penalty differentiates with respect to this."""

TINY_DISCREPANCY = 1e-6
"""Least scale of a discrepancy [SI units]: differences below are rounding."""

DISCREPANCY_SLOPE = 0.25
"""Fall of the logit per median of discrepancy m = |s' - s'_R|. With a critic -w m, Eq. (13) with a penalty of 1 is
-w E[m] / 2 + w^2, least at w = E[m] / 4; and in medians E[m] is about 1."""


class TransitionDiscriminator(TensorDictModuleBase):
    r"""Judge transitions: :math:`\tilde D(s, a, s')`, high for the robot, low for the simulator.

    The simulator's physics shows in how a state follows from the last, which policy and terrain hide the less, the more
    the network sees of it: with ``difference`` the third input is s' - s, scaled by its own, much smaller, spread. The
    two forms carry the same information; at 50 Hz s' alone is nearly s. Where it is known what the robot did after the
    same state and action (:class:`agility_rl.collectors.ReplayCollector`), that is the best origin: with
    ``matched_key`` the third input is the discrepancy \|s' - s'_R\|, 0 for the robot, and :meth:`rescale` keeps it in
    view while the simulator comes closer. Its sign is left out, because a miss is one to either side: with it, a
    population that misses to one side teaches the network a slope that goes on rising beyond the robot. That less of it
    is better need not be learned either: the logit falls with it from the beginning, and the network, whose last layer
    begins at 0, learns what is different from that.

    .. math:: \tilde D(s, a, s') = \mathrm{MLP}(\mathrm{norm}([s, a, s'])) \quad\text{or}\quad
              \mathrm{MLP}(\mathrm{norm}([s, a, s' - s])) \quad\text{or}\quad
              \mathrm{MLP}(\mathrm{norm}([s, a, m])) - \tfrac14 \sum_i \mathrm{norm}(m)_i,
              \quad m = |s' - s'_R|

    Source: Algorithm S2, D-tilde of Eq. (13); sizes 128-128 with ReLU: EASI's release (method notes, section 6.2).
    Differs from it: inputs are normalised by fixed statistics of the log, because radians and rad/s differ by a factor
    of fifty and clipped weights cannot make up for it. Both other third inputs are ours.

    Keys read:
        measurement          float32 ``[*B, S]``  state, as measured [SI units]
        action               float32 ``[*B, A]``  action taken in it [action units]
        (next, measurement)  float32 ``[*B, S]``  state one control step later
        matched_key          float32 ``[*B, S]``  that of the robot; only if a key is given
    Keys written:
        transition_logit       float32 ``[*B, 1]``        D(s, a, s'), unbounded [1]
        normalized_transition  float32 ``[*B, 2 S + A]``  what the network sees [1]

    Args:
        num_measurements: S.
        num_actions: A.
        hidden: sizes of the hidden layers.
        normalizer: scales the ``2 S + A`` inputs; ``None`` takes them as they are.
        difference: give the network s' - s instead of s'; the normaliser's statistics are then of s' - s as well.
        matched_key: key of what the robot measured after the same state and action; the third input is then by how
            much s' misses that.
        measurement_key: key of the state; the following state stands under ``("next", measurement_key)``.
        action_key: key of the action.
        out_key: key of the logit.
        normalized_key: key of the normalised inputs.

    Raises:
        ValueError: if the normaliser has statistics of another size, s' is to be relative to two states, or an input
            has another size (at the call).

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "measurement": torch.zeros(8, 29), "action": torch.zeros(8, 12),
        ...     "next": TensorDict({"measurement": torch.zeros(8, 29)}, [8]),
        ... }, [8])
        >>> TransitionDiscriminator()(td)["transition_logit"].shape
        torch.Size([8, 1])
        >>> TransitionDiscriminator.from_transitions(td, difference=True).normalizer.mean.shape
        torch.Size([70])
    """

    def __init__(
        self,
        num_measurements: int = features.NUM_MEASUREMENT,
        num_actions: int = constants.NUM_JOINTS,
        hidden: Sequence[int] = (128, 128),
        *,
        normalizer: FeatureNormalizer | None = None,
        difference: bool = False,
        matched_key: NestedKey | None = None,
        measurement_key: NestedKey = MEASUREMENT,
        action_key: NestedKey = ACTION,
        out_key: NestedKey = TRANSITION_LOGIT,
        normalized_key: NestedKey = NORMALIZED_TRANSITION,
    ) -> None:
        super().__init__()
        size = 2 * num_measurements + num_actions
        if normalizer is not None and normalizer.mean.shape[0] != size:
            raise ValueError(
                f"the normaliser has statistics of {normalizer.mean.shape[0]} numbers, but a transition has "
                f"2 * {num_measurements} + {num_actions} = {size}"
            )
        if difference and matched_key is not None:
            raise ValueError("give difference or matched_key: s' is relative to one state, not to two")
        robot = [] if matched_key is None else [matched_key]
        self.sizes = (num_measurements, num_actions, num_measurements, *(num_measurements for _ in robot))
        self.difference, self.matched = difference, bool(robot)
        self.normalizer = normalizer
        self.layers = mlp(size, hidden, activation=nn.ReLU)
        self.head = nn.Linear(hidden[-1], 1)
        nn.init.zeros_(self.head.bias)
        if self.matched:
            nn.init.zeros_(self.head.weight)
        self.in_keys = [measurement_key, action_key, _following(measurement_key), *robot]
        self.out_keys = [out_key, normalized_key]

    @classmethod
    def from_transitions(cls, transitions: TensorDictBase, *, clip: float = 10.0, **options: Any) -> Self:
        """Build a discriminator whose normaliser has the statistics of given transitions, usually the robot's.

        Args:
            transitions: TensorDict with the keys that the discriminator reads.
            clip: bound of the normalised inputs [1].
            **options: further arguments of the class; the sizes follow from the transitions.
        """
        state = transitions.get(options.get("measurement_key", MEASUREMENT))
        action = transitions.get(options.get("action_key", ACTION))
        network = cls(state.shape[-1], action.shape[-1], **options)
        inputs = network.assemble(transitions).detach().flatten(0, -2)
        # A constant entry says nothing; a tiny deviation would blow the simulator's noise in it up to the clip.
        std = inputs.std(0, correction=0).clamp_min(1e-3)
        network.normalizer = FeatureNormalizer(inputs.mean(0), std, clip=clip)
        return network

    def assemble(self, tensordict: TensorDictBase) -> Tensor:
        """Raw inputs ``[*B, 2 S + A]``.

        Raises:
            ValueError: if one has another size.
        """
        inputs = [tensordict.get(key) for key in self.in_keys]
        for key, value, size in zip(self.in_keys, inputs, self.sizes):
            if value.shape[-1] != size:
                raise ValueError(f"{key!r} must be [*B, {size}], got {list(value.shape)}")
        state, action, following, *robot = inputs
        if robot:
            following = (following - robot[0]).abs()
        elif self.difference:
            following = following - state
        return torch.cat((state, action, following), -1)

    @torch.no_grad()
    def rescale(self, transitions: TensorDictBase) -> None:
        """Scale the discrepancy from the robot by its median size in given transitions, in place.

        The median, because start states of replayed windows are far off now and then; what is that far off ends at the
        normaliser's clip and no longer counts.

        Args:
            transitions: the simulator's, ``[*B]``; with ``(collector, mask)`` only the marked ones count.

        Raises:
            ValueError: if the network sees no discrepancy, has no normaliser, or no transition counts.
        """
        size = self.sizes[2]
        if not self.matched or self.normalizer is None:
            raise ValueError(
                "rescale needs a matched_key and a normaliser; build with from_transitions(matched_key=...)"
            )
        discrepancy = self.assemble(transitions)[..., -size:]
        mask = transitions.get(("collector", "mask"), None)
        discrepancy = discrepancy.flatten(0, -2) if mask is None else discrepancy[mask]
        if not len(discrepancy):
            raise ValueError("no transition is valid; look at the parameters and the start states")
        scale = discrepancy.median(0).values.clamp_min(TINY_DISCREPANCY)
        self.normalizer.std[-size:] = scale.to(self.normalizer.std.dtype)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the logit and the normalised inputs."""
        inputs = self.assemble(tensordict)
        normalized = inputs if self.normalizer is None else self.normalizer(inputs)
        logit = self.head(self.layers(normalized))
        if self.matched:
            logit = logit - DISCREPANCY_SLOPE * normalized[..., -self.sizes[2] :].sum(-1, keepdim=True)
        tensordict.set(self.out_keys[0], logit)
        tensordict.set(self.out_keys[1], normalized)
        return tensordict


def _following(key: NestedKey) -> NestedKey:
    return ("next", key) if isinstance(key, str) else ("next", *key)
