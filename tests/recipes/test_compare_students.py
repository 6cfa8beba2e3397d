"""The comparison of students: what follows from counts known by hand, and a whole one of untrained students."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from rich.console import Console

from agility_rl.deploy.artifact import Artifact

Module = Callable[[str], ModuleType]


@pytest.fixture
def recipe(module: Module) -> ModuleType:
    return module("compare_students")


def test_conclusions_by_hand(recipe: ModuleType) -> None:
    def run(byol: bool, none: int, noise: int, blur: int) -> dict[str, Any]:
        return {"byol": byol, "successes": {"none": none, "noise": noise, "blur": blur}}

    found = {"a": run(True, 90, 86, 88), "b": run(True, 94, 90, 92), "c": run(False, 80, 60, 70)}
    result = recipe.conclude(found, 100, 100)
    with_byol, without = result["groups"]["with BYOL"], result["groups"]["without BYOL"]
    assert with_byol["success"]["none"].estimate == pytest.approx(0.92)
    # Student-t with one degree of freedom, 12.706 times the standard error: 0.02
    assert with_byol["success"]["none"].high == pytest.approx(0.92 + 12.706 * 0.02, rel=1e-3)
    assert without["success"]["none"].low == pytest.approx(0.711, abs=1e-3)  # Wilson, 80 of 100
    assert with_byol["loss"]["noise"].estimate == pytest.approx(0.04)
    assert (with_byol["mean_loss"].estimate, without["mean_loss"].estimate) == pytest.approx((0.03, 0.15))
    assert (with_byol["mean_disturbed"].estimate, without["mean_disturbed"].estimate) == pytest.approx((0.89, 0.65))
    assert [(row["name"], row["passed"]) for row in result["targets"]] == [
        ("with BYOL: success / the teacher's", True),
        ("without BYOL: success / the teacher's", False),
        ("mean loss of success with BYOL", True),
        ("mean success under disturbance with BYOL", True),
    ]
    worse = recipe.conclude(found | {"b": run(True, 94, 70, 80)}, None, 100)["targets"]
    assert [row["passed"] for row in worse] == [False, True]
    nothing_to_lose = {"a": run(True, 50, 50, 50), "c": run(False, 80, 60, 70)}
    assert [row["passed"] for row in recipe.conclude(nothing_to_lose, None, 100)["targets"]] == [True, False]
    lossless = {"a": run(True, 9, 9, 9), "c": run(False, 9, 9, 9)}
    assert recipe.conclude(lossless, None, 10)["targets"] == [], "where nothing is lost there is nothing to halve"


def test_students_are_compared_on_the_same_courses(
    recipe: ModuleType, make_student: Callable[..., Path], untrained: Path, untrained_teacher: Path, tmp_path: Path
) -> None:
    runs = (make_student("one"), make_student("two", byol=False, seed=1))
    config = recipe.Config(
        runs,
        teacher=untrained_teacher,
        bbc=untrained,
        course="bar_jump",
        disturbance=("none", "blur"),
        episodes=2,
        robots=2,
        episode_length=0.2,
        num_threads=1,
        output=tmp_path / "out",
    )
    console = Console(file=StringIO(), width=200)
    recipe.compare(config, console)
    found = json.loads((tmp_path / "out" / "student_comparison.json").read_text())
    assert [run["byol"] for run in found["runs"].values()] == [True, False]
    assert all(run["successes"] == {"none": 0, "blur": 0} for run in found["runs"].values())
    assert found["groups"]["without BYOL"]["success"]["blur"]["estimate"] == 0.0
    assert found["teacher"]["successes"] == 0 and found["targets"] == []
    assert "Gaussian blur" in console.file.getvalue()
    assert (tmp_path / "out" / "figures" / "success_under_disturbance.png").is_file()

    # What was measured stands: changed by hand, it is found again; what is missing is added.
    cells = tmp_path / "out" / "cells.json"
    known = json.loads(cells.read_text())
    assert [sorted(cell) for cell in known["cells"].values()] == [["none"], *[["blur", "none"]] * 2]
    weights = found["runs"][str(runs[0])]["weights"]
    known["cells"][weights]["none"]["successes"] = 2
    del known["cells"][weights]["blur"]
    cells.write_text(json.dumps(known))
    again = recipe.compare(replace(config, runs=runs[:1], teacher=None), console)
    assert again["runs"][str(runs[0])]["successes"] == {"none": 2, "blur": 0}
    assert f"{cells}: what stands there is not measured again" in console.file.getvalue().replace("\n", "")
    assert len(json.loads(cells.read_text())["cells"]) == 3, "those of others stay"
    with pytest.raises(ValueError, match=r"cells\.json was measured with other episodes, seed; choose another"):
        recipe.compare(replace(config, episodes=1, seed=2), console)
    with pytest.raises(ValueError, match=r"cells\.json was measured with other course; choose another"):
        recipe.compare(replace(config, course="tunnel"), console)
    cells.write_text("{")
    with pytest.raises(ValueError, match=r"cells\.json is damaged: .*; make it again"):
        recipe.compare(config, console)
    cells.unlink()

    with pytest.raises(ValueError, match="two folders hold the same weights"):
        recipe.compare(replace(config, runs=(runs[0], runs[0] / "policy")), console)
    with pytest.raises(ValueError, match=r"expected a student of tsc_student\.py, got an artifact of kind 'teacher'"):
        recipe.compare(replace(config, runs=(untrained_teacher,)), console)
    stranger = make_student("stranger", teacher="0" * 64)
    assert Artifact.load(stranger / "policy").manifest["teacher"] == "0" * 64
    with pytest.raises(ValueError, match="stranger did not learn from the teacher of"):
        recipe.compare(replace(config, runs=(stranger,)), console)


def test_a_user_sees_one_line(recipe: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        recipe.main([str(tmp_path / "nowhere"), "--disturbance", "noise"])
    errors = capsys.readouterr().err
    assert stop.value.code == 2 and errors.count("\n") == 1 and "check the path" in errors
