"""Record a robot log in a simulator whose parameters are known, so that a search can be judged.

Source: Fu et al. 2025, supplement S2 (4,000 steps at 50 Hz of the pre-trained BBC, or of any other controller).

In:  a run or artifact folder of a BBC (``--policy RUN``); without one, a trot that is played without feedback.
Out: the log (MCAP, CSV or npz by its ending; see ``agility_rl/collectors/log_formats.py``) and, beside it,
     ``NAME.truth.json`` with the parameters and how the log was made. Nothing is ever overwritten.

    python recipes/record_log.py --log logs/target.mcap --policy runs/my_run --truth.hip-stiffness 1.3
    python recipes/record_log.py --log logs/target.mcap --draw --seed 3 --noise 1 --latency 1

Presets: ``paper`` (80 s, the default), ``smoke`` (4 s).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from log_policy import make_actor

from agility_rl.collectors import GAINS, ParameterSpace, RobotLog, record_robot_log
from agility_rl.collectors.log_formats import SUFFIXES
from agility_rl.simulation import make_simulator
from agility_rl.training import cli, run_folder
from agility_rl.training.seeding import seed_everything


@dataclass(frozen=True)
class Truth:
    """Multiples of the nominal values; not given, a value is nominal, or drawn where ``--draw`` is given."""

    hip_stiffness: float | None = None
    hip_damping: float | None = None
    thigh_stiffness: float | None = None
    thigh_damping: float | None = None
    calf_stiffness: float | None = None
    calf_damping: float | None = None
    joint_damping: float | None = None
    armature: float | None = None
    friction_loss: float | None = None
    hip_torque_limit: float | None = None
    thigh_torque_limit: float | None = None
    calf_torque_limit: float | None = None
    ground_friction: float | None = None
    trunk_mass_offset: float | None = None
    """Not a multiple: kilograms."""
    action_delay: float | None = None
    """Not a multiple: seconds, at most one control step."""


@dataclass(frozen=True)
class Config:
    log: Path | None = None
    """File to write; its ending (.mcap, .csv, .npz) says how."""
    steps: int = 4000
    """Rows: 80 s at 50 Hz (supplement S2)."""
    policy: Path | None = None
    """Run or artifact folder of a BBC; an open-loop trot without one."""
    behaviours: tuple[str, ...] = ("pace", "trot")
    """What the BBC is told to do, each turning left and right, in turn. A slow walk tells little about damping."""
    command_seconds: float = 1.0
    """Time between two commands."""
    truth: Truth = field(default_factory=Truth)
    draw: bool = False
    """Draw the six gains that are not given, log-uniformly from [1/span, span] x nominal."""
    span: float = 3.0
    """Range of ``--draw`` (targets of EASI's sim-to-sim runs: method notes, section 6.3)."""
    noise: float = 0.0
    """Factor on the half-widths of the measurement noise of the released code (method notes, section 3.2)."""
    latency: int = 0
    """Control steps by which measurements are late."""
    friction_loss: float | None = None
    """Dry friction of the joints before ``--truth.friction-loss`` [N m]; as the policy was trained when not given."""
    contact_time: float = 0.02
    """Time constant of contacts with the ground [s]; another than the search's is a mismatch it cannot express."""
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    """Friction cone of the engine; likewise."""
    seed: int = 0
    """Of the draw and the noise."""


PRESETS = {"paper": Config(), "smoke": Config(steps=200)}


def parameters(cfg: Config, generator: torch.Generator) -> dict[str, dict[str, float | str | None]]:
    """Value, unit and multiple of the nominal value of the six gains and of everything else that was given.

    Raises:
        ValueError: if a value is out of its physical range.
    """
    given = {name: value for name, value in dataclasses.asdict(cfg.truth).items() if value is not None}
    space = ParameterSpace([*GAINS, *(name for name in given if name not in GAINS)])
    # One draw for every gain, used or not, so that fixing one does not change the others.
    drawn = torch.rand(len(GAINS), generator=generator, dtype=torch.float64) * 2.0 - 1.0
    multiples = dict(zip(GAINS, (cfg.span**drawn).tolist() if cfg.draw else [1.0] * len(GAINS), strict=True)) | given
    truth: dict[str, dict[str, float | str | None]] = {}
    for entry in space.parameters:
        multiple = multiples[entry.name]
        value = multiple * entry.nominal if entry.nominal else multiple
        if not (math.isfinite(value) and entry.minimum <= value <= entry.maximum):
            raise ValueError(
                f"--truth.{entry.name.replace('_', '-')} makes {value:g} {entry.unit}, expected {entry.minimum:g} to "
                f"{entry.maximum:g}"
            )
        truth[entry.name] = {"value": value, "unit": entry.unit, "multiple": multiple if entry.nominal else None}
    return truth


def main(cfg: Config) -> Path:
    """Record, check by reading back, write the truth; returns the log."""
    if cfg.log is None or cfg.log.suffix not in SUFFIXES:
        raise ValueError(f"give --log FILE with a file that ends in {', '.join(SUFFIXES)}")
    truth_file = cfg.log.with_suffix(".truth.json")
    for file in (cfg.log, truth_file):
        if file.exists():
            raise FileExistsError(f"{file} already exists; choose another name for the log")
    if cfg.span < 1.0 or cfg.noise < 0.0:
        raise ValueError(f"expected --span of at least 1 and --noise of at least 0, got {cfg.span} and {cfg.noise}")
    seeds = seed_everything(cfg.seed)
    truth = parameters(cfg, seeds.generator("truth"))
    actor = make_actor(cfg.policy, cfg.behaviours, cfg.command_seconds)
    friction = actor.friction_loss if cfg.friction_loss is None else cfg.friction_loss
    model: dict[str, Any] = {"friction_loss": friction, "contact_time": cfg.contact_time, "cone": cfg.cone}
    simulator = make_simulator(num_simulations=1, num_threads=1, **model)
    space = ParameterSpace(tuple(truth))
    values = torch.tensor([[entry["value"] for entry in truth.values()]], dtype=torch.float64)
    simulator.set_parameters(torch.ones(1, dtype=torch.bool), **space.fields(values))
    log = record_robot_log(
        simulator,
        actor.policy,
        cfg.steps,
        generator=seeds.generator("log"),
        noise=cfg.noise,
        latency=cfg.latency,
    )
    simulator.close()
    log.save(cfg.log)
    recording = {
        "policy": actor.name,
        "behaviours": cfg.behaviours,
        "command_seconds": cfg.command_seconds,
        "friction_loss": friction,
        "noise": cfg.noise,
        "latency": cfg.latency,
        "model": model,
    }
    record = {"parameters": truth, "recording": recording, "config": cfg, "versions": run_folder.versions()}
    run_folder.write_json(truth_file, run_folder.to_json(record))
    falls = int(RobotLog.load(cfg.log).start.sum()) - 1
    print(f"{cfg.log}: {len(log)} rows, {len(log) * log.control_dt:.0f} s, put back {falls} times after a fall")
    print(
        f"{truth_file}: " + ", ".join(f"{name} {entry['value']:.4g} {entry['unit']}" for name, entry in truth.items())
    )
    return cfg.log


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_presets(PRESETS, default="paper", doc=__doc__))
