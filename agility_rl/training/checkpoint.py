"""Checkpoints of a whole run: atomic, durable, rotating, complete, and loaded without pickle.

One checkpoint is one file, ``checkpoint-000000000120.torchrl`` (a TorchRL checkpoint archive: a ZIP of tensor files and
JSON). A single file can be put in place by one ``rename``, which a directory cannot, so there is no moment at which a
killed process leaves the run without a checkpoint; the checksum of every member finds damage before anything is loaded.
"""

from __future__ import annotations

import os
import shutil
import zipfile
import zlib
from collections.abc import Collection, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

PREFIX = "checkpoint"
SUFFIX = ".torchrl"
LEFT = ".left"
"""Added to the names of checkpoints of a branch that was left."""
_RANDOM = "global_random_state"
_STAGING = ".staging"


class RunCheckpoint:
    """Save and restore everything a run consists of, so that a resumed run continues bit for bit.

    Wraps :class:`torchrl.checkpoint.Checkpoint` and :class:`torchrl.checkpoint.CheckpointRotation`, and adds what they
    leave out: ``fsync`` of the file and its folder, replacement in one rename, verification of every checksum before
    the first component is touched, and the global random states, restored last.

    A component is anything with ``state_dict`` and ``load_state_dict`` (module, optimizer, simulator, environment,
    logger), a TorchRL replay buffer, a ``torch.Generator``, a tensor, a TensorDict, or a dict of tensors and
    JSON values (nested as you like). Tensors, TensorDicts and dicts are restored in place.

    Source: no formula; `torchrl.checkpoint` (TorchRL 0.14), design section 7.

    Args:
        directory: folder of the checkpoints, created at the first save.
        keep_last: how many of the newest checkpoints survive.
        keep_best: ``(metadata key, "min" | "max")``; the best checkpoint survives in addition.
        **components: what to save, by name.

    Raises:
        TypeError: if a component can be neither saved nor restored.

    Example:
        >>> import tempfile
        >>> policy, counters = torch.nn.Linear(2, 1), {"iteration": 7}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     checkpoint = RunCheckpoint(folder, policy=policy, counters=counters)
        ...     path = checkpoint.save(step=7)
        ...     counters["iteration"] = 0
        ...     step = checkpoint.load()
        >>> step, counters, path.name
        (7, {'iteration': 7}, 'checkpoint-000000000007.torchrl')
    """

    def __init__(
        self,
        directory: str | Path,
        *,
        keep_last: int = 2,
        keep_best: tuple[str, Any] | None = None,
        **components: Any,
    ) -> None:
        self.directory = Path(directory)
        self._rotation = CheckpointRotation(self.directory, keep_last=keep_last, keep_best=keep_best, prefix=PREFIX)
        self._checkpoint = Checkpoint(format="archive")
        self._modules: dict[str, torch.nn.Module] = {}
        for name, component in components.items():
            self.register(name, component)

    def register(self, name: str, component: Any) -> RunCheckpoint:
        """Add a component; returns self.

        Raises:
            TypeError: if the component has no ``state_dict`` and is no tensor, TensorDict, generator or dict.
            KeyError: if the name is taken.
        """
        self._checkpoint.register(name, _saveable(name, component))
        if isinstance(component, torch.nn.Module):
            self._modules[name] = component
        return self

    def save(self, step: int, metadata: Mapping[str, Any] | None = None) -> Path:
        """Write a checkpoint, make it durable, then drop the ones that rotation no longer keeps.

        Those of later steps, which are there if an earlier one was loaded, are set aside as ``*.left``.

        Args:
            step: number of finished iterations; names the file.
            metadata: JSON values stored beside, such as the metric that ``keep_best`` looks at.

        Returns:
            The file, which is complete and on the disk when this returns.

        Raises:
            CheckpointError: if a weight is not finite: rotation would drop the last checkpoint that is of use.
        """
        self._check_finite()
        staging = self.directory / _STAGING
        shutil.rmtree(staging, ignore_errors=True)  # what a killed save left
        staging.mkdir(parents=True)
        for tombstone in self.directory.glob(f".{PREFIX}-*.delete-*"):  # what a killed rotation left
            tombstone.unlink(missing_ok=True)
        self._register_random_state()
        staged = self._checkpoint.save(staging / "incoming", metadata={**(metadata or {}), "step": step})
        destination = self.directory / f"{PREFIX}-{step:012d}{SUFFIX}"
        publish(staged, destination)
        shutil.rmtree(staging, ignore_errors=True)
        for path in _files(self.directory):
            if step_of(path) > step:  # of a branch that was left by going back; else that would be resumed
                path.replace(path.with_name(path.name + LEFT))
        self._rotation.prune()
        return destination

    def load(
        self, step: int | None = None, *, components: Collection[str] | None = None, map_location: Any = None
    ) -> int:
        """Restore a checkpoint and return its step.

        Every checksum is verified first: a damaged file changes nothing.

        Args:
            step: which checkpoint; the newest by default.
            components: restore only these names, and leave the random states alone.
            map_location: device, or mapping between devices, for tensors saved elsewhere.

        Raises:
            FileNotFoundError: if there is no checkpoint, or none of this step.
            CheckpointError: if the file is damaged, or holds other components than the registered ones.
        """
        path = self._path(step)
        saved = self._verified(path)
        names = set(self._checkpoint.components) - {_RANDOM}
        wanted = set(components) if components is not None else names
        if unknown := wanted - names:
            raise KeyError(f"{sorted(unknown)} were never registered; registered are {sorted(names)}")
        missing, extra = sorted(wanted - saved), sorted(saved - names - {_RANDOM})
        if missing or (extra and components is None):
            raise CheckpointError(
                f"checkpoint {path} holds {sorted(saved - {_RANDOM})}, expected {sorted(wanted)} (missing {missing}, "
                f"unexpected {extra}); resume with the recipe and the options that wrote it, or name the components"
            )
        self._restore(path, wanted, map_location)
        if components is None and _RANDOM in saved:  # last, because restoring may itself draw random numbers
            self._register_random_state()
            self._restore(path, {_RANDOM}, "cpu")
        return step_of(path)

    def steps(self) -> tuple[int, ...]:
        """Steps of the checkpoints in the folder, damaged ones included, oldest first."""
        return tuple(step_of(path) for path in _files(self.directory))

    def _check_finite(self) -> None:
        for component, module in self._modules.items():
            for name, weight in module.named_parameters():
                if not bool(weight.isfinite().all()):
                    kept = f"that of step {steps[-1]} stays" if (steps := self.steps()) else "there is no earlier one"
                    raise CheckpointError(
                        f"{self.directory}: {component}: {name} holds NaN or infinity, so no checkpoint was written, "
                        f"and {kept}; the training diverged: go on from there with a lower learning rate"
                    )

    def _path(self, step: int | None) -> Path:
        files = _files(self.directory)
        if not files:
            raise FileNotFoundError(f"no checkpoint in {self.directory}; expected {PREFIX}-*{SUFFIX}")
        if step is None:
            return files[-1]
        for path in files:
            if step_of(path) == step:
                return path
        raise FileNotFoundError(f"no checkpoint of step {step} in {self.directory}; it has {list(self.steps())}")

    def _verified(self, path: Path) -> set[str]:
        damage = find_damage(path)
        if damage:
            others = [step_of(file) for file in _files(path.parent) if file != path and not find_damage(file)]
            hint = "no other one is intact"
            if others:
                hint = f"intact: step {others[-1]}, load(step={others[-1]}), or remove the damaged file to resume there"
            raise CheckpointError(f"checkpoint {path} is damaged: {damage}; {hint}")
        return set(Checkpoint.manifest(path)["components"])

    def _restore(self, path: Path, names: set[str], map_location: Any) -> None:
        try:
            self._checkpoint.load(path, components=names, map_location=map_location)
        except CheckpointError as error:
            first_lines = " ".join(line.strip() for line in str(error).splitlines()[:3])
            raise CheckpointError(f"checkpoint {path}: {first_lines}") from error

    def _register_random_state(self) -> None:
        if _RANDOM not in self._checkpoint:
            self._checkpoint.register(_RANDOM, _GlobalState())


