"""Labelled and unlabelled clips as one pool of discriminator frames, sampled by indexing.

Every clip is turned into frames once; a sample is a gather from one tensor, whatever the number of clips.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, COMMAND_RANGES, NUM_BEHAVIOURS
from agility_rl.bending import TIGHTEST
from agility_rl.go2 import features as go2_features
from agility_rl.motion.clip import CONTROL_DT, MotionClip, MotionError
from agility_rl.motion.edit import bend, curvature_limits, resample
from agility_rl.motion.edit import mirror as mirror_clip

FrameFeatures = Callable[[MotionClip], Tensor]
"""Maps a clip of ``T`` frames to ``[T, F]`` features."""

STANDING_SPEED = 0.1
"""Slower dogs stand [m/s]."""

_STATE = (
    "root_quaternion",
    "root_linear_velocity",
    "root_angular_velocity",
    "joint_position",
    "joint_velocity",
)


def discriminator_frames(clip: MotionClip) -> Tensor:
    """Features ``[T, 49]`` of every frame of a clip, laid out as :data:`agility_rl.go2.features.MOTION_LAYOUT`."""
    return go2_features.clip_frames(
        clip.root_position[:, 2],
        clip.root_quaternion,
        clip.root_linear_velocity,
        clip.root_angular_velocity,
        clip.joint_position,
        clip.joint_velocity,
    )


class _Pool(NamedTuple):
    """Frames of some clips end to end, and the starts from which a whole sample lies inside one clip."""

    frames: Tensor  # [N, F]
    starts: Tensor  # int64 [S], index into frames
    weights: Tensor  # float64 [S]
    groups: Tensor  # int64 [S], skill of each start, non-decreasing
    clips: Tensor  # int64 [S], first frame of the clip of each start


class MotionDataset:
    """Samples of real (or synthetic) motion for discriminator, predictor and reference-state initialisation.

    Inside a class, or inside the unlabelled pool, a start frame is drawn with probability proportional to the weight of
    its clip; scarce labelled classes are lifted by drawing the class first, never by copying clips.

    Source: method notes, section 3.3 (two-frame transitions, classes lifted, unlabelled uniform in time).

    Args:
        labelled: clips with a label.
        unlabelled: clips whose labels, if any, are ignored.
        dt: seconds between two frames of a sample [s]; clips of another rate are resampled.
        offsets: which frames a sample holds, in frames from its first.
        mirror: also draw from the mirror image of every clip, each with half its weight.
        one_sided: labels whose labelled clips are not mirrored: a canter has a leading leg, and who is shown it on
            both sides may end between them, in a bound.
        turns: also draw from every labelled clip bent to either side, at these shares of the largest turn rate that
            may be commanded of its behaviour (as far as its path and :data:`~agility_rl.bending.TIGHTEST` allow), each
            variant with an equal part of its weight: labelled clips that lead straight ahead teach that turning is no
            dog's.
        features: maps a clip to the features of its frames.
        standing_weight: factor on the weight of unlabelled frames in which the dog stands, which a dog does a third of
            the time: mean speed of the second around them below 0.1 m/s.

    Attributes:
        labelled_clips: the labelled clips as they are drawn from: resampled, sorted by skill, with images and bends.
        as_recorded: whether every unlabelled start is as likely as any other, so that samples show the shares of
            behaviours in the recordings.

    Raises:
        MotionError: if there is no unlabelled motion, a labelled clip has no label, or a clip is shorter than a sample.

    Example:
        >>> from agility_rl.go2.constants import DEFAULT_POSE
        >>> from agility_rl.motion.clip import clip_from_joints
        >>> level = torch.tensor([1.0, 0, 0, 0]).expand(9, 4)
        >>> stand = clip_from_joints("s", 0.02, torch.zeros(9, 3), level, torch.tensor(DEFAULT_POSE).expand(9, 12))
        >>> dataset = MotionDataset([], [stand])
        >>> dataset.sample_unlabelled(4, torch.Generator().manual_seed(0))["motion"].shape
        torch.Size([4, 2, 49])
    """

    def __init__(
        self,
        labelled: Sequence[MotionClip],
        unlabelled: Sequence[MotionClip],
        dt: float = CONTROL_DT,
        offsets: Sequence[int] = go2_features.MOTION_OFFSETS,
        mirror: bool = False,
        features: FrameFeatures = discriminator_frames,
        standing_weight: float = 1.0,
        one_sided: Collection[str] = (),
        turns: Collection[float] = (),
    ) -> None:
        if not unlabelled:
            raise MotionError(
                "expected at least one unlabelled clip, got none; pass the labelled ones if there are no others"
            )
        for clip in labelled:
            if clip.label not in BEHAVIOURS:
                raise MotionError(
                    f"clip {clip.name!r}: label {clip.label!r} is no behaviour; expected one of {', '.join(BEHAVIOURS)}"
                )
        self.dt = dt
        go2_features.check_motion_offsets(offsets)
        self.span = offsets[-1]
        self._offsets = torch.tensor(offsets)
        labelled = sorted((resample(clip, dt) for clip in labelled), key=lambda clip: BEHAVIOURS.index(str(clip.label)))
        unlabelled = [resample(clip, dt) for clip in unlabelled]
        self._class_seconds = {
            name: sum(clip.num_frames * dt for clip in labelled if clip.label == name) for name in BEHAVIOURS
        }
        self._unlabelled_seconds = sum(clip.num_frames * dt for clip in unlabelled)
        labelled = [variant for clip in labelled for variant in _with_turns(clip, turns)]
        if mirror:
            labelled, unlabelled = _with_mirror_images(labelled, one_sided), _with_mirror_images(unlabelled)
        self.labelled_clips = tuple(labelled)
        groups = [BEHAVIOURS.index(str(clip.label)) for clip in labelled]
        frames = torch.cat([features(clip) for clip in labelled]) if labelled else torch.zeros(0)
        self._labelled = _pool(frames, labelled, groups, self.span)
        # An episode may start anywhere. Frames near the ends of a clip are in few whole samples, and a clip that is
        # hardly longer than one has few: a robot that rarely started there falls there.
        self._pairs = _pool(frames, labelled, groups, 1)
        self._unlabelled = _pool(
            torch.cat([features(clip) for clip in unlabelled]), unlabelled, [0] * len(unlabelled), self.span
        )
        if standing_weight != 1.0:
            standing = torch.cat([_standing(clip) for clip in unlabelled])[self._unlabelled.starts]
            self._unlabelled.weights[standing] *= standing_weight
        self._labelled_table = _cumulative(self._labelled, NUM_BEHAVIOURS)
        self._pairs_table = _cumulative(self._pairs, NUM_BEHAVIOURS)
        self._unlabelled_table = _cumulative(self._unlabelled, 1)
        self.as_recorded = bool((self._unlabelled.weights == self._unlabelled.weights[0]).all())
        self._present = torch.bincount(self._labelled.groups, minlength=NUM_BEHAVIOURS) > 0
        self._states = {name: torch.cat([getattr(clip, name) for clip in labelled]) for name in _STATE if labelled}
        if labelled:
            self._states["root_height"] = torch.cat([clip.root_position[:, 2:] for clip in labelled])

    @property
    def device(self) -> torch.device:
        """Where samples are drawn; generators have to be there too."""
        return self._offsets.device

    def to(self, device: torch.device | str) -> MotionDataset:
        """The same motion on another device; the clips themselves stay where they are."""
        moved = copy.copy(self)
        for name in ("_offsets", "_present"):
            setattr(moved, name, getattr(self, name).to(device))
        for name in ("_labelled", "_pairs", "_unlabelled", "_labelled_table", "_pairs_table", "_unlabelled_table"):
            part = getattr(self, name)
            setattr(moved, name, type(part)(*(tensor.to(device) for tensor in part)))
        moved._states = {name: value.to(device) for name, value in self._states.items()}
        return moved

    def sample_unlabelled(self, n: int, generator: torch.Generator | None, *, as_recorded: bool = False) -> TensorDict:
        """``n`` samples of unlabelled motion.

        Args:
            n: number of samples.
            generator: source of randomness.
            as_recorded: draw every start alike, whatever the weights of clips and standing: what the shares of
                behaviours in the recordings are, a skill prior should not learn from a choice of them.

        Returns:
            ``motion`` float32 ``[n, H, F]``.
        """
        pool = self._unlabelled
        if self.as_recorded or as_recorded:
            pick = torch.randint(len(pool.starts), (n,), generator=generator, device=self.device)
        else:
            everyone = torch.zeros(n, dtype=torch.int64, device=self.device)
            pick = _draw(self._unlabelled_table, everyone, generator)
        return TensorDict({keys.MOTION: self._gather(pool, pick)}, batch_size=[n])

    def sample_labelled(
        self, n: int, generator: torch.Generator | None, skill_probabilities: Tensor | None = None
    ) -> TensorDict:
        """``n`` samples of labelled motion: first the class, then a start frame in it.

        Args:
            n: number of samples.
            generator: source of randomness.
            skill_probabilities: ``[5]`` share of each class; classes without clips get none. None: equal shares.

        Returns:
            ``motion`` float32 ``[n, H, F]`` and ``skill`` int64 ``[n]``.

        Raises:
            MotionError: if no class with clips has a positive share.
        """
        shares = self._present.float() if skill_probabilities is None else skill_probabilities.float() * self._present
        if not bool(shares.sum() > 0):
            have = [name for name, there in zip(BEHAVIOURS, self._present.tolist(), strict=True) if there]
            raise MotionError(f"expected a positive share for a class with clips ({', '.join(have) or 'none'})")
        skill = torch.multinomial(shares, n, replacement=True, generator=generator)
        pick = _draw(self._labelled_table, skill, generator)
        return TensorDict({keys.MOTION: self._gather(self._labelled, pick), keys.SKILL: skill}, batch_size=[n])

    def sample_states(self, skill: Tensor, generator: torch.Generator | None) -> TensorDict:
        """One labelled frame of each given skill, to start an episode from.

        All frames of a skill come alike, by the weights of their clips; the first and the last of a clip half as often.

        Args:
            skill: int64 ``[n]``.
            generator: source of randomness.

        Returns:
            ``root_height`` ``[n, 1]`` [m] over the ground, ``root_quaternion`` ``[n, 4]``, ``root_linear_velocity``
            ``[n, 3]`` [m/s] and ``root_angular_velocity`` ``[n, 3]`` [rad/s] in the world frame, ``joint_position``
            ``[n, 12]`` [rad], ``joint_velocity`` ``[n, 12]`` [rad/s], and ``past_motion`` ``[n, span, F]``: the frames
            before, of which a sample's oldest is ``span`` frames old; before a clip's first frame stands that frame.

        Raises:
            MotionError: if a skill has no labelled clip.
        """
        absent = skill[~self._present[skill]]
        if len(absent):
            raise MotionError(
                f"expected labelled clips of {BEHAVIOURS[int(absent[0])]!r} to start from, there are none"
            )
        pool, pick = self._pairs, _draw(self._pairs_table, skill, generator)
        index = pool.starts[pick] + torch.randint(2, pick.shape, generator=generator, device=self.device)
        before = torch.maximum(
            index[:, None] + torch.arange(-self.span, 0, device=self.device), pool.clips[pick][:, None]
        )
        states = {name: value.index_select(0, index) for name, value in self._states.items()}
        return TensorDict(states | {"past_motion": pool.frames[before]}, batch_size=[len(skill)])

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation ``[F]`` of the unlabelled frames; deviations below 1e-3 are raised to that."""
        frames = self._unlabelled.frames
        return frames.mean(0), frames.std(0).clamp(min=1e-3)

    def class_seconds(self) -> dict[str, float]:
        """Seconds of labelled motion of every behaviour, mirror images and bent ones not counted."""
        return dict(self._class_seconds)

    def unlabelled_seconds(self) -> float:
        """Seconds of unlabelled motion, mirror images not counted."""
        return self._unlabelled_seconds

    def label_share(self) -> float:
        """Labelled seconds over all seconds."""
        labelled = sum(self._class_seconds.values())
        return labelled / (labelled + self._unlabelled_seconds)

    def _gather(self, pool: _Pool, pick: Tensor) -> Tensor:
        # index_select over a flat index is several times faster than indexing with a matrix.
        index = pool.starts[pick][:, None] + self._offsets
        return pool.frames.index_select(0, index.flatten()).unflatten(0, index.shape)


