"""What gathers data and searches with it: EASI's collector, its evolution strategy, robot logs, and DAgger."""

from __future__ import annotations

from agility_rl.collectors.behaviour_policy import BehaviourPolicy
from agility_rl.collectors.dagger import DAggerCollector
from agility_rl.collectors.easi import EASICollector, one_thread
from agility_rl.collectors.evolution import EvolutionStrategy
from agility_rl.collectors.log_formats import RobotLogError
from agility_rl.collectors.log_recording import RobotLogRecorder, record_robot_log
from agility_rl.collectors.parameters import GAINS, Parameter, ParameterSpace
from agility_rl.collectors.replay import ReplayCollector
from agility_rl.collectors.response import ResponseMemory
from agility_rl.collectors.robot_log import RobotLog
from agility_rl.collectors.rollout import fallen, roll_out, standing_states
from agility_rl.collectors.sensors import RobotSensors
from agility_rl.collectors.windows import Windows, cut_windows

__all__ = [
    "GAINS",
    "BehaviourPolicy",
    "DAggerCollector",
    "EASICollector",
    "EvolutionStrategy",
    "Parameter",
    "ParameterSpace",
    "ReplayCollector",
    "ResponseMemory",
    "RobotLog",
    "RobotLogError",
    "RobotLogRecorder",
    "RobotSensors",
    "Windows",
    "cut_windows",
    "fallen",
    "one_thread",
    "record_robot_log",
    "roll_out",
    "standing_states",
]
