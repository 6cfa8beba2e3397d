"""The robots of ``LocomotionEnv`` without TorchRL: the same physics, rewards and observations, in a dict of tensors.

A yardstick for ``plain_ppo.py``. It borrows the environment's physical parts (placing, pushing, randomising, state)
and steps them by hand: both sides of a comparison simulate the same robots, only the machinery around them differs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.state import LocomotionState
from agility_rl.envs.terminations import body_contact, diverged
from agility_rl.go2 import features

Observation = dict[str, Tensor]


class PlainLocomotion:
    """Steps the robots of an environment: ``step(action) -> observation, reward, terminated, truncated``."""

    def __init__(self, env: LocomotionEnv) -> None:
        self.env = env
        self.terms: dict[str, Tensor] = {}

    def reset(self, mask: Tensor) -> Observation:
        """Start episodes of the rows of a bool mask ``[N]``; returns the observations of all robots."""
        env = self.env
        env.commands.resample(mask)
        env._place(mask)
        if env.randomization is not None:
            env.robots.randomize(mask, env.randomization)
        env._step_count = env._step_count.masked_fill(mask, 0)
        env.pushes.begin(mask)
        if env.rhythm is not None:
            env.rhythm.begin(mask)
        state = env.robots.begin(mask, env.commands)
        env.observations.reset(mask, state)
        return self._observe(state)

    def step(self, action: Tensor) -> tuple[Observation, Tensor, Tensor, Tensor]:
        """One control step; nobody is reset."""
        env = self.env
        env.pushes.apply(env.simulator, env._step_count)
        env.robots.step(action)
        env._step_count = env._step_count + 1
        state = env.robots.state(action, env.commands)
        if env.rhythm is not None:
            state.rhythm = env.rhythm.update(state, env.commands.skill)
        terms = torch.stack([term.weight * term.function(state) for term in env.rewards.values()])
        self.terms = dict(zip(env.rewards, terms, strict=True))
        reward = (env.dt * terms).masked_fill(state.unstable, 0.0).sum(0).clamp(min=0.0)
        terminated = body_contact(state) | diverged(state)
        truncated = (env._step_count >= env.max_steps) & ~terminated
        env.commands.advance()
        env.observations.update(state)
        env.robots.remember(state)
        return self._observe(state), reward, terminated, truncated

    def _observe(self, state: LocomotionState) -> Observation:
        env = self.env
        return {
            keys.PROPRIOCEPTION: env.observations.history[:, -1],
            keys.EXPLICIT: features.explicit(state.root_height, state.linear_velocity),
            keys.PRIVILEGED: env.robots.privileged,
            keys.HISTORY: env.observations.history,
            keys.COMMAND: env.commands.vector(),
            keys.PEAK: (state.peak_height * env.commands.jumping)[:, None],
            keys.MOTION: env.observations.motion(),
            keys.SKILL: env.commands.skill,
            keys.SHIFT: env.commands.shift,
        }
