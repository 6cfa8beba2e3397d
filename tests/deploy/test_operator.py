"""A person over a policy: who decides what, and what leads to which mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pytest
import torch

from agility_rl import behaviours
from agility_rl.deploy.behaviour import DeployedBBC
from agility_rl.deploy.commander import BehaviourCommand, Commander, Operator, Perception
from agility_rl.deploy.controller import Controller, Mode
from agility_rl.deploy.deadlines import ManualClock
from agility_rl.deploy.operator import BEHAVIOUR_KEYS, Operation, SharedControl, Status, Stick, drawn_pose
from agility_rl.deploy.transport import FakeBus, RobotState
from agility_rl.go2 import constants

PERCEPTION = Perception(0.0, RobotState.standing(), torch.zeros(45), torch.zeros(4))


class Policy:
    """Stands for a task policy: every decision differs from the last, and it counts how often it was asked."""

    def __init__(self) -> None:
        self.asked = self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def decide(self, perception: Perception) -> BehaviourCommand:
        self.asked += 1
        if self.asked % 2:
            return BehaviourCommand.of("canter", velocity_x=1.5, yaw_rate=0.4, height=0.3, shift=0.4)
        return BehaviourCommand.of("jump", velocity_x=1.2, height=0.52, shift=-0.6)

    def sources(self) -> Mapping[str, float]:
        return {"depth": 0.25}


@pytest.fixture
def policy() -> Policy:
    return Policy()


@pytest.fixture
def control(policy: Policy) -> SharedControl:
    return SharedControl(policy, now=1.0)


def decided(control: SharedControl) -> tuple[str, list[float], float]:
    command = control.decide(PERCEPTION)
    return command.name, [round(value, 3) for value in command.command.tolist()], round(command.shift, 3)


def test_nothing_pressed_is_the_policy_alone(control: SharedControl) -> None:
    commander: Commander = control
    assert commander.decide(PERCEPTION).name == "canter" and commander.decide(PERCEPTION).name == "jump"
    assert control.chosen_by == "policy"
    assert commander.sources() == {"depth": 0.25, "operator": 1.0}
    control.heard(2.0)
    assert commander.sources()["operator"] == 2.0


def test_velocities_are_the_operators_and_behaviours_the_policys(control: SharedControl, policy: Policy) -> None:
    """Figure S1: the operator only adjusts velocities, the behaviour remains the policy's."""
    control.decide(PERCEPTION)  # canter at 1.5 m/s, turning by 0.4 rad/s
    for key in ("up", "right"):
        assert control.press(key)
    assert control.chosen_by == "operator: velocity"
    name, command, shift = decided(control)
    assert (name, shift) == ("jump", -0.6), "behaviour and shift go on changing with the policy"
    assert command == pytest.approx([1.6, 0.0, 0.2, 0.52, 0.0])
    assert decided(control)[0] == "canter"
    control.press("space")
    assert decided(control) == ("jump", [1.2, 0.0, 0.0, 0.52, 0.0], -0.6) and control.chosen_by == "policy"
    assert policy.asked == 4, "its memory must not miss a step while somebody else decides"


@pytest.mark.parametrize("key", list(BEHAVIOUR_KEYS))
def test_number_keys_choose_a_behaviour(control: SharedControl, key: str) -> None:
    name = behaviours.BEHAVIOURS[int(key) - 1]
    assert control.press(key) and control.chosen_by == "operator: behaviour"
    low, high = (bound[int(key) - 1] for bound in behaviours.command_bounds())
    for _ in range(2):  # whatever the policy says
        command = control.decide(PERCEPTION)
        assert command.name == name
        assert bool((command.command >= low - 1e-6).all() and (command.command <= high + 1e-6).all()), "Table S2"


def test_a_height_of_another_kind_is_not_taken_over(control: SharedControl) -> None:
    control.press("5")
    assert control.decide(PERCEPTION).command[3] == pytest.approx(0.5), "the middle: canter's 0.3 m is no jump"
    assert control.decide(PERCEPTION).command[3] == pytest.approx(0.52), "the policy's own jump"


