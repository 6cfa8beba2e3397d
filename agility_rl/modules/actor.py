"""The Gaussian policy over joint targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from agility_rl.keys import ACTION, COMMAND, ESTIMATE, HISTORY, LATENT, PEAK, PROPRIOCEPTION
from agility_rl.modules.mlp import ConcatenatedMLP


class DiagonalGaussian(Independent):
    """A Gaussian with diagonal covariance over the last dimension; its deterministic sample is the mean.

    Args:
        loc: ``[*B, A]``, mean.
        scale: ``[*B, A]``, standard deviation.

    Example:
        >>> gaussian = DiagonalGaussian(torch.zeros(3, 2), torch.ones(3, 2))
        >>> gaussian.log_prob(torch.zeros(3, 2)).shape
        torch.Size([3])
    """

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        # validate_args reads values, which costs a synchronisation and breaks compilation; scale is positive by build
        super().__init__(Normal(loc, scale, validate_args=False), 1, validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """``[*B, A]``, the mean."""
        return self.mean


class GaussianActor(ProbabilisticTensorDictSequential):
    r"""Act by a Gaussian whose mean is an MLP and whose standard deviation is a parameter per action.

    .. math:: a \sim \mathcal{N}\left(\mu(o), \mathrm{diag}(\max(\sigma, \sigma_{\min}))^2\right)

    The floor keeps exploration alive. The gradient of the standard deviation passes the floor unchanged, so that a
    deviation which fell below can rise again; call :meth:`project_std` after an optimiser step to keep the parameter
    itself above the floor.

    Source: {512, 256, 128}: section S6; ELU, initial deviation 1.0 and floors of {hip 0.05, thigh 0.02, calf 0.05} x
    joint range: released code (method notes, section 3.1).

    Works in :class:`torchrl.objectives.ClipPPOLoss` as it is. Follows
    :func:`tensordict.nn.set_interaction_type`; the default draws at random.

    Keys read:
        proprioception, estimate, latent, command, peak (see :mod:`agility_rl.keys`), or ``in_keys``
    Keys written:
        loc              float32 ``[*B, A]``  mean action
        scale            float32 ``[*B, A]``  standard deviation
        action           float32 ``[*B, A]``
        action_log_prob  float32 ``[*B]``     log-density of the action

    Args:
        in_features: size of all inputs together, sequences flattened.
        num_actions: A.
        in_keys: keys of the inputs.
        hidden: size of every hidden layer (ELU).
        initial_std: standard deviation at the start, in units of the action.
        min_std: floor of the standard deviation, one number or ``[A]``.
        sequence_keys: inputs that end in ``[T, F]``; they are flattened.
        action_key: key of the action.
        loc_key: key of the mean.
        scale_key: key of the standard deviation.
        log_prob_key: key of the log-density.
        generator: source of randomness of the samples; a ``torch.Generator``, or the key of a seed or generator.

    Raises:
        ValueError: if a floor is not positive or above ``initial_std``, or the inputs do not have ``in_features``
            entries (at the call).

    Example:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import set_interaction_type
        >>> actor = GaussianActor(45 + 11, in_keys=["proprioception", "command"])
        >>> td = TensorDict({"proprioception": torch.zeros(8, 45), "command": torch.zeros(8, 11)}, batch_size=[8])
        >>> actor(td)["action"].shape, td["action_log_prob"].shape
        (torch.Size([8, 12]), torch.Size([8]))
        >>> with set_interaction_type(InteractionType.DETERMINISTIC):
        ...     bool((actor(td)["action"] == td["loc"]).all())
        True
    """

    def __init__(
        self,
        in_features: int,
        num_actions: int = 12,
        *,
        in_keys: Sequence[NestedKey] = (PROPRIOCEPTION, ESTIMATE, LATENT, COMMAND, PEAK),
        hidden: Sequence[int] = (512, 256, 128),
        initial_std: float = 1.0,
        min_std: Tensor | float = 0.1,
        sequence_keys: Sequence[NestedKey] = (HISTORY,),
        action_key: NestedKey = ACTION,
        loc_key: NestedKey = "loc",
        scale_key: NestedKey = "scale",
        log_prob_key: NestedKey = "action_log_prob",
        generator: torch.Generator | NestedKey | None = None,
    ) -> None:
        network = GaussianNetwork(
            ConcatenatedMLP(in_keys, in_features, hidden, num_actions, sequence_keys=sequence_keys),
            num_actions,
            initial_std,
            min_std,
        )
        super().__init__(
            TensorDictModule(network, in_keys=list(in_keys), out_keys=[loc_key, scale_key]),
            ProbabilisticTensorDictModule(
                in_keys={"loc": loc_key, "scale": scale_key},
                out_keys=[action_key],
                distribution_class=DiagonalGaussian,
                return_log_prob=True,
                log_prob_key=log_prob_key,
                default_interaction_type=InteractionType.RANDOM,
                generator=generator,
            ),
        )

    @property
    def network(self) -> GaussianNetwork:
        """The network below the distribution: call it with the inputs to get mean and deviation, for deployment."""
        return self[0].module

    def project_std(self) -> None:
        """Raise the standard-deviation parameter to its floor, in place."""
        self.network.project_std()


class GaussianNetwork(nn.Module):
    """Mean by a network, standard deviation by a parameter above a floor.

    Example:
        >>> loc, scale = GaussianNetwork(nn.Linear(3, 2), 2, initial_std=0.5, min_std=0.1)(torch.zeros(4, 3))
        >>> scale[0].tolist()
        [0.5, 0.5]
    """

    min_std: Tensor

    def __init__(self, mean: nn.Module, num_actions: int, initial_std: float, min_std: Tensor | float) -> None:
        super().__init__()
        floor = torch.as_tensor(min_std, dtype=torch.get_default_dtype()).expand(num_actions).clone()
        if not bool((floor > 0).all()) or bool((floor > initial_std).any()):
            raise ValueError(f"min_std must be positive and at most initial_std={initial_std}, got {floor.tolist()}")
        self.mean = mean
        self.std = nn.Parameter(torch.full((num_actions,), float(initial_std)))
        self.register_buffer("min_std", floor, persistent=False)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        state_dict.pop(f"{prefix}min_std", None)  # weights of before hold it; it is a setting
        super()._load_from_state_dict(state_dict, prefix, *args)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each ``[*B, A]``."""
        loc = self.mean(*inputs)
        lift = (self.min_std - self.std.detach()).clamp_min(0.0)  # constant: the floor stops no gradient
        return loc, (self.std + lift).expand_as(loc)

    @torch.no_grad()
    def project_std(self) -> None:
        """Raise the parameter to the floor, in place."""
        self.std.copy_(torch.maximum(self.std, self.min_std))
