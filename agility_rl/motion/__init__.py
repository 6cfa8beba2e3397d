"""Motion clips of a dog on the Go2: readers, synthetic gaits, retargeting, gait measurement, the sampled dataset."""

from agility_rl.motion.clip import MotionClip, MotionError
from agility_rl.motion.dataset import MotionDataset
from agility_rl.motion.formats import load_clip, load_clips
from agility_rl.motion.gait_analysis import classify_gait
from agility_rl.motion.gaits import synthesize_gait
from agility_rl.motion.retarget import retarget

__all__ = [
    "MotionClip",
    "MotionDataset",
    "MotionError",
    "classify_gait",
    "load_clip",
    "load_clips",
    "retarget",
    "synthesize_gait",
]
