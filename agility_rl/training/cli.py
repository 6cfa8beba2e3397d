"""Command line of a recipe: named presets, every field a flag, one-line errors, and the run folder it writes to.

A recipe owns a frozen dataclass and a dict of named instances; nothing in the package ever sees either.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib.metadata
import json
import math
import os
import platform
import signal
import subprocess
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console
from torchrl.checkpoint import CheckpointError

import agility_rl
from agility_rl.training.checkpoint import publish

C = TypeVar("C")
CONFIG_FILE = "config.json"
CONFIG_VERSION = 1
STOPS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""Signals that end a loop after its present iteration."""
_PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "numpy")


def from_presets(
    presets: Mapping[str, C], args: Sequence[str] | None = None, *, default: str | None = None, doc: str | None = None
) -> C:
    """Read ``PRESET --section.field value ...`` into the preset's configuration.

    An unknown preset or flag ends the program with status 2 and one line that names the closest known one; ``--help``
    prints every field with its documentation.

    Source: no formula; `tyro` reads the dataclass.

    Args:
        presets: named instances of one frozen dataclass; nested dataclasses become sections.
        args: command line without the program's name; ``sys.argv[1:]`` by default.
        default: preset to use when the first argument is none.
        doc: description shown by ``--help``, such as the recipe's ``__doc__``.

    Raises:
        SystemExit: on ``--help`` (status 0) and on any error (status 2).
        ValueError: if there is no preset, or the presets have several types.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     epochs: int = 5
        ...     seed: int = 0
        >>> from_presets({"cpu": Config(seed=1)}, ["cpu", "--epochs", "3"])
        Config(epochs=3, seed=1)
    """
    kinds = {type(preset) for preset in presets.values()}
    if len(kinds) != 1:
        raise ValueError(f"expected presets of exactly one dataclass, got {sorted(kind.__name__ for kind in kinds)}")
    kind = kinds.pop()
    arguments = list(sys.argv[1:] if args is None else args)
    names = ", ".join(presets)
    if arguments and not arguments[0].startswith("-"):
        name = arguments.pop(0)
    elif default is not None:
        name = default
    elif any(argument in ("-h", "--help") for argument in arguments):
        name = next(iter(presets))
    else:
        _stop(f"expected a preset first, one of {names}; got {' '.join(arguments[:1]) or 'nothing'}")
    if name not in presets:
        _stop(f"unknown preset {name!r}; {_suggest(name, list(presets))} (presets: {names})")
    options = _options(presets[name])
    for argument in arguments:
        if argument.startswith("--") and argument != "--help":
            option = argument[2:].split("=")[0].replace("_", "-")
            if option not in options:
                _stop(f"unknown option --{option}; {_suggest(option, options, '--')} (all of them: --help)")
    description = f"{doc or kind.__doc__ or ''}\n\nPresets: {names}; the defaults shown are those of {name!r}."
    program = f"{Path(sys.argv[0]).name} {name}"
    return _finite(tyro.cli(kind, args=arguments, default=presets[name], prog=program, description=description))


