"""What ``evaluate_course.py`` measured, for the page of a run."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from html_page import interval, note, picture, table

COLUMNS = {
    "success": "success",
    "time, s": "time",
    "speed, m/s": "speed",
    "peak, m/s": "peak_speed",
    "collisions": "collisions_of_all",
}
"""Columns of the table and the entries that they show."""


def course_results(found: Mapping[str, Any], figures: Path) -> str:
    """Success, time and speed on every course, each obstacle that was met, and where the robots went."""
    settings, kind = found["settings"], found["kind"]
    where = "by depth images alone" if kind == "student" else "by scandots" if kind == "teacher" else "by a script"
    parts = [
        f"<h2>On courses: {escape(' '.join(dict.fromkeys((kind, str(found['run'])))))}</h2>",
        note(
            f"{settings['episodes']} episodes of each course, of {settings['episode_length']:g} s at most, decided "
            f"{where}. Time and speeds are of successful episodes, collisions of all. Intervals are of 95 %."
        ),
    ]
    courses = found["courses"]
    rows = [[name, *(interval(entry.get(key)) for key in COLUMNS.values())] for name, entry in courses.items()]
    parts.append(table(["course", *COLUMNS], rows))
    met = [
        [name, obstacle.replace("_", " "), one["met"], one["passed"], interval(one["success"])]
        for name, entry in courses.items()
        if len(entry["obstacles"]) > 1
        for obstacle, one in entry["obstacles"].items()
    ]
    if met:
        parts += ["<h3>Obstacles on courses of several</h3>", table(["course", "", "met", "passed", "success"], met)]
    for name in courses:
        file = Path(name.split(", ")[0]).stem
        if ", " not in name:  # disturbed images go other ways, but the picture would say the same
            caption = f"{name}: of the successes one of median time, of the failures the one that came farthest"
            parts.append(picture(figures / f"course_{file}.png", caption))
    parts.append(picture(figures / "course_behaviours.png", "behaviours before each obstacle, shares of time"))
    return "\n".join(parts)
