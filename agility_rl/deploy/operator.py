"""A person at the controls: keys and sticks in, a behaviour command and a requested mode out; no device, no screen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from agility_rl import behaviours, rotations
from agility_rl.deploy.commander import BehaviourCommand, Commander, Perception
from agility_rl.deploy.controller import SINK_SECONDS, Controller, Mode, StepRecord
from agility_rl.deploy.transport import RobotState
from agility_rl.go2 import constants, features, kinematics

STEPS: dict[str, tuple[float, float, float]] = {
    "up": (0.1, 0.0, 0.0),
    "down": (-0.1, 0.0, 0.0),
    "a": (0.0, 0.1, 0.0),
    "d": (0.0, -0.1, 0.0),
    "left": (0.0, 0.0, 0.2),
    "right": (0.0, 0.0, -0.2),
}
"""What a key adds to the wished velocity: forward [m/s], to the left [m/s], turning to the left [rad/s]; ours."""
GIVE_BACK, STOP, GO_ON = "space", "escape", "enter"
BEHAVIOUR_KEYS = {str(index + 1): name for index, name in enumerate(behaviours.BEHAVIOURS)}
"""Number keys, in the order of :data:`agility_rl.behaviours.BEHAVIOURS`."""
NEXT_MODE: dict[Mode, Mode] = {
    Mode.DAMPING: Mode.PASSIVE,
    Mode.PASSIVE: Mode.STAND_UP,
    Mode.READY: Mode.RUN,
    Mode.RUN: Mode.STAND_UP,
}
"""What the key to go on asks for; standing up leads to ``ready`` by itself."""
SHOW_EVERY = 2
"""Control steps between two looks of the operator at the robot."""


class Stick(NamedTuple):
    """Where the sticks of a gamepad stand, each -1 to 1: forward, to the left, turning to the left."""

    forward: float = 0.0
    left: float = 0.0
    turn: float = 0.0


class SharedControl:
    """A person over a policy: the policy goes on deciding, and the person's wishes replace parts of what it decides.

    Velocities that the person adjusts replace the policy's, while the behaviour, its height and its shift remain the
    policy's choice, unless a behaviour is chosen too. Giving control back forgets all of it, and so does every start.
    Whatever comes out is inside the range of the behaviour. Without a policy, ``below`` is a constant command
    (:class:`agility_rl.deploy.commander.Operator`), and giving control back returns to that.

    Source: supplement S7 and Figure S1 (what the operator adjusts, Space gives back); Table S2 (ranges).

    Args:
        below: who decides where the person does not; asked in every control step, so that its memory stays true.
        now: the present, on the controller's clock [s].

    Attributes:
        latest: what was decided last, since the last start.

    Example:
        >>> from agility_rl.deploy.commander import Operator
        >>> policy = Operator(BehaviourCommand.of("walk", velocity_x=0.0), now=0.0)
        >>> control = SharedControl(policy, now=0.0)
        >>> perception = Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))
        >>> keys = [control.press(key) for key in ("up", "up", "left")]
        >>> command = control.decide(perception)
        >>> command.name, [round(number, 2) for number in command.command[:3].tolist()], control.chosen_by
        ('walk', [0.2, 0.0, 0.2], 'operator: velocity')
        >>> control.press("space"), control.decide(perception).command[0].item(), control.chosen_by
        (True, 0.0, 'policy')
    """

    def __init__(self, below: Commander, now: float) -> None:
        self.below = below
        self._heard = now
        self._request: str | None = None
        self._behaviour: str | None = None
        self._velocity: tuple[float, ...] | None = None
        self._stick: Stick | None = None
        self.latest: BehaviourCommand | None = None

    # -- from the device ---------------------------------------------------------------------------------------------
    def press(self, key: str) -> bool:
        """Take a key; false if it means nothing here."""
        if key in STEPS:
            self._adjust(STEPS[key])
        elif key in BEHAVIOUR_KEYS:
            self._behaviour = BEHAVIOUR_KEYS[key]
            self.latest = self.latest and self._over(self.latest)
        elif key == GIVE_BACK:
            self._give_back()
        elif key == STOP:
            self._give_back()
            self._request = STOP
        elif key == GO_ON:
            self._request = self._request or GO_ON  # a stop that is still to come is not undone
        else:
            return False
        return True

    def steer(self, stick: Stick) -> None:
        """Take the sticks, as shares of the velocities that the behaviour allows."""
        self._stick, self._velocity = Stick(*(min(max(share, -1.0), 1.0) for share in stick)), None

    def heard(self, now: float) -> None:
        """The person's device is still there."""
        self._heard = now

    def request(self, mode: Mode) -> Mode | None:
        """Mode that the person has asked for since the last call, from the present one."""
        wish, self._request = self._request, None
        return Mode.DAMPING if wish == STOP else NEXT_MODE.get(mode) if wish == GO_ON else None

    @property
    def chosen_by(self) -> str:
        """Who decides now: ``policy``, or what the operator has taken over."""
        steered = self._velocity is not None or self._stick is not None
        wishes = ["behaviour"] * (self._behaviour is not None) + ["velocity"] * steered
        return "operator: " + " and ".join(wishes) if wishes else "policy"

    # -- a commander -------------------------------------------------------------------------------------------------
    def reset(self) -> None:
        """The robot is about to start: the policy begins anew, and old wishes do not make the robot take off."""
        self._give_back()
        self.latest = None
        self.below.reset()

    def decide(self, perception: Perception) -> BehaviourCommand:
        """The policy's decision, with the person's wishes over it."""
        self.latest = self._over(self.below.decide(perception))
        return self.latest

    def sources(self) -> Mapping[str, float]:
        """When the device was last heard, and what the policy depends on [s]."""
        return {**self.below.sources(), "operator": self._heard}

    def _give_back(self) -> None:
        self._behaviour = self._velocity = self._stick = None

    def _adjust(self, step: Sequence[float]) -> None:
        """Go on from what is commanded now, whoever decided it, in whole steps."""
        sizes = [max(abs(change[axis]) for change in STEPS.values()) for axis in range(3)]
        now = (self._velocity or (0.0,) * 3) if self.latest is None else self.latest.command[:3].tolist()
        wish = zip(now, step, sizes, strict=True)
        self._velocity = tuple(round((value + change) / size) * size for value, change, size in wish)
        self._stick = None
        self.latest = self.latest and self._over(self.latest)

    def _over(self, policy: BehaviourCommand) -> BehaviourCommand:
        if self.chosen_by == "policy":
            return policy
        name = self._behaviour or policy.name
        velocity = policy.command[:3].tolist() if self._velocity is None else self._velocity
        if self._stick is not None:
            most = behaviours.command_bounds()[1][behaviours.skill_index(name)]
            velocity = (torch.tensor(self._stick) * most[:3]).tolist()
        like = policy.jumping == (name == behaviours.BEHAVIOURS[behaviours.JUMP])
        height = float(policy.command[3 if policy.jumping else 4]) if like else None
        return BehaviourCommand.of(
            name,
            velocity_x=velocity[0],
            velocity_y=velocity[1],
            yaw_rate=velocity[2],
            height=height,
            shift=policy.shift,
        )