def from_arguments(kind: type[C], args: Sequence[str] | None = None, *, doc: str | None = None) -> C:
    """Read a command line without presets: every field of a dataclass a flag, or an argument in its place.

    Args:
        kind: dataclass with defaults; ``tyro.conf.Positional`` makes a field an argument.
        args: command line without the program's name; ``sys.argv[1:]`` by default.
        doc: description shown by ``--help``, such as the recipe's ``__doc__``.

    Raises:
        SystemExit: on ``--help`` (status 0) and on any error (status 2).

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     seconds: float = 20.0
        >>> from_arguments(Config, ["--seconds", "8"])
        Config(seconds=8.0)
    """
    return _finite(tyro.cli(kind, args=args, description=doc))


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn the errors that a user can mend into one line and status 2; defects keep their traceback.

    Mendable are wrong values (``ValueError``, which motion and artifact errors are), files that are missing, present or
    unreadable (``OSError``), packages that are not installed, and checkpoints that cannot be read.

    Example:
        >>> with contextlib.suppress(SystemExit), one_line_errors():
        ...     raise ValueError("expected a folder")
    """
    try:
        yield
    except (ValueError, OSError, ImportError, CheckpointError) as error:
        _stop(" ".join(str(error).split()))


def console(width: int) -> Console:
    """Console of a recipe that prints tables: as wide as the terminal, else ``width`` columns.

    A pipe or a file has no width, and tables folded to 80 columns are hard to read.

    Example:
        >>> console(160).width > 0
        True
    """
    return Console(soft_wrap=True, highlight=False, width=None if sys.stdout.isatty() else width)


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C end a loop after its present iteration, so that what is saved then is exact; twice stops at once.

    So do the signals of ``kill``, of a scheduler whose time is up and of a terminal that is closed.

    Example:
        >>> with interruptible() as interrupted:
        ...     interrupted()
        False
    """
    requests = 0

    def request(number: int, frame: types.FrameType | None) -> None:
        nonlocal requests
        requests += 1
        if requests > 1:
            raise KeyboardInterrupt
        with contextlib.suppress(OSError):  # a terminal that is closed takes no words
            sys.stderr.write("stopping after this iteration; press Ctrl-C again to stop at once\n")

    # Who began the program with nohup wants it to outlive its terminal.
    numbers = [number for number in STOPS if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN]
    previous = {number: signal.signal(number, request) for number in numbers}
    try:
        yield lambda: requests > 0
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


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
        raise FileExistsError(
            f"{folder} already holds a run; choose another name, or continue it with --resume {folder}"
        )
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


def unheeded(asked: Any, began: Any, arguments: Sequence[str] | None = None) -> list[str]:
    """Options of a command line that a run does not heed, since it began with others, each with what it began with.

    Args:
        asked: the dataclass instance that the command line gave.
        began: that of the run.
        arguments: command line without the program's name; ``sys.argv[1:]`` by default.

    Example:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Config:
        ...     epochs: int = 5
        ...     mirror: bool = True
        >>> unheeded(Config(3, False), Config(4), ["cpu", "--epochs", "3", "--no-mirror"])
        ['--epochs (4)', '--no-mirror (True)']
    """
    given = (argument[2:].split("=")[0] for argument in (sys.argv[1:] if arguments is None else arguments))
    known = [option for option in dict.fromkeys(given) if option.replace("_", "-") in _options(asked)]
    return [
        f"--{option} ({_value(began, option)})" for option in known if _value(asked, option) != _value(began, option)
    ]


def _value(config: Any, option: str) -> Any:
    """What a configuration has for a flag of the command line."""
    *sections, name = option.replace("-", "_").split(".")
    for section in sections:
        config = getattr(config, section)
    return getattr(config, name) if hasattr(config, name) else getattr(config, name.removeprefix("no_"))


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
                raise ValueError(f"{where}: unknown field {name!r} in {kind.__name__}; {_suggest(name, list(hints))}")
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


def _options(config: Any, prefix: str = "") -> list[str]:
    """Every flag of a configuration, as it is written on the command line, without the leading dashes."""
    found: list[str] = []
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            found += _options(value, f"{prefix}{name}.")
        else:
            found.append(prefix + name)
            if isinstance(value, bool):
                found.append(f"{prefix}no-{name}")
    return found


def _finite(config: C) -> C:
    """The same, if its numbers are numbers: NaN compares with nothing, and passes the checks that come later."""
    for option in _options(config):
        value = _value(config, option)
        numbers = [number for number in (value if isinstance(value, tuple) else (value,)) if isinstance(number, float)]
        if not all(map(math.isfinite, numbers)):
            _stop(f"--{option} must be finite, got {' '.join(map(str, numbers))}")
    return config


def _suggest(name: str, known: list[str], dashes: str = "") -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if not close:  # a field given without its section, or in the wrong one
        close = [option for option in known if option.split(".")[-1] == name.split(".")[-1]][:1]
    return f"did you mean {dashes}{close[0]}?" if close else "nothing known resembles it"


def _stop(message: str) -> typing.NoReturn:
    sys.stderr.write(f"error: {message}\n")
    raise SystemExit(2)
