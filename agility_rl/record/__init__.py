"""What a run leaves behind: metrics and episodes in MCAP, and figures."""

from agility_rl.record.episode import EpisodeRecorder, free_file, is_free, read_episode, write_episode
from agility_rl.record.layout import write_layout
from agility_rl.record.mcap_logger import MCAPLogger, read_scalars
from agility_rl.record.scene import Shape

__all__ = [
    "EpisodeRecorder",
    "MCAPLogger",
    "Shape",
    "free_file",
    "is_free",
    "read_episode",
    "read_scalars",
    "write_episode",
    "write_layout",
]
