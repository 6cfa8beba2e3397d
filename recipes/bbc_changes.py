"""Options of the training of a Basic Behaviour Controller: which may change during a run, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

from bbc_config import Config

from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs.obstacles import BOX_HALF

CHANGEABLE: tuple[str, ...] = ("ppo.entropy", "ppo.desired_kl", "env.jump_weight", "env.progress_left")
CHANGEABLE += ("env.lowest_box", "env.highest_box", "env.standing_starts", "env.canter_stance", "env.walk_emphasis")
CHANGEABLE += tuple(f"imitation.{reward}_reward" for reward in ("imitation", "skill", "shift", "task"))
"""Options that may change during a run."""
NAMED: tuple[str, ...] = ("conditional", "labelled_share", "warm_up", "cloning", "cloning_weight")
"""Options of the imitation that need labels."""


def check(cfg: Config) -> None:
    """Refuse changes of options that cannot change, behaviours that do not exist, values that mean nothing.

    Raises:
        ValueError: naming the option and what can stand there.
    """
    if cfg.iterations < 1:
        raise ValueError(f"--iterations: expected at least 1, got {cfg.iterations}")
    if unknown := sorted(set(cfg.ppo.symmetric) - set(BEHAVIOURS)):
        raise ValueError(f"--ppo.symmetric: unknown {', '.join(unknown)}; expected some of {', '.join(BEHAVIOURS)}")
    for name, least, most, expected in (
        ("standing_starts", 0.0, 1.0, "a share from 0 to 1"),
        ("canter_stance", -1.0, 1.0, "a share of time"),
        ("boxes", 0.0, 1.0, "a share from 0 to 1"),
        ("lowest_box", 0.0, 2.0 * BOX_HALF[2], "a height of boxes [m]"),
        ("highest_box", 0.0, 2.0 * BOX_HALF[2], "a height of boxes [m]"),
        ("walk_emphasis", 0.0, math.inf, "a factor of at least 0"),
    ):
        later = [value for _, option, value in cfg.changes if option.replace("-", "_") == f"env.{name}"]
        if bad := [value for value in (getattr(cfg.env, name), *later) if not least <= value <= most]:
            raise ValueError(f"--env.{name.replace('_', '-')}: expected {expected}, got {bad[0]}")
    if cfg.motion.label_share == 0.0:
        named = {f"--imitation.{name.replace('_', '-')}": getattr(cfg.imitation, name) for name in NAMED}
        named |= {"--env.rhythm-weight": cfg.env.rhythm_weight, "--trials.start": cfg.trials.start}
        if needed := [option for option, value in named.items() if value]:
            raise ValueError(f"--motion.label-share 0: expected {', '.join(needed)} off, for they need labels")
    if cfg.env.lowest_box > cfg.env.highest_box:
        raise ValueError(
            f"--env.lowest-box: expected at most --env.highest-box, {cfg.env.highest_box}, got {cfg.env.lowest_box}"
        )
    if cfg.env.shares and (
        len(cfg.env.shares) != len(BEHAVIOURS) or min(cfg.env.shares) < 0 or not sum(cfg.env.shares)
    ):
        raise ValueError(f"--env.shares: expected {len(BEHAVIOURS)} numbers, none below 0, got {cfg.env.shares}")
    for name, least in (("start", 1), ("every", 1), ("episodes", 1), ("seconds", 2), ("switches", 0)):
        if (value := getattr(cfg.trials, name)) is not None and value < least:
            raise ValueError(f"--trials.{name}: expected at least {least}, got {value}")
    for _, option, _ in cfg.changes:
        if option.replace("-", "_") not in CHANGEABLE:
            raise ValueError(f"--changes: {option} cannot change in a run, only {', '.join(CHANGEABLE)} can")


def at(cfg: Config, iteration: int) -> Config:
    """The configuration with the changes that hold at an iteration; of two, the one further behind."""
    for start, option, value in cfg.changes:
        if iteration >= start:
            section, name = option.replace("-", "_").split(".")
            cfg = replace(cfg, **{section: replace(getattr(cfg, section), **{name: value})})
    return cfg
