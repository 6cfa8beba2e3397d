"""Teach a student's depth encoder what single images tell, from stored images, on a GPU or a CPU.

The encoder is asked what ``glances.py`` asks, of images that ``tsc_images.py`` has collected, in batches drawn from all
of them, at a rate that falls along half a cosine. Memory and actor stay as they are; if the encoder gets other sizes,
what reads its features begins anew. ``tsc_student.py --init-from`` goes on from there.

Source: ours; the questions: ``glances.py``.

In:  a student (``--student RUN``), folders of ``tsc_images.py`` (``--images RUN RUN ...``).
Out: ``runs/NAME/`` with ``config.json``, ``policy/`` (kind ``student``), and the errors of robots held out, printed.

    python recipes/tsc_glances.py --images runs/images_0 runs/images_1 --minutes 30 --name sharp
    python recipes/tsc_glances.py --images runs/images_* --minutes 5 --device cuda --batch 512 --name sharp
    python recipes/tsc_student.py cpu --init-from runs/sharp --imitation.led 0 --glance.steps 1 --name student
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from glances import ROUND, Glances
from learning_rates import half_cosine, set_learning_rate
from safetensors.torch import load_file
from tensordict import TensorDict, TensorDictBase
from tsc_artifacts import Trained, load_trained
from tsc_images import IMAGES_FILE
from tsc_setup import course_of
from tsc_student_config import AugmentationConfig, GlanceConfig
from tsc_student_setup import make_augmentation

from agility_rl import keys
from agility_rl.deploy.artifact import Artifact
from agility_rl.modules import RecurrentStudent
from agility_rl.training import cli, run_folder
from agility_rl.training.precision import Precision, hidden_precision
from agility_rl.training.seeding import seed_everything

ENCODER = ("encoder_channels", "encoder_hidden", "encoder_features")
"""Sizes of the encoder."""


@dataclass(frozen=True)
class Config:
    images: tuple[Path, ...]
    """Folders of ``tsc_images.py``."""
    student: Path = Path("pretrained/student_leaping")
    """Run or artifact folder of the student to start from."""
    name: str = "glances"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    minutes: float = 10.0
    """Learn for so long."""
    batch: int = 128
    """Images of a gradient step."""
    learning_rate: float = 1.5e-3
    """At first."""
    held_out: float = 0.1
    """Share of the robots of each folder whose images measure and do not teach."""
    reports: int = 6
    """How often errors are printed before the end."""
    device: str = "cpu"
    """Where the networks and all images are: ``cpu`` or ``cuda``."""
    precision: Precision = "auto"
    """Of the encoder's layers; ``auto`` is bfloat16 on hardware that multiplies in it."""
    encoder_channels: tuple[int, ...] | None = None
    encoder_hidden: int | None = None
    encoder_features: int | None = None
    glance_hidden: tuple[int, ...] | None = None
    """Other sizes than the student's: then encoder, glance and what reads them begin anew, with the last one only what
    says where obstacles are."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    seed: int = 0
    """Of everything that is drawn."""


def check(cfg: Config) -> None:
    """Refuse impossible options before anything is loaded."""
    if not cfg.images:
        raise ValueError("--images: expected one folder of tsc_images.py or more, got none")
    if not 0.0 < cfg.held_out < 1.0:
        raise ValueError(f"--held-out: expected a share within (0, 1), got {cfg.held_out}")
    if cfg.minutes <= 0.0 or cfg.learning_rate <= 0.0 or min(cfg.batch, cfg.reports) < 1:
        raise ValueError("expected --minutes and --learning-rate above 0, --batch and --reports of at least 1")


def resized(trained: Trained, cfg: Config) -> RecurrentStudent:
    """The student, with an encoder of other sizes if asked; every weight that still fits is kept."""
    network = trained.network
    assert isinstance(network, RecurrentStudent)
    asked = {name: getattr(cfg, name) for name in (*ENCODER, "glance_hidden") if getattr(cfg, name) is not None}
    student = RecurrentStudent(**(network.settings | asked))
    if student.settings == network.settings:
        return network
    state, known = student.state_dict(), network.state_dict()
    same = all(student.settings[name] == network.settings[name] for name in ENCODER)
    anew = "memory.glance.correction." if same else ("depth_encoder.", "memory.glance.", "memory.fusion.0.")
    kept = {
        name: value for name, value in known.items() if not name.startswith(anew) and value.shape == state[name].shape
    }
    student.load_state_dict(state | kept)
    return student


def load_images(cfg: Config, device: torch.device) -> tuple[TensorDictBase, TensorDictBase]:
    """Those to learn from and those held out, ``[M]`` each.

    Raises:
        FileNotFoundError: if a folder holds no images.
        ValueError: if a folder has a single robot.
    """
    train, test = [], []
    for folder in cfg.images:
        path = folder / IMAGES_FILE
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; expected a folder that tsc_images.py wrote")
        tensors = load_file(path)
        time_steps, robots = tensors[keys.PROGRESS].shape
        if robots < 2:
            raise ValueError(f"{path}: expected two robots or more, of which some are held out, got {robots}")
        rows = TensorDict(tensors, [time_steps, robots])  # type: ignore[arg-type]
        apart = min(max(1, round(cfg.held_out * robots)), robots - 1)
        learned = torch.ones(robots, dtype=torch.bool)
        learned[((torch.arange(apart) + 0.5) * robots / apart).long()] = False  # of those led by a teacher, and others
        test.append(rows[:, ~learned].flatten().to(device))
        train.append(rows[:, learned].flatten().to(device))
    return torch.cat(train), torch.cat(test)  # type: ignore[return-value, arg-type]


def teach(
    glances: Glances, test: TensorDictBase, cfg: Config, interrupted: Callable[[], bool] = lambda: False
) -> dict[str, float]:
    """Learn for the given time, or until interrupted, print errors now and then; returns the last ones."""
    start, steps, reported = time.monotonic(), 0, 0
    while (share := (time.monotonic() - start) / (60.0 * cfg.minutes)) < 1.0 and not interrupted():
        set_learning_rate(glances.optimizer, half_cosine(cfg.learning_rate, share, steps))
        found = glances.learn(ROUND, steps)
        steps += ROUND
        if share * cfg.reports >= reported:
            reported += 1
            show(f"{steps} steps, {share * cfg.minutes:.1f} minutes, learning", found)
            show("held out", glances.measure(test))
    errors = glances.measure(test)
    show(f"{steps} steps; held out", errors)
    return errors


def show(title: str, errors: dict[str, float]) -> None:
    """Print a line."""
    parts = "  ".join(f"{name.removeprefix('glance/')} {value:.3g}" for name, value in errors.items())
    print(f"{title}: {parts}", flush=True)


def main(cfg: Config) -> Path:
    """Teach and save; returns the run folder."""
    check(cfg)
    trained = load_trained(cfg.student, "student")
    device = torch.device(cfg.device)
    train, test = load_images(cfg, device)
    seeds = seed_everything(cfg.seed, device)
    student = resized(trained, cfg).to(device)
    student.depth_encoder.to(memory_format=torch.channels_last)
    student.depth_encoder.module.precision = hidden_precision(cfg.precision, device)
    settings = GlanceConfig(batch=cfg.batch, learning_rate=cfg.learning_rate, kept=len(train))
    augmentation = make_augmentation(cfg.augmentation, seeds.generator("augmentation"))
    glances = Glances.of(student, course_of(trained.course), settings, augmentation, seeds.generator("batches"))
    folder = run_folder.start_run(cfg, cfg.runs / cfg.name, recipe="tsc_glances")
    with run_folder.abandoned_by_errors(folder), cli.interruptible() as interrupted:
        glances.images.extend(train)
        print(f"{len(train)} images to learn from, {len(test)} held out")
        show("before; held out", glances.measure(test))
        teach(glances, test, cfg, interrupted)
    manifest = {name: value for name, value in trained.artifact.manifest.items() if name != "weights"}
    manifest["network"] = student.settings
    state = {name: value.detach().cpu().contiguous() for name, value in student.state_dict().items()}
    Artifact.save(folder / "policy", state, manifest)
    print(f"saved {folder}")
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__))
