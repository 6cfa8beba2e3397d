from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from agility_rl.behaviours import BEHAVIOURS, skill_index
from agility_rl.motion import MotionClip, MotionDataset, MotionError, load_clips, synthesize_gait
from agility_rl.motion.clip import clip_from_joints
from agility_rl.motion.dataset import discriminator_frames

ClipMaker = Callable[..., MotionClip]


def tagged(clip: MotionClip, tag: float) -> MotionClip:
    """The clip with its number in the joint velocity that the tests below read."""
    return replace(clip, joint_velocity=torch.full_like(clip.joint_velocity, tag))


def tag_and_frame(clip: MotionClip) -> torch.Tensor:
    """Two features a test can read: which clip, which frame."""
    return torch.stack((clip.joint_velocity[:, 0], torch.arange(clip.num_frames).float()), -1)


@pytest.fixture
def clips(make_clip: ClipMaker) -> dict[str, MotionClip]:
    return {
        "walk": tagged(make_clip(frames=11, label="walk"), 1.0),
        "walk2": tagged(make_clip(frames=21, label="walk", weight=3.0), 2.0),
        "trot": tagged(make_clip(frames=41, label="trot"), 3.0),
        "free": tagged(make_clip(frames=101), 4.0),
        "free2": tagged(make_clip(frames=3), 5.0),
    }


@pytest.fixture
def dataset(clips: dict[str, MotionClip]) -> MotionDataset:
    labelled = [clips["trot"], clips["walk"], clips["walk2"]]
    return MotionDataset(labelled, [clips["free"], clips["free2"]], features=tag_and_frame)


def test_samples_are_consecutive_frames_of_one_clip(dataset: MotionDataset, generator: torch.Generator) -> None:
    for batch in (dataset.sample_unlabelled(2000, generator), dataset.sample_labelled(2000, generator)):
        motion = batch["motion"]
        assert motion.shape == (2000, 2, 2) and batch.batch_size == (2000,)
        assert torch.equal(motion[:, 0, 0], motion[:, 1, 0])
        assert torch.equal(motion[:, 0, 1] + 1, motion[:, 1, 1])


def test_longer_horizons(clips: dict[str, MotionClip], generator: torch.Generator) -> None:
    dataset = MotionDataset([], [clips["free"]], offsets=range(5), features=tag_and_frame)
    motion = dataset.sample_unlabelled(50, generator)["motion"]
    assert torch.equal(motion[:, :, 1].diff(dim=1), torch.ones(50, 4))


def test_frames_far_apart(clips: dict[str, MotionClip], generator: torch.Generator) -> None:
    dataset = MotionDataset([clips["trot"]], [clips["free"]], offsets=(0, 7, 20), features=tag_and_frame)
    for batch in (dataset.sample_unlabelled(500, generator), dataset.sample_labelled(500, generator)):
        frames = batch["motion"][..., 1]
        assert torch.equal(frames - frames[:, :1], torch.tensor([0.0, 7.0, 20.0]).expand(500, 3))
    assert frames[:, 0].max() == 20  # of the 41 frames of the trot
    with pytest.raises(ValueError, match=r"rise from 0, such as \(0, 1\), got \(0, 5, 5\)"):
        MotionDataset([], [clips["free"]], offsets=(0, 5, 5))


def test_unlabelled_motion_is_drawn_by_time(dataset: MotionDataset, generator: torch.Generator) -> None:
    tags = dataset.sample_unlabelled(20000, generator)["motion"][:, 0, 0]
    assert dataset.as_recorded and (tags == 5).float().mean() == pytest.approx(2 / 102, abs=0.005)


def test_unlabelled_weights_count(clips: dict[str, MotionClip], generator: torch.Generator) -> None:
    heavy = replace(clips["free2"], weight=50.0)
    dataset = MotionDataset([], [clips["free"], heavy], features=tag_and_frame)
    tags = dataset.sample_unlabelled(20000, generator)["motion"][:, 0, 0]
    assert not dataset.as_recorded and (tags == 5).float().mean() == pytest.approx(0.5, abs=0.02)
    tags = dataset.sample_unlabelled(20000, generator, as_recorded=True)["motion"][:, 0, 0]
    assert (tags == 5).float().mean() == pytest.approx(2 / 102, abs=0.005)


