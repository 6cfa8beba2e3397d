"""Batched environments: TorchRL ``EnvBase`` over a :class:`agility_rl.simulation.Simulator`, and their terms."""

from __future__ import annotations

import importlib.util

from agility_rl.envs.agility import AgilityEnv
from agility_rl.envs.course import Course, CourseError, Slot
from agility_rl.envs.course_file import load_course
from agility_rl.envs.course_presets import COURSES
from agility_rl.envs.locomotion import LocomotionEnv

if importlib.util.find_spec("gymnasium") is not None:  # optional; the import registers the robots with Gymnasium
    importlib.import_module("agility_rl.envs.gymnasium")

__all__ = ["COURSES", "AgilityEnv", "Course", "CourseError", "LocomotionEnv", "Slot", "load_course"]
