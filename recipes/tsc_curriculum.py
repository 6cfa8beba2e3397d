"""How a course grows with what is mastered: heights first, then obstacles; more practice of what fails."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from tsc_config import CurriculumConfig

from agility_rl.envs import AgilityEnv
from agility_rl.envs.obstacles import OBSTACLES


@dataclass
class Curriculum:
    """Harder courses as soon as the present ones are mastered.

    Attributes:
        cfg: when, and by how much.
        difficulty: share of the range of heights.
        obstacles: most obstacles of an episode.
        passed, failed: ``[7]``, moving averages of how often each type was passed and failed.
        successes, episodes: finished since the last step.
    """

    cfg: CurriculumConfig
    difficulty: float
    obstacles: int
    most: int
    passed: Tensor = field(default_factory=lambda: torch.ones(len(OBSTACLES)))
    failed: Tensor = field(default_factory=lambda: torch.ones(len(OBSTACLES)))
    successes: int = 0
    episodes: int = 0

    @classmethod
    def start(cls, cfg: CurriculumConfig, env: AgilityEnv) -> Curriculum:
        """Where a run on a course begins."""
        most = len(env.arena.layout.kinds)
        return cls(cfg, cfg.difficulty, min(cfg.obstacles, most), most)

    def update(self, passed: Tensor, failed: Tensor, successes: int, episodes: int) -> None:
        """Count what an iteration has finished, and take a step if it is time."""
        keep = 0.98
        self.passed, self.failed = keep * self.passed + passed, keep * self.failed + failed
        self.successes, self.episodes = self.successes + successes, self.episodes + episodes
        if self.episodes < self.cfg.episodes:
            return
        if self.successes / self.episodes >= self.cfg.success:
            if self.difficulty < 1.0:
                # Rounded, since ten steps of 0.1 are less than 1.
                self.difficulty = min(1.0, round(self.difficulty + self.cfg.difficulty_step, 6))
            else:
                self.obstacles = min(self.most, self.obstacles + 1)
        self.successes = self.episodes = 0

    def start_weights(self, types: Tensor) -> Tensor:
        """``[K]``, how often to start before each obstacle, from one-hot types ``[K, 7]``."""
        rate = self.passed / (self.passed + self.failed)
        return 1.0 + self.cfg.practice * ((1.0 - rate) / rate.clamp(min=0.1))[types.float().argmax(-1).cpu()]

    def state_dict(self) -> dict[str, Any]:
        """Where it stands."""
        names = ("difficulty", "obstacles", "passed", "failed", "successes", "episodes")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, value in state.items():
            setattr(self, name, value)
