"""Physics of many robots at once, behind one protocol."""

from agility_rl.simulation.batch import BatchSimulator
from agility_rl.simulation.depth_camera import DepthCamera
from agility_rl.simulation.scenery import Hinge, Piece, Shape
from agility_rl.simulation.simulator import (
    PARAMETERS,
    Camera,
    HardwareError,
    Simulator,
    make_simulator,
    simulator_device,
)
from agility_rl.simulation.terrain import HeightField, ridges, rough_pyramids

__all__ = [
    "PARAMETERS",
    "BatchSimulator",
    "Camera",
    "DepthCamera",
    "HardwareError",
    "HeightField",
    "Hinge",
    "Piece",
    "Shape",
    "Simulator",
    "make_simulator",
    "ridges",
    "rough_pyramids",
    "simulator_device",
]
