"""The part of a run's page about courses, from an evaluation as it is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from agility_rl.training import cli

Module = Callable[[str], ModuleType]


def test_the_page_shows_what_another_controller_did_on_courses(tmp_path: Path, module: Module) -> None:
    evaluation, report = module("evaluate_course"), module("report")
    config = evaluation.Config(script="trot:1.0", course=("bar_jump", "hurdles"), episodes=2, robots=2)
    config = replace(config, episode_length=0.5, num_threads=1, output=tmp_path / "run" / "course")
    found = evaluation.evaluate(config, cli.console(160))
    page = report.main(report.Config(tmp_path / "run")).read_text()
    assert "<h2>On courses: script" in page
    assert "2 episodes of each course, of 0.5 s at most, decided by a script" in page
    assert page.count("data:image/png;base64,") == 3, "a plan view of either course, and the behaviours"
    assert set(found["courses"]) == {"bar_jump", "hurdles"} and "not evaluated yet" not in page


def test_a_disturbed_course_has_a_row_and_no_picture_of_its_own(tmp_path: Path, module: Module) -> None:
    share = {"estimate": 0.5, "low": 0.1, "high": 0.9}
    one = {"success": share, "obstacles": {"bar_jump": {"met": 2, "passed": 1, "success": share}}}
    found = {
        "settings": {"episodes": 2, "episode_length": 30.0},
        "kind": "student",
        "run": "<i>mine</i>",
        "courses": {"bar_jump": one, "bar_jump, blur": one},
    }
    (tmp_path / "course_evaluation.json").write_text(json.dumps(found))
    text = module("course_report").course_results(found, tmp_path / "figures")
    assert "Obstacles on courses of several" not in text
    found["courses"]["full"] = one | {
        "obstacles": one["obstacles"] | {"a_frame": {"met": 1, "passed": 1, "success": share}}
    }
    text = module("course_report").course_results(found, tmp_path / "figures")
    assert "Obstacles on courses of several" in text and "<td>a frame</td><td>1</td><td>1</td>" in text
    assert "<td>bar_jump, blur</td>" in text and text.count("no picture course_bar_jump.png") == 1
    assert "&lt;i&gt;mine&lt;/i&gt;" in text and "decided by depth images alone" in text