@dataclass(frozen=True)
class Status:
    """What an operator sees of the robot.

    Attributes:
        mode: of the controller.
        behaviour: name, while running.
        chosen_by: see :attr:`SharedControl.chosen_by`.
        commanded: forward [m/s], to the left [m/s], turning to the left [rad/s], while running.
        measured: the same as it is, while running: speeds by the state estimator, the turn by the gyroscope.
        message: the latest event, refusals and faults included.
        pose: position [m], quaternion (w, x, y, z) and joints [rad] of the robot, once it has spoken.
    """

    mode: Mode
    behaviour: str = ""
    chosen_by: str = ""
    commanded: tuple[float, ...] | None = None
    measured: tuple[float, ...] | None = None
    message: str = ""
    pose: tuple[float, ...] | None = None

    @classmethod
    def of(cls, step: StepRecord, control: SharedControl, message: str = "") -> Status:
        """Status after a control step."""
        pose = None if step.state is None else tuple(drawn_pose(step.state).tolist())
        if step.behaviour is None or step.state is None or step.estimate is None:
            return cls(step.mode, message=message, pose=pose)
        speed = (step.estimate[1:3] / features.LINEAR_VELOCITY_SCALE).tolist()
        return cls(
            step.mode,
            step.behaviour.name,
            control.chosen_by,
            tuple(step.behaviour.command[:3].tolist()),
            (*speed, float(step.state.angular_velocity[2])),
            message,
            pose,
        )

    def lines(self) -> list[tuple[str, str]]:
        """What to write, each line with its style: ``title``, ``good``, ``bad`` or ``dim``.

        Example:
            >>> Status(Mode.READY, message="standing").lines()
            [('title', 'ready'), ('dim', 'event      standing')]
        """
        title = f"{self.mode}: {self.behaviour}" if self.behaviour else str(self.mode)
        lines = [("bad" if self.mode is Mode.DAMPING else "title", title)]
        for name, style, values in (("commanded", "good", self.commanded), ("measured", "title", self.measured)):
            if values is not None:
                x, y, turn = values
                lines.append((style, f"{name:9}  {x:+.2f} m/s, side {y:+.2f}, turn {turn:+.2f} rad/s"))
        lines += [("dim", f"decides    {self.chosen_by}")] if self.chosen_by else []
        style = "bad" if self.mode is Mode.DAMPING else "dim"
        return lines + ([(style, f"event      {self.message}")] if self.message else [])


