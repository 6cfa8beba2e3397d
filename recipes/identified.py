"""Simulators read from files: what a search found (``result.json``), or the known truth of a recorded log."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agility_rl.collectors import ParameterSpace
from agility_rl.collectors.parameters import Parameter
from agility_rl.envs.randomization import NOMINAL, Randomization
from agility_rl.go2 import constants


@dataclass(frozen=True)
class SimulatorFile:
    """A distribution of simulators.

    Attributes:
        draw: fields for ``Simulator.set_parameters`` of a number of robots.
        model: options of the model that differ from its defaults, such as the friction of the joints.
        text: for people.
    """

    draw: Callable[[int, torch.Generator], dict[str, Tensor]]
    model: Mapping[str, Any]
    text: str

    @property
    def randomization(self) -> Randomization:
        """These simulators for an environment; what they leave open is nominal."""
        return replace(NOMINAL, draw=self.draw)

    def one_robot(self, stiffness: Sequence[float], damping: Sequence[float]) -> dict[str, Any]:
        """Options of a :class:`agility_rl.deploy.simulated.SimulatedRobot` that is commanded with some gains.

        Gains that the file leaves open are nominal.

        Raises:
            ValueError: if something differs that a simulated robot cannot have.
        """
        drawn = self.draw(1, torch.Generator().manual_seed(0))
        if extra := set(drawn) - {"stiffness", "damping"}:
            raise ValueError(f"expected a simulator that differs in stiffness and damping only, got {sorted(extra)}")
        nominal = {"stiffness": constants.STIFFNESS, "damping": constants.DAMPING}
        true = {name: drawn.get(name, torch.full((1, constants.NUM_JOINTS), gain))[0] for name, gain in nominal.items()}
        commanded = {"stiffness": torch.tensor(stiffness), "damping": torch.tensor(damping)}
        return {f"{name}_factor": (true[name] / commanded[name]).tolist() for name in nominal} | dict(self.model)


def load_simulator(path: Path) -> SimulatorFile:
    """Read ``result.json`` of ``easi.py`` (a Gaussian) or ``NAME.truth.json`` of ``record_log.py`` (one simulator).

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is neither, or damaged.
    """
    path = path / "result.json" if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected result.json of easi.py or NAME.truth.json of record_log.py, no file")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        parameters = content["parameters"]
        return _found(content, parameters) if "search" in content else _truth(content, parameters)
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError) as error:  # bad JSON is a ValueError too
        raise ValueError(f"{path} is damaged, or no result of easi.py nor truth of record_log.py: {error}") from error


def _found(content: Mapping[str, Any], parameters: Mapping[str, Any]) -> SimulatorFile:
    search, model = content["search"], content.get("model", {})
    named = [Parameter.named(name, **search["ranges"][name]) for name in parameters]
    space = ParameterSpace(named, base=known_fields(model))
    mean = torch.tensor(search["mean"], dtype=torch.float64)
    values, vectors = torch.linalg.eigh(torch.tensor(search["covariance"], dtype=torch.float64))
    root = vectors * values.clamp_min(0.0).sqrt()

    def draw(count: int, generator: torch.Generator) -> dict[str, Tensor]:
        shape, device = (count, len(mean)), generator.device
        normal = torch.randn(shape, generator=generator, dtype=torch.float64, device=device).cpu()
        return _there(space.fields(space.denormalize(mean + normal @ root.mT)), device)

    return SimulatorFile(draw, model, _describe(parameters, "mean"))


def _truth(content: Mapping[str, Any], parameters: Mapping[str, Any]) -> SimulatorFile:
    model = dict(content["recording"]["model"])
    space = ParameterSpace(tuple(parameters), base=known_fields(model))
    values = torch.tensor([[float(entry["value"]) for entry in parameters.values()]], dtype=torch.float64)

    def draw(count: int, generator: torch.Generator) -> dict[str, Tensor]:
        return _there(space.fields(values.expand(count, -1)), generator.device)

    return SimulatorFile(draw, model, _describe(parameters, "value"))


def known_fields(model: Mapping[str, Any]) -> dict[str, list[float]]:
    """What joints have that no parameter of a space sets: the dry friction of the model, if it says one."""
    return {"friction_loss": [model["friction_loss"]] * constants.NUM_JOINTS} if "friction_loss" in model else {}


def _there(fields: Mapping[str, Tensor], device: torch.device) -> dict[str, Tensor]:
    return {name: value.to(device) for name, value in fields.items()}


def _describe(parameters: Mapping[str, Any], key: str) -> str:
    return ", ".join(f"{name} {float(entry[key]):.4g} {entry['unit']}" for name, entry in parameters.items())
