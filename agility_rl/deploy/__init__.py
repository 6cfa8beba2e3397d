"""From a trained controller to a robot: the artifact, what runs it at 50 Hz, and where it gives up.

Nothing here needs a training stack: no torchrl, and no simulator unless ``simulated`` or ``robot_process`` is imported.
"""

from agility_rl.deploy.artifact import Artifact
from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import BehaviourCommand, Commander, Operator
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.depth import DepthPreprocessor
from agility_rl.deploy.operator import SharedControl
from agility_rl.deploy.safety import SafetyLimits
from agility_rl.deploy.task import DeployedStudent
from agility_rl.deploy.transport import JointCommand, RobotState, Transport

__all__ = [
    "Artifact",
    "BehaviourCommand",
    "Commander",
    "Controller",
    "DeployedBBC",
    "DeployedStudent",
    "DepthPreprocessor",
    "JointCommand",
    "Mode",
    "Operator",
    "RobotState",
    "SafetyLimits",
    "SharedControl",
    "Transport",
]
