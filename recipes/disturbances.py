"""What a student is tested under: disturbed images, a camera that is late, or one that is not mounted straight."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from agility_rl.go2.camera import PITCH_JITTER
from agility_rl.modules import DepthAugmentation

NOTHING: Mapping[str, Any] = {"rectangle": 0.0, "white_noise": 0.0, "dropout": 0.0, "blur": 0.0}
MOUNTING = math.radians(1.0)
"""Half-width of the camera's mounting angle where that is no disturbance [rad]; the release evaluates with U(0, 1
degree) (method notes, section 8)."""


@dataclass(frozen=True)
class Disturbance:
    """One disturbance of a student's camera.

    Attributes:
        label: how tables call it.
        every: probabilities of :class:`DepthAugmentation` that are 1: every image is disturbed, each in its own way.
        late: control steps (20 ms) by which images come later than in training.
        pitch: half-width of the mounting angle [rad].
        strength: how many times images are disturbed: n rectangles, n independent noises, ...
    """

    label: str
    every: tuple[str, ...] = ()
    late: int = 0
    pitch: float = MOUNTING
    strength: int = 1

    def camera(self, training: Mapping[str, Any]) -> dict[str, Any]:
        """Keyword arguments of the camera, from those of the training."""
        fewest, most = training["latency"]
        return {**training, "latency": (fewest + self.late, most + self.late), "pitch": self.pitch}

    def images(self, generator: torch.Generator) -> Callable[[Tensor], Tensor]:
        """Function from normalised images ``[*B, H, W]`` to disturbed ones."""
        augmentation = DepthAugmentation(generator, **{**NOTHING, **dict.fromkeys(self.every, 1.0)})

        def disturb(images: Tensor) -> Tensor:
            for _ in range(self.strength if self.every else 0):
                images = augmentation.augment(images)
            return images

        return disturb


DISTURBANCES = {
    "none": Disturbance("none"),
    "rectangles": Disturbance("random rectangles", ("rectangle",)),
    "noise": Disturbance("white noise", ("white_noise",)),
    "blur": Disturbance("Gaussian blur", ("blur",)),
    "dropout": Disturbance("pixel drop-out", ("dropout",)),
    "late_1": Disturbance("one frame late", late=1),
    "late_2": Disturbance("two frames late", late=2),
    "pitch": Disturbance("pitch ± 5°", pitch=PITCH_JITTER),
}
"""Sizes are those of the training's augmentation (method notes, section 5.10), times the strength."""


def chosen(names: tuple[str, ...], strength: int = 1) -> dict[str, Disturbance]:
    """Disturbances by name, ``all`` for every one.

    Raises:
        ValueError: if there is no such disturbance, or the strength is none.
    """
    if strength < 1:
        raise ValueError(f"expected --strength of at least 1, got {strength}")
    wanted = tuple(DISTURBANCES) if "all" in names else tuple(dict.fromkeys(names))
    if unknown := [name for name in wanted if name not in DISTURBANCES]:
        raise ValueError(f"unknown disturbance {unknown[0]!r}; expected all, or some of {', '.join(DISTURBANCES)}")
    return {name: replace(DISTURBANCES[name], strength=strength) for name in wanted}
