from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.motion import MotionClip, MotionError, load_clip, load_clips
from agility_rl.motion.clip import save

ClipMaker = Callable[..., MotionClip]
Rows = Callable[..., list[list[float]]]


@pytest.fixture
def folder(make_clip: ClipMaker, sixty_one_rows: Rows, write_json: Callable[..., Path], tmp_path: Path) -> Path:
    """Three clips of two formats at 30 Hz, and files that are none."""
    clip = make_clip(frames=31, dt=1 / 30)
    (tmp_path / "more").mkdir()
    write_json(sixty_one_rows(clip), "trot_10.json", 1 / 30)
    write_json(sixty_one_rows(clip), "trot_9.json", 1 / 30)
    save(make_clip(label="jump"), tmp_path / "more" / "walk_1.npz")
    (tmp_path / "LICENSE.txt").write_text("do not read")
    (tmp_path / "LICENCE.txt").write_text("do not read")
    (tmp_path / "README.md").write_text("nor this")
    return tmp_path


def test_a_folder_is_read_in_order_at_50_hz_and_on_the_floor(folder: Path) -> None:
    clips = load_clips(folder)
    assert [clip.num_frames for clip in clips] == [60, 51, 51]
    assert [clip.label for clip in clips] == ["jump", None, None]
    assert all(clip.dt == 0.02 for clip in clips)
    assert all("grounded" in clip.notes[-1] for clip in clips)
    assert [clip.name for clip in clips[1:]] == ["trot_9", "trot_10"]


def test_labels_from_names(folder: Path) -> None:
    assert [clip.label for clip in load_clips(folder, label="from name")] == ["walk", "trot", "trot"]
    assert load_clip(folder / "trot_9.json", label="canter").label == "canter"


def test_height_and_rate_can_be_left_alone(folder: Path) -> None:
    clip = load_clip(folder / "trot_9.json", dt=None, grounding=None)
    assert clip.num_frames == 31 and clip.dt == pytest.approx(1 / 30)
    assert torch.allclose(clip.root_position[:, 2], torch.tensor(0.2884), atol=1e-4)


def test_a_label_that_is_no_behaviour_is_refused(folder: Path) -> None:
    with pytest.raises(MotionError, match="label 'gallop' is no behaviour; expected one of walk, pace"):
        load_clip(folder / "trot_9.json", label="gallop")
    (folder / "trot_9.json").rename(folder / "moonwalk_9.json")
    with pytest.raises(MotionError, match=r"moonwalk_9.json: label 'moonwalk' is no behaviour"):
        load_clips(folder, label="from name")


def test_missing_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="found nothing; check the path"):
        load_clips(tmp_path / "nowhere")
    with pytest.raises(MotionError, match="found none in this folder"):
        load_clips(tmp_path)
    with pytest.raises(MotionError, match="found nothing"):
        load_clip(tmp_path / "nowhere.json")
    with pytest.raises(MotionError, match="found a folder"):
        load_clip(tmp_path)


def test_an_unknown_extension_is_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"")
    with pytest.raises(MotionError, match="no known motion format"):
        load_clip(tmp_path / "clip.mp4")


def test_one_broken_file_is_named(folder: Path, write_json: Callable[..., Path]) -> None:
    write_json([[0.0] * 61, [0.0] * 13], "walk_2.json")
    with pytest.raises(MotionError, match=r"walk_2.json: frame 1 expected 61 columns, got 13"):
        load_clips(folder)


def test_json_is_read_as_json_whatever_it_begins_with(folder: Path, tmp_path: Path) -> None:
    text = (folder / "trot_9.json").read_text()
    marked = folder / "marked.json"
    marked.write_text(text, encoding="utf-8-sig")
    assert load_clip(marked).num_frames == 51
    marked.write_text(f"[{text}]")
    with pytest.raises(MotionError, match="expected a JSON object with 'Frames'"):
        load_clip(marked)


def test_a_clip_too_short_for_a_gait_is_named(tmp_path: Path, make_clip: ClipMaker) -> None:
    path = save(make_clip(frames=11), tmp_path / "short.npz")
    with pytest.raises(MotionError, match=r"short.npz: a gait needs at least 0.3 s, got 11 frames"):
        load_clip(path, label="from gait")


def test_the_papers_labelled_set(data: Path) -> None:
    clips = load_clips(data / "nju_go2_json" / "labelled", label="from name")
    assert len(clips) == 12 and {clip.label for clip in clips} == set(BEHAVIOURS)
    heights = {clip.name: float(clip.root_position[:, 2].median()) for clip in clips}
    # canter_3's floor is 8 cm too high in the file; after grounding it stands like the others.
    assert all(0.28 < height < 0.38 for height in heights.values()), heights


@pytest.mark.parametrize(
    ("file", "gait"), [("pace_0", "pace"), ("trot_0", "trot"), ("jump_0", "jump"), ("canter_0", "canter")]
)
def test_labels_from_the_feet(data: Path, file: str, gait: str) -> None:
    clip = load_clip(data / "nju_go2_json" / "labelled" / f"{file}.json", label="from gait")
    assert clip.label == gait and clip.notes[-1] == f"the feet show {gait}"


@pytest.mark.parametrize(
    ("folder_name", "count"), [("a1_metalhead", 18), ("laikago_clips", 10), ("mimickit_go2_pkl", 7)]
)
def test_every_other_format_is_read(data: Path, folder_name: str, count: int) -> None:
    clips = load_clips(data / folder_name)
    assert len(clips) == count
    for clip in clips:
        assert 0.2 < clip.root_position[:, 2].median() < 0.5, clip.name
        assert clip.foot_contact.any(), clip.name
