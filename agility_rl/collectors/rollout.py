"""Roll-outs of a policy in bare simulations, where only what a robot measures reaches it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.collectors.sensors import RobotSensors
from agility_rl.envs.terminations import TERMINATION_FORCE
from agility_rl.go2 import constants, features
from agility_rl.simulation import Simulator

MeasuredPolicy = Callable[[TensorDictBase], Tensor]
"""``measured [N] -> action [N, 12]``. The TensorDict has ``roll_pitch`` [N, 2], ``angular_velocity`` [N, 3],
``joint_position``, ``joint_velocity``, ``action`` (the last one) [N, 12], ``foot_contact`` bool [N, 4], and ``is_init``
bool [N, 1], true where a robot has just been reset."""

START_ENTRIES = (
    "root_position",
    "root_quaternion",
    "root_linear_velocity",
    "root_angular_velocity",
    "joint_position",
    "joint_velocity",
)


def standing_states(height: float = constants.STANDING_HEIGHT) -> TensorDict:
    """One start state: standing in the default pose, as ``Simulator.reset`` takes it.

    Example:
        >>> standing_states()["joint_position"].shape
        torch.Size([1, 12])
    """
    return TensorDict(
        {
            "root_position": torch.tensor([[0.0, 0.0, height]]),
            "root_quaternion": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            "root_linear_velocity": torch.zeros(1, 3),
            "root_angular_velocity": torch.zeros(1, 3),
            "joint_position": torch.tensor([constants.DEFAULT_POSE]),
            "joint_velocity": torch.zeros(1, constants.NUM_JOINTS),
        },
        [1],
    )


def fallen(simulator: Simulator) -> Tensor:
    """Bool ``[N]``: trunk (head included) or a hip presses on something (as environments end an episode)."""
    force = simulator.contact_force[:, [constants.TRUNK_GROUP, *constants.HIP_GROUPS]]
    return (force > TERMINATION_FORCE).any(-1)


def roll_out(
    simulator: Simulator,
    policy: MeasuredPolicy,
    num_steps: int,
    *,
    sensors: RobotSensors,
    generator: torch.Generator,
    start: TensorDictBase | None = None,
    failure: Callable[[Simulator], Tensor] = fallen,
) -> TensorDict:
    """Let every robot act for a number of control steps and keep its transitions.

    A robot that falls, or whose simulation diverges, goes back to a start state after that step. The following state
    of a transition is what was measured *before* the reset, so that no transition crosses one. Transitions in which
    the engine diverged, or which are not finite, are masked, with the state repeated in place of what followed: the
    engine replaces such a state on its own.

    Source: Algorithm S2, lines 5 to 8.

    Args:
        simulator: N robots.
        policy: from measurements to actions.
        num_steps: T.
        sensors: what the robots measure; reset here.
        generator: draws the start states.
        start: states ``[M]`` with the entries and frames of ``Simulator.reset``, drawn uniformly; by default standing.
        failure: when a robot is put back.

    Returns:
        TensorDict ``[N, T]``: ``measurement`` [29], ``action`` [12], ``is_init`` bool [1] (first step after a reset),
        ``("next", "measurement")``, ``("next", "fallen")``, ``("next", "unstable")`` bool [1], and
        ``("collector", "mask")`` bool, which losses and :meth:`EASICollector.score` honour.

    Raises:
        ValueError: if there is no step, start states lack an entry, or an action has another shape or is not finite.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1, got {num_steps}")
    start = standing_states() if start is None else start
    if missing := set(START_ENTRIES) - set(start.keys()):
        raise ValueError(f"start states lack {', '.join(sorted(missing))}; they have {sorted(start.keys())}")
    start = start.select(*START_ENTRIES)
    n, size = simulator.num_simulations, features.NUM_MEASUREMENT
    pose, scale = torch.tensor(constants.DEFAULT_POSE), torch.tensor(constants.ACTION_SCALE)
    states, following = torch.empty(num_steps, n, size), torch.empty(num_steps, n, size)
    actions = torch.empty(num_steps, n, constants.NUM_JOINTS)
    first, down, diverged, valid = (torch.empty(num_steps, n, dtype=torch.bool) for _ in range(4))

    is_init = torch.ones(n, dtype=torch.bool)
    action = torch.zeros(n, constants.NUM_JOINTS)
    reading = _place(simulator, sensors, start, is_init, generator)
    for step in range(num_steps):
        action = _checked(policy(_measured(reading, action, is_init)), n, step)
        states[step], actions[step], first[step] = reading[:, :size], action, is_init
        simulator.step(pose + scale * action)
        reading = sensors.read(simulator)
        finite = reading.isfinite().all(-1)
        down[step], diverged[step], valid[step] = failure(simulator), simulator.unstable, finite & ~simulator.unstable
        following[step] = torch.where(valid[step][:, None], reading[:, :size], states[step])
        is_init = down[step] | ~valid[step]
        if bool(is_init.any()):
            reading = _place(simulator, sensors, start, is_init, generator)
            action = action.masked_fill(is_init[:, None], 0.0)

    def rows(entry: Tensor) -> Tensor:
        return entry.transpose(0, 1)

    return TensorDict(
        {
            keys.MEASUREMENT: rows(states),
            keys.ACTION: rows(actions),
            "is_init": rows(first)[..., None],
            "next": TensorDict(
                {
                    keys.MEASUREMENT: rows(following),
                    "fallen": rows(down)[..., None],
                    "unstable": rows(diverged)[..., None],
                },
                [n, num_steps],
            ),
            "collector": TensorDict({"mask": rows(valid)}, [n, num_steps]),
        },
        [n, num_steps],
        names=[None, "time"],
    )


def _place(
    simulator: Simulator, sensors: RobotSensors, start: TensorDictBase, mask: Tensor, generator: torch.Generator
) -> Tensor:
    """Put the masked robots into drawn start states; the readings of all."""
    # One draw for every robot, whoever is reset, so that a robot's draws do not depend on how many fall with it.
    chosen = torch.randint(len(start), (simulator.num_simulations,), generator=generator)
    simulator.reset(mask, **{name: start[name][chosen] for name in START_ENTRIES})
    return sensors.reset(simulator, mask)


def _measured(reading: Tensor, action: Tensor, is_init: Tensor) -> TensorDict:
    layout = features.MEASUREMENT_LAYOUT
    entries = {entry.name: reading[:, features.layout_slice(layout, entry.name)] for entry in layout}
    entries["foot_contact"] = reading[:, features.NUM_MEASUREMENT :] > 0.5
    return TensorDict({**entries, keys.ACTION: action, "is_init": is_init[:, None]}, [len(reading)])


def _checked(action: Tensor, num_robots: int, step: int) -> Tensor:
    if tuple(action.shape) != (num_robots, constants.NUM_JOINTS):
        raise ValueError(f"the policy must return [{num_robots}, {constants.NUM_JOINTS}], got {list(action.shape)}")
    if not bool(action.isfinite().all()):
        rows = (~action.isfinite().all(-1)).nonzero()[:, 0].tolist()
        raise ValueError(f"the policy's actions of robots {rows[:8]} are not finite in step {step}")
    return action.detach()
