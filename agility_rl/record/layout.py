"""A Foxglove layout for episodes: the robot in 3D, its gait diagram, and plots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agility_rl.go2 import constants
from agility_rl.record.scene import TRUNK

LAYOUT_FILE = "agility_rl.layout.json"
DEFAULT_PLOTS: dict[str, tuple[str, ...]] = {
    "Joint positions, front left [rad]": tuple(
        f'/joint_states.joints[:]{{name=="{joint}"}}.position' for joint in constants.JOINT_NAMES[:3]
    ),
}


def write_layout(folder: str | Path, plots: Mapping[str, Sequence[str]] | None = None) -> Path:
    """Write ``agility_rl.layout.json``, to be imported in Foxglove beside an episode.

    Source: the layout format that Foxglove exports; no formula.

    Args:
        folder: where the episodes lie.
        plots: further plots, title to Foxglove message paths such as ``/command.velocity_x``.

    Returns:
        The file.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = write_layout(folder, {"Speed [m/s]": ["/command.velocity_x", "/measured.velocity_x"]})
        ...     sorted(json.loads(path.read_text())["configById"])[:2]
        ['3D!robot', 'Plot!0']
    """
    configurations: dict[str, Any] = {"3D!robot": _scene(), "StateTransitions!gait": _gait()}
    names = []
    for index, (title, paths) in enumerate({**(plots or {}), **DEFAULT_PLOTS}.items()):
        names.append(f"Plot!{index}")
        configurations[names[-1]] = _plot(title, paths)
    layout = {
        "configById": configurations,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "splitPercentage": 60,
            "first": {
                "direction": "column",
                "splitPercentage": 75,
                "first": "3D!robot",
                "second": "StateTransitions!gait",
            },
            "second": _column(names),
        },
    }
    path = Path(folder) / LAYOUT_FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(layout, indent=2) + "\n", encoding="utf-8")
    return path


def _scene() -> dict[str, Any]:
    return {
        "cameraState": {"perspective": True, "distance": 2.5, "phi": 65, "thetaOffset": 60, "targetOffset": [0, 0, 0]},
        "followMode": "follow-position",
        "followTf": TRUNK,
        "scene": {},
        "transforms": {},
        "topics": {"/scene": {"visible": True}, "/feet": {"visible": True}},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "frameId": "world",
                "visible": True,
                "size": 40,
                "divisions": 40,
                "label": "Ground",
            }
        },
    }


def _gait() -> dict[str, Any]:
    paths = [{"value": f"/contacts.{leg}", "label": leg, "timestampMethod": "receiveTime"} for leg in constants.LEGS]
    return {"isSynced": True, "paths": paths, "foxglovePanelTitle": "Feet on the ground"}


def _plot(title: str, paths: Sequence[str]) -> dict[str, Any]:
    lines = [{"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths]
    return {
        "paths": lines,
        "foxglovePanelTitle": title,
        "xAxisVal": "timestamp",
        "showLegend": True,
        "isSynced": True,
        "followingViewWidth": 4,
    }


def _column(names: Sequence[str]) -> Any:
    """Panels below each other, all of one height, as the nested halves that the format wants."""
    if len(names) == 1:
        return names[0]
    return {
        "direction": "column",
        "splitPercentage": 100 / len(names),
        "first": names[0],
        "second": _column(names[1:]),
    }
