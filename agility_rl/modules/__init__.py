"""Networks: TensorDict in, TensorDict out; no loss and no environment."""

from __future__ import annotations

from agility_rl.modules.actor import DiagonalGaussian, GaussianActor
from agility_rl.modules.adaptation import HistoryEncoder, PrivilegedEncoder
from agility_rl.modules.behaviour_controller import BasicBehaviourController
from agility_rl.modules.byol import BYOL
from agility_rl.modules.critic import Critic
from agility_rl.modules.depth_augmentation import DepthAugmentation
from agility_rl.modules.depth_encoder import DepthEncoder
from agility_rl.modules.discriminator import Discriminator, MotionTrunk
from agility_rl.modules.estimator import StateEstimator
from agility_rl.modules.grad_cam import grad_cam
from agility_rl.modules.hybrid_actor import HybridActor, selected_parameters
from agility_rl.modules.normalization import FeatureNormalizer
from agility_rl.modules.predictor import Predictor
from agility_rl.modules.scandots import ScandotsEncoder
from agility_rl.modules.skill_prior import SkillPrior
from agility_rl.modules.student import RecurrentStudent
from agility_rl.modules.teacher import Teacher
from agility_rl.modules.transition_discriminator import TransitionDiscriminator

__all__ = [
    "BYOL",
    "BasicBehaviourController",
    "Critic",
    "DepthAugmentation",
    "DepthEncoder",
    "DiagonalGaussian",
    "Discriminator",
    "FeatureNormalizer",
    "GaussianActor",
    "HistoryEncoder",
    "HybridActor",
    "MotionTrunk",
    "Predictor",
    "PrivilegedEncoder",
    "RecurrentStudent",
    "ScandotsEncoder",
    "SkillPrior",
    "StateEstimator",
    "Teacher",
    "TransitionDiscriminator",
    "grad_cam",
    "selected_parameters",
]
