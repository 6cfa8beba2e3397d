"""The folder of a run: its configuration, whatever else is JSON in it, and what it was made with."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import agility_rl
from agility_rl.training.checkpoint import publish

C = TypeVar("C")
CONFIG_FILE = "config.json"
CONFIG_VERSION = 1
_PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "numpy")


def start_run(config: Any, folder: str | Path, *, resume: bool = False, **extra: Any) -> Path:
    """Make a run's folder and write its ``config.json``: every resolved value, versions, command line and time.

    A resumed run keeps its first ``config.json`` and adds ``config.resumed-N.json``.

    Args:
        config: the recipe's dataclass instance.
        folder: ``runs/NAME``.
        resume: continue in a folder that exists.
        **extra: further JSON values to store, such as the recipe's name.

    Raises:
        FileExistsError: if the folder already holds a run and ``resume`` is false; nothing is ever overwritten.
        FileNotFoundError: if ``resume`` is true and there is no run.
    """
    folder = Path(folder)
    path = folder / CONFIG_FILE
    if resume:
        if not path.is_file():
            raise FileNotFoundError(f"nothing to resume: {path} does not exist; expected the folder of a run")
        count = len(list(folder.glob("config.resumed-*.json"))) + 1
        path = folder / f"config.resumed-{count}.json"
    elif folder.exists() and any(folder.iterdir()):
        going_on = f", or continue it with --resume {folder}" if hasattr(config, "resume") else ""
        raise FileExistsError(f"{folder} already holds a run; choose another name{going_on}")
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "config_version": CONFIG_VERSION,
        "config": to_json(config),
        "versions": versions(),
        "command": sys.argv,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        **extra,
    }
    write_json(path, record)
    return folder


def abandon_run(folder: str | Path) -> None:
    """Free the name of a run that :func:`start_run` began and that could not go on; anything but its record stays."""
    folder = Path(folder)
    (folder / CONFIG_FILE).unlink(missing_ok=True)
    for empty in (*folder.iterdir(), folder):
        with contextlib.suppress(OSError):
            empty.rmdir()


@contextlib.contextmanager
def abandoned_by_errors(folder: str | Path) -> Iterator[None]:
    """:func:`abandon_run` if what is done within fails: there is nothing to go on with, and the name stays free."""
    try:
        yield
    except BaseException:
        abandon_run(folder)
        raise


def read_config(folder: str | Path, kind: type[C]) -> C:
    """Configuration of a run, from its ``config.json``, as the recipe's dataclass.

    Raises:
        FileNotFoundError: if there is no ``config.json``.
        ValueError: if the file is damaged, or has fields that the dataclass does not know.
    """
    path = Path(folder) / CONFIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"nothing to resume: {path} does not exist; expected the folder of a run")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        values, version = record["config"], record["config_version"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged or no run's configuration: {error}") from error
    if version != CONFIG_VERSION:
        raise ValueError(
            f"{path} has configuration version {version}, expected {CONFIG_VERSION}; use the release it names"
        )
    try:
        return from_json(kind, values, str(path))
    except ValueError as error:
        raise ValueError(f"{error}; it is the configuration of a run of {record.get('recipe')}.py") from error


def to_json(value: Any) -> Any:
    """Dataclasses, paths and tuples as plain JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    return str(value) if isinstance(value, os.PathLike) else value


def from_json(kind: Any, value: Any, where: str = "config") -> Any:
    """Inverse of :func:`to_json` for a known type: nested dataclasses, tuples, paths, optional values.

    Raises:
        ValueError: if a dataclass has no field of a given name; the message names the closest one.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     hidden: tuple[int, ...] = (64,)
        >>> from_json(Config, {"hidden": [32, 16]})
        Config(hidden=(32, 16))
    """
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
        hints = typing.get_type_hints(kind)
        for name in value:
            if name not in hints:
                raise ValueError(f"{where}: unknown field {name!r} in {kind.__name__}; {closest(name, list(hints))}")
        return kind(**{name: from_json(hints[name], item, f"{where}: {name}") for name, item in value.items()})
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        options = [option for option in arguments if option is not type(None)]
        return None if value is None else from_json(options[0], value, where)
    if origin is tuple and isinstance(value, list):
        inner = [arguments[0]] * len(value) if len(arguments) == 2 and arguments[1] is Ellipsis else list(arguments)
        return tuple(from_json(item_kind, item, where) for item_kind, item in zip(inner, value, strict=True))
    return Path(value) if kind is Path else value


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file in one step that a kill or a power cut cannot split."""
    staged = path.with_name(f".{path.name}.incoming")
    staged.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
    publish(staged, path)


def read_json(path: Path) -> Any:
    """What a JSON file holds, or None where there is none.

    Raises:
        ValueError: if the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}; make it again") from error


def versions() -> dict[str, str]:
    """Versions of this package, of what it stands on, of Python, and of the source when it is a git checkout."""
    found = {"agility_rl": agility_rl.__version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    source = Path(agility_rl.__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(source.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", source.name)  # else the checkout is one that it was installed into
        found["commit"] = git("describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.SubprocessError):
        pass
    return found


def closest(name: str, known: list[str], dashes: str = "") -> str:
    """Which known name somebody may have meant, for a message.

    Example:
        >>> closest("epoch", ["epochs", "seed"], "--")
        'did you mean --epochs?'
    """
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:  # a field given without its section, or in the wrong one
        close = [option for option in known if option.split(".")[-1] == name.split(".")[-1]][:1]
    return f"did you mean {dashes}{close[0]}?" if close else "nothing known resembles it"
