"""The BYOL loss: two disturbed views of one image shall mean the same."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor

from agility_rl.keys import PREDICTION, PROJECTION
from agility_rl.losses.functional import cosine_regression
from agility_rl.losses.keyed import KeyedLoss


class BYOLLoss(KeyedLoss):
    r"""Predict, from one view, the moving average's projection of the other; both ways.

    .. math:: L = E\left[2 - 2 \cos(q(z_1), z'_2)\right] + E\left[2 - 2 \cos(q(z_2), z'_1)\right], \qquad
              \theta' \leftarrow \beta \theta' + (1 - \beta) \theta

    The target network, encoder and projector at the moving average of their parameters, gets no gradient: build a
    ``torchrl.objectives.SoftUpdate(loss, eps=0.99)`` and call its ``step()`` after each step of the optimiser. Both
    networks normalise by the statistics of their batch.

    Source: "BYOL loss": supplement, section S2; formula and decay 0.99: released code (method notes, section 5.10);
    Grill et al. 2020, arXiv:2006.07733, Eq. (2).

    Keys read:
        (view_1, ...)  every entry of ``network.in_keys``, by default ``depth`` ``[*B, 58, 87]``
        (view_2, ...)  the same images, disturbed otherwise
    Keys written:
        loss_byol   ``[]``, or ``[*B]`` with ``reduction="none"``; gradient to the online network
        similarity  ``[]``  mean cosine of prediction and target, detached
        spread      ``[]``  mean standard deviation of the normalised projections over the batch, detached: 0 when all
                    images are mapped to one point, about 1/8 for 64 independent projections

    Args:
        network: writes projection and prediction ``[*B, P]``, such as :class:`agility_rl.modules.BYOL`.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Example:
        >>> from torchrl.objectives import SoftUpdate
        >>> from agility_rl.modules import BYOL, DepthEncoder
        >>> loss = BYOLLoss(BYOL(DepthEncoder(), hidden=16))
        >>> average = SoftUpdate(loss, eps=0.99)
        >>> view = TensorDict({"depth": torch.rand(4, 58, 87) - 0.5}, [4])
        >>> loss(TensorDict({"view_1": view, "view_2": view}, [4]))["loss_byol"].backward()
        >>> average.step()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the loss, changed by ``set_keys``.

        Attributes:
            view_1 (NestedKey): nested TensorDict of the images, disturbed.
            view_2 (NestedKey): nested TensorDict of the images, disturbed otherwise.
            projection (NestedKey): what the network writes.
            prediction (NestedKey): what the network writes.
        """

        view_1: NestedKey = "view_1"
        view_2: NestedKey = "view_2"
        projection: NestedKey = PROJECTION
        prediction: NestedKey = PREDICTION

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    network: TensorDictModule
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_byol", "similarity", "spread"]

    def __init__(self, network: TensorDictModule, *, reduction: str | None = None) -> None:
        super().__init__()
        self.reduction = "mean" if reduction is None else reduction
        self.convert_to_functional(network, "network", create_target_params=True)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        views = (self.tensor_keys.view_1, self.tensor_keys.view_2)
        self._in_keys = [unravel_key((view, key)) for view in views for key in self.network.in_keys]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss; the input stays as it is."""
        keys = self.tensor_keys
        views = [tensordict.get(view).select(*self.network.in_keys) for view in (keys.view_1, keys.view_2)]
        with self.network_params.to_module(self.network, preserve_module_state=False):
            predictions = [self.network(view.clone(False)).get(keys.prediction) for view in views]
        with torch.no_grad(), self.target_network_params.to_module(self.network, preserve_module_state=False):
            targets = [self.network(view.clone(False)).get(keys.projection) for view in views]
        error = cosine_regression(predictions[0], targets[1]) + cosine_regression(predictions[1], targets[0])  # [*B]
        out = TensorDict()
        out.set("loss_byol", self._reduce_loss(error, tensordict))
        out.set("similarity", 1.0 - error.detach().mean() / 4.0)
        out.set("spread", _spread(targets[0]))
        self._clear_weakrefs(tensordict, out, "network_params", "target_network_params")
        return out


def _spread(projection: Tensor) -> Tensor:
    unit = torch.nn.functional.normalize(projection.detach(), dim=-1)
    return unit.flatten(0, -2).std(0, correction=0).mean()
