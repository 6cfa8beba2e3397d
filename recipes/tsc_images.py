"""Collect images of a course where a student and its teacher walk, with what each of them should tell.

Images are what a student's perception is short of, and who collects them needs processors, not a GPU: start as many
processes as there are cores, each with its seed, and let ``tsc_glances.py`` learn from all that they wrote.

Source: ours; who leads is as in DAgger (Ross et al. 2011, arXiv:1011.0686).

In:  a student (``--student RUN``), its teacher and the controller of both.
Out: ``runs/NAME/`` with ``config.json`` and ``images.safetensors``: ``depth`` uint8 [T, N, 58, 87], ``terrain_latent``
     [T, N, 32], ``obstacle`` [T, N], ``place`` [T, N, 8], ``progress`` [T, N] of N robots in T decisions.

    python recipes/tsc_images.py --name images_0 --minutes 10 --led 0.5 --seed 0
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from course_metrics import judge, set_course
from glances import asked, known_terrain
from safetensors.torch import save_file
from tensordict import TensorDictBase
from tsc_artifacts import load_trained
from tsc_student_config import CPU
from tsc_student_setup import build, load_student, resolve

from agility_rl.training import cli, run_folder

IMAGES_FILE = "images.safetensors"


@dataclass(frozen=True)
class Config:
    student: Path = Path("pretrained/student_leaping")
    """Run or artifact folder of the student, which walks where it is not led."""
    teacher: Path = Path("pretrained/teacher_leaping")
    """Run or artifact folder of its teacher."""
    bbc: Path | None = None
    """Run or artifact folder of the Basic Behaviour Controller of both; found by default."""
    course: str | None = None
    """Preset or file; its teacher's by default. In one with other walls an encoder learns not to go by them."""
    name: str = "images"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    minutes: float = 10.0
    """Stop after this time."""
    windows: int = 1_000_000
    """Or after so many windows of 48 decisions."""
    led: float = 0.5
    """Share of the robots that do what the teacher says: they see what lies behind where the student fails."""
    start_spread: float = 4.0
    """How many times as far aside and turned as released episodes start; 4 is how robots leave an obstacle."""
    start_after: float = 0.0
    """Share of the episodes that start where the obstacle before is left. A student that walks knows nothing of that;
    with ``--led 1 --episode-length 4`` all images are of the way from one obstacle to the next."""
    episode_length: float = 40.0
    """Seconds."""
    num_robots: int = 64
    """Simulated together."""
    num_threads: int = 1
    """Of this process."""
    seed: int = 0
    """Of everything that is drawn."""


def check(cfg: Config) -> None:
    """Refuse impossible options before anything is loaded."""
    if not 0.0 <= cfg.led <= 1.0:
        raise ValueError(f"--led: expected a share from 0 to 1, got {cfg.led}")
    if cfg.minutes <= 0.0 or min(cfg.windows, cfg.num_robots, cfg.num_threads) < 1:
        raise ValueError("expected --minutes above 0, and --windows, --num-robots and --num-threads of at least 1")


def collect(cfg: Config) -> TensorDictBase:
    """Walk and look: :func:`glances.asked`, ``[T, N]``."""
    learner = load_trained(cfg.student, "student")
    student = learner.network.settings
    encoder = ("encoder_channels", "encoder_hidden", "encoder_features", "glance_hidden")
    own = ("memory", *encoder, "heading_gate", "estimator_history")
    robots = ("course", "num_robots", "num_threads", "start_spread", "start_after", "episode_length")
    run, trained = resolve(
        replace(
            CPU,
            teacher=cfg.teacher,
            bbc=cfg.bbc,
            init_from=cfg.student,
            seed=cfg.seed,
            env=replace(CPU.env, **{name: getattr(cfg, name) for name in robots}),
            **{name: student[name] for name in own if name in student},
        )
    )
    if learner.artifact.manifest["teacher"] != trained.digest:
        print(f"{cfg.student} learned from another teacher than {cfg.teacher}, whose view of the terrain is stored")
    parts = build(run, trained)
    load_student(parts, cfg.student, kept=())
    parts.collector.led = round(cfg.led * cfg.num_robots)
    rows: list[TensorDictBase] = []
    start = time.monotonic()
    while len(rows) < cfg.windows and (not rows or time.monotonic() - start < 60.0 * cfg.minutes):
        set_course(parts.env, parts.curriculum)
        window = parts.collector.collect()
        judge(parts.env, parts.curriculum, window)
        rows.append(asked(window, known_terrain(parts.teacher, window)).clone())
    parts.env.close()
    return torch.cat(rows)  # type: ignore[return-value, arg-type]


def main(cfg: Config) -> Path:
    """Collect and save; returns the run folder."""
    check(cfg)
    torch.set_num_threads(cfg.num_threads)
    folder = run_folder.start_run(cfg, cfg.runs / cfg.name, recipe="tsc_images")
    with run_folder.abandoned_by_errors(folder):
        images = collect(cfg)
    save_file({name: value.contiguous() for name, value in images.items()}, folder / IMAGES_FILE)
    print(f"{images.numel()} images of {images.shape[1]} robots: {folder / IMAGES_FILE}")
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__))
