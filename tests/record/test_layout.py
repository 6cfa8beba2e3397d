"""The Foxglove layout: every panel it arranges exists, and every path it plots is a topic we write."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from agility_rl.go2 import constants
from agility_rl.record.layout import LAYOUT_FILE, write_layout


def leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


def test_layout(tmp_path: Path) -> None:
    path = write_layout(tmp_path / "episodes", {"Speed": ["/command.velocity_x"], "Height": ["/measured.height"]})
    assert path == tmp_path / "episodes" / LAYOUT_FILE
    layout = json.loads(path.read_text())
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    assert {panel.split("!")[0] for panel in layout["configById"]} == {"3D", "Plot", "StateTransitions"}
    values = [line["value"] for c in layout["configById"].values() for line in c.get("paths", [])]
    assert "/command.velocity_x" in values and "/contacts.RR" in values
    assert f'/joint_states.joints[:]{{name=="{constants.JOINT_NAMES[0]}"}}.position' in values


def test_layout_without_further_plots(tmp_path: Path) -> None:
    layout = json.loads(write_layout(tmp_path).read_text())
    assert len(leaves(layout["layout"])) == 3
