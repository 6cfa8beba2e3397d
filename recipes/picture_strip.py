"""Pictures of an episode: one row a behaviour, frames a few hundredths of a second apart, seen from the robot's side.

In:  an episode (``.mcap``) as ``perform.py`` or an EpisodeRecorder writes it.
Out: a PNG. Needs a machine that can render: ``MUJOCO_GL=egl`` without a display.

    MUJOCO_GL=egl python recipes/picture_strip.py runs/my_run/episodes/perform_0.mcap strip.png
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import mujoco
import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from agility_rl import rotations
from agility_rl.go2.appearance import dress
from agility_rl.go2.model import build_spec
from agility_rl.record import read_episode
from agility_rl.record.episode import read_metadata
from agility_rl.record.plots import save_figure


@dataclass(frozen=True)
class Config:
    episode: Annotated[Path, tyro.conf.Positional]
    """Episode file."""
    picture: Annotated[Path, tyro.conf.Positional]
    """PNG to write."""
    frames: int = 8
    """Pictures in a row."""
    spacing: float = 0.08
    """Time between two pictures [s]."""
    width: int = 320
    """Width of a picture in pixels."""
    height: int = 240
    """Height of a picture in pixels."""
    skin: Path | None = None
    """Folder with the meshes of a Go2, for looks."""


def visible_model(skin: Path | None) -> mujoco.MjModel:
    """The Go2 as it should be looked at: without a skin, its collision shapes are what there is to see."""
    return dress(build_spec(skin=skin)).compile()


def rows_of(metadata: dict[str, Any], steps: int) -> list[tuple[str, int, int]]:
    """Name, first step and length of every piece of an episode; the whole of it if it names none."""
    return [tuple(piece) for piece in metadata.get("pieces", [])] or [(metadata.get("behaviour", ""), 0, steps)]


def main(config: Config) -> None:
    """Render and write."""
    if config.frames < 1 or config.spacing <= 0:
        raise ValueError("expected --frames of at least 1 and --spacing above 0")
    episode, metadata = read_episode(config.episode), read_metadata(config.episode)
    pose = [episode[name] for name in ("root_position", "root_quaternion", "joint_position")]
    step = max(1, round(config.spacing / metadata["dt"]))
    pieces = rows_of(metadata, len(pose[0]))
    model = visible_model(config.skin)
    buffer = model.vis.global_
    buffer.offwidth, buffer.offheight = max(buffer.offwidth, config.width), max(buffer.offheight, config.height)
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.distance, camera.elevation = 1.1, -12.0
    figure = Figure(figsize=(1.6 * config.frames, 1.35 * len(pieces)), layout="constrained")
    FigureCanvasAgg(figure)
    with mujoco.Renderer(model, config.height, config.width) as renderer:
        for row, (name, start, length) in enumerate(pieces):
            # From past the middle on: by then the robot has settled into what it was told.
            first = start + min(length // 2, max(0, length - config.frames * step))
            for column in range(config.frames):
                index = min(first + column * step, start + length - 1)
                data.qpos[:19] = np.concatenate([part[index].numpy() for part in pose])
                mujoco.mj_forward(model, data)
                camera.lookat[:] = [*pose[0][index, :2].tolist(), 0.25]
                _, _, yaw = rotations.to_euler(pose[1][index])
                camera.azimuth = math.degrees(float(yaw)) + 90.0
                renderer.update_scene(data, camera)
                axes = figure.add_subplot(len(pieces), config.frames, row * config.frames + column + 1)
                axes.imshow(renderer.render())
                axes.set_axis_off()
                axes.set_title(f"{name}  {index * metadata['dt']:.2f} s".strip(), fontsize=6, pad=2)
    save_figure(figure, config.picture)


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, description=__doc__))
    except Exception as error:  # whatever a graphics driver may raise: one line for the caller
        sys.exit(f"{type(error).__name__}: {error}")
