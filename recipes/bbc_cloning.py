"""A warm start for stage 1: the actor copies the labelled clips before it meets the discriminator.

From a random start the quickest way out of falling is to stand still, and from standing the style reward shows no way
back. An actor that has seen what joint targets a dog's motion takes falls as well, but while moving.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import avg_pool1d, max_pool1d, mse_loss, pad

from agility_rl import keys, rotations
from agility_rl.behaviours import BEHAVIOURS, JUMP, NUM_BEHAVIOURS, command_vector
from agility_rl.go2 import constants, features
from agility_rl.modules import BasicBehaviourController
from agility_rl.motion import MotionClip
from agility_rl.motion.tracking import joint_targets

SMOOTHING = 0.5
"""Seconds over which the motion's velocity and height are averaged to the command that it would answer."""
STATE_NOISE = {"roll_pitch": 0.05, "angular_velocity": 0.1, "joint_position": 0.05, "joint_velocity": 0.1}
STATE_NOISE |= {"last_action": 0.5, "foot_contact": 0.0}
"""Standard deviations, in scaled units: the robot will not be where the dog was, and copying must not rest on the
last action alone."""
ESTIMATE_NOISE = (0.03, 0.1, 0.1, 0.05)
COMMAND_NOISE = (0.1, 0.05, 0.2, 0.02, 0.02)
CONTACT_FLIPS = 0.1


def demonstration(clip: MotionClip, privileged: Tensor, generator: torch.Generator) -> TensorDict:
    """Policy inputs and actions ``[T]`` of one labelled clip; shifts, which a clip does not have, are random."""
    skill, frames = BEHAVIOURS.index(str(clip.label)), clip.num_frames
    action = (joint_targets(clip) - torch.tensor(constants.DEFAULT_POSE)) / torch.tensor(constants.ACTION_SCALE)
    roll, pitch, _ = rotations.to_euler(clip.root_quaternion)
    velocity = rotations.rotate_inverse(clip.root_quaternion, clip.root_linear_velocity)
    turning = rotations.rotate_inverse(clip.root_quaternion, clip.root_angular_velocity)
    height = clip.root_position[:, 2:]
    window = round(SMOOTHING / clip.dt)
    wanted = _pool(torch.cat((velocity[:, :2], turning[:, 2:], height), -1), window, avg_pool1d)
    leap = round(features.PEAK_WINDOW / clip.dt)
    jumping = float(skill == JUMP)
    peak = _pool(height, leap, max_pool1d)
    command = torch.cat((wanted[:, :3], jumping * peak, (1.0 - jumping) * wanted[:, 3:]), -1)
    shift = 2.0 * torch.rand(frames, 1, generator=generator, device=generator.device).to(height.device) - 1.0
    past = max_pool1d(pad(height.T[None], (leap - 1, 0), mode="replicate"), leap, 1)[0].T
    explicit = features.explicit(height, velocity)
    return TensorDict(
        {
            keys.PROPRIOCEPTION: features.proprioception(
                torch.stack((roll, pitch), -1),
                turning,
                clip.joint_position,
                clip.joint_velocity,
                torch.cat((action[:1], action[:-1])),
                clip.foot_contact,
            ),
            keys.EXPLICIT: explicit,
            keys.ESTIMATE: explicit,
            keys.PRIVILEGED: privileged.expand(frames, -1),
            keys.COMMAND: command_vector(torch.full((frames,), skill), command, shift),
            keys.PEAK: jumping * past,
            keys.ACTION: action,
        },
        [frames],
    )


class Demonstrations:
    """Labelled clips as what a policy would have seen and done, drawn every behaviour equally often.

    Args:
        clips: labelled clips at the control rate.
        privileged: ``[29]``, the robot that the clips are copied for.
        generator: source of all draws.
    """

    def __init__(self, clips: Sequence[MotionClip], privileged: Tensor, generator: torch.Generator) -> None:
        self.generator, device = generator, generator.device
        shown = [demonstration(clip, privileged, generator) for clip in clips]
        self.data: TensorDict = TensorDict.cat(shown).to(device)
        command = self.data[keys.COMMAND]
        skill = command[:, -NUM_BEHAVIOURS:].argmax(-1)
        self.weight = 1.0 / skill.bincount(minlength=NUM_BEHAVIOURS)[skill]
        spread = [torch.full((entry.size,), STATE_NOISE[entry.name]) for entry in features.PROPRIOCEPTION_LAYOUT]
        rest = torch.zeros(command.shape[-1] - len(COMMAND_NOISE))
        noises = {
            keys.PROPRIOCEPTION: torch.cat(spread),
            keys.ESTIMATE: torch.tensor(ESTIMATE_NOISE),
            keys.COMMAND: torch.cat((torch.tensor(COMMAND_NOISE), rest)),
        }
        self.noises = {key: noise.to(device) for key, noise in noises.items()}

    def sample(self, size: int) -> TensorDict:
        """Draw demonstrations, their inputs blurred by :data:`STATE_NOISE` and its like."""
        sample = self.data[torch.multinomial(self.weight, size, replacement=True, generator=self.generator)]
        for key, noise in self.noises.items():
            normal = torch.randn(sample[key].shape, generator=self.generator, device=noise.device)
            sample[key] = sample[key] + noise * normal
        contact = features.layout_slice(features.PROPRIOCEPTION_LAYOUT, "foot_contact")
        flipped = torch.rand(size, 4, generator=self.generator, device=self.generator.device) < CONTACT_FLIPS
        touched = sample[keys.PROPRIOCEPTION][:, contact]
        sample[keys.PROPRIOCEPTION][:, contact] = torch.where(flipped, -touched, touched)
        return sample

    def error(self, bbc: BasicBehaviourController, size: int = 512) -> Tensor:
        """Mean squared difference between the mean action and the clips' [action units squared]; a loss for the actor.

        Beside PPO it keeps behaviours alive that are hard to find again, as in Rajeswaran et al. 2018
        (arXiv:1709.10087).
        """
        sample = self.sample(size)
        return mse_loss(bbc.trained_actor()[:-1](sample)["loc"], sample[keys.ACTION])


def clone_behaviour(
    bbc: BasicBehaviourController, demonstrations: Demonstrations, steps: int, learning_rate: float = 1e-3
) -> float:
    """Fit the mean action and the state estimator to demonstrations.

    Returns:
        The mean squared error of the last batch, in action units.
    """
    network, optimizer = bbc.trained_actor()[:-1], torch.optim.Adam(bbc.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)
    error = torch.zeros(())
    for _ in range(steps):
        sample = demonstrations.sample(512)
        error = mse_loss(network(sample)["loc"], sample[keys.ACTION])
        estimate = bbc.estimator(sample.select(keys.PROPRIOCEPTION))[keys.ESTIMATE]
        optimizer.zero_grad(set_to_none=True)
        (error + mse_loss(estimate, sample[keys.EXPLICIT])).backward()
        optimizer.step()
        schedule.step()
    return float(error.detach())


def _pool(value: Tensor, window: int, function) -> Tensor:  # type: ignore[no-untyped-def]
    """Pool ``[T, C]`` along time over a centred window, the ends repeated."""
    window = min(window | 1, 2 * ((len(value) - 1) // 2) + 1)
    return function(pad(value.T[None], (window // 2, window // 2), mode="replicate"), window, 1)[0].T
