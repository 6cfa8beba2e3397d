"""Evaluation as a user runs it, and its numbers on cases that are known by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.go2 import features
from agility_rl.modules import BasicBehaviourController
from agility_rl.motion.clip import save
from agility_rl.motion.gaits import synthesize_gait
from agility_rl.training.metrics import Interval


@pytest.fixture
def evaluate(module: Callable[[str], ModuleType]) -> ModuleType:
    return module("evaluate")


def test_an_evaluation_writes_numbers_tables_and_pictures(untrained: Path, recipe, module) -> None:
    shortened = ("--episodes", 2, "--seconds", 2.5, "--switches", 1, "--switch-seconds", 1, "--num-threads", 1)
    result = recipe("evaluate", untrained, *shortened, "--robots", 8)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "targets reached" in result.stdout and "no dog moved like this" in result.stdout
    found = json.loads((untrained / "evaluation.json").read_text())
    assert [sum(row) for row in found["matrix"]["counts"]] == [2] * 5
    assert len(found["switches"]["without_fall"]) == 20
    assert set(found["prior"]["learned"]) == set(BEHAVIOURS)
    assert sum(found["prior"]["unlabelled_among_behaviours"].values()) == pytest.approx(1.0, abs=1e-4)
    rows, fall = found["episodes"], len(found["matrix"]["columns"]) - 1
    assert len(rows["measured"]) == 10
    for index, name in enumerate(BEHAVIOURS):
        numbers = zip(rows["skill"], rows["shown"], rows["commanded"], rows["measured"], strict=True)
        turns = [(c[2], m[2]) for skill, shown, c, m in numbers if skill == index and shown != fall]
        for side, sign in (("left", 1.0), ("right", -1.0)):
            shares = [measured / commanded for commanded, measured in turns if sign * commanded > 0.2]
            told = found["behaviours"][name]["turns"].get(side)
            assert (told is not None) == bool(shares)
            assert told is None or told["estimate"] == pytest.approx(sum(shares) / len(shares), abs=1e-5)
    walk = next(row for row in found["targets"] if row["name"] == "walk: recognised")
    assert not walk["passed"], "an untrained controller does not walk"
    pictures = {path.name for path in (untrained / "figures").iterdir()}
    assert {"behaviour_matrix.png", *(f"footfall_{name}.png" for name in BEHAVIOURS)} <= pictures

    report = module("report")
    scatter = report.tracking_scatter(found["episodes"], found["matrix"]["columns"].index("fall"))
    points = [len(marks.get_offsets()) for marks in scatter.axes[0].collections]
    assert sum(points[1::2]) == sum(entry["shown"]["fall"] for entry in found["behaviours"].values())
    assert sum(points) == len(rows["skill"])
    page = report.main(report.Config(untrained))
    text = page.read_text()
    assert page == untrained / "report.html"
    assert "Mean errors of an episode, without falls" in text and "yaw rate, rad/s" in text
    assert "no metrics.mcap" in text and text.count("data:image/png;base64,") >= 12
    assert "http://" not in text and "https://" not in text, "the page needs no network"


def test_a_missing_folder_is_one_line(tmp_path: Path, command, evaluate: ModuleType) -> None:
    result = command("evaluate", tmp_path / "nowhere")
    assert result.returncode == 2 and "check the path" in result.stderr
    assert "Traceback" not in result.stderr
    with pytest.raises(FileNotFoundError, match=r"manifest\.json is missing"):
        evaluate.load_controller(tmp_path)


def test_an_artifact_of_another_kind_or_network_is_refused(tmp_path: Path, evaluate: ModuleType) -> None:
    load = evaluate.load_controller
    weights = {"actor.bias": torch.zeros(12)}
    Artifact.save(tmp_path / "teacher", weights, build_manifest("teacher", {}, control_period=0.02))
    with pytest.raises(ValueError, match="expected an artifact of kind 'bbc', got 'teacher'"):
        load(tmp_path / "teacher")
    Artifact.save(tmp_path / "bare", weights, build_manifest("bbc", {}, control_period=0.02))
    with pytest.raises(ValueError, match="lacks 'network'"):
        load(tmp_path / "bare")
    other = build_manifest("bbc", {}, control_period=0.02) | {"network": {"hidden": [8]}}
    Artifact.save(tmp_path / "other", weights, other)
    with pytest.raises(ValueError, match="weights are not those of the expected network"):
        load(tmp_path / "other")


@pytest.mark.parametrize("option", [{"episodes": 0}, {"seconds": 1.0}, {"switches": -1}, {"switch_seconds": 0.5}])
def test_impossible_options_are_refused(untrained: Path, evaluate: ModuleType, option: dict) -> None:
    with pytest.raises(ValueError, match="expected --"):
        evaluate.evaluate(evaluate.Config(untrained, **option), None)
    assert not (untrained / "evaluation.json").exists()


def test_motion_needs_labels(evaluate: ModuleType) -> None:
    with pytest.raises(ValueError, match=r"needs --motion\.labelled"):
        evaluate.load_motion(evaluate.MotionConfig(unlabelled=Path("anywhere")), {}, 0)


def test_motion_that_is_asked_for_must_be_there_and_motion_that_is_gone_is_named(
    evaluate: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clips = tmp_path / "clips"
    for name in ("walk", "trot"):
        save(synthesize_gait(name, duration=1.0), clips / f"{name}.npz")
    with pytest.raises(ValueError, match="clisp: expected a motion file or a folder of them, found nothing"):
        evaluate.load_motion(evaluate.MotionConfig(clips, tmp_path / "clisp"), {}, 0)
    trained = {"motion": {"labelled": str(clips), "unlabelled": str(tmp_path / "moved")}}
    found = evaluate.load_motion(evaluate.MotionConfig(), trained, 0)
    assert len(found.labelled) == 2 and found.unlabelled == []
    assert "moved, the unlabelled motion of the training, is gone" in capsys.readouterr().out
    found = evaluate.load_motion(evaluate.MotionConfig(), {"motion": {"labelled": str(tmp_path / "moved")}}, 0)
    assert found.synthetic
    assert "moved, the labelled motion of the training, is gone: synthetic gaits" in capsys.readouterr().out


def test_gaits_of_robots_are_named_and_a_fall_is_no_gait(evaluate: ModuleType) -> None:
    clips = [synthesize_gait(name, duration=4.0) for name in (*BEHAVIOURS, "trot")]
    heading = [rotations.heading(clip.root_quaternion) for clip in clips]
    recording = evaluate.Recording(
        feet=torch.stack(
            [
                rotations.rotate_inverse(turn[:, None], clip.foot_position - clip.root_position[:, None])
                for turn, clip in zip(heading, clips, strict=True)
            ]
        ),
        sole=torch.stack([clip.foot_contact for clip in clips]),
        pressed=torch.stack([clip.foot_contact for clip in clips]),
        height=torch.stack([clip.root_position[:, 2] for clip in clips]),
        velocity=torch.stack(
            [
                rotations.rotate_inverse(turn, clip.root_linear_velocity)
                for turn, clip in zip(heading, clips, strict=True)
            ]
        ),
        yaw_rate=torch.stack([clip.root_angular_velocity[:, 2] for clip in clips]),
        fell=torch.tensor([False] * 5 + [True]),
    )
    shown, figures = evaluate.name_gaits(recording, start=25)
    assert [evaluate.COLUMNS[index] for index in shown] == [*BEHAVIOURS, "fall"]
    assert figures["phase FL-FR"][2] == pytest.approx(0.5, abs=0.03)
    assert figures["stride frequency"].isnan().tolist() == [False] * 5 + [True]


def test_comparison_with_the_dog_by_hand(evaluate: ModuleType) -> None:
    def within(value: float, dog: list[float], slack: float = 0.0) -> bool:
        return evaluate.compare(Interval(value, value, value), dog, slack)["within"]

    assert within(0.75, [1.0, 2.0]) and within(2.5, [1.0, 2.0])
    assert not within(0.74, [1.0, 2.0]) and not within(2.51, [1.0, 2.0])
    assert within(0.08, [0.04], slack=0.05) and not within(0.1, [0.04], slack=0.05)
    assert evaluate.compare(Interval(3.0, 3.0, 3.0), [1.0, 2.0], 0.0)["ratio_to_mean"] == 2.0


def test_nmi_interval_encloses_the_estimate(evaluate: ModuleType, generator: torch.Generator) -> None:
    counts = torch.zeros(5, 8, dtype=torch.int64)
    counts[torch.arange(5), torch.arange(5)] = 90
    counts[torch.arange(5), 6] = 10
    interval = evaluate.nmi_interval(counts, generator, resamples=100)
    assert interval.low < interval.estimate < interval.high < 1.0
    perfect = evaluate.nmi_interval(torch.eye(5, 8).long() * 20, generator, resamples=20)
    assert tuple(perfect) == (1.0, 1.0, 1.0)


def test_the_prior_is_compared_with_shares_of_time(evaluate: ModuleType) -> None:
    clips = [synthesize_gait("trot", duration=6.0), synthesize_gait("pace", duration=6.0)]
    found = evaluate.evaluate_prior([0.0, 0.5, 0.5, 0.0, 0.0], clips)
    assert float(found["total_variation"]) == pytest.approx(0.0, abs=1e-9)
    assert found["unlabelled_seconds"]["trot"] == pytest.approx(6.0, abs=0.1)


def test_a_controller_is_driven_with_the_friction_that_it_was_trained_with(tmp_path: Path, module) -> None:
    """By its manifest; where that does not say, by its run's options."""
    load, bbc = module("rollouts").load_controller, BasicBehaviourController(hidden=(16, 16))
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02)
    for name, told in (("plain", {}), ("told", {"simulation": {"friction_loss": 0.2}})):
        Artifact.save(tmp_path / name, bbc.state_dict(), manifest | {"network": bbc.settings} | told)
    assert [load(tmp_path / name).friction_loss for name in ("plain", "told")] == [0.0, 0.2]
    options = json.dumps({"config": {"env": {"friction_loss": 0.1}}})  # of a distilled one: not what its teachers had
    for name, said in (("silent", {}), ("distilled", told)):
        Artifact.save(tmp_path / name / "policy", bbc.state_dict(), manifest | {"network": bbc.settings} | said)
        (tmp_path / name / "config.json").write_text(options)
    assert [load(tmp_path / name).friction_loss for name in ("silent", "distilled")] == [0.1, 0.2]
