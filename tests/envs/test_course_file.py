"""Course files: what is read, and one clear message for everything that is wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from agility_rl.envs.course import CourseError
from agility_rl.envs.course_file import load_course

TOML = """
size = [4.0, 12.0]
wall_height = [0.5, 5]
wall_distance = [0, 1.5]
routes = [[0, 1], [0]]

[[slots]]
obstacle = "bar_jump"
position = [2, 3.0]
yaw_degrees = 90
difficulty = [0.10, 0.25]
jitter = {x = 0.1, yaw_degrees = 2.0}

[[slots]]
obstacle = "tunnel"
position = [2.0, 8.0]
yaw_degrees = 90.0
way_points = [[-1.5, 0.0], [1.0, 0.0], [1.5, 0.0]]
"""


def write(folder: Path, text: str, name: str = "mine.toml") -> Path:
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def test_a_file_becomes_a_course(tmp_path: Path) -> None:
    course = load_course(write(tmp_path, TOML))
    assert course.name == "mine" and course.size == (4.0, 12.0) and not course.shuffle
    assert course.wall_height == (0.5, 5.0) and course.wall_distance == (0.0, 1.5) and course.routes == ((0, 1), (0,))
    hurdle, tunnel = course.slots
    assert hurdle.yaw == pytest.approx(math.pi / 2) and hurdle.heights == (0.10, 0.25)
    assert hurdle.jitter == pytest.approx((0.1, 0.0, math.radians(2.0)))
    assert tunnel.goals == ((-1.5, 0.0), (1.0, 0.0), (1.5, 0.0))


def test_json_says_the_same(tmp_path: Path) -> None:
    slot = {"obstacle": "a_frame", "position": [2, 4], "yaw_degrees": 90}
    course = load_course(
        write(tmp_path, json.dumps({"name": "x", "size": [4, 8], "slots": [slot], "open": True}), "c.json")
    )
    assert course.name == "x" and course.slots[0].obstacle == "a_frame" and course.wall_height is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bar_jump", "hoop", r"mine.toml: course 'mine', slot 0 \(hoop\): unknown obstacle"),
        ("size = [4.0, 12.0]", "", "mine.toml: 'size' is missing"),
        ("position = [2.0, 8.0]", "", "mine.toml, slot 1: 'position' is missing"),
        ("size = [4.0, 12.0]", "size = [4.0]", "mine.toml: size must be two numbers"),
        ("position = [2, 3.0]", "position = [2, 'x']", "slot 0: position must be a number, got 'x'"),
        ("yaw_degrees = 90.0", "yaw = 1.57", "slot 1: unknown entry 'yaw'; expected some of obstacle, position"),
        ("yaw_degrees = 90.0", "yaw_degrees = true", "yaw_degrees must be a number, got True"),
        ("jitter = {x = 0.1, yaw_degrees = 2.0}", "jitter = 0.1", "jitter: expected a table of x, y, yaw_degrees"),
        ("difficulty = [0.10, 0.25]", "difficulty = [0.10, 0.5]", "within 0.05 to 0.3"),
        ("way_points = [[-1.5, 0.0], [1.0, 0.0], [1.5, 0.0]]", "way_points = []", "no way-points"),
        ("way_points = [[-1.5, 0.0], [1.0, 0.0], [1.5, 0.0]]", "way_points = 3", "way_points must be a list"),
        ("routes = [[0, 1], [0]]", "routes = [[0.5]]", "lists of slot numbers"),
        ("size = [4.0, 12.0]", "size = [4.0, 12.0]\nsize = [4.0, 12.0]", "malformed"),
        ("size = [4.0, 12.0]", "size = [4.0, 12.0]\nshuffle = 1", "shuffle must be true or false"),
        ("size = [4.0, 12.0]", "size = [4.0, 8.0]", "inside 4.0 x 8.0 m"),
        ("[[slots]]", "[[slots", "malformed"),
    ],
)
def test_a_bad_file_gives_one_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TOML
    with pytest.raises(CourseError, match=message) as caught:
        load_course(write(tmp_path, TOML.replace(old, new)))
    assert "mine.toml" in str(caught.value) and "\n" not in str(caught.value).split("malformed")[0]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.json", '{"size": [4, 8], "size": [4, 8]}', "c.json: malformed: key 'size' is there twice"),
        ("c.json", "[1, 2]", "expected a table"),
        ("c.json", '{"size": [4, 8], "slots": {}}', "slots must be a list"),
        ("c.json", '{"size": [4, 8], "slots": [3]}', "slot 0: expected a table"),
        ("c.json", '{"size": [4, 8], "slots": []}', "has no slots"),
        ("c.yaml", "size: 3", r"expected a \.toml or \.json file"),
    ],
)
def test_other_bad_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises(CourseError, match=message):
        load_course(write(tmp_path, text, name))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CourseError, match="cannot be read"):
        load_course(tmp_path / "none.toml")
