"""Command line of a recipe: named presets, every field a flag, one-line errors, Ctrl-C.

A recipe owns a frozen dataclass and a dict of named instances; nothing in the package ever sees either.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console
from torchrl.checkpoint import CheckpointError

from agility_rl.training.run_folder import closest, read_config

C = TypeVar("C")
STOPS = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
"""Signals that end a loop after its present iteration."""


def from_presets(
    presets: Mapping[str, C],
    args: Sequence[str] | None = None,
    *,
    default: str | None = None,
    doc: str | None = None,
    kept: Sequence[str] = (),
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
        kept: fields that may change when a run is resumed (``--resume RUN``, a field ``resume``); where the command
            line says nothing of one, it is the run's own and not the preset's.

    Raises:
        SystemExit: on ``--help`` (status 0) and on any error (status 2).
        ValueError: if there is no preset, the presets have several types, or the run is one of another recipe.
        FileNotFoundError: if there is no such run.

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
        _stop(f"unknown preset {name!r}; {closest(name, list(presets))} (presets: {names})")
    options = _options(presets[name])
    for option in _given(arguments):
        if option not in (*options, "help"):
            _stop(f"unknown option --{option}; {closest(option, options, '--')} (all of them: --help)")
    description = f"{doc or kind.__doc__ or ''}\n\nPresets: {names}; the defaults shown are those of {name!r}."
    program = f"{Path(sys.argv[0]).name} {name}"
    config = _finite(tyro.cli(kind, args=arguments, default=presets[name], prog=program, description=description))
    left_out = [name for name in kept if name.replace("_", "-") not in _given(arguments)]
    if not left_out or config.resume is None:  # type: ignore[attr-defined]
        return config
    own = read_config(config.resume, kind)  # type: ignore[attr-defined]
    return dataclasses.replace(config, **{name: getattr(own, name) for name in left_out})  # type: ignore[type-var]


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
    known = [option for option in _given(sys.argv[1:] if arguments is None else arguments) if option in _options(asked)]
    return [
        f"--{option} ({_value(began, option)})" for option in known if _value(asked, option) != _value(began, option)
    ]


def _value(config: Any, option: str) -> Any:
    """What a configuration has for a flag of the command line."""
    *sections, name = option.replace("-", "_").split(".")
    for section in sections:
        config = getattr(config, section)
    return getattr(config, name) if hasattr(config, name) else getattr(config, name.removeprefix("no_"))


def _given(arguments: Sequence[str]) -> list[str]:
    """Flags of a command line, each once, as :func:`_options` writes them."""
    flags = (argument[2:].split("=")[0] for argument in arguments if argument.startswith("--"))
    return list(dict.fromkeys(flag.replace("_", "-") for flag in flags))


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
        if wrong := [number for number in _numbers(_value(config, option)) if not math.isfinite(number)]:
            _stop(f"--{option} must be finite, got {wrong[0]}")
    return config


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _numbers(part)


def _stop(message: str) -> typing.NoReturn:
    sys.stderr.write(f"error: {message}\n")
    raise SystemExit(2)