@pytest.mark.parametrize(("weight", "share"), [(1.0, 0.5), (0.1, 0.1 / 1.1), (0.0, 0.0)])
def test_motion_of_dogs_that_stand_counts_less(
    make_clip: ClipMaker, generator: torch.Generator, weight: float, share: float
) -> None:
    """Half a minute of standing and as much of walking, in clips of their own."""
    velocity = torch.tensor([1.0, 0.0, 0.0])
    stands, walks = (tagged(make_clip(frames=1501), number) for number in (1.0, 2.0))
    stands = replace(stands, root_linear_velocity=torch.zeros_like(stands.root_linear_velocity))
    walks = replace(walks, root_linear_velocity=velocity.expand_as(walks.root_linear_velocity))
    dataset = MotionDataset([], [stands, walks], features=tag_and_frame, standing_weight=weight)
    drawn = dataset.sample_unlabelled(4000, generator)["motion"][:, 0, 0]
    assert (drawn == 1.0).float().mean().item() == pytest.approx(share, abs=0.03)
    assert dataset.as_recorded == (weight == 1.0)
    whole = dataset.sample_unlabelled(4000, generator, as_recorded=True)["motion"][:, 0, 0]
    assert (whole == 1.0).float().mean().item() == pytest.approx(0.5, abs=0.03)


def test_classes_are_drawn_by_share_and_clips_by_weight(dataset: MotionDataset, generator: torch.Generator) -> None:
    shares = torch.tensor([0.8, 0.0, 0.2, 0.0, 0.0])
    batch = dataset.sample_labelled(20000, generator, shares)
    walks = batch["skill"] == skill_index("walk")
    assert walks.float().mean() == pytest.approx(0.8, abs=0.02)
    tags = batch["motion"][:, 0, 0]
    assert set(tags[walks].tolist()) == {1.0, 2.0} and set(tags[~walks].tolist()) == {3.0}
    # 10 starts of weight 1 against 20 of weight 3.
    assert (tags[walks] == 2).float().mean() == pytest.approx(60 / 70, abs=0.02)


def test_scarce_classes_are_lifted(dataset: MotionDataset, generator: torch.Generator) -> None:
    skills = dataset.sample_labelled(20000, generator)["skill"]
    assert torch.bincount(skills, minlength=5).tolist()[1::2] == [0, 0]
    assert (skills == skill_index("trot")).float().mean() == pytest.approx(0.5, abs=0.02)


def test_every_start_is_reached(dataset: MotionDataset, generator: torch.Generator) -> None:
    frames = dataset.sample_labelled(20000, generator, torch.tensor([0.0, 0, 1, 0, 0]))["motion"][:, 0, 1]
    assert sorted(frames.unique().tolist()) == list(range(40))


def test_classes_without_clips_get_no_share(dataset: MotionDataset, generator: torch.Generator) -> None:
    skills = dataset.sample_labelled(100, generator, torch.tensor([0.1, 0.9, 0.0, 0.0, 0.0]))["skill"]
    assert (skills == skill_index("walk")).all()
    with pytest.raises(MotionError, match=r"class with clips \(walk, trot\)"):
        dataset.sample_labelled(1, generator, torch.tensor([0.0, 1.0, 0, 0, 0]))


def test_states_come_from_the_asked_skill(dataset: MotionDataset, generator: torch.Generator) -> None:
    skill = torch.tensor([0, 2, 2, 0, 2])
    states = dataset.sample_states(skill, generator)
    assert ((states["joint_velocity"][:, 0] == 3) == (skill == 2)).all()
    shapes = {name: tuple(value.shape) for name, value in states.items()}
    assert shapes == {
        "root_height": (5, 1),
        "root_quaternion": (5, 4),
        "root_linear_velocity": (5, 3),
        "root_angular_velocity": (5, 3),
        "joint_position": (5, 12),
        "joint_velocity": (5, 12),
        "past_motion": (5, 1, 2),
    }
    with pytest.raises(MotionError, match="labelled clips of 'jump' to start from"):
        dataset.sample_states(torch.tensor([0, 4]), generator)


def test_states_bring_the_frames_before_them(clips: dict[str, MotionClip], generator: torch.Generator) -> None:
    walk = clips["walk"]  # its height counts its frames, so that a state tells which frame it is
    walk = replace(walk, root_position=torch.arange(11.0)[:, None].expand(11, 3))
    dataset = MotionDataset([clips["trot"], walk], [walk], offsets=(0, 1, 4), features=tag_and_frame)
    states = dataset.sample_states(torch.zeros(400, dtype=torch.int64), generator)
    now = states["root_height"]
    assert sorted(now.unique().tolist()) == list(range(11))
    before = now + torch.arange(-4.0, 0.0)
    assert torch.equal(states["past_motion"][..., 1], before.clamp(min=0.0))  # the clip's first frame before the clip
    assert (states["past_motion"][..., 0] == 1.0).all()  # never another clip's


