"""One seed for a run, and from it one independent generator for every component that draws random numbers."""

from __future__ import annotations

import random
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agility_rl.training import distributed


class Seeds:
    """Named random streams that all follow from one seed.

    A stream depends on the seed and on its own name only, so that adding a component changes nobody else's numbers.
    Register the object in a :class:`~agility_rl.training.checkpoint.RunCheckpoint` and a resumed run draws what an
    uninterrupted one would have drawn.

    .. math:: s_{name} = \\mathrm{SeedSequence}(seed, \\mathrm{crc32}(name), rank)

    Source: numpy ``SeedSequence`` (O'Neill's hash); no paper formula.

    Args:
        seed: non-negative integer.
        device: where the torch generators live.
        rank: of several processes with one seed; the first one's streams are those of a single process.

    Raises:
        ValueError: if the seed is negative.

    Example:
        >>> a, b = Seeds(1), Seeds(1)
        >>> _ = b.generator("environment")
        >>> torch.rand(1, generator=a.generator("policy")) == torch.rand(1, generator=b.generator("policy"))
        tensor([True])
    """

    def __init__(self, seed: int, device: torch.device | str = "cpu", rank: int = 0) -> None:
        if seed < 0:
            raise ValueError(f"a seed must be at least 0, got {seed}")
        self.seed, self.rank = seed, rank
        self.device = torch.device(device)
        self._torch: dict[str, torch.Generator] = {}
        self._numpy: dict[str, np.random.Generator] = {}

    def integer(self, name: str) -> int:
        """Seed of one component, 0 <= seed < 2**63; the same whenever it is asked for."""
        entropy = [self.seed, zlib.crc32(name.encode()), *([self.rank] if self.rank else [])]
        sequence = np.random.SeedSequence(entropy)
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))

    def generator(self, name: str) -> torch.Generator:
        """Torch generator of one component; a second call returns the same object, further along its stream."""
        if name not in self._torch:
            self._torch[name] = torch.Generator(self.device).manual_seed(self.integer(name))
        return self._torch[name]

    def numpy(self, name: str) -> np.random.Generator:
        """NumPy generator of one component; a second call returns the same object."""
        if name not in self._numpy:
            self._numpy[name] = np.random.Generator(np.random.PCG64(self.integer(name)))
        return self._numpy[name]

    def state_dict(self) -> dict[str, Any]:
        """Position of every stream handed out so far."""
        return {
            "seed": self.seed,
            "rank": self.rank,
            "torch": {name: generator.get_state() for name, generator in self._torch.items()},
            # A PCG64 state holds 128-bit integers, which JSON keeps exactly and tensors cannot.
            "numpy": {name: generator.bit_generator.state for name, generator in self._numpy.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put every stream back where :meth:`state_dict` found it, in the generators already handed out.

        Raises:
            ValueError: if the state belongs to another seed, or to another process.
        """
        if state["seed"] != self.seed:
            raise ValueError(
                f"the run was started with seed {state['seed']}, got seed {self.seed}; resume with its own"
            )
        if state.get("rank", self.rank) != self.rank:  # states of before do not say it
            raise ValueError(f"these are the streams of process {state['rank']}, expected those of {self.rank}")
        for name in {*self._torch, *state["torch"]}:  # who had drawn nothing yet is at its beginning
            fresh = torch.Generator(self.device).manual_seed(self.integer(name)).get_state()
            self.generator(name).set_state(state["torch"].get(name, fresh).cpu())
        for name in {*self._numpy, *state["numpy"]}:
            fresh_bits = np.random.PCG64(self.integer(name)).state
            self.numpy(name).bit_generator.state = state["numpy"].get(name, fresh_bits)


def permutation(number: int, generator: torch.Generator) -> Tensor:
    """The indices below a number in random order, int64 ``[number]``, where the generator is.

    Example:
        >>> sorted(permutation(3, torch.Generator()).tolist())
        [0, 1, 2]
    """
    return torch.randperm(number, generator=generator, device=generator.device)


def seed_everything(seed: int, device: torch.device | str = "cpu") -> Seeds:
    """Seed the global generators of Python, NumPy and torch (all devices) and return the named streams.

    Global generators serve the libraries that offer nothing else (initial weights of ``torch.nn``, TorchRL's policy
    sampling); our own components take a generator from the streams, which live on ``device``. Every process has streams
    of its own.

    Example:
        >>> _ = seed_everything(3); first = torch.rand(1)
        >>> _ = seed_everything(3); bool(first == torch.rand(1))
        True
    """
    seeds = Seeds(seed, device, rank=distributed.rank())
    random.seed(seeds.integer("python"))
    np.random.seed(seeds.integer("numpy") % 2**32)  # noqa: NPY002  (the global state is what is seeded here)
    torch.manual_seed(seeds.integer("torch"))
    return seeds