def _pool(frames: Tensor, clips: Sequence[MotionClip], groups: Sequence[int], span: int) -> _Pool:
    """The frames of clips, and every start of a sample whose last frame is ``span`` frames behind its first."""
    starts, weights, members, firsts, total = [], [], [], [], 0
    for clip, group in zip(clips, groups, strict=True):
        count = clip.num_frames - span
        if count < 1:
            raise MotionError(
                f"clip {clip.name!r}: {clip.num_frames} frames, expected at least the {span + 1} of a sample"
            )
        starts.append(torch.arange(total, total + count))
        weights.append(torch.full((count,), clip.weight, dtype=torch.float64))
        members.append(torch.full((count,), group))
        firsts.append(torch.full((count,), total))
        total += clip.num_frames
    if not clips:
        empty = torch.zeros(0, dtype=torch.int64)
        return _Pool(frames, empty, empty.double(), empty, empty)
    return _Pool(frames, *(torch.cat(parts) for parts in (starts, weights, members, firsts)))


class _Table(NamedTuple):
    """Cumulative weights in which group k fills the interval from k to k + 1, and the span of starts of each group."""

    ends: Tensor  # float64 [S]
    first: Tensor  # int64 [K]
    last: Tensor  # int64 [K]


def _cumulative(pool: _Pool, num_groups: int) -> _Table:
    counts = torch.bincount(pool.groups, minlength=num_groups)
    last = counts.cumsum(0) - 1
    ends = torch.empty_like(pool.weights)
    for group in range(num_groups):
        part = slice(int(last[group] - counts[group] + 1), int(last[group]) + 1)
        if counts[group]:
            total = pool.weights[part].cumsum(0)
            if not bool(total[-1] > 0):
                raise MotionError(
                    f"expected a positive weight for some clip of every class, all of class {group} are 0"
                )
            ends[part] = group + total / total[-1]
    return _Table(ends, last - counts + 1, last)


