"""Parameters that may differ between simulations: names, and where each lives in a MuJoCo model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agility_rl.simulation.simulator import PARAMETERS
from agility_rl.simulation.world import JOINT_SPEEDS, World

FIELDS = (
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "geom_friction",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "dof_damping",
    "dof_armature",
    "dof_frictionloss",
)
"""Fields of the model that they live in."""
_INERTIAL = {"trunk_mass_offset", "trunk_com_offset", "armature"}
"""After these, the engine has to compute other fields anew."""
_OF_JOINTS = {"joint_damping": "dof_damping", "armature": "dof_armature", "friction_loss": "dof_frictionloss"}


class SimulationParameters:
    """Values of :data:`agility_rl.simulation.PARAMETERS` in ``N`` simulations, written to the fields of their models.

    Args:
        world: the model as it was compiled, whose values are the nominal ones.
        num_simulations: N.
        field: gives a model field as a tensor ``[N, ...]`` to write into.
        device: of the values.

    Attributes:
        values: what was set, ``[N, size]`` each.
        delay: ``[N]``, physics steps by which targets come late; ``None`` if nothing is late.

    Example:
        >>> world = World()
        >>> gains = torch.zeros(2, 12, 10)
        >>> parameters = SimulationParameters(world, 2, lambda name: gains)
        >>> parameters.value("stiffness")[0, 0]
        tensor(40.)
    """

    def __init__(
        self, world: World, num_simulations: int, field: Callable[[str], Tensor], device: torch.device | str = "cpu"
    ) -> None:
        self.world, self.num_simulations, self.device = world, num_simulations, torch.device(device)
        self.values: dict[str, Tensor] = {}
        self.delay: Tensor | None = None
        self._field = field

    def set(self, mask: Tensor, fields: Mapping[str, Tensor]) -> bool:
        """Change parameters in the rows of a bool mask; whether the engine has to compute other fields anew.

        Raises:
            ValueError: if a parameter is unknown, has a wrong shape, or a delay is too long.
        """
        for name, value in fields.items():
            if name not in PARAMETERS:
                raise ValueError(f"unknown parameter {name!r}; expected one of {', '.join(PARAMETERS)}")
            shape = (self.num_simulations, PARAMETERS[name][0])
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} must be {list(shape)}, got {list(value.shape)}")
        for name, value in fields.items():
            changed = torch.where(mask[:, None], value.float(), self.value(name))
            self._write(name, mask, changed)
            self.values[name] = changed
        return bool(_INERTIAL & set(fields))

    def value(self, name: str) -> Tensor:
        """Present value ``[N, size]``, as a copy."""
        return self.values[name].clone() if name in self.values else self.nominal(name)

    def nominal(self, name: str) -> Tensor:
        """Value ``[N, size]`` in the model as it was compiled."""
        model, size = self.world.model, PARAMETERS[name][0]
        if name in _OF_JOINTS:
            value = getattr(model, _OF_JOINTS[name])[JOINT_SPEEDS]
        elif name == "stiffness":
            value = model.actuator_gainprm[:, 0]
        elif name == "damping":
            value = -model.actuator_biasprm[:, 2]
        elif name == "torque_limit":
            value = model.actuator_forcerange[:, 1]
        elif name == "ground_friction":
            value = model.geom("floor").friction[:1]
        else:  # offsets and the delay
            value = np.zeros(size)
        row = torch.as_tensor(np.array(value), dtype=torch.float32, device=self.device).reshape(1, size)
        return row.repeat(self.num_simulations, 1)

    def _write(self, name: str, rows: Tensor, value: Tensor) -> None:
        model = self.world.model
        trunk = model.body("trunk").id
        if name == "stiffness":
            self._put("actuator_gainprm", rows, value, ..., 0)
            self._put("actuator_biasprm", rows, -value, ..., 1)
        elif name == "damping":
            self._put("actuator_biasprm", rows, -value, ..., 2)
        elif name == "torque_limit":
            self._put("actuator_forcerange", rows, -value, ..., 0)
            self._put("actuator_forcerange", rows, value, ..., 1)
        elif name == "ground_friction":
            self._put("geom_friction", rows, value, self.world.ground, 0)
        elif name == "trunk_mass_offset":
            mass = model.body_mass[trunk] + value[:, 0].double()
            self._put("body_mass", rows, mass, trunk)
            inertia = torch.tensor(model.body_inertia[trunk], device=self.device)
            self._put("body_inertia", rows, inertia * (mass / model.body_mass[trunk])[:, None], trunk)
        elif name == "trunk_com_offset":
            centre = torch.tensor(model.body_ipos[trunk], device=self.device)
            self._put("body_ipos", rows, centre + value.double(), trunk)
        elif name == "action_delay":
            steps = (value[:, 0] / self.world.sim_dt).round().long()
            if bool(((steps < 0) | (steps > self.world.substeps)).any()):
                raise ValueError(f"action_delay must be from 0 to one control step, {self.world.control_dt} s")
            self.delay = steps if bool(steps.any()) else None
        else:
            self._put(_OF_JOINTS[name], rows, value, JOINT_SPEEDS)

    def _put(self, name: str, rows: Tensor, value: Tensor, *part: Any) -> None:
        """Write into a part of a field; without indexing by rows, which would make a GPU wait."""
        field = self._field(name)
        present = field[:, *part]
        chosen = rows.reshape(-1, *[1] * (present.dim() - 1))
        field[:, *part] = torch.where(chosen, value.to(field.dtype), present)
