"""The state machine, and every fault injected into a running robot: each must end in damping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import BehaviourCommand, Operator, Perception
from agility_rl.deploy.controller import DAMPING_GAIN, FOLDED_POSE, Controller, Mode, StepRecord
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.transport import FakeBus, JointCommand
from agility_rl.go2 import constants

Running = Callable[[], Controller]


def is_damping(command: JointCommand) -> bool:
    return (
        not bool(command.stiffness.any())
        and not bool(command.torque.any())
        and bool((command.damping == DAMPING_GAIN).all())
    )


def modes(controller: Controller) -> list[Mode]:
    return [event.mode for event in controller.events if event.kind == "mode"]


def test_nothing_moves_until_it_is_asked_to(controller: Controller, bus: FakeBus) -> None:
    for _ in range(5):
        assert controller.step().mode is Mode.PASSIVE
    assert not any(command.stiffness.any() or command.damping.any() for command in bus.sent)


def test_standing_up_folds_the_legs_then_rises_without_a_jerk(controller: Controller, bus: FakeBus) -> None:
    bus.state = replace(bus.state, joint_position=torch.tensor((0.3, 1.0, -2.4) * 4))
    controller.request(Mode.STAND_UP)
    records = [controller.step() for _ in range(130)]
    targets = torch.stack([record.command.position for record in records])
    assert (targets[1:] - targets[:-1]).abs().max() < 0.03, "1.5 rad/s at most"
    assert torch.allclose(targets[0], torch.tensor((0.3, 1.0, -2.4) * 4))
    assert torch.allclose(targets[50], torch.tensor(FOLDED_POSE), atol=1e-3), "folded after 1 s"
    assert torch.allclose(targets[100:], torch.tensor(constants.DEFAULT_POSE), atol=1e-3), "up after 2 s"
    assert [record.mode for record in records[-5:]] == [Mode.READY] * 5
    assert records[0].command.stiffness.tolist() == [constants.STIFFNESS] * 12
    assert modes(controller) == [Mode.STAND_UP, Mode.READY]


def test_a_run_follows_the_policy_from_a_fresh_memory(running: Running, deployed: DeployedBBC, bus: FakeBus) -> None:
    controller = running()
    record = controller.step()
    assert record.mode is Mode.RUN and record.behaviour.name == "trot" and record.continues
    assert torch.allclose(record.command.position, deployed.default_pose + deployed.action_scale * record.action)
    assert torch.equal(bus.sent[-1].position, record.command.position)
    # The first action of a run is that of a controller that has seen nothing but the present.
    controller.request(Mode.STAND_UP)
    stopping = [controller.step() for _ in range(60)]
    assert stopping[-1].mode is Mode.READY and (stopping[-1].command.position == deployed.default_pose).all()
    controller.request(Mode.RUN)
    first = controller.step()
    assert not first.continues and first.action is not None
    deployed.reset()
    deployed.observe(first.state)
    assert torch.equal(deployed.act(first.behaviour), first.action)


def test_a_run_ends_without_a_jerk(running: Running, bus: FakeBus) -> None:
    controller = running()
    bend(bus, joint_position=torch.tensor(constants.DEFAULT_POSE) + 0.2)
    controller.request(Mode.STAND_UP)
    targets = torch.stack([controller.step().command.position for _ in range(30)])
    assert torch.equal(targets[0], bus.state.joint_position)
    # 0.2 rad in the 0.5 s to settle are 0.008 rad in each of its 25 steps.
    assert (targets[1:] - targets[:-1]).abs().max() == pytest.approx(0.008, abs=1e-4)
    assert torch.allclose(targets[25:], torch.tensor(constants.DEFAULT_POSE))


def test_only_listed_requests_are_granted(controller: Controller, running: Running) -> None:
    controller.request(Mode.RUN)
    assert controller.step().mode is Mode.PASSIVE
    assert controller.events[-1].reason == "refused run: from passive, one may ask for stand up, damping"
    running()
    controller.request(Mode.PASSIVE)
    assert controller.step().mode is Mode.RUN, "limp legs would let it fall"
    controller.request(Mode.DAMPING)
    assert controller.step().mode is Mode.DAMPING and controller.fault is None
    controller.request(Mode.STAND_UP)
    assert controller.step().mode is Mode.DAMPING
    controller.request(Mode.PASSIVE)
    assert controller.step().mode is Mode.PASSIVE


def test_a_robot_that_is_not_fit_does_not_stand_up(controller: Controller, bus: FakeBus) -> None:
    for age, others, reason in ((0.2, (), "stale state"), (0.0, ("sport mode",), "second commander")):
        bus.age, bus.others = age, others
        controller.request(Mode.STAND_UP)
        before = len(bus.sent)
        assert controller.step().mode is Mode.PASSIVE
        assert f"refused stand up: {reason}" in controller.events[-1].reason
        assert len(bus.sent) == before + (0 if others else 1), "it does not interfere with another commander"
    bus.state, bus.others = None, ()
    controller.request(Mode.STAND_UP)
    assert controller.step().mode is Mode.PASSIVE and "never arrived" in controller.events[-1].reason


def test_whoever_was_never_driven_is_left_to_another_program(controller: Controller, bus: FakeBus) -> None:
    bus.others = ("sport mode",)
    controller.run(seconds=0.1)
    assert controller.mode is Mode.PASSIVE and not bus.sent
    bus.others = ()
    controller.run(seconds=0.1)
    assert controller.mode is Mode.DAMPING and is_damping(bus.sent[-1])


def test_a_stop_is_not_undone_by_what_is_asked_for_after_it(running: Running) -> None:
    controller = running()
    controller.request(Mode.DAMPING)
    controller.request(Mode.STAND_UP)
    assert controller.step().mode is Mode.DAMPING
    controller.request(Mode.PASSIVE)
    assert controller.step().mode is Mode.PASSIVE


def test_a_stop_forgets_what_was_asked_for_before_it(running: Running, bus: FakeBus) -> None:
    controller = running()
    controller.request(Mode.PASSIVE)
    controller.stop()
    assert controller.step().mode is Mode.DAMPING and is_damping(bus.sent[-1])


def test_a_run_begins_only_from_the_default_pose(controller: Controller, bus: FakeBus, running: Running) -> None:
    controller.request(Mode.STAND_UP)
    while controller.mode is not Mode.READY:
        controller.step()
    bus.follow = False
    bus.state = replace(bus.state, joint_position=bus.state.joint_position + 0.4)
    controller.request(Mode.RUN)
    assert controller.step().mode is Mode.READY
    assert "a joint is 0.40 rad off the default pose" in controller.events[-1].reason


def bend(bus: FakeBus, **changes: torch.Tensor) -> None:
    bus.follow = False
    bus.state = replace(bus.state, **changes)


def silence(controller: Controller, bus: FakeBus) -> None:
    controller.on_step = None  # the operator is not heard again


def stale_depth(controller: Controller, bus: FakeBus) -> None:
    heard = controller.clock.now()
    operator = controller.commander

    class WithDepth:
        reset, decide = staticmethod(operator.reset), staticmethod(operator.decide)

        def sources(self) -> dict[str, float]:
            return {**operator.sources(), "depth": heard}

    controller.commander = WithDepth()


def slow(controller: Controller, bus: FakeBus) -> None:
    decide = controller.commander.decide

    def think(perception: Perception) -> BehaviourCommand:
        controller.clock.time += 0.03
        return decide(perception)

    controller.commander.decide = think


def broken(controller: Controller, bus: FakeBus) -> None:
    def fail(perception: Perception) -> BehaviourCommand:
        raise RuntimeError("the camera's cable")

    controller.commander.decide = fail


def policy(value: float) -> Callable[[Controller, FakeBus], None]:
    def put(controller: Controller, bus: FakeBus) -> None:
        controller.bbc.network = lambda *inputs: (torch.full((1, 12), value), torch.zeros(1, 4))

    return put


def swap_names(controller: Controller, bus: FakeBus) -> None:
    bus.joint_names = (*constants.JOINT_NAMES[3:6], *constants.JOINT_NAMES[:3], *constants.JOINT_NAMES[6:])


FAULTS: dict[str, tuple[Callable[[Controller, FakeBus], None], str, int]] = {
    "stale state": (lambda c, bus: setattr(bus, "age", 0.06), "stale state", 1),
    "silent robot": (lambda c, bus: setattr(bus, "state", None), "stale state", 1),
    "stale depth": (stale_depth, "stale depth", 12),
    "nan in the state": (lambda c, bus: bend(bus, joint_velocity=torch.full((12,), float("nan"))), "not a number", 1),
    "nan from the policy": (policy(float("nan")), "not a number", 1),
    "joint beyond its stop": (lambda c, bus: bend(bus, joint_position=torch.zeros(12)), "joint limits", 1),
    "joints too fast": (lambda c, bus: bend(bus, joint_velocity=torch.full((12,), 31.0)), "joint speed", 5),
    "torque too large": (lambda c, bus: bend(bus, joint_torque=torch.full((12,), 50.0)), "joint torque", 5),
    "wild command": (policy(30.0), "commanded torque", 1),
    "tilt": (lambda c, bus: bend(bus, quaternion=torch.tensor([0.7, 0.714, 0.0, 0.0])), "tilt", 1),
    "joints in another order": (swap_names, "joint order", 1),
    "lost operator": (silence, "lost operator", 27),
    "missed deadlines": (slow, "missed deadlines", 7),
    "second commander": (lambda c, bus: setattr(bus, "others", ("sport mode",)), "second commander", 1),
    "exception": (broken, "exception", 1),
}


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_ends_in_damping(name: str, running: Running, bus: FakeBus) -> None:
    inject, check, within = FAULTS[name]
    controller = running()
    for _ in range(3):
        assert controller.step().mode is Mode.RUN
    sent = len(bus.sent)
    inject(controller, bus)
    taken = 0
    while controller.mode is Mode.RUN:
        controller.step()
        taken += 1
        assert taken <= within, f"still running after {taken} steps"
    assert controller.fault is not None and controller.fault.check == check
    assert is_damping(bus.sent[-1]) and len(bus.sent) == sent + taken
    assert all(bool(command.position.isfinite().all()) for command in bus.sent), "nothing bad was ever sent"
    assert controller.events[-1].reason == str(controller.fault) or name == "missed deadlines"
    for _ in range(10):  # and there it stays, whatever the bus does
        assert controller.step().mode is Mode.DAMPING and is_damping(bus.sent[-1])


@pytest.mark.parametrize("mode", [Mode.STAND_UP, Mode.READY])
@pytest.mark.parametrize("check", ["stale state", "commanded torque"])
def test_faults_of_a_robot_that_stands_end_in_damping_too(
    mode: Mode, check: str, controller: Controller, bus: FakeBus
) -> None:
    controller.request(Mode.STAND_UP)
    while controller.mode is not mode:
        controller.step()
    if check == "stale state":
        bus.age = 0.06
    else:  # a thigh is 2.1 rad off where it was told to be: 40 N m/rad ask for 84 N m, the limit is 4 x 20
        bend(bus, joint_position=torch.tensor((0.0, 3.0, -1.8) * 4))
    assert controller.step().mode is Mode.DAMPING and is_damping(bus.sent[-1])
    assert controller.fault is not None and controller.fault.check == check


def test_one_late_state_or_step_is_forgiven(running: Running, bus: FakeBus, clock: ManualClock) -> None:
    controller = running()
    bus.age = 0.04
    clock.time += 0.05
    record = controller.step()
    assert record.mode is Mode.RUN and not record.continues
    assert controller.deadlines.misses == 1
    missed = next(event.reason for event in controller.events if event.kind == "missed")
    assert missed == "skipped 1 control steps, woke 10.0 ms late"
    bus.age = 0.0
    assert controller.step().mode is Mode.RUN


def test_steps_that_come_closer_together_or_farther_apart_are_no_transitions(
    running: Running, clock: ManualClock
) -> None:
    controller = running()
    assert controller.step().continues
    clock.time += 0.035  # 15 ms late, and the next one is due 5 ms later
    records = [controller.step() for _ in range(3)]
    assert [record.continues for record in records] == [False, False, True]
    assert records[0].lateness == pytest.approx(0.015)


def test_after_a_fault_it_can_stand_up_again(running: Running, bus: FakeBus) -> None:
    controller = running()
    bus.age = 1.0
    controller.step()
    bus.age = 0.0
    controller.request(Mode.PASSIVE)
    controller.step()
    controller.request(Mode.STAND_UP)
    assert controller.step().mode is Mode.STAND_UP


def test_a_fault_is_history_once_a_request_was_granted(running: Running, bus: FakeBus) -> None:
    controller = running()
    bus.age = 1.0
    controller.step()
    bus.age = 0.0
    controller.request(Mode.DAMPING)
    assert controller.step().mode is Mode.DAMPING and controller.fault is not None, "damping led nowhere else"
    controller.request(Mode.RUN)
    controller.step()
    assert controller.fault is not None, "nothing was granted"
    controller.request(Mode.PASSIVE)
    controller.step()
    assert controller.fault is None


def test_what_was_too_fast_before_a_fault_does_not_count_again(running: Running, bus: FakeBus) -> None:
    controller = running()
    bend(bus, joint_velocity=torch.full((12,), 31.0))
    while controller.mode is Mode.RUN:
        controller.step()
    for mode in (Mode.PASSIVE, Mode.STAND_UP):
        controller.request(mode)
        assert controller.step().mode is mode, controller.events[-1]


def test_run_ends_in_damping_also_when_something_breaks(running: Running, bus: FakeBus) -> None:
    controller = running()
    steps: list[StepRecord] = []
    heard = controller.on_step

    def on_step(step: StepRecord) -> None:
        heard(step)
        steps.append(step)

    controller.on_step = on_step
    controller.run(seconds=1.0)
    assert len(steps) == 50 and controller.mode is Mode.DAMPING and is_damping(bus.sent[-1])

    def full_disk(step: StepRecord) -> None:
        raise OSError("no space left")

    controller.on_step = full_disk
    before = len(bus.sent)
    with pytest.raises(OSError, match="no space left"):
        controller.run()
    assert len(bus.sent) > before and is_damping(bus.sent[-1])


def test_an_hour_of_steps_takes_no_more_memory_than_a_minute(running: Running, bus: FakeBus) -> None:
    controller = running()
    bus.sent = _Nothing()
    for _ in range(50):
        controller.step()
    kept = (len(controller.events), controller.events.maxlen, len(controller.deadlines.durations._counts))
    for _ in range(200):
        controller.step()
    assert (len(controller.events), controller.events.maxlen, len(controller.deadlines.durations._counts)) == kept
    assert len(controller.bbc._heights) <= 45 and controller.bbc._history.shape == (10, 45)


class _Nothing(list):
    def append(self, item: object) -> None:
        pass


def test_the_commander_sees_what_the_networks_see(running: Running) -> None:
    controller = running()
    seen: list[Perception] = []

    class Task:
        """A policy above the behaviour controller: it has a memory, and forgets it when a run begins."""

        memory = 0

        def reset(self) -> None:
            self.memory = 0

        def decide(self, perception: Perception) -> BehaviourCommand:
            seen.append(perception)
            self.memory += 1
            return BehaviourCommand.of("jump" if self.memory > 2 else "walk")

        def sources(self) -> dict[str, float]:
            return {"depth": controller.clock.now()}

    controller.commander = Task()
    for _ in range(2):
        controller.request(Mode.STAND_UP)
        for _ in range(60):
            controller.step()
        controller.request(Mode.RUN)
        assert [controller.step().behaviour.name for _ in range(4)] == ["walk", "walk", "jump", "jump"]
    assert seen[0].proprioception.shape == (45,) and not seen[0].estimate.any() and seen[1].estimate.any()
    assert seen[0].state.joint_position.shape == (12,)


def test_operator_commands_reach_the_policy(running: Running, operator: Operator) -> None:
    controller = running()
    operator.command(BehaviourCommand.of("canter", velocity_x=1.5), controller.clock.now())
    record = controller.step()
    assert record.behaviour.name == "canter" and float(record.behaviour.command[0]) == 1.5