def test_states_are_all_frames_alike_however_long_a_sample_is(make_clip: ClipMaker, generator: torch.Generator) -> None:
    """A clip of 11 frames beside one of 41 has 10 of 50 pairs, but only 1 of the 32 samples that span 10 frames."""
    short, long = (make_clip(frames=frames, label="walk") for frames in (11, 41))
    short = replace(short, root_position=torch.arange(100.0, 111.0)[:, None].expand(11, 3))
    dataset = MotionDataset([long, short], [long], offsets=(0, 10))
    heights = dataset.sample_states(torch.zeros(50_000, dtype=torch.int64), generator)["root_height"][:, 0]
    counts = torch.stack([(heights == 100.0 + frame).sum() for frame in range(11)]).float()
    torch.testing.assert_close(counts, torch.tensor([500.0, *[1000.0] * 9, 500.0]), rtol=0.0, atol=5 * 1000**0.5)


def test_equal_generators_draw_equal_samples(dataset: MotionDataset) -> None:
    draws = [dataset.sample_labelled(64, torch.Generator().manual_seed(3))["motion"] for _ in range(2)]
    assert torch.equal(*draws)


def test_seconds_and_share(dataset: MotionDataset) -> None:
    seconds = dataset.class_seconds()
    assert tuple(seconds) == BEHAVIOURS
    assert seconds["walk"] == pytest.approx(0.64) and seconds["trot"] == pytest.approx(0.82) and seconds["jump"] == 0
    assert dataset.label_share() == pytest.approx(1.46 / (1.46 + 2.08))


def test_mirror_images_halve_the_weight_and_balance_left_and_right(
    clips: dict[str, MotionClip], generator: torch.Generator
) -> None:
    labelled, unlabelled = [clips["walk"]], [clips["free"], clips["free2"]]
    dataset = MotionDataset(labelled, unlabelled, mirror=True)
    plain = MotionDataset(labelled, unlabelled)
    assert dataset.class_seconds() == plain.class_seconds() and dataset.label_share() == plain.label_share()
    motion = dataset.sample_unlabelled(20000, generator)["motion"]
    # The clip always turns left; with its image the mean of roll and of the yaw rate vanishes.
    assert plain.sample_unlabelled(100, generator)["motion"][..., 8].min() > 0.05
    assert motion[..., 8].mean().abs() < 2e-3 and motion[..., 0].mean().abs() < 2e-3
    states = dataset.sample_states(torch.zeros(1000, dtype=torch.int64), generator)
    assert (states["root_angular_velocity"][:, 2] > 0).float().mean() == pytest.approx(0.5, abs=0.06)


def test_one_sided_labels_have_no_mirror_image(clips: dict[str, MotionClip], generator: torch.Generator) -> None:
    labelled = [clips["walk"], replace(clips["walk"], label="canter")]
    dataset = MotionDataset(labelled, [clips["free"]], mirror=True, one_sided=("canter",))
    assert [clip.label for clip in dataset.labelled_clips] == ["walk", "walk", "canter"]
    assert [clip.weight for clip in dataset.labelled_clips] == [0.5, 0.5, 1.0]
    states = dataset.sample_states(torch.tensor([0] * 500 + [3] * 500), generator)
    turning = states["root_angular_velocity"][:, 2] > 0
    assert turning[500:].all() and not turning[:500].all()


def test_labelled_clips_bent_to_both_sides_share_the_weight(generator: torch.Generator) -> None:
    """A trot of 1 m/s at a half and the whole of 1.57 rad/s: five variants, whose turn rates a robot may be asked."""
    trot = synthesize_gait("trot", speed=1.0)
    dataset = MotionDataset([trot], [trot], turns=(0.5, 1.0))
    assert [clip.weight for clip in dataset.labelled_clips] == pytest.approx([0.2] * 5)
    assert dataset.class_seconds() == MotionDataset([trot], [trot]).class_seconds()
    rates = [float(clip.root_angular_velocity[:, 2].mean()) for clip in dataset.labelled_clips]
    assert rates == pytest.approx([0.0, -0.785, 0.785, -1.57, 1.57], rel=0.06, abs=0.02)
    states = dataset.sample_states(torch.full((500,), skill_index("trot")), generator)
    assert (states["root_angular_velocity"][:, 2].abs() > 0.3).float().mean() == pytest.approx(0.8, abs=0.08)