def test_steps_stop_at_the_ends_of_the_range_and_come_back_at_once() -> None:
    control = SharedControl(Operator(BehaviourCommand.of("walk", velocity_x=0.0), 0.0), 0.0)
    control.decide(PERCEPTION)
    for _ in range(20):
        control.press("up")
        control.press("a")
        control.press("left")
    assert decided(control)[1][:3] == pytest.approx([0.6, 0.15, 1.0]), "a walk's ends"
    control.press("down")
    assert decided(control)[1][0] == pytest.approx(0.5), "not twenty steps back first"
    for _ in range(5):
        control.press("down")
    assert decided(control)[1][0] == 0.0
    control.press("3")
    control.press("up")
    assert decided(control)[:1] == ("trot",) and decided(control)[1][0] == pytest.approx(0.6), "from a trot's 0.5"


def test_small_steps_reach_every_value_through_the_dead_band() -> None:
    control = SharedControl(Operator(BehaviourCommand.of("walk", velocity_x=0.0), 0.0), 0.0)
    found = []
    for _ in range(4):
        control.press("up")
        found.append(decided(control)[1][0])
    assert found == pytest.approx([0.1, 0.2, 0.3, 0.4])
    for _ in range(4):
        control.press("down")
        found.append(decided(control)[1][0])
    assert found[4:] == pytest.approx([0.3, 0.2, 0.1, 0.0])


def test_sticks_are_shares_of_what_the_behaviour_allows(control: SharedControl) -> None:
    control.press("3")
    control.steer(Stick(1.0, -0.5, 2.0))
    assert decided(control)[1][:3] == pytest.approx([1.5, -0.15, 1.57]), "no stick goes beyond its stop"
    control.press("1")
    assert decided(control)[1][:3] == pytest.approx([0.6, -0.075, 1.0])
    control.steer(Stick())
    assert decided(control)[1][:3] == [0.0, 0.0, 0.0] and "velocity" in control.chosen_by
    control.press("up")
    assert decided(control)[1][0] == pytest.approx(0.1), "keys take over from sticks"
    control.steer(Stick(0.5))
    assert decided(control)[1][0] == pytest.approx(0.3), "and sticks from keys"


@pytest.mark.parametrize(
    ("mode", "asked"),
    [
        (Mode.PASSIVE, Mode.STAND_UP),
        (Mode.STAND_UP, None),
        (Mode.READY, Mode.RUN),
        (Mode.RUN, Mode.STAND_UP),
        (Mode.DAMPING, Mode.PASSIVE),
    ],
)
def test_modes_are_asked_for_once(control: SharedControl, mode: Mode, asked: Mode | None) -> None:
    assert control.request(mode) is None
    control.press("enter")
    assert control.request(mode) is asked
    assert control.request(mode) is None
    control.press("escape")
    assert control.request(mode) is Mode.DAMPING


@pytest.mark.parametrize("keys", [("escape", "enter"), ("enter", "escape"), ("escape", "up", "enter", "3")])
def test_a_stop_is_not_undone_by_other_keys_of_the_same_moment(control: SharedControl, keys: tuple[str, ...]) -> None:
    for key in keys:
        control.press(key)
    assert control.request(Mode.RUN) is Mode.DAMPING


def test_a_start_forgets_old_wishes(control: SharedControl, policy: Policy) -> None:
    control.press("5")
    control.press("up")
    control.reset()
    assert control.chosen_by == "policy" and policy.resets == 1
    assert control.decide(PERCEPTION).name == "canter"


def test_other_keys_mean_nothing(control: SharedControl) -> None:
    assert not control.press("q") and not control.press("6") and not control.press("")
    assert control.chosen_by == "policy"


class Keyboard:
    """A device whose keys a test presses."""

    def __init__(self) -> None:
        self.keys: list[str | Stick] = []
        self.there = True
        self.shown: list[Status] = []

    def read(self) -> Sequence[str | Stick]:
        keys, self.keys = self.keys, []
        return keys

    def connected(self) -> bool:
        return self.there

    def ended(self) -> bool:
        return False

    def show(self, status: Status) -> None:
        self.shown.append(status)

    def close(self) -> None:
        """Nothing to release."""


