"""Join behaviours of several controllers in one: of each run the behaviours that it does best.

Runs of ``bbc_pretrain.py`` differ in which behaviours come out well. Here every behaviour has a teacher, and one
student learns to act as the teacher of whatever it is told to do, in states that it gets into itself.

Source: ours; the roll-outs of student and labels of a teacher are those of DAgger (Ross, Gordon and Bagnell 2011).

In:  controllers of the same layout (``--teachers BEHAVIOUR PATH BEHAVIOUR PATH ...``, every behaviour once), clips to
     start episodes from (``--motion.labelled DIR``); without them, synthetic gaits.
Out: ``runs/NAME/`` with ``config.json`` and ``policy/``. Ctrl-C ends the round and saves; such a run is not resumed.

    python recipes/bbc_distill.py cpu --teachers walk runs/a pace runs/b trot runs/a canter runs/a jump runs/a
    python recipes/bbc_pretrain.py polish --init-from runs/distilled ...     # PPO goes on, and trains a discriminator
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import bbc_changes
import bbc_config
import torch
from bbc_world import make_env
from mirroring import Side, mirrored
from rollouts import Controller, MotionConfig, load_controller, load_motion
from steering import steered
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import mse_loss
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS
from agility_rl.deploy.artifact import Artifact, build_manifest
from agility_rl.envs import LocomotionEnv
from agility_rl.go2 import constants, features
from agility_rl.losses import AdaptationLoss, StateEstimationLoss
from agility_rl.modules import BasicBehaviourController
from agility_rl.motion import MotionDataset
from agility_rl.training import cli, run_folder
from agility_rl.training.seeding import seed_everything

Act = Callable[[TensorDictBase], Tensor]
Experience = tuple[TensorDictBase, TensorDictBase]
LABEL = "label"
"""Mean action of a row's teacher, float32 ``[B, 12]``."""
INPUTS = (keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.HISTORY, keys.COMMAND, keys.PEAK, keys.SKILL)

ENVIRONMENT = bbc_config.EnvConfig(
    num_robots=512,
    randomize=False,
    push_interval=None,
    observation_noise=0.0,
    episode_length=8.0,  # as in the preset ``cpu`` of ``bbc_pretrain.py``
)


@dataclass(frozen=True)
class Config:
    name: str = "distilled"
    """Folder under ``runs``."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    seed: int = 0
    """Of everything that is drawn."""
    teachers: tuple[tuple[str, Path], ...] = ()
    """Behaviour and run or artifact folder, for each of the five behaviours. The first one's network is the student's,
    and its weights are where the student starts."""
    steered: tuple[str, ...] = ()
    """Behaviours whose teacher only goes straight ahead: it is led along the commanded curves (``steering.py``)."""
    mirrored: tuple[tuple[str, Side], ...] = ()
    """Behaviour and the side to which its teacher turns well: to the other it acts in a mirror (``mirroring.py``)."""
    env: bbc_config.EnvConfig = field(default_factory=lambda: ENVIRONMENT)
    """Where they walk. The joints' dry friction is that of the teachers' simulator; rewards are not used."""
    rounds: int = 24
    """Roll-outs, each followed by learning from the newest ones."""
    teacher_rounds: int = 2
    """First rounds in which the teachers act."""
    steps: int = 50
    """Control steps of a round."""
    memory: int = 16
    """Newest rounds that are learned from."""
    updates: int = 150
    """Of a round."""
    batch_size: int = 4096
    """Rows of a gradient step."""
    learning_rate: float = 1e-3
    """At first; it falls to a twentieth."""
    noise: float = 0.2
    """Standard deviation of what is added to the actions that are taken, in action units; labels are without."""
    motion: MotionConfig = field(default_factory=MotionConfig)


PRESETS = {
    "cpu": Config(),
    "smoke": Config(
        name="smoke",
        env=replace(ENVIRONMENT, num_robots=20),
        rounds=3,
        teacher_rounds=1,
        steps=20,
        updates=5,
        batch_size=128,
    ),
}


def load_teachers(cfg: Config) -> list[Controller]:
    """The teacher of every behaviour, in the order of the behaviours.

    Raises:
        ValueError: if a behaviour is missing, named twice, or none of the five, here, in ``--steered`` or in
            ``--mirrored``.
    """
    sides = [name for name, _ in cfg.mirrored]
    for option, chosen in (("steered", cfg.steered), ("mirrored", sides)):
        if unknown := sorted(set(chosen) - set(BEHAVIOURS)):
            raise ValueError(f"--{option}: unknown {', '.join(unknown)}; expected some of {', '.join(BEHAVIOURS)}")
    if len(set(sides)) < len(sides):
        raise ValueError(f"--mirrored: expected every behaviour once at most, got {', '.join(sides)}")
    names = [name for name, _ in cfg.teachers]
    if sorted(names) != sorted(BEHAVIOURS):
        raise ValueError(
            f"expected --teachers with every behaviour once ({', '.join(BEHAVIOURS)}), got {', '.join(names) or 'none'}"
        )
    loaded = {path: load_controller(path) for path in dict.fromkeys(path for _, path in cfg.teachers)}
    frictions = {str(path): controller.friction_loss for path, controller in loaded.items()}
    if len(set(frictions.values())) > 1:
        raise ValueError(f"expected teachers of one simulator, their joints have dry frictions of {frictions} N m")
    return [loaded[dict(cfg.teachers)[name]] for name in BEHAVIOURS]


def labeller(teachers: list[Controller], lead: Collection[str] = (), sides: Mapping[str, Side] | None = None) -> Act:
    """A function that gives the mean action ``[B, 12]`` of the teacher of each row's behaviour.

    Args:
        teachers: in the order of the behaviours.
        lead: behaviours that are led along curves.
        sides: behaviours that act in a mirror where the other side is commanded.
    """
    sides = sides or {}
    kinds = [
        (id(teacher.bbc), name in lead, sides.get(name)) for name, teacher in zip(BEHAVIOURS, teachers, strict=True)
    ]
    acts: dict[tuple[int, bool, Side | None], Act] = {}
    for kind, teacher in zip(kinds, teachers, strict=True):
        act: Act = partial(mean_action, teacher.bbc)
        if kind[1]:
            act = steered(act)
        acts[kind] = act if kind[2] is None else mirrored(act, kind[2])
    index = torch.tensor([list(acts).index(kind) for kind in kinds])

    @torch.no_grad()
    def label(observation: TensorDictBase) -> Tensor:
        teacher = index[observation[keys.SKILL]]
        said = torch.empty(len(observation), constants.NUM_JOINTS)
        for number, act in enumerate(acts.values()):
            rows = teacher == number
            said[rows] = act(observation[rows])
        return said

    return label


def mean_action(bbc: BasicBehaviourController, observation: TensorDictBase) -> Tensor:
    """Mean action ``[B, 12]`` of a controller that knows the simulator's parameters; its estimate stays as it is."""
    inputs = observation.select(keys.PROPRIOCEPTION, keys.PRIVILEGED, keys.COMMAND, keys.PEAK)
    with torch.no_grad():
        bbc.estimator(inputs)
    return bbc.trained_actor()[:-1](inputs)["loc"]


