"""Short windows of a robot log, which a simulator can replay: from the log's own states, with the log's own actions.

Each window starts from the state that the log shows, plays the logged actions, and is compared with what was measured
after every control step. A log holds neither trunk velocity nor trunk height, so both are estimated from the legs: feet
that bear the trunk stand still on the ground. Such a start state is not exact. Around impacts it is far off, so that
the errors have heavy tails and a sum of squares is a poor measure of them; elsewhere what it costs fades within some
steps, as soft contacts and joint controllers forget where they came from, and the first steps of a window therefore
need not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl import rotations
from agility_rl.collectors.easi import one_thread
from agility_rl.collectors.parameters import ParameterSpace
from agility_rl.collectors.robot_log import RobotLog
from agility_rl.collectors.rollout import START_ENTRIES
from agility_rl.go2 import constants, features, kinematics
from agility_rl.simulation import Simulator

LAYOUT = features.MEASUREMENT_LAYOUT
STANCE_SOFTNESS = 0.005
"""A foot this much higher than the lowest counts for a factor e less in the trunk's velocity [m]."""
SINK = 0.01
"""Depth of a loaded foot in the simulator's soft ground [m]: 6 mm standing, 10 to 12 mm in a trot (measured)."""
TINY = 1e-5
"""Step of the central difference that turns joint speeds into speeds of the feet [s]."""
SMOOTHING = (7, 3)
"""Rows and degree of the Savitzky-Golay filter for start states of noisy logs; 7 rows are 0.14 s."""
START_UNCERTAINTY = 0.05
"""Share of a channel's deviation that even the right model would miss, because start states are estimates."""
LARGEST_RESIDUAL = 10.0
"""Normalised residuals are clipped here: one fall must not outweigh the rest of a log."""


@dataclass(frozen=True)
class Windows:
    """Pieces of a robot log to predict.

    Source: no paper; the usual prediction error of system identification, on a robot whose base floats.

    Attributes:
        start: ``[W]``, estimated states, as ``Simulator.reset`` takes them.
        first: ``[W, 29]``, what the robot measured there.
        action: ``[W, H, 12]``, what it did [action units].
        measured: ``[W, H, 29]``, what the robot measured after each, latency taken out.
        scale: ``[29]``, expected error of a perfect model.
        skip: predictions of this many first steps do not count.
        control_dt: for how long each action was held [s].

    Example:
        >>> time = constants.CONTROL_DT * torch.arange(100, dtype=torch.float64)
        >>> log = RobotLog(
        ...     time=time, joint_position=torch.tensor(constants.DEFAULT_POSE).repeat(100, 1),
        ...     joint_velocity=torch.zeros(100, 12), roll_pitch=torch.zeros(100, 2),
        ...     angular_velocity=torch.zeros(100, 3), action=torch.sin(time)[:, None].repeat(1, 12).float(),
        ...     start=torch.zeros(100, dtype=torch.bool),
        ... )
        >>> windows = cut_windows(log, 5, skip=1)
        >>> len(windows), windows.target.shape
        (19, torch.Size([19, 5, 12]))
        >>> windows.residual(windows.measured).shape
        torch.Size([19, 4, 29])
    """

    start: TensorDict
    first: Tensor
    action: Tensor
    measured: Tensor
    scale: Tensor
    skip: int
    control_dt: float = constants.CONTROL_DT

    def __len__(self) -> int:
        return len(self.action)

    @property
    def steps(self) -> int:
        """Control steps of a window, H."""
        return self.action.shape[1]

    @property
    def target(self) -> Tensor:
        """Joint targets ``[W, H, 12]`` [rad], held for one control step each."""
        return torch.tensor(constants.DEFAULT_POSE) + torch.tensor(constants.ACTION_SCALE) * self.action

    def residual(self, predicted: Tensor, measured: Tensor | None = None) -> Tensor:
        """(Predicted - measured) / scale, clipped, ``[*B, H - skip, 29]``; the largest where a simulation diverged."""
        difference = (predicted - (self.measured if measured is None else measured)) / self.scale
        difference = difference[..., self.skip :, :]
        return difference.nan_to_num(LARGEST_RESIDUAL).clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL)

    def take(self, rows: Tensor) -> Windows:
        """Some of the windows."""
        return replace(
            self, start=self.start[rows], first=self.first[rows], action=self.action[rows], measured=self.measured[rows]
        )


