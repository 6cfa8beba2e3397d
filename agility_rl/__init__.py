"""agility_rl: from dog motion capture to an agile quadruped robot, in reusable TorchRL components."""

__version__ = "0.1.0"
