"""Losses that teach the robot to do without the simulator's truth: state estimation and online adaptation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch

from agility_rl.keys import ESTIMATE, EXPLICIT, LATENT
from agility_rl.losses.functional import missed
from agility_rl.losses.keyed import KeyedLoss


class StateEstimationLoss(KeyedLoss):
    r"""Regress the state that the robot cannot measure: trunk height and linear velocity.

    .. math:: L = E \, \tfrac1n \| \hat s(o) - s \|^2

    Source: "estimated proprioception", section S6; mean squared error: released code (method notes, section 3.1).

    Keys read:
        the estimator's inputs, by default ``proprioception`` float32 ``[*B, P]``
        explicit  float32 ``[*B, 4]``  the true state, never differentiated
    Keys written:
        loss_estimation   ``[]``, or ``[*B]`` with ``reduction="none"``; gradient to the estimator
        error_estimation  ``[]``  root of the mean squared error, in the target's units, detached

    Args:
        estimator: module that writes the estimate ``[*B, n]``.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Example:
        >>> from agility_rl.modules import StateEstimator
        >>> loss = StateEstimationLoss(StateEstimator(45))
        >>> td = TensorDict({"proprioception": torch.zeros(8, 45), "explicit": torch.ones(8, 4)}, batch_size=[8])
        >>> loss(td)["loss_estimation"].backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            estimate (NestedKey): what the estimator writes.
            target (NestedKey): the true state.
        """

        estimate: NestedKey = ESTIMATE
        target: NestedKey = EXPLICIT

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    estimator: TensorDictModule
    estimator_params: TensorDictParams
    target_estimator_params: TensorDictParams
    out_keys = ["loss_estimation", "error_estimation"]

    def __init__(self, estimator: TensorDictModule, *, reduction: str | None = None) -> None:
        super().__init__()
        self.reduction = "mean" if reduction is None else reduction
        self.convert_to_functional(estimator, "estimator")
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        self._in_keys = [*self.estimator.in_keys, self.tensor_keys.target]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss; the input stays as it is."""
        tensordict = tensordict.clone(False)
        with self.estimator_params.to_module(self.estimator, preserve_module_state=False):
            estimate = self.estimator(tensordict.select(*self.estimator.in_keys)).get(self.tensor_keys.estimate)
        target = tensordict.get(self.tensor_keys.target)
        error = missed(estimate, target, self.tensor_keys.target).square().mean(-1)  # [*B]
        out = TensorDict()
        out.set("loss_estimation", self._reduce_loss(error, tensordict))
        out.set("error_estimation", self._mean(error, tensordict).sqrt())
        self._clear_weakrefs(tensordict, out, "estimator_params", "target_estimator_params")
        return out


class AdaptationLoss(KeyedLoss):
    r"""Make the history encoder's latent and the privileged encoder's meet.

    .. math:: L = w_h \, E \| h(o_{t-9:t}) - \mathrm{sg}[z(p)] \| + w_p \, E \| z(p) - \mathrm{sg}[h(o_{t-9:t})] \|

    The first term teaches the robot to infer its physics from its history; the second keeps the privileged latent
    inferable. ``sg`` stops the gradient, so that each encoder learns from its own term alone. All coefficients are
    already applied to the losses returned.

    Source: regularised online adaptation, released code (method notes, section 3.7: L2 norm; second coefficient
    0 to 0.1, from update 1,000 over 2,000); Cheng et al. 2023, arXiv:2309.14341.

    Keys read:
        the encoders' inputs, by default ``history`` float32 ``[*B, 10, P]`` and ``privileged`` float32 ``[*B, 29]``
    Keys written (``[]``, or ``[*B]`` with ``reduction="none"``):
        loss_adaptation   gradient to the history encoder only
        loss_privileged   gradient to the privileged encoder only
        error_adaptation  ``[]``  mean distance of the latents [1], detached

    Args:
        history_encoder: module that writes a latent ``[*B, L]``.
        privileged_encoder: module that writes a latent ``[*B, L]``, under the same key or another one.
        history: coefficient of the first term; schedulable.
        privileged: coefficient of the second term; schedulable.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if the latents differ in shape (at the call).

    Example:
        >>> from agility_rl.modules import HistoryEncoder, PrivilegedEncoder
        >>> loss = AdaptationLoss(HistoryEncoder(num_features=45), PrivilegedEncoder())
        >>> td = TensorDict({"history": torch.zeros(8, 10, 45), "privileged": torch.ones(8, 29)}, batch_size=[8])
        >>> loss(td)["loss_adaptation"].backward()
        >>> loss.privileged = 0.1  # in place, no rebuild
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            history_latent (NestedKey): what the history encoder writes.
            privileged_latent (NestedKey): what the privileged encoder writes.
        """

        history_latent: NestedKey = LATENT
        privileged_latent: NestedKey = LATENT

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    history_encoder: TensorDictModule
    history_encoder_params: TensorDictParams
    target_history_encoder_params: TensorDictParams
    privileged_encoder: TensorDictModule
    privileged_encoder_params: TensorDictParams
    target_privileged_encoder_params: TensorDictParams
    out_keys = ["loss_adaptation", "loss_privileged", "error_adaptation"]
    _schedulable_buffers = frozenset({"history", "privileged"})

    def __init__(
        self,
        history_encoder: TensorDictModule,
        privileged_encoder: TensorDictModule,
        *,
        history: float = 1.0,
        privileged: float = 0.0,
        reduction: str | None = None,
    ) -> None:
        super().__init__()
        self.reduction = "mean" if reduction is None else reduction
        self.convert_to_functional(history_encoder, "history_encoder")
        self.convert_to_functional(privileged_encoder, "privileged_encoder")
        self.register_coeff_buffer("history", history)
        self.register_coeff_buffer("privileged", privileged)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        self._in_keys = [*self.history_encoder.in_keys, *self.privileged_encoder.in_keys]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input stays as it is."""
        tensordict = tensordict.clone(False)
        keys = self.tensor_keys
        with self.history_encoder_params.to_module(self.history_encoder, preserve_module_state=False):
            inferred = self.history_encoder(tensordict.select(*self.history_encoder.in_keys)).get(keys.history_latent)
        with self.privileged_encoder_params.to_module(self.privileged_encoder, preserve_module_state=False):
            truth = self.privileged_encoder(tensordict.select(*self.privileged_encoder.in_keys)).get(
                keys.privileged_latent
            )
        if inferred.shape != truth.shape:
            raise ValueError(
                f"both encoders must write latents of one shape, got {list(inferred.shape)} from the history and "
                f"{list(truth.shape)} from the privileged quantities; give them the same out_features"
            )
        adaptation = torch.linalg.vector_norm(inferred - truth.detach(), dim=-1)  # [*B]
        regularization = torch.linalg.vector_norm(truth - inferred.detach(), dim=-1)  # [*B]
        out = TensorDict()
        out.set("loss_adaptation", self.history * self._reduce_loss(adaptation, tensordict))
        out.set("loss_privileged", self.privileged * self._reduce_loss(regularization, tensordict))
        out.set("error_adaptation", self._mean(adaptation, tensordict))
        self._clear_weakrefs(
            tensordict,
            out,
            "history_encoder_params",
            "target_history_encoder_params",
            "privileged_encoder_params",
            "target_privileged_encoder_params",
        )
        return out
