"""The policy over hybrid actions: one of several choices, and continuous parameters beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import (
    CompositeDistribution,
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.distributions import Categorical

from agility_rl.behaviours import COMMANDS, NUM_BEHAVIOURS
from agility_rl.keys import ACTION, BEHAVIOUR, PARAMETERS
from agility_rl.modules.actor import DiagonalGaussian, GaussianNetwork
from agility_rl.modules.mlp import ConcatenatedMLP, mlp

FORBIDDEN = -1e6
"""Added to the logit of a choice that is not allowed; finite, so that its entropy is 0 and not NaN."""


class HybridActor(ProbabilisticTensorDictSequential):
    r"""Act by a categorical choice and a Gaussian over continuous parameters, two heads on one trunk.

    .. math:: \pi(a^D, a^C | o) = \mathrm{Cat}(a^D; \ell(o)) \;
              \mathcal{N}\left(a^C; \mu(o), \mathrm{diag}(\max(\sigma, \sigma_{\min}))^2\right)

    With the default shape ``(K, P)`` every one of K choices has its own block of P parameters. The actor draws all
    blocks; :func:`selected_parameters` takes the chosen one. Given the observation, choice and parameters are
    independent, so any other shape, such as ``(A,)`` for continuous actions that belong to no choice, works alike.

    The deviation is a parameter per continuous number, with the floor of :class:`~agility_rl.modules.GaussianActor`.

    Source: 5 behaviours, 5 x 6 parameters, {512, 256, 128}: section S6; ELU, state-independent deviation from 1.0,
    all blocks drawn, argmax and mean when deterministic: released code (method notes, sections 5.1 and 5.3).

    Follows :func:`tensordict.nn.set_interaction_type`; the default draws at random, ``DETERMINISTIC`` takes the
    likeliest choice and the mean.

    Keys read:
        ``in_keys``
    Keys written:
        logits  float32 ``[*B, K]``     unnormalised log-probabilities of the choices
        loc     float32 ``[*B, K, P]``  mean parameters
        scale   float32 ``[*B, K, P]``  standard deviations
        (action, behaviour)            int64 ``[*B]``           the choice
        (action, parameters)           float32 ``[*B, K, P]``   all parameters
        (action, behaviour_log_prob)   float32 ``[*B]``         log-probability of the choice
        (action, parameters_log_prob)  float32 ``[*B, K]``      log-density of each block; of shape ``(A,)``: ``[*B]``
        Log-probabilities are always named after their action, with ``_log_prob`` appended.

    Args:
        in_features: size of all inputs together, sequences flattened.
        num_choices: K.
        continuous_shape: shape of the continuous action, ``(K, P)`` for P parameters of each choice.
        in_keys: keys of the inputs.
        hidden: size of every hidden layer of the trunk (ELU).
        initial_std: standard deviation at the start, in units of the parameters.
        min_std: floor of the standard deviation, one number or a tensor that expands to ``continuous_shape``.
        allowed: indices of the choices that may be taken; ``None`` for all.
        sequence_keys: inputs that end in ``[T, F]``; they are flattened.
        choice_key: key of the choice.
        parameters_key: key of the continuous action.
        logits_key: key of the logits.
        loc_key: key of the mean.
        scale_key: key of the standard deviation.
        generator: source of randomness of the samples; a ``torch.Generator``, or the key of a seed or generator.

    Raises:
        ValueError: if a size or floor is impossible, or the inputs do not have ``in_features`` entries (at the call).

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import set_interaction_type
        >>> actor = HybridActor(45 + 32, in_keys=["proprioception", "terrain_latent"])
        >>> td = {"proprioception": torch.zeros(8, 45), "terrain_latent": torch.zeros(8, 32)}
        >>> td = actor(TensorDict(td, batch_size=[8]))
        >>> td["action", "behaviour"].shape, td["action", "parameters"].shape
        (torch.Size([8]), torch.Size([8, 5, 6]))
        >>> td["action", "behaviour_log_prob"].shape, td["action", "parameters_log_prob"].shape
        (torch.Size([8]), torch.Size([8, 5]))
        >>> with set_interaction_type(InteractionType.DETERMINISTIC):
        ...     bool((actor(td)["action", "parameters"] == td["loc"]).all())
        True
    """

    def __init__(
        self,
        in_features: int,
        num_choices: int = NUM_BEHAVIOURS,
        continuous_shape: Sequence[int] = (NUM_BEHAVIOURS, len(COMMANDS) + 1),
        *,
        in_keys: Sequence[NestedKey],
        hidden: Sequence[int] = (512, 256, 128),
        initial_std: float = 1.0,
        min_std: Tensor | float = 0.1,
        allowed: Sequence[int] | None = None,
        sequence_keys: Sequence[NestedKey] = (),
        choice_key: NestedKey = (ACTION, BEHAVIOUR),
        parameters_key: NestedKey = (ACTION, PARAMETERS),
        logits_key: NestedKey = "logits",
        loc_key: NestedKey = "loc",
        scale_key: NestedKey = "scale",
        generator: torch.Generator | NestedKey | None = None,
    ) -> None:
        network = HybridNetwork(
            ConcatenatedMLP(in_keys, in_features, hidden, sequence_keys=sequence_keys),
            hidden[-1],
            num_choices,
            continuous_shape,
            initial_std,
            min_std,
            allowed,
        )
        super().__init__(
            TensorDictModule(network, in_keys=list(in_keys), out_keys=[logits_key, loc_key, scale_key]),
            ProbabilisticTensorDictModule(
                in_keys={"logits": logits_key, "loc": loc_key, "scale": scale_key},
                out_keys=[choice_key, parameters_key],
                distribution_class=hybrid_distribution,
                distribution_kwargs={"choice_key": choice_key, "parameters_key": parameters_key},
                return_log_prob=True,
                default_interaction_type=InteractionType.RANDOM,
                generator=generator,
            ),
        )

    @property
    def network(self) -> HybridNetwork:
        """The network below the distribution: inputs to logits, mean and deviation, for deployment."""
        return self[0].module

    def project_std(self) -> None:
        """Raise the standard-deviation parameter to its floor, in place."""
        self.network.project_std()


class HybridNetwork(nn.Module):
    """Logits by one linear head on a trunk, mean and deviation of the continuous action by another.

    Example:
        >>> network = HybridNetwork(nn.Linear(3, 8), 8, 4, (4, 2), initial_std=0.5, min_std=0.1)
        >>> [tuple(output.shape) for output in network(torch.zeros(7, 3))]
        [(7, 4), (7, 4, 2), (7, 4, 2)]
    """

    mask: Tensor

    def __init__(
        self,
        trunk: nn.Module,
        num_features: int,
        num_choices: int,
        continuous_shape: Sequence[int],
        initial_std: float,
        min_std: Tensor | float,
        allowed: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        if num_choices < 2 or not continuous_shape or min(continuous_shape) < 1:
            raise ValueError(
                "a hybrid action needs at least 2 choices and a continuous shape of positive sizes, got "
                f"num_choices={num_choices}, continuous_shape={tuple(continuous_shape)}; for one kind of action use "
                "GaussianActor, or a categorical policy"
            )
        mask = torch.zeros(num_choices)
        if allowed is not None:
            if not allowed or not set(allowed) <= set(range(num_choices)):
                raise ValueError(f"allowed must name choices 0 to {num_choices - 1}, got {tuple(allowed)}")
            mask[[index for index in range(num_choices) if index not in allowed]] = FORBIDDEN
        self.register_buffer("mask", mask, persistent=False)
        self.continuous_shape = tuple(continuous_shape)
        num_continuous = math.prod(self.continuous_shape)
        floor = torch.as_tensor(min_std).expand(self.continuous_shape).flatten()
        self.trunk = trunk
        self.choice_head = mlp(num_features, (), num_choices)
        self.parameters_head = GaussianNetwork(
            mlp(num_features, (), num_continuous), num_continuous, initial_std, floor
        )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        state_dict.pop(f"{prefix}mask", None)  # weights of before hold it; it is a setting
        super()._load_from_state_dict(state_dict, prefix, *args)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits ``[*B, K]``, mean and standard deviation, each ``[*B, *continuous_shape]``."""
        features = self.trunk(*inputs)
        loc, scale = self.parameters_head(features)  # [*B, K P]
        shape = self.continuous_shape
        return self.choice_head(features) + self.mask, loc.unflatten(-1, shape), scale.unflatten(-1, shape)

    def project_std(self) -> None:
        """Raise the standard-deviation parameter to its floor, in place."""
        self.parameters_head.project_std()


