"""The controller of one robot: a state machine around the behaviour controller, at 50 Hz, ending in damping."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor

from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import BehaviourCommand, Commander, Perception
from agility_rl.deploy.deadlines import Clock, Deadlines, MonotonicClock
from agility_rl.deploy.safety import Fault, Safety, SafetyLimits
from agility_rl.deploy.transport import JointCommand, RobotState, Transport

logger = logging.getLogger(__name__)

FOLDED_POSE = (0.0, 1.36, -2.65) * 4
"""Joint angles [rad] of a robot that lies on its trunk with its legs folded under it."""
DAMPING_GAIN = 3.0
"""Damping of every joint in the state ``damping`` [N m s/rad]; chosen by us."""
SINK_SECONDS = 1.5
"""Time that a robot in the state ``damping`` takes to sink down [s]; chosen by us."""
FOLD_SECONDS = 1.0
"""Time to fold the legs before standing up [s]."""
RISE_SECONDS = 1.0
"""Time from the folded to the default pose [s]."""
SETTLE_SECONDS = 0.5
"""Time that the default pose is held before the robot counts as ready, and to return to it from a run [s]."""
READY_TOLERANCE = 0.35
"""Largest deviation of a joint from the default pose in which a run may start [rad]."""
EVENTS = 1000
"""Most recent events that are kept."""


class Mode(StrEnum):
    """What the controller is doing."""

    PASSIVE = "passive"
    """Joints limp; nothing happens until a request."""
    STAND_UP = "stand up"
    """From wherever the joints are to the default pose."""
    READY = "ready"
    """Holds the default pose."""
    RUN = "run"
    """The behaviour controller moves the robot."""
    DAMPING = "damping"
    """Joints only resist motion, and the robot sinks down; every fault ends here."""


REQUESTS: dict[Mode, tuple[Mode, ...]] = {
    Mode.PASSIVE: (Mode.STAND_UP, Mode.DAMPING),
    Mode.STAND_UP: (Mode.DAMPING,),
    Mode.READY: (Mode.RUN, Mode.DAMPING),
    Mode.RUN: (Mode.STAND_UP, Mode.DAMPING),
    Mode.DAMPING: (Mode.PASSIVE, Mode.DAMPING),
}
"""From each mode, those that may be requested; ``ready`` follows ``stand up`` by itself."""


@dataclass(frozen=True)
class Event:
    """A change of mode, a refused request or missed deadlines.

    Attributes:
        time: the controller's clock [s].
        kind: ``mode``, ``refused`` or ``missed``.
        mode: the mode from then on.
        reason: why.
    """

    time: float
    kind: str
    mode: Mode
    reason: str


@dataclass(frozen=True)
class StepRecord:
    """One control step, for whoever records.

    Attributes:
        time: when it began, on the controller's clock [s].
        mode: the mode in which the command was given.
        state: what the robot said; ``None`` if it has not spoken yet.
        command: what the motors were told.
        action: ``[12]`` [action units] in the mode ``run``, else ``None``.
        behaviour: what was commanded to the behaviour controller in the mode ``run``, else ``None``.
        estimate: ``[4]`` (:data:`agility_rl.keys.ESTIMATE`) in the mode ``run``, else ``None``.
        continues: the step before it was in the mode ``run`` too, and its state came a period before this one, give or
            take half of one.
        duration: from its beginning until the command was sent [s].
        lateness: by how much it began too late [s].
    """

    time: float
    mode: Mode
    state: RobotState | None
    command: JointCommand
    action: Tensor | None
    behaviour: BehaviourCommand | None
    estimate: Tensor | None
    continues: bool
    duration: float
    lateness: float


class Controller:
    """Runs one robot: reads its state, checks it, decides, checks the command, and sends it, in every control step.

    Modes and the requests between them are in :class:`Mode` and :data:`REQUESTS`. Whatever fails, an exception
    included, ends in ``damping``, which only a request leaves. The PD loop itself runs in the motors.

    Source: supplement S3 (50 Hz; motors at 1,000 Hz); reference notes, section 4 (what deployed controllers lack).

    Args:
        transport: way to the robot.
        bbc: behaviour controller.
        commander: who tells it what to do.
        limits: where to give up; those of the artifact's manifest by default.
        clock: what tells the time; tests give one of their own.
        on_step: called after every command was sent, with what happened; its time counts towards the next deadline.

    Attributes:
        mode: present mode.
        entered: when that began, on the clock [s].
        fault: what led to ``damping`` the last time, if it was a fault and no request has been granted since.
        events: most recent changes of mode, refusals and misses.
        deadlines: periods, misses, durations, latenesses.

    Example:
        >>> import tempfile
        >>> from agility_rl.deploy.artifact import Artifact, build_manifest
        >>> from agility_rl.deploy.behaviour import torch_network
        >>> from agility_rl.deploy.commander import Operator
        >>> from agility_rl.deploy.deadlines import ManualClock
        >>> from agility_rl.deploy.transport import FakeBus
        >>> from agility_rl.go2 import features
        >>> from agility_rl.modules import BasicBehaviourController
        >>> module = BasicBehaviourController(hidden=(8,))
        >>> manifest = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=0.02, network=module.settings)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     artifact = Artifact.save(folder, module.state_dict(), manifest)
        >>> clock = ManualClock()
        >>> operator = Operator(BehaviourCommand.of("trot"), now=0.0)
        >>> bus = FakeBus(clock)
        >>> controller = Controller(bus, DeployedBBC(torch_network(artifact), artifact), operator, clock=clock)
        >>> controller.request(Mode.STAND_UP)
        >>> controller.step().mode
        <Mode.STAND_UP: 'stand up'>
        >>> bus.age = 1.0  # the robot falls silent
        >>> controller.step().mode, str(controller.fault)
        (<Mode.DAMPING: 'damping'>, 'stale state: the state is 1000 ms old, expected at most 50 ms')
    """

    def __init__(
        self,
        transport: Transport,
        bbc: DeployedBBC,
        commander: Commander,
        *,
        limits: SafetyLimits | None = None,
        clock: Clock | None = None,
        on_step: Callable[[StepRecord], None] | None = None,
    ) -> None:
        self.transport, self.bbc, self.commander = transport, bbc, commander
        self.clock = MonotonicClock() if clock is None else clock
        self.on_step = on_step
        limits = SafetyLimits.from_manifest(bbc.manifest) if limits is None else limits
        torque_limit = bbc.manifest["limits"]["joint_torque"]
        self.safety = Safety(limits, joint_names=bbc.joint_names, torque_limit=torque_limit)
        self.deadlines = Deadlines(bbc.period, self.clock)
        self.mode = Mode.PASSIVE
        self.fault: Fault | None = None
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self._request: Mode | None = None
        self.entered = self.clock.now()
        self._start_pose: Tensor | None = None
        self._from_run = False
        self._ran_from: RobotState | None = None
        self._folded = torch.tensor(FOLDED_POSE)

    # -- from outside ------------------------------------------------------------------------------------------------
    def request(self, mode: Mode) -> None:
        """Ask for a mode; the next control step grants or refuses it. May be called from another thread.

        Damping that was asked for is not undone by what is asked for after it.
        """
        if self._request is not Mode.DAMPING:
            self._request = mode

    def run(self, seconds: float | None = None, until: Callable[[], bool] | None = None) -> None:
        """Step at 50 Hz for some time, or until something holds; leaves the robot in damping."""
        self.deadlines.restart()
        periods = math.inf if seconds is None else round(seconds / self.bbc.period)
        try:
            while self.deadlines.periods < periods and not (until is not None and until()):
                self.step()
        finally:
            self.stop("the run has ended")

    def stop(self, reason: str = "stopped") -> None:
        """Send damping at once, and remain there; silent while passive and somebody else commands the robot.

        For the thread that steps; from another one, ``request(Mode.DAMPING)`` does it within a control step.
        """
        if self.mode is Mode.PASSIVE and self.transport.other_commanders():
            return
        self._request = None  # what was asked for before must not lead out of it
        self._enter(Mode.DAMPING, reason)
        self.transport.send(JointCommand.damped(DAMPING_GAIN))

    # -- one control step --------------------------------------------------------------------------------------------
    def step(self) -> StepRecord:
        """Wait for the next deadline and do one control step."""
        tick = self.deadlines.wait()
        now = self.clock.now()
        if tick.skipped:
            self._note("missed", f"skipped {tick.skipped} control steps, woke {1e3 * tick.lateness:.1f} ms late")
        action: Tensor | None = None
        behaviour: BehaviourCommand | None = None
        state: RobotState | None = None
        before = self._ran_from if self.mode is Mode.RUN else None
        try:
            state = self.transport.read()
            self._grant(state, now)
            fault = self._check(state, now)
            command = JointCommand.damped(DAMPING_GAIN if self.mode is Mode.DAMPING else 0.0)
            if fault is None and state is not None and self.mode in (Mode.STAND_UP, Mode.READY, Mode.RUN):
                if self.mode is Mode.RUN:
                    behaviour, action = self._act(state, now)
                command = self._command(state, action, now)
                fault = self.safety.check_command(command, state)
        except Exception as error:  # whatever it is, the robot must not go on moving
            logger.exception("the control step failed")
            fault = Fault("exception", f"{type(error).__name__}: {error}")
        if fault is not None:
            self.fault = fault
            self._enter(Mode.DAMPING, str(fault))
            command, action, behaviour = JointCommand.damped(DAMPING_GAIN), None, None
        if self.mode is not Mode.PASSIVE or not self.transport.other_commanders():
            self.transport.send(command)
        duration = self.deadlines.finish(tick)
        if tick.lateness + duration > self.deadlines.period:
            self._note(
                "missed", f"missed a deadline: began {1e3 * tick.lateness:.1f} ms late, took {1e3 * duration:.1f} ms"
            )
        running = self.mode is Mode.RUN
        record = StepRecord(
            time=now,
            mode=self.mode,
            state=state,
            command=command,
            action=action,
            behaviour=behaviour,
            estimate=self.bbc.estimate if running else None,
            continues=running and self._follows(state, before),
            duration=duration,
            lateness=tick.lateness,
        )
        self._ran_from = state if running else None
        if self.on_step is not None:
            self.on_step(record)
        return record

    def _follows(self, state: RobotState | None, before: RobotState | None) -> bool:
        """Whether one control step lies between two states: late ones come closer together, or farther apart."""
        if state is None or before is None:
            return False
        return abs(state.time - before.time - self.bbc.period) < 0.5 * self.bbc.period

    def _check(self, state: RobotState | None, now: float) -> Fault | None:
        """Everything that must hold while the joints are driven."""
        if self.mode in (Mode.PASSIVE, Mode.DAMPING):
            return None
        missed = self.deadlines.consecutive
        fault = self.safety.check_bus(self.transport.joint_names, self.transport.other_commanders())
        fault = fault or self.safety.check_loop(now, self.commander.sources(), missed)
        return fault or self.safety.check_state(state, now)

    def _act(self, state: RobotState, now: float) -> tuple[BehaviourCommand, Tensor]:
        proprioception = self.bbc.observe(state)
        behaviour = self.commander.decide(Perception(now, state, proprioception, self.bbc.estimate))
        return behaviour, self.bbc.act(behaviour)

    def _command(self, state: RobotState, action: Tensor | None, now: float) -> JointCommand:
        """What the joints are told in the modes that drive them."""
        if action is not None:
            return JointCommand(self.bbc.target(action), self.bbc.stiffness, self.bbc.damping)
        target = self.bbc.default_pose
        if self.mode is Mode.STAND_UP:
            assert self._start_pose is not None
            elapsed = now - self.entered
            if self._from_run:
                target = torch.lerp(self._start_pose, target, min(elapsed / SETTLE_SECONDS, 1.0))
                finished = elapsed >= 2.0 * SETTLE_SECONDS
            elif elapsed < FOLD_SECONDS:
                target, finished = torch.lerp(self._start_pose, self._folded, elapsed / FOLD_SECONDS), False
            else:
                target = torch.lerp(self._folded, target, min((elapsed - FOLD_SECONDS) / RISE_SECONDS, 1.0))
                finished = elapsed >= FOLD_SECONDS + RISE_SECONDS + SETTLE_SECONDS
            if finished:
                self._enter(Mode.READY, "standing")
        return JointCommand(target, self.bbc.stiffness, self.bbc.damping)

    # -- modes -------------------------------------------------------------------------------------------------------
    def _grant(self, state: RobotState | None, now: float) -> None:
        """Take up a request, if it may be granted."""
        wanted, self._request = self._request, None
        if wanted is None:
            return
        if wanted not in REQUESTS[self.mode]:
            allowed = ", ".join(REQUESTS[self.mode])
            self._note("refused", f"refused {wanted}: from {self.mode}, one may ask for {allowed}")
            return
        if wanted in (Mode.STAND_UP, Mode.RUN):
            refusal = self._refusal(wanted, state, now)
            if refusal:
                self._note("refused", f"refused {wanted}: {refusal}")
                return
        if wanted is Mode.STAND_UP:
            assert state is not None
            self._start_pose, self._from_run = state.joint_position.clone(), self.mode is Mode.RUN
        if wanted is Mode.RUN:
            self.bbc.reset()
            self.commander.reset()
        if wanted is not self.mode:
            self.fault = None
        self._enter(wanted, "requested")

    def _refusal(self, wanted: Mode, state: RobotState | None, now: float) -> str | None:
        """Why a robot in this state must not start to move, if so."""
        if self.mode is Mode.PASSIVE:
            self.safety.reset()
            self.deadlines.consecutive = 0
            fault = self.safety.check_bus(self.transport.joint_names, self.transport.other_commanders())
            fault = fault or self.safety.check_loop(now, self.commander.sources(), 0)
            fault = fault or self.safety.check_state(state, now)
            return None if fault is None else str(fault)
        if wanted is Mode.RUN and state is not None:
            deviation = float((state.joint_position - self.bbc.default_pose).abs().max())
            if not deviation <= READY_TOLERANCE:
                return f"a joint is {deviation:.2f} rad off the default pose, expected at most {READY_TOLERANCE}"
        return None

    def _enter(self, mode: Mode, reason: str) -> None:
        if mode is self.mode:
            return
        self.mode, self.entered = mode, self.clock.now()
        self._note("mode", reason)

    def _note(self, kind: str, reason: str) -> None:
        self.events.append(Event(self.clock.now(), kind, self.mode, reason))
        logger.warning("%s: %s", self.mode, reason)
