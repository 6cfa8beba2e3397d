"""Names, bounds and units of the physical parameters that a search may change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.simulation import PARAMETERS

GAINS = tuple(f"{link}_{gain}" for link in constants.LINKS for gain in ("stiffness", "damping"))
"""The six parameters of the paper: proportional and derivative gain of hip, thigh and calf (supplement S2)."""

NOMINAL_FIELDS: dict[str, tuple[float, ...]] = {
    "stiffness": (constants.STIFFNESS,) * 12,
    "damping": (constants.DAMPING,) * 12,
    "joint_damping": (constants.JOINT_DAMPING,) * 12,
    "armature": (constants.ARMATURE,) * 12,
    "friction_loss": (constants.FRICTION_LOSS,) * 12,
    "torque_limit": constants.TORQUE_LIMIT,
    "ground_friction": (1.0,),
    "trunk_mass_offset": (0.0,),
    "trunk_com_offset": (0.0, 0.0, 0.0),
    "action_delay": (0.0,),
}
"""Values of the model as it is built, of every field of :data:`agility_rl.simulation.PARAMETERS`."""

_OWN_RANGES: dict[str, dict[str, Any]] = {
    "trunk_mass_offset": {"low": -1.0, "high": 3.0, "minimum": -0.9 * constants.TRUNK_MASS},
    "trunk_com_offset": {"low": -0.1, "high": 0.1, "minimum": -0.15, "maximum": 0.15},
    "action_delay": {"low": 0.0, "high": constants.CONTROL_DT, "maximum": constants.CONTROL_DT},
}
"""Ranges of parameters whose nominal value is 0, where a multiple of it says nothing; they are linear."""


@dataclass(frozen=True)
class Parameter:
    """One number of a search and the entries of a simulator field that it sets.

    Attributes:
        name: unique in a space.
        field: one of :data:`agility_rl.simulation.PARAMETERS`.
        entries: indices into the field that all take this value.
        nominal: value of the model as it is built [unit of the field].
        low: lower end of the first search range; normalised 0.
        high: upper end; normalised 1.
        scale: ``"log"`` gives equal ratios equal distances, ``"linear"`` equal differences.
        minimum: smallest value that makes sense, whatever the first range is.
        maximum: largest.

    Raises:
        ValueError: if the field is unknown, an entry does not exist, or the ranges do not fit each other.
    """

    name: str
    field: str
    entries: tuple[int, ...]
    nominal: float
    low: float
    high: float
    scale: Literal["log", "linear"] = "log"
    minimum: float = 0.0
    maximum: float = math.inf

    def __post_init__(self) -> None:
        if self.field not in PARAMETERS:
            raise ValueError(f"{self.name}: unknown field {self.field!r}; expected one of {', '.join(PARAMETERS)}")
        if not self.entries or not set(self.entries) <= set(range(PARAMETERS[self.field][0])):
            raise ValueError(f"{self.name}: {self.field} has {PARAMETERS[self.field][0]} entries, got {self.entries}")
        if self.scale not in ("log", "linear"):
            raise ValueError(f"{self.name}: scale must be 'log' or 'linear', got {self.scale!r}")
        if not self.minimum <= self.low < self.high <= self.maximum:
            raise ValueError(
                f"{self.name}: expected minimum <= low < high <= maximum [{self.unit}], "
                f"got {self.minimum}, {self.low}, {self.high}, {self.maximum}"
            )
        if self.scale == "log" and self.low <= 0.0:
            raise ValueError(f"{self.name}: a logarithmic scale needs low > 0, got {self.low}; use scale='linear'")

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return PARAMETERS[self.field][1]

    @classmethod
    def named(cls, name: str, *, span: float = 3.0, **changes: Any) -> Parameter:
        """A parameter by its name: a field for all joints, or ``LINK_FIELD`` for the joints of hip, thigh or calf.

        The first range is [1/span, span] x nominal on a logarithmic scale; mass offset, centre-of-mass offset
        (``trunk_com_offset_x``, ``_y``, ``_z``) and action delay have linear ranges of their own.

        Source: range with span 3: EASI's sim-to-sim runs (method notes, section 6.3).

        Args:
            name: such as ``hip_stiffness``, ``armature``, ``calf_torque_limit``, ``ground_friction``.
            span: largest ratio to the nominal value in the first range.
            **changes: attributes to replace, such as ``low``, ``high``, ``scale``.

        Raises:
            ValueError: if there is no such parameter, or its joints have different nominal values.

        Example:
            >>> Parameter.named("hip_stiffness", high=80.0)
            Parameter(name='hip_stiffness', field='stiffness', entries=(0, 3, 6, 9), nominal=40.0, low=13.3...,
            high=80.0, scale='log', minimum=0.0, maximum=inf)
        """
        link, _, rest = name.partition("_")
        axis = name[-1] if name.startswith("trunk_com_offset_") and name[-2:] in ("_x", "_y", "_z") else ""
        if link in constants.LINKS and PARAMETERS.get(rest, (0,))[0] == constants.NUM_JOINTS:
            field, entries = rest, tuple(range(constants.LINKS.index(link), constants.NUM_JOINTS, 3))
        elif axis:
            field, entries = "trunk_com_offset", ("xyz".index(axis),)
        elif name in PARAMETERS and name != "trunk_com_offset":
            field, entries = name, tuple(range(PARAMETERS[name][0]))
        else:
            raise ValueError(
                f"unknown parameter {name!r}; expected one of {', '.join(PARAMETERS)}, with hip_, thigh_ or calf_ "
                "before a parameter of the joints, or trunk_com_offset_x, _y, _z"
            )
        values = {NOMINAL_FIELDS[field][index] for index in entries}
        if len(values) > 1:
            raise ValueError(f"{name} differs between joints; name hip_{name}, thigh_{name} and calf_{name} instead")
        nominal = values.pop()
        own: dict[str, Any] = {"scale": "linear", **_OWN_RANGES[field]} if field in _OWN_RANGES else {}
        ranges: dict[str, Any] = {"low": nominal / span, "high": nominal * span, **own, **changes}
        return cls(name, field, entries, nominal, **ranges)


class ParameterSpace:
    r"""Map search vectors to the fields of simulations, and back.

    Search vectors are normalised: 0 and 1 are the ends of the first range of every parameter, and a search may leave
    [0, 1] as far as the physical limits allow.

    .. math:: x = a + u (b - a) \quad\text{(linear)}, \qquad x = a (b / a)^u \quad\text{(logarithmic)}

    Source: supplement S2 (the six gains of :data:`GAINS`); that a common scale helps: method notes, section 6.5.

    Args:
        parameters: parameters, or names for :meth:`Parameter.named`; the six gains if none are given.
        span: first range of parameters given by name: [1/span, span] x nominal.
        base: fields ``[size]`` of the simulator whose values differ from :data:`NOMINAL_FIELDS`; entries that no
            parameter sets have these.

    Raises:
        ValueError: if there is no parameter, two set the same entry or have one name, or a base has another size.

    Example:
        >>> space = ParameterSpace()
        >>> space.names[:2], space.units[:2]
        (('hip_stiffness', 'hip_damping'), ('N m/rad', 'N m s/rad'))
        >>> values = space.denormalize(torch.full((1, 6), 0.5))
        >>> values[0, :2].round(decimals=3).tolist()
        [40.0, 1.0]
        >>> space.fields(values)["stiffness"].shape
        torch.Size([1, 12])
    """

    def __init__(
        self,
        parameters: Sequence[Parameter | str] = GAINS,
        *,
        span: float = 3.0,
        base: Mapping[str, Tensor | Sequence[float]] | None = None,
    ) -> None:
        self.parameters = tuple(Parameter.named(p, span=span) if isinstance(p, str) else p for p in parameters)
        set_entries = [(p.field, entry) for p in self.parameters for entry in p.entries]
        if not self.parameters:
            raise ValueError("a space needs at least one parameter")
        if len(set(self.names)) < len(self.names) or len(set(set_entries)) < len(set_entries):
            raise ValueError(f"two of the parameters {', '.join(self.names)} have one name or set the same joints")
        fields = {p.field for p in self.parameters}
        self.base = {f: torch.as_tensor((base or {}).get(f, NOMINAL_FIELDS[f]), dtype=torch.float64) for f in fields}
        for field, value in self.base.items():
            if tuple(value.shape) != (PARAMETERS[field][0],):
                raise ValueError(f"base {field} must be [{PARAMETERS[field][0]}], got {list(value.shape)}")

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in the order of every vector."""
        return tuple(p.name for p in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the physical values."""
        return tuple(p.unit for p in self.parameters)

    @property
    def nominal(self) -> Tensor:
        """Physical values of the model as it is built, float64 ``[D]``."""
        return self._attribute("nominal")

    @property
    def low(self) -> Tensor:
        """Lower ends of the first range, physical, float64 ``[D]``."""
        return self._attribute("low")

    @property
    def high(self) -> Tensor:
        """Upper ends of the first range, physical, float64 ``[D]``."""
        return self._attribute("high")

    @property
    def limits(self) -> tuple[Tensor, Tensor]:
        """Physical limits as normalised vectors ``[D]`` each, infinite where there is none: bounds of a search."""
        return self.normalize(self._attribute("minimum")), self.normalize(self._attribute("maximum"))

    def narrowed(self, low: Tensor | Sequence[float], high: Tensor | Sequence[float]) -> ParameterSpace:
        """The same parameters with another first range, physical ``[D]``."""
        bounds = zip(self.parameters, torch.as_tensor(low).tolist(), torch.as_tensor(high).tolist(), strict=True)
        return ParameterSpace([replace(p, low=a, high=b) for p, a, b in bounds], base=self.base)

    def denormalize(self, vectors: Tensor) -> Tensor:
        """Physical values, float64 ``[*B, D]``, of search vectors ``[*B, D]``; clipped to the physical limits.

        Raises:
            ValueError: if the vectors have another length.
        """
        u, low, high = self._checked(vectors), self.low, self.high
        ratio = torch.where(self._is_log, high / low, 1.0)
        values = torch.where(self._is_log, low * ratio**u, low + u * (high - low))
        return values.clamp(self._attribute("minimum"), self._attribute("maximum"))

    def normalize(self, values: Tensor) -> Tensor:
        """Search vectors, float64 ``[*B, D]``, of physical values ``[*B, D]``.

        Raises:
            ValueError: if the values have another length.
        """
        x, low, high = self._checked(values), self.low, self.high
        safe = torch.where(self._is_log, low, 1.0)
        logarithmic = (x / safe).log() / torch.where(self._is_log, high / safe, 2.0).log()
        return torch.where(self._is_log, logarithmic, (x - low) / (high - low))

    def fields(self, values: Tensor) -> dict[str, Tensor]:
        """Fields for ``Simulator.set_parameters``, float32 ``[N, size]`` each, of physical values ``[N, D]``."""
        values = self._checked(values)
        fields = {field: base.repeat(*values.shape[:-1], 1) for field, base in self.base.items()}
        for index, parameter in enumerate(self.parameters):
            fields[parameter.field][..., list(parameter.entries)] = values[..., index : index + 1]
        return {name: value.float() for name, value in fields.items()}

    def values(self, fields: Mapping[str, Tensor]) -> Tensor:
        """Physical values, float64 ``[N, D]``, in simulator fields ``[N, size]``; the inverse of :meth:`fields`.

        Raises:
            KeyError: if a field is missing.
            ValueError: if joints that share a parameter differ.
        """
        columns = []
        for parameter in self.parameters:
            entries = fields[parameter.field][..., list(parameter.entries)].double()
            if not torch.allclose(entries, entries[..., :1]):
                raise ValueError(f"{parameter.name} has no one value: {parameter.field} differs between its joints")
            columns.append(entries[..., 0])
        return torch.stack(columns, -1)

    @property
    def _is_log(self) -> Tensor:
        return torch.tensor([p.scale == "log" for p in self.parameters])

    def _attribute(self, name: str) -> Tensor:
        return torch.tensor([getattr(p, name) for p in self.parameters], dtype=torch.float64)

    def _checked(self, vectors: Tensor) -> Tensor:
        if vectors.shape[-1] != len(self):
            raise ValueError(f"expected [*B, {len(self)}] for {', '.join(self.names)}, got {list(vectors.shape)}")
        return vectors.double()
