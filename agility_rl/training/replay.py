"""A replay buffer that draws from a stream of random numbers saved by itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl.data import TensorDictReplayBuffer


class SeededReplay(TensorDictReplayBuffer):
    """TorchRL's replay buffer, whose random numbers are a stream of :class:`~agility_rl.training.seeding.Seeds`.

    The stream is part of a checkpoint already. TorchRL 0.14 saves it again, and restores on the CPU what belongs to a
    GPU, which fails.

    Args:
        generator: on the device of the storage.
        **options: of ``TensorDictReplayBuffer``.

    Example:
        >>> from torchrl.data import LazyTensorStorage
        >>> SeededReplay(torch.Generator(), storage=LazyTensorStorage(8), batch_size=2).generator.device
        device(type='cpu')
    """

    def __init__(self, generator: torch.Generator, **options: Any) -> None:
        super().__init__(generator=generator, **options)
        self.generator = generator

    def dumps(self, path: str | Path) -> None:
        """Save everything but the stream."""
        self.set_rng(None)
        try:
            super().dumps(path)
        finally:
            self.set_rng(self.generator)

    def loads(self, path: str | Path) -> None:
        """Restore what :meth:`dumps` saved."""
        super().loads(path)
        self.set_rng(self.generator)
