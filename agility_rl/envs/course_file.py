"""Courses as files, TOML or JSON: lengths in metres, angles in degrees.

::

    name = "hurdle and tunnel"
    size = [4.0, 12.0]

    [[slots]]
    obstacle = "bar_jump"
    position = [2.0, 3.0]
    yaw_degrees = 90.0
    difficulty = [0.10, 0.20]
    jitter = {x = 0.1, y = 0.1, yaw_degrees = 2.0}

    [[slots]]
    obstacle = "tunnel"
    position = [2.0, 8.0]
    yaw_degrees = 90.0
    way_points = [[-1.5, 0.0], [1.0, 0.0], [1.5, 0.0]]

Further names: ``shuffle = true``, ``routes = [[0, 1], [1, 0]]``, ``wall_height = [0.5, 5.0]``,
``wall_distance = [0.0, 2.0]``, ``open = true`` for no walls.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from agility_rl.envs.course import Course, CourseError, Jitter, Slot

Reader = Callable[[Any, str], Any]


def load_course(path: str | Path) -> Course:
    """Read a course from a ``.toml`` or ``.json`` file.

    Args:
        path: the file; its stem is the name of a course that names itself nowhere.

    Raises:
        CourseError: if the file cannot be read, or describes no course that can be built; one message says why.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".toml":
            data: Any = tomllib.loads(text)
        elif path.suffix == ".json":
            data = json.loads(text, object_pairs_hook=partial(_unique, path))
        else:
            raise CourseError(f"{path}: expected a .toml or .json file")
    except OSError as error:
        raise CourseError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CourseError(f"{path}: malformed: {error}") from error
    if not isinstance(data, Mapping):
        raise CourseError(f"{path}: expected a table with size and slots, got {data!r}")
    return parse_course({"name": path.stem, **data}, str(path))


def parse_course(data: Mapping[str, Any], where: str = "course") -> Course:
    """Build a course from the contents of a file.

    Args:
        data: the table.
        where: begins every message.

    Raises:
        CourseError: if a key is unknown or missing, a value has another form, or the course cannot be built.

    Example:
        >>> slot = {"obstacle": "tunnel", "position": [2, 4], "yaw_degrees": 90}
        >>> parse_course({"name": "tunnel", "size": [4, 8], "slots": [slot]}).slots[0].obstacle
        'tunnel'
    """
    entries = _entries(data, _COURSE, {"name", "size", "slots"}, where)
    if entries.pop("open", False):
        entries["wall_height"] = None
    try:
        return Course(**entries)
    except CourseError as error:
        raise CourseError(f"{where}: {error}") from error


def _unique(path: Path, pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse a key that is there twice, which JSON would let pass (TOML does not)."""
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise CourseError(f"{path}: malformed: key {name!r} is there twice in one table")
    return dict(pairs)


def _entries(data: Any, readers: Mapping[str, tuple[str, Reader]], needed: set[str], where: str) -> dict[str, Any]:
    """Read every entry of a table, under the name that Python gives it."""
    if not isinstance(data, Mapping):
        raise CourseError(f"{where}: expected a table of {', '.join(readers)}, got {data!r}")
    if unknown := sorted(set(data) - set(readers)):
        raise CourseError(f"{where}: unknown entry {unknown[0]!r}; expected some of {', '.join(readers)}")
    if missing := sorted(needed - set(data)):
        raise CourseError(f"{where}: {missing[0]!r} is missing")
    return {readers[name][0]: readers[name][1](value, f"{where}: {name}") for name, value in data.items()}


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CourseError(f"{where} must be a number, got {value!r}")
    return float(value)


def _angle(value: Any, where: str) -> float:
    return math.radians(_number(value, where))


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or not value:
        raise CourseError(f"{where} must be a text, got {value!r}")
    return value


def _flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise CourseError(f"{where} must be true or false, got {value!r}")
    return value


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise CourseError(f"{where} must be a list, got {value!r}")
    return list(value)


def _pair(value: Any, where: str) -> tuple[float, float]:
    numbers = [_number(item, where) for item in _list(value, where)]
    if len(numbers) != 2:
        raise CourseError(f"{where} must be two numbers, got {value!r}")
    return numbers[0], numbers[1]


def _points(value: Any, where: str) -> tuple[tuple[float, float], ...]:
    return tuple(_pair(item, where) for item in _list(value, where))


def _routes(value: Any, where: str) -> tuple[tuple[int, ...], ...]:
    routes = [tuple(_list(route, where)) for route in _list(value, where)]
    if not all(isinstance(index, int) and not isinstance(index, bool) for route in routes for index in route):
        raise CourseError(f"{where} must be lists of slot numbers, got {value!r}")
    return tuple(routes)


def _jitter(value: Any, where: str) -> Jitter:
    return Jitter(**_entries(value, _JITTER, set(), where))


def _slots(value: Any, where: str) -> tuple[Slot, ...]:
    place = where.removesuffix(": slots")
    return tuple(
        Slot(**_entries(item, _SLOT, {"obstacle", "position"}, f"{place}, slot {index}"))
        for index, item in enumerate(_list(value, where))
    )


_JITTER: dict[str, tuple[str, Reader]] = {"x": ("x", _number), "y": ("y", _number), "yaw_degrees": ("yaw", _angle)}
_SLOT: dict[str, tuple[str, Reader]] = {
    "obstacle": ("obstacle", _text),
    "position": ("position", _pair),
    "yaw_degrees": ("yaw", _angle),
    "jitter": ("jitter", _jitter),
    "difficulty": ("difficulty", _pair),
    "way_points": ("way_points", _points),
}
_COURSE: dict[str, tuple[str, Reader]] = {
    "name": ("name", _text),
    "size": ("size", _pair),
    "slots": ("slots", _slots),
    "routes": ("routes", _routes),
    "shuffle": ("shuffle", _flag),
    "wall_height": ("wall_height", _pair),
    "wall_distance": ("wall_distance", _pair),
    "open": ("open", _flag),
}