def collect(
    env: LocomotionEnv, carrier: TensorDictBase, act: Act, label: Act, cfg: Config, generator: torch.Generator
) -> Experience:
    """Inputs and labels ``[steps * N]`` of a round, and the observation from which the next one goes on."""
    rows = []
    for _ in range(cfg.steps):
        row = carrier.select(*INPUTS).clone()
        row[LABEL] = label(row)
        carrier[keys.ACTION] = act(row) + cfg.noise * torch.randn(row[LABEL].shape, generator=generator)
        rows.append(row)
        _, carrier = env.step_and_maybe_reset(carrier)
    return torch.cat(rows), carrier


def learn(
    bbc: BasicBehaviourController, replay: TensorDictReplayBuffer, updates: int, optimizer: torch.optim.Optimizer
) -> None:
    """Regress on labels, true states and true parameters."""
    estimation = StateEstimationLoss(bbc.estimator)
    adaptation = AdaptationLoss(bbc.history_encoder, bbc.privileged_encoder)
    for _ in range(updates):
        batch = replay.sample()
        loss = mse_loss(mean_action(bbc, batch), batch[LABEL])
        loss = loss + estimation(batch)["loss_estimation"] + adaptation(batch)["loss_adaptation"]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()


def errors(bbc: BasicBehaviourController, data: TensorDictBase) -> dict[str, float]:
    """Root mean square of student minus teacher by behaviour, in action units."""
    with torch.no_grad():
        squares = (mean_action(bbc, data) - data[LABEL]).square().mean(-1)
    return {name: float(squares[data[keys.SKILL] == index].mean().sqrt()) for index, name in enumerate(BEHAVIOURS)}


def main(cfg: Config) -> Path:
    """Distil and save; returns the run folder."""
    teachers = load_teachers(cfg)
    seeds = seed_everything(cfg.seed)
    first = load_controller(cfg.teachers[0][1])
    bbc = first.bbc
    motion = load_motion(cfg.motion, first.trained, cfg.seed)
    print(f"episodes start from: {motion.source}")
    world = bbc_config.Config(env=replace(cfg.env, friction_loss=first.friction_loss))
    bbc_changes.check(world)
    env = make_env(world, MotionDataset(motion.labelled, motion.labelled), seeds)
    folder = run_folder.start_run(cfg, cfg.runs / cfg.name, recipe="bbc_distill")
    label, carrier = labeller(teachers, cfg.steered, dict(cfg.mirrored)), env.reset()
    optimizer = torch.optim.Adam(bbc.parameters(), lr=cfg.learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.05, cfg.rounds)
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.memory * cfg.steps * cfg.env.num_robots), batch_size=cfg.batch_size
    )
    with run_folder.abandoned_by_errors(folder), cli.interruptible() as interrupted:
        for number in range(cfg.rounds):
            act = label if number < cfg.teacher_rounds else partial(mean_action, bbc)
            with torch.no_grad():
                rows, carrier = collect(env, carrier, act, label, cfg, seeds.generator("noise"))
            found = "  ".join(f"{name} {value:.3f}" for name, value in errors(bbc, rows).items())
            print(f"round {number + 1:2d}: {found}", flush=True)
            replay.extend(rows)
            learn(bbc, replay, cfg.updates, optimizer)
            schedule.step()
            if interrupted():
                break
    env.close()
    known = first.artifact.manifest
    learned_from = dict.fromkeys(name for teacher in teachers for name in teacher.artifact.manifest["data"])
    manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=env.dt, data=list(learned_from))
    manifest |= {name: known[name] for name in ("network", "prior") if name in known}
    manifest["simulation"] = {"friction_loss": first.friction_loss}  # whatever --env says
    manifest["teachers"] = {
        name: teacher.artifact.manifest["weights"]["sha256"] for name, teacher in zip(BEHAVIOURS, teachers, strict=True)
    }
    Artifact.save(folder / "policy", bbc.state_dict(), manifest)
    print(f"saved {folder}")
    return folder


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_presets(PRESETS, doc=__doc__))
