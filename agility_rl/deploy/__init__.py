"""From a trained controller to a robot: the artifact and what runs it at 50 Hz."""

from agility_rl.deploy.artifact import Artifact

__all__ = ["Artifact"]
