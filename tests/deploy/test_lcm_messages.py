"""LCM messages: bit for bit as LCM's own generator makes them, and refused when they are another's."""

from __future__ import annotations

import importlib.util
import shutil
import struct
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.deploy import lcm_messages
from agility_rl.deploy.lcm_messages import (
    MessageError,
    Sent,
    definition,
    pack_command,
    pack_state,
    unpack_command,
    unpack_state,
)
from agility_rl.deploy.transport import JointCommand, RobotState
from agility_rl.go2 import constants

SENT = Sent(robot=2**62 + 1, sender=3, sequence=2**40)


def random_state(generator: torch.Generator) -> RobotState:
    still = RobotState.standing(time=1.5)
    tensors = {entry.name: getattr(still, entry.name) for entry in fields(still)}
    shaken = {
        name: torch.randn(value.shape, generator=generator)
        for name, value in tensors.items()
        if isinstance(value, torch.Tensor)
    }
    return replace(still, **shaken, trunk_position=torch.randn(3, generator=generator), sequence=7)


def random_command(generator: torch.Generator) -> JointCommand:
    return JointCommand(*torch.randn(5, 12, generator=generator))


def test_a_state_arrives_bit_for_bit(generator: torch.Generator) -> None:
    state = random_state(generator)
    found, robot, names = unpack_state(pack_state(state, SENT.robot), time=9.0)
    assert (found.time, robot, names) == (9.0, SENT.robot, constants.JOINT_NAMES), "the time of its arrival"
    for entry in fields(RobotState):
        sent, got = getattr(state, entry.name), getattr(found, entry.name)
        if isinstance(sent, torch.Tensor):
            assert torch.equal(sent, got), entry.name
    assert found.sequence == 7
    unknown, _, names = unpack_state(pack_state(replace(state, trunk_position=None), 0, ("a", "bc") * 6), 0.0)
    assert unknown.trunk_position is None and names == ("a", "bc") * 6


def test_a_command_arrives_bit_for_bit(generator: torch.Generator) -> None:
    command = random_command(generator)
    found, sent = unpack_command(pack_command(command, SENT, time=4.0))
    assert sent == SENT
    for entry in fields(JointCommand):
        assert torch.equal(getattr(command, entry.name), getattr(found, entry.name)), entry.name


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ModuleType]:
    """What LCM's own generator makes of our definition."""
    tool = shutil.which("lcm-gen") or shutil.which("lcm-gen", path=str(Path(sys.executable).parent))
    if tool is None:
        pytest.skip("needs lcm-gen, which comes with the extra lcm")
    folder = tmp_path_factory.mktemp("lcm")
    (folder / "types.lcm").write_text(definition())
    subprocess.run([tool, "-p", "--ppath", str(folder), str(folder / "types.lcm")], check=True, capture_output=True)
    modules = {}
    for name in lcm_messages.TYPES:
        spec = importlib.util.spec_from_file_location(name, folder / lcm_messages.PACKAGE / f"{name}.py")
        assert spec is not None and spec.loader is not None
        modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    return modules


def test_lcms_own_generator_agrees(generated: dict[str, ModuleType], generator: torch.Generator) -> None:
    state, command = random_state(generator), random_command(generator)
    messages = {
        "robot_state_t": pack_state(state, SENT.robot),
        "joint_command_t": pack_command(command, SENT, time=4.25),
    }
    for name, message in messages.items():
        kind = getattr(generated[name], name)
        assert kind._get_hash_recursive([]) == lcm_messages.FINGERPRINTS[name]
        read = kind.decode(message)
        assert read.encode() == message, "there and back through the generated code"
        assert read.version == kind.VERSION == lcm_messages.VERSION and read.robot == SENT.robot
    read = generated["robot_state_t"].robot_state_t.decode(messages["robot_state_t"])
    assert tuple(read.joint_names) == constants.JOINT_NAMES and read.trunk_known
    assert list(read.joint_torque) == state.joint_torque.tolist() and read.time == 1.5
    read = generated["joint_command_t"].joint_command_t.decode(messages["joint_command_t"])
    assert list(read.damping) == command.damping.tolist() and (read.sender, read.sequence, read.time) == (
        3,
        2**40,
        4.25,
    )


def test_other_types_versions_and_damage_are_refused(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = pack_state(random_state(generator), 1)
    with pytest.raises(
        MessageError, match=r"its fingerprint is 5727d83b19c2e23e, expected 813c361035aa9e24; the other"
    ):
        unpack_state(pack_command(random_command(generator), SENT, 0.0), 0.0)
    newer = state[:8] + struct.pack(">i", lcm_messages.VERSION + 1) + state[12:]
    with pytest.raises(MessageError, match="its version is 2, expected 1; install the same version"):
        unpack_state(newer, 0.0)
    for end in range(12, len(state), 13):
        with pytest.raises(MessageError, match=f"damaged at byte [0-9]+ of {end}"):
            unpack_state(state[:end], 0.0)
    with pytest.raises(MessageError, match=f"{len(state) + 1} bytes, expected {len(state)}"):
        unpack_state(state + b"\0", 0.0)
    start = state.index(b"FL_hip_joint") - 4
    for length in (-1, 0, 5, 2**31 - 1):
        with pytest.raises(MessageError, match="a string of"):
            unpack_state(state[:start] + struct.pack(">i", length) + state[start + 4 :], 0.0)
    # A member that is renamed is another layout.
    members = lcm_messages.TYPES["robot_state_t"]
    renamed = (*members[:-1], replace(members[-1], name="trunk"))
    monkeypatch.setitem(lcm_messages.TYPES, "robot_state_t", renamed)
    assert lcm_messages.fingerprint("robot_state_t") != lcm_messages.FINGERPRINTS["robot_state_t"]
