"""Networks: TensorDict in, TensorDict out; no loss and no environment."""

from __future__ import annotations

from agility_rl.modules.actor import DiagonalGaussian, GaussianActor
from agility_rl.modules.adaptation import HistoryEncoder, PrivilegedEncoder
from agility_rl.modules.behaviour_controller import BasicBehaviourController
from agility_rl.modules.critic import Critic
from agility_rl.modules.discriminator import Discriminator, MotionTrunk
from agility_rl.modules.estimator import StateEstimator
from agility_rl.modules.hybrid_actor import HybridActor, selected_parameters
from agility_rl.modules.normalization import FeatureNormalizer
from agility_rl.modules.predictor import Predictor
from agility_rl.modules.scandots import ScandotsEncoder
from agility_rl.modules.skill_prior import SkillPrior
from agility_rl.modules.teacher import Teacher
from agility_rl.modules.transition_discriminator import TransitionDiscriminator

__all__ = [
    "BasicBehaviourController",
    "Critic",
    "DiagonalGaussian",
    "Discriminator",
    "FeatureNormalizer",
    "GaussianActor",
    "HistoryEncoder",
    "HybridActor",
    "MotionTrunk",
    "Predictor",
    "PrivilegedEncoder",
    "ScandotsEncoder",
    "SkillPrior",
    "StateEstimator",
    "Teacher",
    "TransitionDiscriminator",
    "selected_parameters",
]
