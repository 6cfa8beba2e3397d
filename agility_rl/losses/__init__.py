"""Losses: LossModules over the pure functions of :mod:`agility_rl.losses.functional`; no network, no environment."""

from __future__ import annotations

from agility_rl.losses.adaptation import AdaptationLoss, StateEstimationLoss
from agility_rl.losses.byol import BYOLLoss
from agility_rl.losses.discriminator import DiscriminatorLoss
from agility_rl.losses.hybrid_ppo import HybridPPOLoss
from agility_rl.losses.imitation_reward import ImitationReward
from agility_rl.losses.predictor import PredictorLoss
from agility_rl.losses.student import StudentLoss
from agility_rl.losses.transition_discriminator import TransitionDiscriminatorLoss

__all__ = [
    "AdaptationLoss",
    "BYOLLoss",
    "DiscriminatorLoss",
    "HybridPPOLoss",
    "ImitationReward",
    "PredictorLoss",
    "StateEstimationLoss",
    "StudentLoss",
    "TransitionDiscriminatorLoss",
]
