"""The discriminator loss of EASI, Eq. (13)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor, nn

from agility_rl.keys import TRANSITION_LOGIT
from agility_rl.losses.functional import wasserstein
from agility_rl.losses.keyed import KeyedLoss, penalized_logit
from agility_rl.losses.reduction import Reduction, check_reduction


class TransitionDiscriminatorLoss(KeyedLoss):
    r"""Teach a discriminator to tell the robot's transitions from the simulator's.

    .. math:: L = \tfrac12 \left(-E_E \tilde D(s, a, s') + E_\pi \tilde D(s, a, s')\right)
              + \tfrac{\lambda_{gp}}{2} \left(E_E \|\nabla \tilde D\|^2 + E_\pi \|\nabla \tilde D\|^2\right)

    A critic without bound on its slope could grow for ever. Either its weights are clipped, as in EASI's release: call
    :meth:`clip_weights` before every step. Or the penalty bounds the slope; it is taken at both groups, because it is
    zero-centred and a critic that is flat on the robot's transitions only could still fall without limit on the
    simulator's. It is taken with respect to the *normalised* inputs where the discriminator writes them.

    Source: Eq. (13), Algorithm S2; clipping at 0.01: EASI's release (method notes, section 6.2). Penalty: Mroueh et al.
    2018, arXiv:1711.04894 (the slope is measured under the mixture of both distributions); not in the paper.

    Keys read:
        (expert, ...)   every entry of ``discriminator.in_keys`` in the nested TensorDict of the robot; with the default
                        network ``measurement``, ``(next, measurement)`` float32 ``[*B, S]``, ``action`` ``[*B, A]``
        (policy, ...)   the same of the simulator, any other batch size; with ``(collector, mask)`` bool ``[*B]`` only
                        the marked transitions count
    Keys written (``[]`` each):
        loss_discriminator     criterion; gradient to every parameter of the discriminator but the last bias
        loss_gradient_penalty  the same parameters; absent with ``gradient_penalty=None``
        logit_expert, logit_policy  mean D, detached
        distance               their difference, which estimates the distance of the two distributions, detached

    Args:
        discriminator: module that writes one logit ``[*B, 1]``; any inputs.
        weight_clip: bound of every weight and bias for :meth:`clip_weights` (released: 0.01); schedulable; ``None``
            makes that method do nothing.
        gradient_penalty: coefficient; schedulable; ``None`` leaves the term, and its cost, out.
        reduction: ``"mean"`` (default) or ``"sum"`` over samples.

    Raises:
        ValueError: if the reduction is unknown, the clip is not positive, or neither clip nor penalty is given.

    Example:
        >>> from agility_rl.modules import TransitionDiscriminator
        >>> def transitions(n, value):
        ...     entries = {"measurement": torch.zeros(n, 29), "action": torch.zeros(n, 12)}
        ...     return TensorDict({**entries, "next": {"measurement": torch.full((n, 29), value)}}, [n])
        >>> loss = TransitionDiscriminatorLoss(TransitionDiscriminator())
        >>> optimizer = torch.optim.RMSprop(loss.parameters(), lr=3e-4)
        >>> for _ in range(10):
        ...     loss.clip_weights()
        ...     losses = loss(TensorDict({"expert": transitions(4, 0.1), "policy": transitions(6, 0.0)}))
        ...     losses["loss_discriminator"].backward()
        ...     optimizer.step()
        ...     optimizer.zero_grad()
        >>> bool(losses["distance"] > 0)
        True
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            expert (NestedKey): nested TensorDict of the robot's transitions.
            policy (NestedKey): nested TensorDict of the simulator's transitions.
            logit (NestedKey): what the discriminator writes, ``[*B, 1]``.
            penalty_input (NestedKey): input or output of the discriminator with respect to which the penalty
                differentiates; where the discriminator has no such entry, all its floating-point inputs.
        """

        expert: NestedKey = "expert"
        policy: NestedKey = "policy"
        logit: NestedKey = TRANSITION_LOGIT
        penalty_input: NestedKey = "normalized_transition"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    discriminator: TensorDictModule
    discriminator_params: TensorDictParams
    target_discriminator_params: TensorDictParams
    _schedulable_buffers = frozenset({"weight_clip", "gradient_penalty"})

    def __init__(
        self,
        discriminator: TensorDictModule,
        *,
        weight_clip: float | None = 0.01,
        gradient_penalty: float | None = None,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__()
        if weight_clip is None and gradient_penalty is None:
            raise ValueError("a Wasserstein critic needs a bound on its slope: give weight_clip or gradient_penalty")
        if weight_clip is not None and weight_clip <= 0:
            raise ValueError(f"weight_clip must be positive, got {weight_clip}")
        self.reduction = check_reduction(reduction)
        self.convert_to_functional(discriminator, "discriminator")
        self.register_coeff_buffer("weight_clip", weight_clip)
        self.register_coeff_buffer("gradient_penalty", gradient_penalty)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        self._in_keys = [
            unravel_key((group, key))
            for group in (self.tensor_keys.expert, self.tensor_keys.policy)
            for key in self.discriminator.in_keys
        ]

    @property
    def out_keys(self) -> list[str]:
        """Entries written."""
        penalty = [] if self.gradient_penalty is None else ["loss_gradient_penalty"]
        return ["loss_discriminator", *penalty, "logit_expert", "logit_policy", "distance"]

    @torch.no_grad()
    def clip_weights(self) -> None:
        """Clamp every parameter of the discriminator to +- ``weight_clip`` in place; its statistics stay as they are.

        Source: method notes, section 6.2 (before each step).
        """
        if self.weight_clip is None:
            return
        for value in self.discriminator_params.values(True, True):
            if isinstance(value, nn.Parameter):
                value.clamp_(-self.weight_clip, self.weight_clip)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input stays as it is."""
        tensordict = tensordict.clone(False)
        expert, policy = tensordict.get(self.tensor_keys.expert), tensordict.get(self.tensor_keys.policy)
        with self.discriminator_params.to_module(self.discriminator, preserve_module_state=False):
            expert_logit, expert_penalty = self._judge(expert)
            policy_logit, policy_penalty = self._judge(policy)
        expert_term, policy_term = wasserstein(expert_logit, policy_logit)
        out = TensorDict()
        loss = self._reduce_loss(expert_term, expert) + self._reduce_loss(policy_term, policy)
        out.set("loss_discriminator", loss)
        if expert_penalty is not None and policy_penalty is not None:
            penalty = self._reduce_loss(expert_penalty, expert) + self._reduce_loss(policy_penalty, policy)
            out.set("loss_gradient_penalty", 0.5 * self.gradient_penalty * penalty)
        expert_mean, policy_mean = self._mean(expert_logit, expert), self._mean(policy_logit, policy)
        out.set("logit_expert", expert_mean)
        out.set("logit_policy", policy_mean)
        out.set("distance", expert_mean - policy_mean)
        self._clear_weakrefs(tensordict, out, "discriminator_params", "target_discriminator_params")
        return out

    def _judge(self, group: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        """Logits ``[*B, 1]`` of a group and, if asked for, their penalty ``[*B]``."""
        counting = self._counting(group)
        group = group.select(*self.discriminator.in_keys)
        if counting is not None:  # NaN in a row that does not count would still reach the weights: 0 NaN is NaN
            group = group.masked_fill(~counting, 0.0)
        if self.gradient_penalty is None:
            return self.discriminator(group).get(self.tensor_keys.logit), None
        return penalized_logit(self.discriminator, group, self.tensor_keys.logit, self.tensor_keys.penalty_input)
