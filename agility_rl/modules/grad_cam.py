"""Grad-CAM: which pixels of a depth image an encoder's output depends on."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from agility_rl.modules.depth_encoder import DepthEncoder


def grad_cam(encoder: DepthEncoder, images: Tensor, objective: Callable[[Tensor], Tensor] | None = None) -> Tensor:
    r"""Attention maps of a depth encoder, in [0, 1].

    .. math:: \mathrm{cam} = \mathrm{ReLU}\left(\sum_k \alpha_k A_k\right), \qquad
              \alpha_k = \mathrm{mean}_{ij} \frac{\partial y}{\partial A_{k,ij}}

    A are the maps of the last convolution, y is the objective; the map is enlarged bilinearly to the image and divided
    by its largest value. The encoder and its gradients stay as they are.

    Source: supplement, section S8 and Fig. S2; Selvaraju et al. 2017, arXiv:1610.02391. Ours: features are no classes,
    so y is by default the length of the feature vector; pass the output that matters, such as a behaviour's logit.

    Args:
        encoder: of depth images.
        images: ``[*B, 58, 87]``.
        objective: from features ``[N, F]`` to one number an image ``[N]``.

    Returns:
        ``[*B, 58, 87]``; all zero where no map raises the objective.

    Example:
        >>> grad_cam(DepthEncoder(), torch.rand(2, 58, 87)).shape
        torch.Size([2, 58, 87])
    """
    network = encoder.module
    maps: list[Tensor] = []

    def keep(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
        # Differentiable from here on, whatever the parameters are.
        maps.append(output if output.requires_grad else output.detach().requires_grad_())
        return maps[0]

    handle = network.convolutions.register_forward_hook(keep)
    try:
        with torch.enable_grad():
            features = network(images.reshape(-1, *images.shape[-2:]))
            value = torch.linalg.vector_norm(features, dim=-1) if objective is None else objective(features)
            if value.shape != features.shape[:1]:
                raise ValueError(f"the objective must give one number an image, [{len(features)}], got {value.shape}")
            (gradient,) = torch.autograd.grad(value.sum(), maps[0])
    finally:
        handle.remove()
    cam = (gradient.mean((-2, -1), keepdim=True) * maps[0].detach()).sum(1, keepdim=True).relu()
    cam = nn.functional.interpolate(cam, size=images.shape[-2:], mode="bilinear", align_corners=False)[:, 0]
    largest = cam.amax((-2, -1), keepdim=True)
    return (cam / torch.where(largest > 0.0, largest, 1.0)).reshape(images.shape)
