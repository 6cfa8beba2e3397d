"""One robot, its ground and its scenery as a MuJoCo model: what every engine steps, and where things are in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import torch
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.go2.model import build_spec
from agility_rl.simulation.scenery import Piece, add_scenery, hinge_name
from agility_rl.simulation.terrain import HeightField

# The robot is the model's first tree, and its contact forces are the first sensors; scenery comes behind.
JOINTS, JOINT_SPEEDS = slice(7, 7 + constants.NUM_JOINTS), slice(6, 6 + constants.NUM_JOINTS)
FORCES = slice(0, 3 * len(constants.CONTACT_GROUPS))
_TERRAIN_MARGIN = 2.0
"""Robots start at least this far from the edge of a height field [m]."""


class World:
    """The model of one simulation.

    Args:
        control_dt: control step [s], a multiple of ``sim_dt``.
        sim_dt: physics step [s].
        terrain: height field instead of a plane.
        scenery: pieces that every simulation places for itself.
        **model_options: keyword arguments of :func:`agility_rl.go2.model.build_spec`.

    Attributes:
        spec: as it was compiled.
        model: compiled.
        substeps: physics steps of a control step.
        hinges: where the angles of the scenery's hinges are in ``qpos``.
        hinge_speeds: and their rates in ``qvel``.
        ground: shapes whose friction is the ground's.
        ground_extent: half side of the square in which robots may start [m].

    Raises:
        ValueError: if the steps do not fit each other, or a height field has no room to start in.

    Example:
        >>> World().substeps
        4
    """

    def __init__(
        self,
        *,
        control_dt: float = constants.CONTROL_DT,
        sim_dt: float = constants.SIM_DT,
        terrain: HeightField | None = None,
        scenery: Sequence[Piece] = (),
        **model_options: Any,
    ) -> None:
        substeps = control_dt / sim_dt
        if abs(substeps - round(substeps)) > 1e-6 or round(substeps) < 1:
            raise ValueError(f"control_dt must be a multiple of sim_dt, got {control_dt} and {sim_dt} s")
        self.control_dt, self.sim_dt, self.substeps = control_dt, sim_dt, round(substeps)
        self.ground_extent = 0.0 if terrain is None else min(terrain.half_size) - _TERRAIN_MARGIN
        if terrain is not None:
            if self.ground_extent <= 0.0:
                raise ValueError(
                    f"a height field must reach farther than {_TERRAIN_MARGIN} m from its middle, got half sides of "
                    f"{terrain.half_size} m"
                )
            model_options |= {"heights": terrain.heights.numpy(), "height_field_size": terrain.half_size}
        self.scenery: Sequence[Piece] = tuple(scenery)
        self.spec = build_spec(sim_dt=sim_dt, **model_options)
        add_scenery(self.spec, self.scenery)
        self.model: mujoco.MjModel = self.spec.compile()
        hinges = [self.model.joint(hinge_name(piece)) for piece in self.scenery if piece.hinge is not None]
        self.hinges = [int(joint.qposadr[0]) for joint in hinges]
        self.hinge_speeds = [int(joint.dofadr[0]) for joint in hinges]
        bodies = {name for piece in self.scenery for name in (piece.name, f"{piece.name}/moving")}
        geoms = (self.model.geom(index) for index in range(self.model.ngeom))
        self.ground = [
            geom.id for geom in geoms if geom.name == "floor" or self.model.body(geom.bodyid[0]).name in bodies
        ]

    def check_places(
        self, mask: Tensor, position: Tensor, quaternion: Tensor, hinge_angle: Tensor, *, finite: bool = True
    ) -> None:
        """Refuse places of the scenery that are none.

        Args:
            mask: bool ``[N]``, rows that count.
            position: ``[N, P, 3]``.
            quaternion: ``[N, P, 4]``.
            hinge_angle: ``[N, H]``.
            finite: look for NaN too, for which a GPU has to be waited for.

        Raises:
            ValueError: if a shape is another or a number is not finite.
        """
        n, pieces = len(mask), len(self.scenery)
        for name, value, shape in (
            ("position", position, (n, pieces, 3)),
            ("quaternion", quaternion, (n, pieces, 4)),
            ("hinge_angle", hinge_angle, (n, len(self.hinges))),
        ):
            if tuple(value.shape) != shape:
                raise ValueError(f"{name} of the scenery must be {list(shape)}, got {list(value.shape)}")
            if finite and not bool(torch.isfinite(value[mask]).all()):
                raise ValueError(f"{name} of the scenery is not finite; look for NaN in what it comes from")


def check_target(target: Tensor, num_simulations: int) -> None:
    """Refuse joint targets that are not ``[N, 12]``.

    Raises:
        ValueError: naming both shapes.
    """
    shape = (num_simulations, constants.NUM_JOINTS)
    if tuple(target.shape) != shape:
        raise ValueError(f"target must be {list(shape)}, got {list(target.shape)}")


def check_finite(rows: Tensor, *states: Tensor) -> None:
    """Refuse states ``[M, ...]`` of rows ``[M]`` with NaN or infinity in them.

    Raises:
        ValueError: naming the rows.
    """
    sound = torch.isfinite(torch.cat(states, -1)).all(-1)
    if not bool(sound.all()):
        named = rows[~sound].tolist()
        raise ValueError(f"the states of rows {named[:8]} are not finite; look for NaN in what they come from")
