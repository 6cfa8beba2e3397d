"""The predictor loss of semi-supervised InfoGAIL, Eq. (10)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from torch.nn import functional

from agility_rl.keys import SHIFT, SHIFT_ESTIMATE, SKILL, SKILL_LOGITS
from agility_rl.losses.functional import conditional_entropy, marginal_entropy, missed
from agility_rl.losses.keyed import KeyedLoss
from agility_rl.losses.reduction import Reduction, check_reduction


class PredictorLoss(KeyedLoss):
    r"""Teach a predictor the skill from few labels and much unlabelled motion, and the shift from the policy.

    .. math:: L = w_{SS} \, \mathrm{CE}(Q^c(o_L), y) + w_{US} \, E_\pi |Q^\epsilon(o) - \epsilon|
              + w_{RIM} \, E_U H(Q^c(\cdot | o)) - w_M \, H(E_U Q^c(\cdot | o))

    The entropy term pushes the class boundaries into sparse regions of the unlabelled motion; ramp its coefficient,
    or it sharpens a random guess. The policy's skill is not used: its mutual information is pressed through the
    reward. All coefficients are already applied to the losses returned.

    Source: Eq. (10); released code (method notes, section 3.4), which ramps the entropy coefficient from iteration
    200 on. Differs from it: cross-entropy on logits, not on probabilities. The last term is Ess-InfoGAIL's, off here.

    Keys read:
        (labelled, ...)    every entry of ``predictor.in_keys``, with the default network ``motion`` float32
                           ``[*B, H, F]``, and ``skill`` int64 ``[*B]``, the label
        (policy, ...)      the same, and ``shift`` float32 ``[*B, S]``, the latent the policy was given
        (unlabelled, ...)  the same, nothing else
        A group whose coefficients are all ``None`` is not read. Batch sizes are free.
    Keys written (``[]`` each, unless said):
        loss_skill, loss_shift, loss_information, loss_marginal  only those with a coefficient
        accuracy_labelled             share of labels recovered, detached
        error_shift                   mean absolute error [1], detached
        entropy_unlabelled            mean H(y | o) [nat], detached
        unlabelled_skill_probability  ``[K]`` mean Q^c of the unlabelled samples, detached: what a SkillPrior takes

    Args:
        predictor: module that writes skill logits ``[*B, K]`` and shift estimates ``[*B, S]``.
        labelled: coefficient of the cross-entropy; schedulable.
        shift: coefficient of the shift's L1 error; schedulable.
        information: coefficient of the conditional entropy; schedulable.
        marginal: coefficient of the marginal entropy; schedulable.
        reduction: ``"mean"`` (default) or ``"sum"`` over samples.

    Raises:
        ValueError: if no coefficient is given, or the reduction is unknown.

    Example:
        >>> import torch
        >>> from agility_rl.modules import Predictor
        >>> loss = PredictorLoss(Predictor(num_features=3, horizon=2, hidden=(8,)), information=0.0)
        >>> motion = torch.zeros(4, 2, 3)
        >>> losses = loss(TensorDict({
        ...     "labelled": TensorDict({"motion": motion, "skill": torch.tensor([0, 1, 2, 3])}, [4]),
        ...     "policy": TensorDict({"motion": motion, "shift": torch.zeros(4, 1)}, [4]),
        ...     "unlabelled": TensorDict({"motion": motion}, [4]),
        ... }))
        >>> losses["unlabelled_skill_probability"].shape
        torch.Size([5])
        >>> loss.information = 0.3  # in place, no rebuild
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            labelled (NestedKey): nested TensorDict of labelled expert samples.
            policy (NestedKey): nested TensorDict of policy samples.
            unlabelled (NestedKey): nested TensorDict of unlabelled expert samples.
            skill (NestedKey): label inside ``labelled``, int64 ``[*B]``.
            shift (NestedKey): latent inside ``policy``, float32 ``[*B, S]``.
            skill_logits (NestedKey): what the predictor writes, ``[*B, K]``.
            shift_estimate (NestedKey): what the predictor writes, ``[*B, S]``.
        """

        labelled: NestedKey = "labelled"
        policy: NestedKey = "policy"
        unlabelled: NestedKey = "unlabelled"
        skill: NestedKey = SKILL
        shift: NestedKey = SHIFT
        skill_logits: NestedKey = SKILL_LOGITS
        shift_estimate: NestedKey = SHIFT_ESTIMATE

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    predictor: TensorDictModule
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams
    _schedulable_buffers = frozenset({"labelled", "shift", "information", "marginal"})

    def __init__(
        self,
        predictor: TensorDictModule,
        *,
        labelled: float | None = 1.0,
        shift: float | None = 1.0,
        information: float | None = 1.0,
        marginal: float | None = None,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__()
        if labelled is None and shift is None and information is None and marginal is None:
            raise ValueError("at least one of labelled, shift, information and marginal must be a number, got none")
        self.reduction = check_reduction(reduction)
        self.convert_to_functional(predictor, "predictor")
        self.register_coeff_buffer("labelled", labelled)
        self.register_coeff_buffer("shift", shift)
        self.register_coeff_buffer("information", information)
        self.register_coeff_buffer("marginal", marginal)
        self._set_in_keys()

    @property
    def _reads_unlabelled(self) -> bool:
        return self.information is not None or self.marginal is not None

    def _set_in_keys(self) -> None:
        keys, inputs = self.tensor_keys, list(self.predictor.in_keys)
        groups: list[tuple[NestedKey, list[NestedKey]]] = []
        if self.labelled is not None:
            groups.append((keys.labelled, [*inputs, keys.skill]))
        if self.shift is not None:
            groups.append((keys.policy, [*inputs, keys.shift]))
        if self._reads_unlabelled:
            groups.append((keys.unlabelled, inputs))
        self._in_keys = [unravel_key((group, key)) for group, entries in groups for key in entries]

    @property
    def out_keys(self) -> list[str]:
        """Entries written."""
        names: list[str] = []
        if self.labelled is not None:
            names += ["loss_skill", "accuracy_labelled"]
        if self.shift is not None:
            names += ["loss_shift", "error_shift"]
        if self.information is not None:
            names.append("loss_information")
        if self.marginal is not None:
            names.append("loss_marginal")
        if self._reads_unlabelled:
            names += ["entropy_unlabelled", "unlabelled_skill_probability"]
        return names

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input stays as it is."""
        tensordict = tensordict.clone(False)
        keys = self.tensor_keys
        out = TensorDict()
        # One pass a group: batch sizes stay free, and on two cores it is no slower than one pass over all of them
        # (26.5 against 28 ms for 1024 + 1024 + 512 samples), for it saves the concatenation.
        with self.predictor_params.to_module(self.predictor, preserve_module_state=False):
            if self.labelled is not None:
                group = tensordict.get(keys.labelled)
                logits = self._predict(group).get(keys.skill_logits)
                label = group.get(keys.skill)
                # [*B, K], [*B] -> [N, K], [N] -> [*B]: cross_entropy wants the classes second
                flat = functional.cross_entropy(logits.flatten(0, -2), label.flatten(), reduction="none")
                out.set("loss_skill", self.labelled * self._reduce_loss(flat.reshape(label.shape), group))
                out.set("accuracy_labelled", self._mean((logits.argmax(-1) == label).to(logits.dtype), group))
            if self.shift is not None:
                group = tensordict.get(keys.policy)
                error = missed(self._predict(group).get(keys.shift_estimate), group.get(keys.shift), keys.shift)
                error = error.abs().mean(-1)
                out.set("loss_shift", self.shift * self._reduce_loss(error, group))
                out.set("error_shift", self._mean(error, group))
            if self._reads_unlabelled:
                self._write_unlabelled(tensordict.get(keys.unlabelled), out)
        self._clear_weakrefs(tensordict, out, "predictor_params", "target_predictor_params")
        return out

    def _predict(self, group: TensorDictBase) -> TensorDictBase:
        return self.predictor(group.select(*self.predictor.in_keys))

    def _write_unlabelled(self, group: TensorDictBase, out: TensorDictBase) -> None:
        logits = self._predict(group).get(self.tensor_keys.skill_logits)
        entropy = conditional_entropy(logits)
        if self.information is not None:
            out.set("loss_information", self.information * self._reduce_loss(entropy, group))
        out.set("entropy_unlabelled", self._mean(entropy, group))
        counting = self._counting(group)
        logits = logits.flatten(0, -2) if counting is None else logits[counting]
        if self.marginal is not None:
            out.set("loss_marginal", -self.marginal * marginal_entropy(logits))
        out.set("unlabelled_skill_probability", logits.detach().softmax(-1).mean(0))
