"""Small clips made by hand, so that most tests need no real data."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.motion.clip import MotionClip, clip_from_joints

ClipMaker = Callable[..., MotionClip]
JsonWriter = Callable[..., Path]


@pytest.fixture
def make_clip() -> ClipMaker:
    """A clip that walks forward, turns left and swings every joint differently."""

    def make(frames: int = 60, dt: float = 0.02, **options: object) -> MotionClip:
        time = torch.arange(frames) * dt
        yaw = 0.3 * time
        zero = torch.zeros_like(time)
        position = torch.stack((0.5 * time, 0.1 * time, torch.full_like(time, constants.STANDING_HEIGHT)), -1)
        swing = 0.1 * torch.sin(6.0 * time[:, None] + torch.arange(12.0))
        joints = torch.tensor(constants.DEFAULT_POSE) + swing
        quaternion = rotations.from_euler(zero + 0.05, zero - 0.02, yaw)
        return clip_from_joints("swing", dt, position, quaternion, joints, **options)  # type: ignore[arg-type]

    return make


@pytest.fixture
def hop() -> MotionClip:
    """Standing 0.5 s, 0.3 s of flight up to 0.11 m, standing 0.5 s, on a floor 7 cm too low, at 50 Hz."""
    time = torch.arange(65) * 0.02
    flight = (time - 0.5).clamp(0.0, 0.3)
    height = constants.STANDING_HEIGHT - 0.07 + 4.905 * flight * (0.3 - flight)
    position = torch.stack((torch.zeros(65), torch.zeros(65), height), -1)
    level = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(65, 4)
    joints = torch.tensor(constants.DEFAULT_POSE).expand(65, 12)
    return clip_from_joints("hop", 0.02, position, level, joints)


@pytest.fixture
def write_json(tmp_path: Path) -> JsonWriter:
    """Write frames as a JSON motion file and return its path."""

    def write(frames: object, name: str = "clip.json", duration: object = 0.02) -> Path:
        path = tmp_path / name
        path.write_text(json.dumps({"LoopMode": "Wrap", "FrameDuration": duration, "Frames": frames}))
        return path

    return write


@pytest.fixture
def sixty_one_rows() -> Callable[..., list[list[float]]]:
    """A clip as 61 columns in a chosen convention: joint order, hip sign, foot order, foot frame."""

    def rows(
        clip: MotionClip,
        joint_order: tuple[int, ...] = (0, 1, 2, 3),
        hip_signs: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
        foot_order: tuple[int, ...] = (0, 1, 2, 3),
        frame: str = "world",
    ) -> list[list[float]]:
        joints = clip.joint_position.double().unflatten(-1, (4, 3)).clone()
        base = kinematics.forward(clip.joint_position.double())
        joints[..., 0] *= torch.tensor(hip_signs, dtype=torch.float64)
        quaternion = clip.root_quaternion.double()
        turned = rotations.rotate(quaternion[:, None], base)
        feet = {"base": base, "root": turned, "world": clip.root_position.double()[:, None] + turned}[frame]
        columns = (
            clip.root_position.double(),
            torch.roll(quaternion, -1, -1),
            joints[:, list(joint_order)].flatten(1),
            feet[:, list(foot_order)].flatten(1),
            torch.zeros(clip.num_frames, 30, dtype=torch.float64),
        )
        result: list[list[float]] = torch.cat(columns, -1).tolist()
        return result

    return rows
