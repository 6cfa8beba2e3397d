"""A picture strip of an episode on a course: the robot before, on and behind every obstacle.

Needs a machine that can render: ``MUJOCO_GL=egl`` without a display.
"""

from __future__ import annotations

import math

import mujoco
import torch
from course_judgement import layout_of
from course_rollouts import Episode
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from play_course import add_course

from agility_rl import rotations
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.envs import Course
from agility_rl.envs.layout import CourseLayout
from agility_rl.go2.appearance import dress
from agility_rl.go2.constants import CONTROL_DT
from agility_rl.go2.model import build_spec

PLACES = (-0.7, 0.0, 0.7)
"""Where on the axis of each obstacle the robot is shown, from the edge before it over its middle to that behind [m]."""
WIDTH, HEIGHT = 360, 270
"""Of a picture [pixels]."""


def moments(layout: CourseLayout, episode: Episode) -> list[tuple[str, list[int]]]:
    """Obstacles of the route, each with the control steps in which the robot came nearest to :data:`PLACES`."""
    found = []
    for index in layout.route[0, : layout.length[0]].tolist():
        kind = layout.kinds[index]
        reach = kind.half_extents[0]
        axis = [torch.tensor([[x + math.copysign(reach, x) if x else 0.0, 0.0]]) for x in PLACES]
        wanted = [layout.world(torch.tensor([index]), at) for at in axis]
        away = [torch.linalg.vector_norm(episode.path[1:] - at, dim=-1) for at in wanted]
        found.append((kind.name, [int(distance.argmin()) for distance in away]))
    return found


def world(layout: CourseLayout) -> mujoco.MjModel:
    """The Go2 and the course as they should be looked at."""
    spec = build_spec()
    position, quaternion, _ = (rows[0] for rows in layout.poses())
    add_course(spec, layout.pieces, position, quaternion)
    return dress(spec).compile()


def course_strip(course: Course, episode: Episode) -> Figure:
    """Draw an episode, one column an obstacle.

    Raises:
        Exception: whatever the graphics driver of a machine without one raises.
    """
    layout = layout_of(course, episode)
    shown = moments(layout, episode)
    model = world(layout)
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    camera.distance, camera.elevation = 2.0, -18.0
    figure = Figure(figsize=(2.4 * len(shown), 1.95 * len(PLACES)), layout="constrained")
    FigureCanvasAgg(figure)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for column, (name, steps) in enumerate(shown):
            for row, step in enumerate(steps):
                frame = episode.steps[step]
                data.qpos[:] = torch.cat((frame["position"], frame["pose"])).numpy()
                mujoco.mj_forward(model, data)
                camera.lookat[:] = [*frame["position"][:2].tolist(), 0.25]
                _, _, yaw = rotations.to_euler(frame["pose"][:4])
                camera.azimuth = math.degrees(float(yaw)) + 120.0
                renderer.update_scene(data, camera)
                axes = figure.add_subplot(len(PLACES), len(shown), row * len(shown) + column + 1)
                axes.imshow(renderer.render())
                axes.set_axis_off()
                what = BEHAVIOURS[int(frame["behaviour"])]
                axes.set_title(f"{name.replace('_', ' ')}: {what}, {step * CONTROL_DT:.1f} s", fontsize=7, pad=2)
    return figure