def find_damage(path: str | Path) -> str | None:
    """What is wrong with a checkpoint file in one line, or None if every checksum agrees.

    Example:
        >>> find_damage("nothing-here.torchrl")
        'there is no such file'
    """
    path = Path(path)
    if not path.is_file():
        return "there is no such file"
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
        if broken is not None:
            return f"the checksum of {broken} does not agree"
        Checkpoint.manifest(path)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, KeyError, RuntimeError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        return f"{path.stat().st_size} bytes that are no complete archive, probably truncated ({reason})"
    return None


def step_of(path: str | Path) -> int:
    """Step in a checkpoint's file name.

    Example:
        >>> step_of("checkpoint-000000000120.torchrl")
        120
    """
    return int(Path(path).name.removeprefix(f"{PREFIX}-").removesuffix(SUFFIX))


def publish(staged: Path, destination: Path) -> None:
    """Put a finished file in place, in one step that survives a power cut: fsync, rename, fsync of the folder."""
    with open(staged, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(staged, destination)
    folder = os.open(destination.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _files(directory: Path) -> list[Path]:
    found = directory.glob(f"{PREFIX}-*{SUFFIX}") if directory.is_dir() else ()
    return sorted((path for path in found if path.name[len(PREFIX) + 1 : -len(SUFFIX)].isdigit()), key=step_of)


def _saveable(name: str, component: Any) -> Any:
    """The component itself, or a view of it that has ``state_dict`` and ``load_state_dict``."""
    if isinstance(component, torch.Generator):
        return _GeneratorState(component)
    if isinstance(component, Tensor | TensorDictBase) and not isinstance(component, torch.nn.Module):
        return _TensorState(component)
    if hasattr(component, "state_dict") and hasattr(component, "load_state_dict"):
        return component
    if hasattr(component, "dump") and hasattr(component, "load"):
        return component
    if isinstance(component, MutableMapping):
        return _MappingState(component)
    raise TypeError(
        f"component {name!r} is a {type(component).__name__}; expected something with state_dict and load_state_dict, "
        "a torch.Generator, a tensor, a TensorDict, or a dict"
    )


class _GlobalState(GlobalRNGState):
    """Generators of this process, on a machine that may have fewer GPUs than the one that saved them."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        state = dict(state_dict)
        if "torch_cuda" in state:
            state["torch_cuda"] = list(state["torch_cuda"])[: torch.cuda.device_count()]
            if not state["torch_cuda"]:
                del state["torch_cuda"]
        super().load_state_dict(state)


class _GeneratorState:
    """A ``torch.Generator`` as a checkpoint component."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def state_dict(self) -> dict[str, Any]:
        return {"state": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.generator.set_state(state["state"].cpu())


class _TensorState:
    """A tensor or TensorDict as a checkpoint component, restored in place."""

    def __init__(self, value: Tensor | TensorDictBase) -> None:
        self.value = value

    def state_dict(self) -> dict[str, Any]:
        return {"value": self.value if isinstance(self.value, Tensor) else self.value.to_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if isinstance(self.value, Tensor):
            _copy("the tensor", self.value, state["value"])
            return
        saved = TensorDict(state["value"], batch_size=self.value.batch_size)
        here, there = set(self.value.keys(True, True)), set(saved.keys(True, True))
        if here != there:
            raise ValueError(f"expected the keys {sorted(map(str, here))}, got {sorted(map(str, there))}")
        for key in here:
            _copy(str(key), self.value.get(key), saved.get(key))


class _MappingState:
    """A dict of tensors and JSON values as a checkpoint component, restored in place."""

    def __init__(self, value: MutableMapping[str, Any]) -> None:
        self.value = value

    def state_dict(self) -> dict[str, Any]:
        return dict(self.value)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        _update(self.value, state)


def _update(target: MutableMapping[str, Any], saved: Mapping[str, Any]) -> None:
    for name in [name for name in target if name not in saved]:
        del target[name]
    for name, value in saved.items():
        present = target.get(name)
        if isinstance(present, Tensor) and isinstance(value, Tensor) and present.shape == value.shape:
            _copy(name, present, value)
        elif isinstance(present, MutableMapping) and isinstance(value, Mapping):
            _update(present, value)
        else:
            target[name] = value


def _copy(name: str, target: Tensor, saved: Tensor) -> None:
    if target.shape != saved.shape or target.dtype != saved.dtype:
        raise ValueError(
            f"{name}: expected {target.dtype} {tuple(target.shape)}, got {saved.dtype} {tuple(saved.shape)} in the file"
        )
    with torch.no_grad():
        target.copy_(saved)
