"""Proximal policy optimisation of hybrid actions: a clipped objective for the discrete and for the continuous part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor
from torch.distributions import Distribution, kl_divergence

from agility_rl.keys import ACTION, BEHAVIOUR, PARAMETERS
from agility_rl.losses.functional import clipped_surrogate, divergence_estimate
from agility_rl.losses.keyed import KeyedLoss


class HybridPPOLoss(KeyedLoss):
    r"""Improve a policy over a discrete choice and continuous parameters by one clipped surrogate for each.

    .. math:: L = E\left[L^{clip}(\rho_D) + L^{clip}(\rho_C)\right] + w_V E (V(o) - \hat R)^2
              - w_D E[H_D] - w_C E\left[\tfrac1n H_C\right]
    .. math:: L^{clip}(\rho) = -\min(\rho A, \mathrm{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A), \qquad
              \rho_D = \frac{\pi(a^D | o)}{\pi_{old}(a^D | o)}, \quad \rho_C = \frac{\pi(a^C | o)}{\pi_{old}(a^C | o)}

    Both parts see the same advantage, and each is clipped by itself: a joint ratio would stop the choice whenever the
    many continuous dimensions have moved. n is the number of continuous dimensions in H_C.

    Where each choice has its own block of parameters, ``continuous`` says which blocks enter the ratio, the entropy and
    the divergence: ``"all"``, or of each sample only the ``"selected"`` one, which alone acted. The other blocks carry
    no information about the advantage: leaving them out takes noise from the gradient and leaves the selected one the
    whole clipping range, and their deviations move only while their choice is tried.

    An environment that clips parameters to [-1, 1] gives a mean far outside no gradient: whatever is tried, the same is
    done. ``bounds_coeff`` holds means back, by the part of each that lies beyond:

    .. math:: w_B E \left\| \max(|\mu| - 1, 0) \right\|^2

    Source: section S2, algorithm S3 ("Hybrid-PPO"); clip 0.2: Table S4; two surrogates, all blocks, entropy
    coefficients 0.01, mean over dimensions: released code (method notes, section 5.2); Fan et al. 2019,
    arXiv:1903.01344. ``"selected"`` and the bounds are in neither.

    Advantages come from outside, for example from :class:`torchrl.objectives.value.GAE`; normalise them before. All
    coefficients are already applied to the losses returned.

    Keys read:
        the inputs of actor and critic
        (action, behaviour)            int64 ``[*B]``        the choice
        (action, parameters)           float32 ``[*B, ...]`` the continuous action, ``[*B, K, P]`` with blocks
        (action, behaviour_log_prob)   float32 ``[*B]``      its log-probability at collection
        (action, parameters_log_prob)  float32 ``[*B, ...]`` its log-density at collection, ``[*B, K]`` with blocks
        advantage                      float32 ``[*B, 1]``
        value_target                   float32 ``[*B, 1]``   return that the critic fits
    Keys written (losses ``[]``, or ``[*B]`` with ``reduction="none"``; the others ``[]``, detached):
        loss_discrete, loss_continuous            clipped surrogates; gradient to the actor
        loss_critic                               squared error; gradient to the critic
        loss_entropy                              both entropies, weighted, negative; gradient to the actor
        loss_bounds                               means beyond [-1, 1], weighted; only with a coefficient; to the actor
        clip_fraction_discrete, _continuous       share of ratios outside the clip
        kl_discrete, kl_continuous                KL(old || new) [nat], estimated from the ratios
        entropy_discrete, entropy_continuous      H_D and H_C / n [nat]

    Args:
        actor: policy whose distribution is a :class:`tensordict.nn.CompositeDistribution` of the two actions, such as
            :class:`agility_rl.modules.HybridActor`.
        critic: module that writes the value ``[*B, 1]``.
        continuous: which continuous dimensions count.
        clip_epsilon: half width of the clipping interval; schedulable.
        critic_coeff: weight of the critic's error; schedulable.
        discrete_entropy_coeff: weight of the choice's entropy; schedulable.
        continuous_entropy_coeff: weight of the parameters' mean entropy; schedulable.
        bounds_coeff: weight of means beyond [-1, 1]; schedulable. ``None`` leaves the term out.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if ``continuous`` is neither ``"all"`` nor ``"selected"``; at the call, if advantage, target or
            value do not end in one dimension of size 1, or there is no log-density of each block to select from.
        KeyError: if an entry is missing (at the call).

    Example:
        >>> from agility_rl.modules import Critic, HybridActor
        >>> actor = HybridActor(3, 2, (2, 4), in_keys=["observation"], hidden=(8,))
        >>> loss = HybridPPOLoss(actor, Critic(3, in_keys=["observation"], hidden=(8,)), continuous="selected")
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict({"observation": torch.zeros(16, 3)}, batch_size=[16]))
        >>> batch["advantage"], batch["value_target"] = torch.ones(16, 1), torch.zeros(16, 1)
        >>> losses = loss(batch)
        >>> losses["loss_discrete"].item(), losses["loss_continuous"].item()  # the ratio is still one
        (-1.0, -1.0)
        >>> sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        >>> loss.discrete_entropy_coeff = 0.005  # in place, no rebuild
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            discrete_action (NestedKey): the choice, int64 ``[*B]``.
            continuous_action (NestedKey): the parameters.
            discrete_log_prob (NestedKey): log-probability of the choice at collection.
            continuous_log_prob (NestedKey): log-density of the parameters at collection.
            advantage (NestedKey): how much better than expected the action was.
            value_target (NestedKey): what the critic fits.
            value (NestedKey): what the critic writes.
        """

        discrete_action: NestedKey = (ACTION, BEHAVIOUR)
        continuous_action: NestedKey = (ACTION, PARAMETERS)
        discrete_log_prob: NestedKey = (ACTION, BEHAVIOUR + "_log_prob")
        continuous_log_prob: NestedKey = (ACTION, PARAMETERS + "_log_prob")
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor: ProbabilisticTensorDictSequential
    actor_params: TensorDictParams
    target_actor_params: TensorDictParams
    critic: TensorDictModule
    critic_params: TensorDictParams
    target_critic_params: TensorDictParams
    _schedulable_buffers = frozenset(
        {"clip_epsilon", "critic_coeff", "discrete_entropy_coeff", "continuous_entropy_coeff", "bounds_coeff"}
    )

    def __init__(
        self,
        actor: ProbabilisticTensorDictSequential,
        critic: TensorDictModule,
        *,
        continuous: Literal["all", "selected"] = "all",
        clip_epsilon: float = 0.2,
        critic_coeff: float = 1.0,
        discrete_entropy_coeff: float = 0.01,
        continuous_entropy_coeff: float = 0.01,
        bounds_coeff: float | None = None,
        reduction: str | None = None,
    ) -> None:
        super().__init__()
        if continuous not in ("all", "selected"):
            raise ValueError(f"continuous must be 'all' or 'selected', got {continuous!r}")
        self.continuous = continuous
        self.reduction = "mean" if reduction is None else reduction
        self.convert_to_functional(actor, "actor")
        self.convert_to_functional(critic, "critic")
        self.register_coeff_buffer("clip_epsilon", clip_epsilon)
        self.register_coeff_buffer("critic_coeff", critic_coeff)
        self.register_coeff_buffer("discrete_entropy_coeff", discrete_entropy_coeff)
        self.register_coeff_buffer("continuous_entropy_coeff", continuous_entropy_coeff)
        self.register_coeff_buffer("bounds_coeff", bounds_coeff)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        entries = [*self.actor.in_keys, *self.critic.in_keys, keys.discrete_action, keys.continuous_action]
        entries += [keys.discrete_log_prob, keys.continuous_log_prob, keys.advantage, keys.value_target]
        self._in_keys = list(dict.fromkeys(unravel_key(key) for key in entries))

    @property
    def out_keys(self) -> list[str]:
        """Everything that is written."""
        return [
            *("loss_discrete", "loss_continuous", "loss_critic", "loss_entropy"),
            *(["loss_bounds"] if self.bounds_coeff is not None else []),
            *("clip_fraction_discrete", "clip_fraction_continuous", "kl_discrete", "kl_continuous"),
            *("entropy_discrete", "entropy_continuous"),
        ]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input stays as it is."""
        tensordict = tensordict.clone(False)
        keys = self.tensor_keys
        advantage = _per_sample(tensordict, keys.advantage).detach()  # [*B]
        choice, parameters = _entry(tensordict, keys.discrete_action), _entry(tensordict, keys.continuous_action)
        discrete, continuous = self._heads(self._policy(tensordict))
        log_ratio = {
            "discrete": _total(_log_ratio(discrete, choice, tensordict, keys.discrete_log_prob), advantage.ndim),
            "continuous": self._counted(
                _log_ratio(continuous, parameters, tensordict, keys.continuous_log_prob), choice, advantage.ndim
            ),
        }
        blocks = continuous.entropy()
        dimensions = parameters.shape[advantage.ndim :].numel()
        if self.continuous == "selected":
            dimensions //= blocks.shape[-1]
        entropy = {
            "discrete": _total(discrete.entropy(), advantage.ndim),
            "continuous": self._counted(blocks, choice, advantage.ndim) / dimensions,
        }
        bonus = (
            self.discrete_entropy_coeff * entropy["discrete"] + self.continuous_entropy_coeff * entropy["continuous"]
        )
        error = (self._value(tensordict) - _per_sample(tensordict, keys.value_target).detach()).square()  # [*B]

        out = TensorDict()
        for head, ratio in log_ratio.items():
            surrogate = clipped_surrogate(ratio, advantage, self.clip_epsilon)
            out.set(f"loss_{head}", self._reduce_loss(surrogate, tensordict))
        out.set("loss_critic", self.critic_coeff * self._reduce_loss(error, tensordict))
        out.set("loss_entropy", -self._reduce_loss(bonus, tensordict))
        if self.bounds_coeff is not None:
            beyond = (continuous.mean.abs() - 1.0).clamp(min=0.0).square().sum(-1)
            excess = self._counted(beyond, choice, advantage.ndim)
            out.set("loss_bounds", self.bounds_coeff * self._reduce_loss(excess, tensordict))
        with torch.no_grad():
            for head, ratio in log_ratio.items():
                outside = ratio.expm1().abs() > self.clip_epsilon
                out.set(f"clip_fraction_{head}", self._mean(outside.to(ratio.dtype), tensordict))
                out.set(f"kl_{head}", self._mean(divergence_estimate(ratio), tensordict))
                out.set(f"entropy_{head}", self._mean(entropy[head], tensordict))
        self._clear_weakrefs(
            tensordict, out, "actor_params", "target_actor_params", "critic_params", "target_critic_params"
        )
        return out

    @torch.no_grad()
    def divergence(self, tensordict: TensorDictBase) -> TensorDictBase:
        r"""Exact divergence KL(old || new) [nat] of each head, for an adaptive learning rate.

        The released code follows the continuous one alone (method notes, section 5.2). With ``"selected"`` it is that
        of the selected blocks, as in the loss.

        Args:
            tensordict: a batch that also holds what the actor wrote at collection as parameters of its distribution;
                :class:`agility_rl.modules.HybridActor` writes ``logits``, ``loc`` and ``scale``.

        Returns:
            ``discrete`` and ``continuous``, ``[]`` each.

        Raises:
            KeyError: if those parameters are missing.
        """
        choice = _entry(tensordict, self.tensor_keys.discrete_action)
        for key in self.actor.dist_params_keys:
            _entry(tensordict, key)
        old = self._heads(self.actor.build_dist_from_params(tensordict))
        new = self._heads(self._policy(tensordict))
        discrete, continuous = (kl_divergence(before, after) for before, after in zip(old, new))
        batch_dims = _entry(tensordict, self.tensor_keys.advantage).ndim - 1
        return TensorDict(
            {
                "discrete": self._mean(_total(discrete, batch_dims), tensordict),
                "continuous": self._mean(self._counted(continuous, choice, batch_dims), tensordict),
            }
        )

    def _policy(self, tensordict: TensorDictBase) -> CompositeDistribution:
        """The present policy's distribution; the old one's parameters in the batch stay as they are."""
        with self.actor_params.to_module(self.actor, preserve_module_state=False):
            return self.actor.get_dist(tensordict.select(*self.actor.in_keys))

    def _heads(self, distribution: CompositeDistribution) -> tuple[Distribution, Distribution]:
        keys = self.tensor_keys
        discrete = distribution[unravel_key(keys.discrete_action)]
        continuous = distribution[unravel_key(keys.continuous_action)]
        if self.continuous == "selected" and continuous.batch_shape != discrete.logits.shape:
            raise ValueError(
                "continuous='selected' needs one log-density for each choice's block, expected "
                f"{list(discrete.logits.shape)}, got {list(continuous.batch_shape)}; use continuous='all' for "
                "parameters that belong to no choice"
            )
        return discrete, continuous

    def _value(self, tensordict: TensorDictBase) -> Tensor:
        with self.critic_params.to_module(self.critic, preserve_module_state=False):
            return _per_sample(self.critic(tensordict.select(*self.critic.in_keys)), self.tensor_keys.value)

    def _counted(self, values: Tensor, choice: Tensor, batch_dims: int) -> Tensor:
        """Sum, to ``[*B]``, what the continuous dimensions that count have contributed."""
        if self.continuous == "all":
            return _total(values, batch_dims)
        return values.gather(-1, choice.unsqueeze(-1)).squeeze(-1)


def _total(values: Tensor, batch_dims: int) -> Tensor:
    """Sum what a head with several numbers a sample, ``[*B, ...]``, says of each, to ``[*B]``."""
    return values if values.ndim == batch_dims else values.flatten(batch_dims).sum(-1)


def _log_ratio(head: Distribution, action: Tensor, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    now, before = head.log_prob(action), _entry(tensordict, key).detach()
    if now.shape != before.shape:
        raise ValueError(
            f"expected log-probabilities {list(now.shape)} in {key!r}, got {list(before.shape)}; store what the actor "
            "wrote there at collection"
        )
    return now - before


def _per_sample(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    value = _entry(tensordict, key)
    if value.ndim == 0 or value.shape[-1] != 1:
        raise ValueError(f"expected {key!r} to be [*B, 1], got {list(value.shape)}")
    return value.squeeze(-1)


def _entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    value = tensordict.get(key, None)
    if value is None:
        present = sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))
        raise KeyError(f"expected {key!r} in the batch, found {', '.join(present)}; collect it, or name it by set_keys")
    return value