def _draw(table: _Table, group: Tensor, generator: torch.Generator | None) -> Tensor:
    """One start of each given group by its weight: one binary search each."""
    uniform = torch.rand(group.shape, dtype=torch.float64, generator=generator, device=group.device)
    pick = torch.searchsorted(table.ends, group + uniform, right=True)
    return pick.clamp(table.first[group], table.last[group])


def _standing(clip: MotionClip) -> Tensor:
    """Bool ``[T]``: the mean speed of the second around a frame is below :data:`STANDING_SPEED`."""
    speed = clip.root_linear_velocity[:, :2].norm(dim=-1)
    window = min(2 * round(0.5 / clip.dt) + 1, 2 * ((len(speed) - 1) // 2) + 1)
    padded = torch.nn.functional.pad(speed[None, None], (window // 2, window // 2), mode="replicate")
    return torch.nn.functional.avg_pool1d(padded, window, stride=1)[0, 0] < STANDING_SPEED


def _with_mirror_images(clips: Sequence[MotionClip], but: Collection[str] = ()) -> list[MotionClip]:
    """Every clip and its mirror image next to it, with half the weight each; clips with some labels as they are."""
    images = []
    for clip in clips:
        if clip.label in but:
            images.append(clip)
        else:
            half = replace(clip, weight=clip.weight / 2)
            images += [half, mirror_clip(half)]
    return images


def _with_turns(clip: MotionClip, shares: Collection[float]) -> list[MotionClip]:
    """A labelled clip, and bent to either side at shares of its behaviour's largest commanded turn rate."""
    speed = float(clip.root_linear_velocity[:, :2].norm(dim=-1).mean())
    if speed < STANDING_SPEED:
        return [clip]  # it leads nowhere
    largest = COMMAND_RANGES[str(clip.label)].yaw_rate[1]
    low, high = curvature_limits(clip)
    low, high = max(low, -TIGHTEST), min(high, TIGHTEST)
    wanted = [sign * share * largest / speed for share in shares for sign in (-1.0, 1.0)]
    part = replace(clip, weight=clip.weight / (1 + len(wanted)))
    return [part, *(bend(part, min(max(curvature, low), high)) for curvature in wanted)]
