"""The student's loss: do as the teacher does, and know what it knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torch.nn import functional

from agility_rl.keys import (
    BEHAVIOUR,
    HEADING_ERROR,
    HEADING_ESTIMATE,
    LABEL,
    OBSTACLE,
    OBSTACLE_LOGITS,
    PARAMETERS,
    PLACE,
    PLACE_ESTIMATE,
    PROGRESS,
    PROGRESS_LOGITS,
    TERRAIN_LATENT,
)
from agility_rl.losses.functional import missed
from agility_rl.losses.keyed import KeyedLoss, parameter_device


class StudentLoss(KeyedLoss):
    r"""Imitate a teacher's hybrid action, and predict the heading errors, the obstacle's type and, if asked, the place.

    .. math:: L = w_D \, \mathrm{CE}(\ell, a^D_T) + w_C \, E \| a^C_T - \mu \|_2
              + w_\psi \, E \| \mathrm{diag}(2, \tfrac12) (\Delta\psi - \widehat{\Delta\psi}) \|_2
              + w_o \, \mathrm{CE}(\ell_o, o) + w_p \, E \| p - \hat p \|_1 + w_g \, \mathrm{CE}(\ell_g, g)
              + \tfrac{w_z}{32} \, E \| z_T - \hat z \|_2^2

    All coefficients are already applied to the losses returned. For a recurrent student give the policy that unrolls
    sequences, ``student.policy(assisted=True, sequence=True)``.

    Source: Eq. (15); form, norms and weights of the headings: released code (method notes, section 5.9). Different:
    cross-entropy of the obstacle on logits, not on probabilities; differences of headings are wrapped to (-pi, pi]; the
    place and the progress on the course (ours) are for students of teachers that read their place; the last term (ours)
    compares the terrain latents themselves, which the actor's gradient else has to find.

    Keys read:
        every entry of ``network.in_keys``
        (label, behaviour)   int64 ``[*B]``           the teacher's choice
        (label, parameters)  float32 ``[*B, K, P]``   its parameters, of all choices
        heading_error        float32 ``[*B, 2]`` [rad]
        obstacle             float32 ``[*B, O]``, one-hot
        place                float32 ``[*B, 8]``      with a coefficient of the place
        progress             float32 ``[*B, S]``, one-hot, with that coefficient
        (label, terrain_latent)  float32 ``[*B, 32]`` the teacher's, with a coefficient of the latent
    Keys written (``[]`` each; losses ``[*B]`` with ``reduction="none"``):
        loss_behaviour, loss_parameters, loss_heading, loss_obstacle, loss_place, loss_progress,
        loss_latent                            only those with a
                                               coefficient
        accuracy_behaviour, accuracy_obstacle, accuracy_progress  share that agrees, detached
        error_heading                          mean absolute error to the current way-point [rad], detached
        error_place                            mean absolute error of the current way-point's x and y [m], detached

    Args:
        network: writes logits ``[*B, K]``, mean parameters ``[*B, K, P]``, heading estimates ``[*B, 2]`` and obstacle
            logits ``[*B, O]``.
        behaviour: coefficient of the choice; schedulable. ``None`` leaves a term out.
        continuous: coefficient of the parameters; schedulable.
        heading: coefficient of the headings; schedulable.
        obstacle: coefficient of the obstacle; schedulable.
        place: coefficient of the place; schedulable. The network then writes place estimates ``[*B, 8]`` too.
        progress: coefficient of the progress; schedulable. The network then writes ``progress_logits`` ``[*B, S]`` too.
        latent: coefficient of the terrain latent; schedulable. The network then writes ``terrain_latent`` too.
        compared: parameters of ``"all"`` choices, as released, or of the one that the teacher ``"selected"``.
        heading_weights: of the errors to the current and the next way-point.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: if no coefficient is given, or ``compared`` is something else.

    Example:
        >>> student = TensorDictModule(
        ...     lambda x: (x[..., :2], x[..., :4].unflatten(-1, (2, 2)), x[..., :2], x[..., :3]),
        ...     in_keys=["x"], out_keys=["logits", "loc", "heading_estimate", "obstacle_logits"])
        >>> label = {"behaviour": torch.zeros(5, dtype=torch.long), "parameters": torch.zeros(5, 2, 2)}
        >>> losses = StudentLoss(student)(TensorDict({"x": torch.ones(5, 4), "label": label,
        ...     "heading_error": torch.zeros(5, 2), "obstacle": torch.eye(3)[[0, 1, 2, 0, 1]]}, [5]))
        >>> round(losses["loss_behaviour"].item(), 4), losses["loss_parameters"].item()
        (0.6931, 2.0)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            logits (NestedKey): what the network writes, ``[*B, K]``.
            loc (NestedKey): what the network writes, ``[*B, K, P]``.
            heading_estimate (NestedKey): what the network writes, ``[*B, 2]``.
            obstacle_logits (NestedKey): what the network writes, ``[*B, O]``.
            place_estimate (NestedKey): what the network writes, ``[*B, 8]``.
            progress_logits (NestedKey): what the network writes, ``[*B, S]``.
            terrain_latent (NestedKey): what the network writes, ``[*B, 32]``.
            behaviour (NestedKey): the teacher's choice.
            parameters (NestedKey): the teacher's parameters.
            heading_error (NestedKey): true heading errors.
            obstacle (NestedKey): true obstacle, one-hot.
            place (NestedKey): true place.
            progress (NestedKey): true way-point, one-hot.
            latent (NestedKey): the teacher's terrain latent.
        """

        logits: NestedKey = "logits"
        loc: NestedKey = "loc"
        heading_estimate: NestedKey = HEADING_ESTIMATE
        obstacle_logits: NestedKey = OBSTACLE_LOGITS
        place_estimate: NestedKey = PLACE_ESTIMATE
        progress_logits: NestedKey = PROGRESS_LOGITS
        terrain_latent: NestedKey = TERRAIN_LATENT
        behaviour: NestedKey = (LABEL, BEHAVIOUR)
        parameters: NestedKey = (LABEL, PARAMETERS)
        heading_error: NestedKey = HEADING_ERROR
        obstacle: NestedKey = OBSTACLE
        place: NestedKey = PLACE
        progress: NestedKey = PROGRESS
        latent: NestedKey = (LABEL, TERRAIN_LATENT)

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    network: TensorDictModule
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    _schedulable_buffers = frozenset({"behaviour", "continuous", "heading", "obstacle", "place", "progress", "latent"})

    def __init__(
        self,
        network: TensorDictModule,
        *,
        behaviour: float | None = 1.0,
        continuous: float | None = 1.0,
        heading: float | None = 1.0,
        obstacle: float | None = 1.0,
        place: float | None = None,
        progress: float | None = None,
        latent: float | None = None,
        compared: Literal["all", "selected"] = "all",
        heading_weights: tuple[float, float] = (2.0, 0.5),
        reduction: str | None = None,
    ) -> None:
        super().__init__()
        coefficients = {"behaviour": behaviour, "continuous": continuous, "heading": heading, "obstacle": obstacle}
        coefficients |= {"place": place, "progress": progress, "latent": latent}
        if all(value is None for value in coefficients.values()):
            raise ValueError(f"at least one of {', '.join(coefficients)} must be a number, got none")
        if compared not in ("all", "selected"):
            raise ValueError(f"compared must be 'all' or 'selected', got {compared!r}")
        self.compared = compared
        self.reduction = "mean" if reduction is None else reduction
        self.convert_to_functional(network, "network")
        for name, value in coefficients.items():
            if value is None:
                setattr(self, name, None)
            else:
                self.register_coeff_buffer(name, value)
        self.register_buffer("heading_weights", torch.tensor(heading_weights, device=parameter_device(self)))
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        keys, targets = self.tensor_keys, []
        if self.behaviour is not None or (self.continuous is not None and self.compared == "selected"):
            targets.append(keys.behaviour)
        for coefficient, key in (
            (self.continuous, keys.parameters),
            (self.heading, keys.heading_error),
            (self.obstacle, keys.obstacle),
            (self.place, keys.place),
            (self.progress, keys.progress),
            (self.latent, keys.latent),
        ):
            if coefficient is not None:
                targets.append(key)
        read = list(self.network.in_keys)
        self._in_keys = [*read, *(key for key in targets if key not in read)]

    @property
    def out_keys(self) -> list[str]:
        """Entries written."""
        names: list[str] = []
        if self.behaviour is not None:
            names += ["loss_behaviour", "accuracy_behaviour"]
        if self.continuous is not None:
            names += ["loss_parameters"]
        if self.heading is not None:
            names += ["loss_heading", "error_heading"]
        if self.obstacle is not None:
            names += ["loss_obstacle", "accuracy_obstacle"]
        if self.place is not None:
            names += ["loss_place", "error_place"]
        if self.progress is not None:
            names += ["loss_progress", "accuracy_progress"]
        if self.latent is not None:
            names += ["loss_latent"]
        return names

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input stays as it is."""
        keys, out = self.tensor_keys, TensorDict()
        with self.network_params.to_module(self.network, preserve_module_state=False):
            written = self.network(tensordict.select(*self.network.in_keys))
        if self.behaviour is not None:
            logits, choice = written.get(keys.logits), tensordict.get(keys.behaviour)
            error = _cross_entropy(logits, choice)
            out.set("loss_behaviour", self.behaviour * self._reduce_loss(error, tensordict))
            out.set("accuracy_behaviour", self._mean((logits.argmax(-1) == choice).float(), tensordict))
        if self.continuous is not None:
            difference = missed(written.get(keys.loc), tensordict.get(keys.parameters), keys.parameters)  # [*B, K, P]
            if self.compared == "selected":
                chosen = tensordict.get(keys.behaviour)
                difference = difference.take_along_dim(chosen[..., None, None], -2)
            error = torch.linalg.vector_norm(difference.flatten(-2), dim=-1)
            out.set("loss_parameters", self.continuous * self._reduce_loss(error, tensordict))
        if self.heading is not None:
            estimate = written.get(keys.heading_estimate)
            difference = _wrap(missed(estimate, tensordict.get(keys.heading_error), keys.heading_error))
            error = torch.linalg.vector_norm(self.heading_weights * difference, dim=-1)
            out.set("loss_heading", self.heading * self._reduce_loss(error, tensordict))
            out.set("error_heading", self._mean(difference[..., 0].abs(), tensordict))
        if self.obstacle is not None:
            error, right = _classified(written.get(keys.obstacle_logits), tensordict.get(keys.obstacle))
            out.set("loss_obstacle", self.obstacle * self._reduce_loss(error, tensordict))
            out.set("accuracy_obstacle", self._mean(right, tensordict))
        if self.place is not None:
            distance = missed(written.get(keys.place_estimate), tensordict.get(keys.place), keys.place).abs()
            out.set("loss_place", self.place * self._reduce_loss(distance.sum(-1), tensordict))
            out.set("error_place", self._mean(distance[..., :2].mean(-1), tensordict))
        if self.progress is not None:
            error, right = _classified(written.get(keys.progress_logits), tensordict.get(keys.progress))
            out.set("loss_progress", self.progress * self._reduce_loss(error, tensordict))
            out.set("accuracy_progress", self._mean(right, tensordict))
        if self.latent is not None:
            difference = missed(written.get(keys.terrain_latent), tensordict.get(keys.latent), keys.latent)
            error = difference.square().mean(-1)
            out.set("loss_latent", self.latent * self._reduce_loss(error, tensordict))
        self._clear_weakrefs(tensordict, out, "network_params", "target_network_params")
        return out


def _cross_entropy(logits: Tensor, index: Tensor) -> Tensor:
    """``[*B, K]`` and ``[*B]`` to ``[*B]``."""
    return functional.cross_entropy(logits.flatten(0, -2), index.flatten(), reduction="none").reshape(index.shape)


def _classified(logits: Tensor, one_hot: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy, and 1 where it is right, each ``[*B]``."""
    kind = one_hot.argmax(-1)
    return _cross_entropy(logits, kind), (logits.argmax(-1) == kind).float()


def _wrap(angle: Tensor) -> Tensor:
    """To (-pi, pi], with a gradient of 1 everywhere."""
    return angle - 2.0 * torch.pi * torch.ceil((angle.detach() - torch.pi) / (2.0 * torch.pi))