@pytest.fixture
def driven(deployed: DeployedBBC) -> tuple[Controller, Keyboard, Callable[[int], None]]:
    clock = ManualClock()
    control = SharedControl(Operator(BehaviourCommand.of("walk", velocity_x=0.0), 0.0), 0.0)
    controller = Controller(FakeBus(clock), deployed, control, clock=clock)
    keyboard = Keyboard()
    controller.on_step = Operation(controller, control, keyboard)

    def steps(count: int) -> None:
        for _ in range(count):
            controller.step()

    return controller, keyboard, steps


def test_a_keyboard_takes_the_robot_up_and_down(driven: tuple[Controller, Keyboard, Callable[[int], None]]) -> None:
    controller, keyboard, steps = driven
    for key, count, mode in (("enter", 150, Mode.READY), ("enter", 3, Mode.RUN), ("escape", 3, Mode.DAMPING)):
        keyboard.keys = [key]
        steps(count)
        assert controller.mode is mode
    assert controller.fault is None
    running = [status for status in keyboard.shown if status.mode is Mode.RUN]
    assert running and running[0].commanded == (0.0, 0.0, 0.0) and running[0].measured is not None
    assert len(keyboard.shown) == pytest.approx(156 / 2, abs=1)


def test_a_key_that_was_meant_for_the_mode_before_does_not_make_a_sinking_robot_limp(
    driven: tuple[Controller, Keyboard, Callable[[int], None]],
) -> None:
    controller, keyboard, steps = driven
    for _ in range(2):
        keyboard.keys = ["enter"]
        steps(150)
    assert controller.mode is Mode.RUN
    assert isinstance(controller.transport, FakeBus)
    controller.transport.age = 1.0
    keyboard.keys = ["enter"]
    steps(2)
    assert controller.mode is Mode.DAMPING and controller.fault is not None
    for _ in range(7):
        keyboard.keys = ["enter"]
        steps(10)
    assert controller.mode is Mode.DAMPING and controller.fault is not None, "1.44 s are not enough"
    steps(5)
    keyboard.keys = ["enter"]
    steps(2)
    assert controller.mode is Mode.PASSIVE


def test_keys_reach_the_policy_and_the_screen(driven: tuple[Controller, Keyboard, Callable[[int], None]]) -> None:
    controller, keyboard, steps = driven
    for _ in range(2):
        keyboard.keys = ["enter"]
        steps(150)
    keyboard.keys = ["2", "backspace", Stick(1.0)]
    steps(1)
    operation = controller.on_step
    assert isinstance(operation, Operation) and operation.others == ["backspace"]
    record = controller.step()
    assert record.behaviour is not None and record.behaviour.name == "pace"
    assert record.behaviour.command[0] == pytest.approx(1.5)
    steps(1)
    last = keyboard.shown[-1]
    assert (last.behaviour, last.chosen_by) == ("pace", "operator: behaviour and velocity")
    assert any("+1.50 m/s" in text for _, text in last.lines())


def test_a_device_that_has_gone_stops_the_robot(driven: tuple[Controller, Keyboard, Callable[[int], None]]) -> None:
    controller, keyboard, steps = driven
    for _ in range(2):
        keyboard.keys = ["enter"]
        steps(150)
    assert controller.mode is Mode.RUN
    keyboard.there = False
    steps(20)
    assert controller.mode is Mode.RUN, "0.4 s of silence are no reason"
    steps(10)
    assert controller.mode is Mode.DAMPING and "lost operator" in str(controller.fault)
    steps(2)
    assert keyboard.shown[-1].lines()[0] == ("bad", "damping")
    assert "lost operator" in keyboard.shown[-1].message


def test_a_robot_is_drawn_with_its_lowest_foot_on_the_ground() -> None:
    standing = drawn_pose(RobotState.standing())
    assert standing[2] == pytest.approx(constants.STANDING_HEIGHT, abs=0.01)
    assert torch.equal(standing[7:], torch.tensor(constants.DEFAULT_POSE))
    on_its_back = RobotState.standing()
    object.__setattr__(on_its_back, "quaternion", torch.tensor([0.0, 1.0, 0.0, 0.0]))
    assert drawn_pose(on_its_back)[2] == pytest.approx(0.06), "not under the ground"
    known = RobotState.standing()
    object.__setattr__(known, "trunk_position", torch.tensor([1.0, 2.0, 0.4]))
    assert drawn_pose(known)[:3].tolist() == pytest.approx([1.0, 2.0, 0.4])