def test_no_clip_is_bent_tighter_than_half_a_metre() -> None:
    walk = synthesize_gait("walk", speed=0.2)  # 1 rad/s would be a radius of 0.2 m
    rates = [
        clip.root_angular_velocity[:, 2].mean() for clip in MotionDataset([walk], [walk], turns=(1,)).labelled_clips
    ]
    assert max(rates) == pytest.approx(0.4, rel=0.1)


def test_a_clip_that_leads_nowhere_is_not_bent(make_clip: ClipMaker) -> None:
    clip = make_clip(label="walk")
    still = replace(clip, root_linear_velocity=torch.zeros_like(clip.root_linear_velocity))
    assert [found.weight for found in MotionDataset([still], [still], turns=(0.5,)).labelled_clips] == [1.0]


def test_features_are_those_of_the_policy(make_clip: ClipMaker) -> None:
    clip = make_clip()
    frames = discriminator_frames(clip)
    assert frames.shape == (60, 49)
    assert torch.allclose(frames[:, 0], torch.tensor(0.05), atol=1e-5)
    assert torch.allclose(frames[:, 1], torch.tensor(-0.02), atol=1e-5)
    assert torch.allclose(frames[:, 2], clip.root_position[:, 2])
    assert torch.equal(frames[:, 45:].bool(), clip.foot_contact)


def test_statistics_are_those_of_the_unlabelled_frames(clips: dict[str, MotionClip]) -> None:
    dataset = MotionDataset([clips["walk"]], [clips["free"]])
    frames = discriminator_frames(clips["free"])
    mean, std = dataset.statistics()
    assert torch.allclose(mean, frames.mean(0)) and torch.allclose(std, frames.std(0).clamp(min=1e-3))
    assert (std >= 1e-3).all()


def test_clips_of_another_rate_are_resampled(make_clip: ClipMaker, generator: torch.Generator) -> None:
    dataset = MotionDataset([], [make_clip(frames=31, dt=1 / 30)], features=tag_and_frame)
    assert dataset.unlabelled_seconds() == pytest.approx(51 * 0.02)


def test_unusable_sets_are_refused(make_clip: ClipMaker, clips: dict[str, MotionClip]) -> None:
    with pytest.raises(MotionError, match="at least one unlabelled clip"):
        MotionDataset([clips["walk"]], [])
    with pytest.raises(MotionError, match="label None is no behaviour"):
        MotionDataset([clips["free"]], [clips["free"]])
    with pytest.raises(MotionError, match="label 'gallop' is no behaviour"):
        MotionDataset([make_clip(label="gallop")], [clips["free"]])
    with pytest.raises(MotionError, match="3 frames, expected at least the 5 of a sample"):
        MotionDataset([], [clips["free2"]], offsets=range(5))
    with pytest.raises(MotionError, match="positive weight"):
        MotionDataset([], [replace(clips["free"], weight=0.0)])


def test_no_labelled_motion_is_allowed_until_it_is_needed(
    clips: dict[str, MotionClip], generator: torch.Generator
) -> None:
    dataset = MotionDataset([], [clips["free"]])
    assert dataset.label_share() == 0
    with pytest.raises(MotionError, match=r"clips \(none\)"):
        dataset.sample_labelled(1, generator)
    with pytest.raises(MotionError, match="'walk'"):
        dataset.sample_states(torch.tensor([0]), generator)


def test_the_papers_set(data: Path, generator: torch.Generator) -> None:
    labelled = load_clips(data / "nju_go2_json" / "labelled", label="from name")
    unlabelled = load_clips(data / "nju_go2_json" / "unlabelled")
    dataset = MotionDataset(labelled, unlabelled, mirror=True)
    assert dataset.unlabelled_seconds() == pytest.approx(770, abs=5)
    assert 0.03 < dataset.label_share() < 0.05
    motion = dataset.sample_labelled(4096, generator)["motion"]
    assert torch.isfinite(motion).all()
    states = dataset.sample_states(torch.randint(5, (4096,), generator=generator), generator)
    assert states["root_height"].min() > 0.2 and states["root_height"].max() < 0.55


def test_a_pool_that_stands_still_has_usable_statistics() -> None:
    level = torch.tensor([1.0, 0, 0, 0]).expand(9, 4)
    stand = clip_from_joints("s", 0.02, torch.zeros(9, 3), level, torch.zeros(9, 12))
    assert (MotionDataset([], [stand]).statistics()[1] == 1e-3).all()
