"""A robot log and the searched gains as MuJoCo's own identification toolbox, ``mujoco.sysid``, takes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco import sysid
from torch import Tensor

from agility_rl.collectors import ParameterSpace, Windows
from agility_rl.collectors.parameters import Parameter
from agility_rl.collectors.rollout import START_ENTRIES
from agility_rl.collectors.windows import measurement
from agility_rl.go2 import constants

FURTHEST = 30.0
"""``mujoco.sysid`` needs finite bounds: this ratio to the nominal value, where a search without bounds has none."""


def toolbox_parameters(space: ParameterSpace, bounds: tuple[Tensor, Tensor]) -> sysid.ParameterDict:
    """Search coordinates as parameters of the toolbox; it starts from the centre of the first range."""
    nearest, furthest = (space.normalize(space.nominal * ratio) for ratio in (1.0 / FURTHEST, FURTHEST))
    low, high = torch.maximum(nearest, bounds[0]), torch.minimum(furthest, bounds[1])

    def setter(entry: Parameter) -> Callable[[Any, sysid.Parameter], None]:
        alone = ParameterSpace([entry])
        change = sysid.apply_pgain if entry.field == "stiffness" else sysid.apply_dgain

        def write(spec: Any, parameter: sysid.Parameter) -> None:
            value = alone.denormalize(torch.from_numpy(parameter.value)).item()
            for joint in entry.entries:
                change(spec, constants.ACTUATOR_NAMES[joint], value)

        return write

    found = sysid.ParameterDict()
    for entry, least, most in zip(space.parameters, low.tolist(), high.tolist(), strict=True):
        found[entry.name] = sysid.Parameter(entry.name, 0.5, least, most, modifier=setter(entry))
    return found


def toolbox_trajectories(model: mujoco.MjModel, windows: Windows) -> list[sysid.SystemTrajectory]:
    """Every window as the toolbox takes it: a control for every physics step, a measurement for every control step."""
    substeps = round(constants.CONTROL_DT / model.opt.timestep)
    # The toolbox drops the last control, because it expects one for the last measurement too.
    controls = windows.target.double().repeat_interleave(substeps, 1)
    controls = torch.cat((controls, controls[:, -1:]), 1)
    times = model.opt.timestep * np.arange(controls.shape[1])
    ends = constants.CONTROL_DT * np.arange(1, windows.steps + 1)
    names = {"measurement": (sysid.SignalType.CustomObs, np.arange(windows.measured.shape[-1]))}
    start = {name: windows.start[name].double() for name in START_ENTRIES}
    qpos = torch.cat([start[name] for name in ("root_position", "root_quaternion", "joint_position")], -1).numpy()
    qvel = torch.cat(
        [start[name] for name in ("root_linear_velocity", "root_angular_velocity", "joint_velocity")], -1
    ).numpy()
    return [
        sysid.SystemTrajectory(
            model=model,
            control=sysid.TimeSeries(times, control),
            sensordata=sysid.TimeSeries(ends, measured, names),
            initial_state=sysid.create_initial_state(model, position, velocity),
            state=None,
        )
        for control, measured, position, velocity in zip(
            controls.numpy(), windows.measured.double().numpy(), qpos, qvel, strict=True
        )
    ]


def toolbox_comparison(windows: Windows) -> Callable[..., Any]:
    """The residual of one roll-out of the toolbox: that of CMA-ES, from states at the ends of control steps."""

    def compare(
        parameters: sysid.ParameterDict,
        predicted: sysid.TimeSeries,
        measured: sysid.TimeSeries,
        model: mujoco.MjModel,
        return_all: bool,
        *,
        state: np.ndarray,
    ) -> tuple[np.ndarray, sysid.TimeSeries, sysid.TimeSeries]:
        substeps = round(constants.CONTROL_DT / model.opt.timestep)
        qpos, qvel = torch.from_numpy(state[substeps - 1 :: substeps, 1:].copy()).split((model.nq, model.nv), -1)
        guess = measurement(qpos[:, 3:7], qvel[:, 3:6], qpos[:, 7:], qvel[:, 6:])
        difference = windows.residual(guess, torch.from_numpy(measured.data))
        return difference.numpy(), measured, measured

    return compare