@one_thread()
def cut_windows(log: RobotLog, steps: int, *, skip: int = 0, noise: float = 0.0, latency: int = 0) -> Windows:
    """Cut a log into windows that do not overlap and cross no reset.

    Args:
        log: the robot's own record.
        steps: control steps of a window, H.
        skip: predictions of this many first steps do not count.
        noise: factor on the half-widths of the sensors' known noise; with any, start states are smoothed.
        latency: known latency of the measurements in control steps; it is taken out.

    Raises:
        ValueError: if the lengths do not fit, or no window fits into the log.
    """
    if not 0 <= skip < steps:
        raise ValueError(f"expected 0 <= skip < window, got {skip} and {steps} control steps")
    if latency < 0:
        raise ValueError(f"expected a latency from 0, got {latency} control steps")
    needed = max(steps + 1, SMOOTHING[0] if noise else 0)
    measured = features.measurement(log.roll_pitch, log.angular_velocity, log.joint_position, log.joint_velocity)
    bounds = sorted({0, *log.start.nonzero()[:, 0].tolist(), len(log)})
    starts, firsts, actions, followings = [], [], [], []
    for first, last in pairwise(bounds):
        state, action = measured[first + latency : last], log.action[first:last]
        if len(state) < needed:
            continue
        start = smooth(state, log.control_dt) if noise else state
        for row in range(0, len(state) - steps, steps):
            starts.append(start[row])
            firsts.append(state[row])
            actions.append(action[row : row + steps])
            followings.append(state[row + 1 : row + steps + 1])
    if not starts:
        raise ValueError(f"{log.name}: expected {needed + latency} rows without a reset, found no such piece")
    missed = START_UNCERTAINTY * measured.std(0)
    deviation = noise * features.noise_scale(LAYOUT) / 3.0**0.5  # of uniform noise
    return Windows(
        estimate_states(torch.stack(starts)),
        torch.stack(firsts),
        torch.stack(actions),
        torch.stack(followings),
        (missed.square() + deviation.square()).sqrt().clamp_min(1e-6),
        skip,
        log.control_dt,
    )


def smooth(state: Tensor, dt: float = constants.CONTROL_DT) -> Tensor:
    """Savitzky-Golay filter on every channel of measurements ``[T, 29]``; joint speeds are slopes of the positions."""
    from scipy.signal import savgol_filter  # takes a second to import, which everyone else should not pay

    rows, degree = SMOOTHING
    smoothed = savgol_filter(state.numpy(), rows, degree, axis=0)
    position, velocity = (features.layout_slice(LAYOUT, name) for name in ("joint_position", "joint_velocity"))
    smoothed[:, velocity] = savgol_filter(state[:, position].numpy(), rows, degree, deriv=1, delta=dt, axis=0)
    return torch.from_numpy(smoothed).float()