def drawn_pose(state: RobotState) -> Tensor:
    """Pose ``[19]`` to draw a robot in, where nothing measures its place: its lowest part on the ground, at the origin.

    Example:
        >>> pose = drawn_pose(RobotState.standing())
        >>> pose.shape, 0.25 < float(pose[2]) < 0.35
        (torch.Size([19]), True)
    """
    position = state.trunk_position
    if position is None:
        feet = rotations.rotate(state.quaternion.expand(4, 4), kinematics.forward(state.joint_position).view(4, 3))
        height = max(constants.FOOT_RADIUS - float(feet[:, 2].min()), 0.06)  # not below what the trunk lies on
        position = torch.tensor([0.0, 0.0, height])
    return torch.cat((position, state.quaternion, state.joint_position))


class Device(Protocol):
    """What a person holds or looks at: a browser, a terminal, a gamepad."""

    def read(self) -> Sequence[str | Stick]:
        """Keys and sticks since the last call, by the names of this module; returns at once."""

    def connected(self) -> bool:
        """Whether the person could press a key now and be heard."""

    def ended(self) -> bool:
        """Whether nothing will come from it any more."""

    def show(self, status: Status) -> None:
        """Let the person see; returns at once."""

    def close(self) -> None:
        """Let go of it."""


class Operation:
    """Joins a device to a controller: call it with the record of every control step.

    While the robot sinks down, the key to go on does nothing: it was meant for the mode before, and would make the
    robot limp.

    Args:
        controller: whose modes are requested; its commander is ``control``, or stands above it.
        control: the person's wishes.
        device: where they come from.
        pose: what to draw, the robot's 19 coordinates first, if something knows better than the robot itself.

    Attributes:
        others: keys of the last step that mean nothing here, for whoever knows more.
        asked: the operator has asked for a mode in the last step.
    """

    def __init__(
        self,
        controller: Controller,
        control: SharedControl,
        device: Device,
        pose: Callable[[], Sequence[float]] | None = None,
    ) -> None:
        self.controller, self.control, self.device, self.pose = controller, control, device, pose
        self.others: list[str] = []
        self.asked = False
        self._count = 0

    def __call__(self, step: StepRecord) -> None:
        """Take what came in, pass a request on, show the robot."""
        self.others = []
        for entry in self.device.read():
            if isinstance(entry, Stick):
                self.control.steer(entry)
            elif not self.control.press(entry):
                self.others.append(entry)
        if self.device.connected():
            self.control.heard(step.time)
        wanted = self.control.request(step.mode)
        if wanted is Mode.PASSIVE and step.time - self.controller.entered < SINK_SECONDS:
            wanted = None
        self.asked = wanted is not None
        if wanted is not None:
            self.controller.request(wanted)
        if self._count % SHOW_EVERY == 0:
            said = [event.reason for event in self.controller.events if event.kind != "missed"]
            status = Status.of(step, self.control, said[-1] if said else "")
            self.device.show(status if self.pose is None else replace(status, pose=tuple(self.pose())))
        self._count += 1