def hybrid_distribution(
    logits: Tensor, loc: Tensor, scale: Tensor, *, choice_key: NestedKey, parameters_key: NestedKey
) -> CompositeDistribution:
    """Join a categorical and a Gaussian, diagonal over the last dimension, under the keys of their actions.

    Args:
        logits: ``[*B, K]``.
        loc: ``[*B, ..., P]``, mean.
        scale: ``[*B, ..., P]``, standard deviation.
        choice_key: key of the choice.
        parameters_key: key of the continuous action.

    Example:
        >>> one = torch.ones(3, 4, 2)
        >>> hybrid = hybrid_distribution(one[..., 0], one, one, choice_key="choice", parameters_key="parameters")
        >>> hybrid["choice"].probs[0].tolist(), hybrid["parameters"].entropy().shape
        ([0.25, 0.25, 0.25, 0.25], torch.Size([3, 4]))
    """
    # from_distributions reads nothing but the batch shape of its first argument
    return CompositeDistribution.from_distributions(
        logits[..., 0],
        {
            choice_key: Categorical(logits=logits, validate_args=False),
            parameters_key: DiagonalGaussian(loc, scale),
        },
    )


def selected_parameters(choice: Tensor, parameters: Tensor) -> Tensor:
    r"""Take the parameters of the chosen block.

    .. math:: a^C_{a^D}

    Source: the chosen block alone reaches the controller: released code (method notes, section 5.1).

    Args:
        choice: int64 ``[*B]``.
        parameters: ``[*B, K, P]``.

    Returns:
        ``[*B, P]``.

    Raises:
        ValueError: if the shapes do not fit.

    Example:
        >>> parameters = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
        >>> selected_parameters(torch.tensor([1]), parameters)
        tensor([[3., 4.]])
    """
    if choice.shape != parameters.shape[:-2]:
        raise ValueError(
            f"expected choice [*B] and parameters [*B, K, P], got {list(choice.shape)} and {list(parameters.shape)}"
        )
    return parameters.take_along_dim(choice[..., None, None], -2).squeeze(-2)