def estimate_states(measured: Tensor) -> TensorDict:
    r"""Full states of measurements ``[W, 29]`` on flat ground, by leg odometry; yaw and horizontal position are 0.

    .. math:: v = -\sum_i w_i (\omega \times p_i + \dot p_i), \qquad h = r - s - \min_i z_i, \qquad
              w = \mathrm{softmax}(-z / 5\,\mathrm{mm})

    with feet :math:`p_i` in the base frame, their heights :math:`z_i` over the trunk's origin, radius r and sink s.
    """
    part = {entry.name: measured[:, features.layout_slice(LAYOUT, entry.name)] for entry in LAYOUT}
    roll, pitch = part["roll_pitch"].unbind(-1)
    upright = rotations.from_euler(roll, pitch, torch.zeros_like(roll))
    position, velocity = part["joint_position"].double(), TINY * part["joint_velocity"].double()
    feet = kinematics.forward(part["joint_position"])
    ahead, behind = kinematics.forward(position + velocity), kinematics.forward(position - velocity)
    speed = ((ahead - behind) / (2.0 * TINY)).float()
    speed = speed + torch.linalg.cross(part["angular_velocity"][:, None].expand_as(feet), feet)
    height = rotations.rotate(upright[:, None].expand(-1, feet.shape[1], -1), feet)[..., 2]
    bears = torch.softmax(-height / STANCE_SOFTNESS, -1)
    root_position = torch.zeros(len(measured), 3)
    root_position[:, 2] = constants.FOOT_RADIUS - SINK - height.amin(-1)
    return TensorDict(
        {
            "root_position": root_position,
            "root_quaternion": upright,
            "root_linear_velocity": rotations.rotate(upright, -(bears[..., None] * speed).sum(1)),
            "root_angular_velocity": part["angular_velocity"],
            "joint_position": part["joint_position"],
            "joint_velocity": part["joint_velocity"],
        },
        [len(measured)],
    )


@one_thread()
@torch.no_grad()
def predict(simulator: Simulator, space: ParameterSpace, individuals: Tensor, windows: Windows) -> Tensor:
    """Play all windows with every individual: a robot for each pair of them, as many at a time as there are robots.

    Args:
        simulator: its parameters and states are overwritten.
        space: what a search vector means.
        individuals: ``[P, D]``, search vectors.
        windows: what is played.

    Returns:
        ``[P, W, H, 29]``, the measurements predicted, NaN where the simulation diverged.

    Raises:
        ValueError: if the simulator holds an action for another time than the robot did.
    """
    if not math.isclose(windows.control_dt, simulator.control_dt):
        raise ValueError(
            f"the log holds an action for {windows.control_dt:g} s, the simulator for {simulator.control_dt:g} s; "
            "make one with this control period"
        )
    robots, values = simulator.num_simulations, space.denormalize(individuals)
    everyone, target = torch.ones(robots, dtype=torch.bool), windows.target
    # Everyone plays a window before the next begins: where robots are a multiple of individuals, every chunk has the
    # same parameters, and they are set once.
    pairs = torch.cartesian_prod(torch.arange(len(windows)), torch.arange(len(individuals)))
    predicted, present_ones = [], None
    for chunk in pairs.split(robots):
        # Robots left over by an incomplete chunk repeat its first pair; nobody looks at them.
        window, individual = torch.cat((chunk, chunk[:1].expand(robots - len(chunk), 2))).unbind(-1)
        if present_ones is None or not torch.equal(individual, present_ones):
            simulator.set_parameters(everyone, **space.fields(values[individual]))
            present_ones = individual
        simulator.reset(everyone, **{name: windows.start[name][window] for name in START_ENTRIES})
        steps, diverged = [], torch.zeros(robots, dtype=torch.bool)
        for held in target[window].unbind(1):
            simulator.step(held)
            diverged = diverged | simulator.unstable
            steps.append(torch.where(diverged[:, None], torch.nan, present(simulator)))
        predicted.append(torch.stack(steps, 1)[: len(chunk)])
    return torch.cat(predicted).unflatten(0, (len(windows), len(individuals))).transpose(0, 1)


def present(simulator: Simulator) -> Tensor:
    """What perfect sensors would measure now, ``[N, 29]``."""
    return measurement(
        simulator.root_quaternion,
        simulator.root_angular_velocity,
        simulator.joint_position,
        simulator.joint_velocity,
    )


def measurement(quaternion: Tensor, angular_velocity: Tensor, position: Tensor, velocity: Tensor) -> Tensor:
    """Measurements ``[*B, 29]`` of full states; the trunk's velocity has no part in them."""
    roll, pitch, _ = rotations.to_euler(quaternion)
    return features.measurement(torch.stack((roll, pitch), -1), angular_velocity, position, velocity)
