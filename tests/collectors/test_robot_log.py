"""Good logs become transitions; bad ones are refused in one line that names the field and the row."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.collectors import RobotLog, RobotLogError
from agility_rl.go2 import constants


def columns(count: int = 150, **changes: Any) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def draw(size: int) -> Tensor:
        return 0.1 * torch.randn(count, size, generator=generator)

    good: dict[str, Tensor] = {
        "time": 5.0 + 0.02 * torch.arange(count, dtype=torch.float64),
        "joint_position": torch.tensor(constants.DEFAULT_POSE) + draw(12),
        "joint_velocity": draw(12),
        "roll_pitch": draw(2),
        "angular_velocity": draw(3),
        "action": draw(12),
    }
    return {name: value for name, value in (good | changes).items() if value is not None}


def with_value(name: str, row: int, column: int, value: float) -> dict[str, Tensor]:
    changed = columns()
    changed[name][row, column] = value
    return changed


def refused(groups: dict[str, Tensor], **options: Any) -> str:
    with pytest.raises(RobotLogError) as error:
        RobotLog.from_columns(groups, name="walk.csv", **options)
    message = str(error.value)
    assert message.startswith("walk.csv")
    assert "\n" not in message
    return message


def test_transitions_by_hand() -> None:
    groups = columns(start=(torch.arange(150) == 40).float())
    td = RobotLog.from_columns(groups).transitions()
    assert td.shape == (148,)  # 149 pairs, one of which would cross the start of row 40
    state = torch.cat([groups[n] for n in ("roll_pitch", "angular_velocity", "joint_position", "joint_velocity")], -1)
    assert torch.equal(td["measurement"][:39], state[:39])
    assert torch.equal(td["measurement"][39], state[40])
    assert torch.equal(td["next", "measurement"][38], state[39])
    assert torch.equal(td["next", "measurement"][39], state[41])
    assert torch.equal(td["action"][39], groups["action"][40])
    assert set(td.keys(True, True)) == {"measurement", "action", ("next", "measurement")}


def test_starts_of_any_type_are_starts() -> None:
    groups = columns()
    for dtype in (torch.int64, torch.float32, torch.bool):
        log = RobotLog(**groups | {"start": (torch.arange(150) == 40).to(dtype)})
        assert log.start.dtype == torch.bool and len(log.transitions()) == 148
    with pytest.raises(RobotLogError, match="row 3, start: expected 0 or 1, got 2"):
        RobotLog(**groups | {"start": 2 * (torch.arange(150) == 3)})


def test_numbers_of_numpy_become_those_of_networks() -> None:
    groups = {name: value.double() for name, value in columns().items()}
    log = RobotLog.from_columns(groups)
    assert log.time.dtype == torch.float64
    assert {value.dtype for value in log.transitions().values(True, True)} == {torch.float32}


def test_a_quaternion_serves_as_orientation() -> None:
    groups = columns()
    roll, pitch = groups["roll_pitch"].unbind(-1)
    quaternion = rotations.from_euler(roll, pitch, torch.linspace(-3.0, 3.0, 150))
    log = RobotLog.from_columns(columns(roll_pitch=None, quaternion=1.002 * quaternion))
    torch.testing.assert_close(log.roll_pitch, groups["roll_pitch"], atol=1e-5, rtol=0)
    quaternion[7] *= 0.5
    assert "row 7, quaternion has length 0.500" in refused(columns(roll_pitch=None, quaternion=quaternion))
    quaternion[7] = math.nan
    assert "row 7, quaternion has length not finite" in refused(columns(roll_pitch=None, quaternion=quaternion))


@pytest.mark.parametrize("suffix", [".mcap", ".csv", ".npz"])
def test_round_trip(tmp_path: Path, suffix: str) -> None:
    groups = columns(start=(torch.arange(150) == 40).float(), linear_acceleration=torch.randn(150, 3))
    log = RobotLog.from_columns(groups)
    again = RobotLog.load(log.save(tmp_path / f"log{suffix}"))
    for name in (*groups, "start"):
        if name != "time":
            assert torch.equal(getattr(again, name), getattr(log, name)), name
    torch.testing.assert_close(again.time, log.time, atol=1e-9, rtol=0)
    one, two = log.transitions(), again.transitions()
    assert all(torch.equal(one[key], two[key]) for key in one.keys(True, True))


def test_wrong_rate() -> None:
    time = 0.01 * torch.arange(150, dtype=torch.float64)
    assert "time runs at 100.0 Hz, expected 50.0 Hz" in refused(columns(time=time))
    assert len(RobotLog.from_columns(columns(time=time), control_dt=0.01)) == 150


def test_gaps_doubled_rows_and_time_that_runs_backwards() -> None:
    time = columns()["time"]
    gap = time.clone()
    gap[60:] += 0.1
    assert "row 60, time comes 120.0 ms after the row before, expected 20.0 ms" in refused(columns(time=gap))
    start = (torch.arange(150) == 60).float()
    assert len(RobotLog.from_columns(columns(time=gap, start=start)).transitions()) == 148
    doubled = time.clone()
    doubled[60:] -= 0.019
    assert "row 60, time comes 1.0 ms" in refused(columns(time=doubled))
    doubled[60] = doubled[59]
    assert "row 60, time goes from" in refused(columns(time=doubled))
    jitter = time + 0.004 * torch.rand(150, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert len(RobotLog.from_columns(columns(time=jitter))) == 150


@pytest.mark.parametrize(
    ("name", "row", "column", "value", "message"),
    [
        ("joint_velocity", 12, 4, math.nan, "row 12, joint_velocity.FR_thigh_joint is nan"),
        ("roll_pitch", 3, 1, math.inf, "row 3, roll_pitch.pitch is inf"),
        ("action", 149, 11, math.nan, "row 149, action.RR_calf_joint is nan"),
        ("joint_position", 5, 2, 0.9, "row 5, joint_position.FL_calf_joint is 0.900 rad, beyond its stops"),
    ],
)
def test_numbers_that_cannot_be(name: str, row: int, column: int, value: float, message: str) -> None:
    assert message in refused(with_value(name, row, column, value))


@pytest.mark.parametrize("value", [math.nan, 0.5, -1.0])
def test_a_start_is_one_or_none(value: float) -> None:
    start = torch.zeros(150)
    start[7] = value
    assert f"row 7, start: expected 0 or 1, got {value:g}" in refused(columns(start=start))


def test_nan_in_time() -> None:
    time = columns()["time"]
    time[9] = math.nan
    assert "row 9, time is nan" in refused(columns(time=time))


def test_a_landing_may_press_a_joint_past_its_stop_but_not_often() -> None:
    stop = constants.JOINT_UPPER[2]
    for rows, past, accepted in ((7, 0.7, True), (8, 0.4, False), (150, 0.19, True), (1, 0.9, False)):
        position = columns()["joint_position"].clone()
        position[-rows:, 2] = stop + past  # of 150 rows; 5 % are 7.5
        if accepted:
            assert len(RobotLog.from_columns(columns(joint_position=position))) == 150
        else:
            assert f"row {150 - rows}, joint_position.FL_calf_joint" in refused(columns(joint_position=position))


def test_joints_in_another_order_leave_their_stops() -> None:
    by_link = columns()["joint_position"].unflatten(-1, (4, 3)).transpose(1, 2).flatten(1)
    assert "joints in another order" in refused(columns(joint_position=by_link))
    degrees = torch.rad2deg(columns()["joint_position"])
    assert "another unit" in refused(columns(joint_position=degrees))


def test_too_short() -> None:
    assert "is too short: 99 rows, expected at least 100" in refused(columns(99))
    assert len(RobotLog.from_columns(columns(99), min_steps=50)) == 99
    assert "too short: 0 rows" in refused(columns(0))


def test_without_actions() -> None:
    assert "has no action; it has angular_velocity" in refused(columns(action=None))
    assert "action is the same in every row" in refused(columns(action=torch.zeros(150, 12)))
    assert "has no roll_pitch (or quaternion)" in refused(columns(roll_pitch=None))


def test_shapes() -> None:
    assert "action must be [150, 12], got [149, 12]" in refused(columns(action=torch.randn(149, 12)))
    assert "angular_velocity must be [150, 3], got [150, 4]" in refused(columns(angular_velocity=torch.randn(150, 4)))


def test_a_bad_file_is_named(tmp_path: Path) -> None:
    path = RobotLog.from_columns(columns()).save(tmp_path / "walk.csv")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:50], *lines[60:]]))
    with pytest.raises(RobotLogError, match=r"walk.csv: row 49, time comes 220.0 ms"):
        RobotLog.load(path)
