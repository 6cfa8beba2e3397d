"""The warm start: what a demonstration holds, and that an actor learns it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import torch

from agility_rl import rotations
from agility_rl.behaviours import JUMP, NUM_BEHAVIOURS
from agility_rl.envs import LocomotionEnv
from agility_rl.go2 import features
from agility_rl.modules import BasicBehaviourController
from agility_rl.motion import synthesize_gait

PRIVILEGED = torch.zeros(29)


def test_demonstration_is_what_the_environment_would_show(module: Callable[[str], ModuleType]) -> None:
    clip = replace(synthesize_gait("trot", speed=1.0), label="trot")
    shown = module("bbc_cloning").demonstration(clip, PRIVILEGED, torch.Generator().manual_seed(0))
    env = LocomotionEnv(2, simulator_options={"num_threads": 1})
    observation = env.reset()
    for key in ("proprioception", "explicit", "privileged", "command", "peak"):
        assert shown[key].shape[1:] == observation[key].shape[1:], key
    assert shown["action"].shape == (clip.num_frames, 12)
    env.close()
    command = shown["command"][clip.num_frames // 2]
    torch.testing.assert_close(command[:1], torch.tensor([1.0]), rtol=0.0, atol=0.1)
    assert command[3] == 0.0 and 0.2 < command[4] < 0.4
    assert command[-NUM_BEHAVIOURS:].argmax() == 2 and (shown["peak"] == 0.0).all()


def test_what_is_shown_is_in_the_robots_frame_and_the_last_action_is_the_last(
    module: Callable[[str], ModuleType],
) -> None:
    clip = replace(synthesize_gait("trot", speed=1.0, yaw_rate=0.5), label="trot")
    shown = module("bbc_cloning").demonstration(clip, PRIVILEGED, torch.Generator().manual_seed(0))
    to_trunk = rotations.rotate_inverse
    columns, place = {}, 0
    for entry in features.PROPRIOCEPTION_LAYOUT:
        columns[entry.name] = shown["proprioception"][:, place : place + entry.size] / entry.scale
        place += entry.size
    roll, pitch, _ = rotations.to_euler(clip.root_quaternion)
    torch.testing.assert_close(columns["roll_pitch"], torch.stack((roll, pitch), -1))
    turning = to_trunk(clip.root_quaternion, clip.root_angular_velocity)
    torch.testing.assert_close(columns["angular_velocity"], turning)
    torch.testing.assert_close(columns["last_action"][1:], shown["action"][:-1])
    velocity = to_trunk(clip.root_quaternion, clip.root_linear_velocity)
    torch.testing.assert_close(shown["explicit"], features.explicit(clip.root_position[:, 2:], velocity))
    assert (velocity[:, :2] - clip.root_linear_velocity[:, :2]).abs().max() > 0.1, "it turns"


def test_a_jump_commands_its_own_peak(module: Callable[[str], ModuleType]) -> None:
    clip = replace(synthesize_gait("jump"), label="jump")
    shown = module("bbc_cloning").demonstration(clip, PRIVILEGED, torch.Generator().manual_seed(0))
    highest = int(clip.root_position[:, 2].argmax())
    torch.testing.assert_close(shown["command"][highest, 3], clip.root_position[:, 2].max())
    assert (shown["command"][:, 4] == 0.0).all() and (shown["command"][:, 6 + JUMP] == 1.0).all()
    past = [clip.root_position[max(0, t - 44) : t + 1, 2].max() for t in range(clip.num_frames)]  # 0.9 s, 45 frames
    torch.testing.assert_close(shown["peak"][:, 0], torch.stack(past))


def test_cloning_fits_the_actions(module: Callable[[str], ModuleType]) -> None:
    clips = [replace(synthesize_gait(name), label=name) for name in ("walk", "pace", "trot", "canter", "jump")]
    cloning = module("bbc_cloning")
    torch.manual_seed(0)
    bbc = BasicBehaviourController(hidden=(64, 64))
    shown = cloning.Demonstrations(clips, PRIVILEGED, torch.Generator().manual_seed(0))
    before = shown.error(bbc).item()
    last = cloning.clone_behaviour(bbc, shown, 150)
    assert last < 0.5 * before
    shown.error(bbc).backward()
    assert bbc.actor.network.std.grad is None  # copying moves the mean, never the exploration
