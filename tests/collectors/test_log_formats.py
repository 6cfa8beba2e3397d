from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from mcap_protobuf.writer import Writer
from torch import Tensor

from agility_rl.collectors import RobotLog, RobotLogError
from agility_rl.collectors.log_formats import GROUPS, SUFFIXES, check_names, read_columns, write_columns
from agility_rl.go2 import constants
from agility_rl.record.messages import read_messages


def columns(count: int = 7, *without: str) -> dict[str, Tensor]:
    groups = {name: torch.randn(count, len(names)) for name, names in GROUPS.items()}
    groups |= {"time": 100.0 + 0.02 * torch.arange(count, dtype=torch.float64)}
    groups |= {"start": (torch.arange(count) == 3).float()}
    return {name: value for name, value in groups.items() if name not in without}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("without", [(), ("quaternion", "linear_acceleration", "start")])
def test_every_bit_comes_back(tmp_path: Path, suffix: str, without: tuple[str, ...]) -> None:
    written = columns(7, *without)
    read = read_columns(write_columns(tmp_path / f"new/log{suffix}", written))
    assert set(read) == set(written)
    for name, value in written.items():
        if name == "time" and suffix == ".mcap":  # whole nanoseconds
            torch.testing.assert_close(read[name], value, atol=1e-9, rtol=0)
        else:
            assert torch.equal(read[name], value), name
    assert [file.name for file in (tmp_path / "new").iterdir()] == [f"log{suffix}"]


def test_csv_is_what_the_documentation_says(tmp_path: Path) -> None:
    lines = write_columns(tmp_path / "log.csv", columns()).read_text().splitlines()
    assert len(lines) == 8
    header = lines[0].split(",")
    assert {"time", "start", "roll_pitch.roll", "joint_position.FL_hip_joint", "action.RR_calf_joint"} <= set(header)


def test_columns_of_other_groups_may_stand_anywhere_and_foreign_ones_are_ignored(tmp_path: Path) -> None:
    path = write_columns(tmp_path / "log.csv", columns())
    rows = [line.split(",") for line in path.read_text().splitlines()]
    time = rows[0].index("time")
    moved = [["battery" if i == 0 else "24.5", row[time], *row[:time], *row[time + 1 :]] for i, row in enumerate(rows)]
    other = tmp_path / "other.csv"
    other.write_text("\n".join(",".join(row) for row in moved))
    one, two = read_columns(path), read_columns(other)
    assert set(one) == set(two)
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_mcap_topics_are_what_the_documentation_says(tmp_path: Path) -> None:
    records = list(read_messages(write_columns(tmp_path / "log.mcap", columns())))
    assert {r.topic for r in records} == {"/joint_states", "/start"} | {
        f"/{name}" for name in GROUPS if not name.startswith("joint_")
    }
    joints = next(r.value for r in records if r.topic == "/joint_states")
    assert [joint.name for joint in joints.joints] == list(constants.JOINT_NAMES)


def test_joints_in_another_order(tmp_path: Path) -> None:
    path = write_columns(tmp_path / "log.csv", columns())
    text = path.read_text()
    for a, b in (("FL", "XX"), ("FR", "FL"), ("XX", "FR")):
        text = text.replace(f"joint_velocity.{a}_", f"joint_velocity.{b}_")
    path.write_text(text)
    with pytest.raises(RobotLogError, match=r"joint_velocity is in another order: column 0 is 'FR_hip_joint'"):
        read_columns(path)

    names = list(constants.JOINT_NAMES)
    np.savez(tmp_path / "log.npz", joint_names=np.array(names[3:] + names[:3]), time=np.arange(3.0))
    with pytest.raises(RobotLogError, match=r"joint_names is in another order: column 0 is 'FR_hip_joint'"):
        read_columns(tmp_path / "log.npz")
    np.savez(tmp_path / "log.npz", time=np.arange(3.0))
    with pytest.raises(RobotLogError, match="has no joint_names"):
        read_columns(tmp_path / "log.npz")


def test_mcap_with_joints_in_another_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = constants.JOINT_NAMES
    with monkeypatch.context() as patch:
        patch.setattr("agility_rl.collectors.log_formats.constants.JOINT_NAMES", names[3:] + names[:3])
        path = write_columns(tmp_path / "log.mcap", columns())
    with pytest.raises(RobotLogError, match=r"/joint_states at 100.000 s is in another order: column 0 is 'FR_hip"):
        read_columns(path)


def test_missing_and_foreign_columns(tmp_path: Path) -> None:
    path = write_columns(tmp_path / "log.csv", columns())
    text = path.read_text()
    path.write_text(text.replace("action.RL_calf_joint", "torque.RL_calf_joint"))
    with pytest.raises(RobotLogError, match=r"action lacks 'RL_calf_joint'; it has 11 columns, expected 12"):
        read_columns(path)
    path.write_text(text.replace("time", "clock"))
    with pytest.raises(RobotLogError, match="has no time"):
        read_columns(path)
    with pytest.raises(RobotLogError, match="has 'z' once too often"):
        check_names("here", ["x", "y", "z", "z"], ("x", "y", "z"))


def test_text_and_torn_lines_in_csv(tmp_path: Path) -> None:
    path = write_columns(tmp_path / "log.csv", {"time": torch.arange(3.0), "roll_pitch": torch.ones(3, 2)})
    path.write_text("time,roll_pitch.roll,roll_pitch.pitch\n0.0,1.0,1.0\n0.02,,1.0\n")
    with pytest.raises(RobotLogError, match=r"row 1, roll_pitch.roll: expected a number, got ''"):
        read_columns(path)
    path.write_text("time,roll_pitch.roll,roll_pitch.pitch\n0.0,1.0,1.0\n0.02,1.0")
    with pytest.raises(RobotLogError, match="row 1 has 2 values, expected 3"):
        read_columns(path)
    path.write_text("time,roll_pitch.roll,roll_pitch.pitch\n0.0,1.0,1.0\n", encoding="utf-8-sig")
    assert read_columns(path)["roll_pitch"].tolist() == [[1.0, 1.0]], "spreadsheets begin a file with a mark"
    path.write_text("time,höhe\n0.0,1.0\n", encoding="latin-1")
    with pytest.raises(RobotLogError, match=r"log.csv is no text in UTF-8"):
        read_columns(path)
    path.write_text("")
    with pytest.raises(RobotLogError, match="is empty"):
        read_columns(path)


@pytest.mark.parametrize("suffix", [".npz", ".mcap"])
def test_damaged_files(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"log{suffix}"
    path.write_bytes(b"this is no log, whatever its name says, and long enough to be one")
    with pytest.raises(RobotLogError, match="damaged or no"):
        read_columns(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("joint_names", "joint_names lacks 'FL_thigh_joint'; it has 1 columns, expected 12"),
        ("time", "time must have a row for each control step"),
        ("quaternion", "quaternion must have a row for each control step"),
    ],
)
def test_npz_whose_arrays_have_no_rows(tmp_path: Path, name: str, message: str) -> None:
    path = write_columns(tmp_path / "log.npz", columns())
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{**arrays, "robot": np.array(7)})
    assert "robot" not in read_columns(path), "what is foreign may have any shape"
    np.savez(path, **{**arrays, name: arrays[name][0]})
    with pytest.raises(RobotLogError, match=message):
        read_columns(path)


def test_what_only_looks_like_a_log(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(tmp_path / "array.npz")
    with pytest.raises(RobotLogError, match="damaged or no npz"):
        read_columns(tmp_path / "array.npz")
    np.savez_compressed(tmp_path / "bad.npz", time=np.arange(4000.0))
    content = bytearray((tmp_path / "bad.npz").read_bytes())
    content[100:140] = bytes(40)
    (tmp_path / "bad.npz").write_bytes(content)
    with pytest.raises(RobotLogError, match="damaged or no npz"):
        read_columns(tmp_path / "bad.npz")
    text = write_columns(tmp_path / "log.csv", columns(400)).read_text()
    (tmp_path / "log.csv").write_text(text.replace("\n", '\n"', 1))
    with pytest.raises(RobotLogError, match=r"is no CSV file: .*look for a stray quotation mark"):
        read_columns(tmp_path / "log.csv")


def test_npz_without_numbers_or_with_pickled_objects(tmp_path: Path) -> None:
    path, names = tmp_path / "log.npz", np.array(constants.JOINT_NAMES)
    np.savez(path, joint_names=names, time=np.array(["a", "b"]))
    with pytest.raises(RobotLogError, match="time must hold numbers"):
        read_columns(path)
    np.savez(path, joint_names=names, time=np.array([{}, {}], dtype=object))
    with pytest.raises(RobotLogError, match="damaged or no npz"):
        read_columns(path)


def test_mcap_knows_no_time_before_zero(tmp_path: Path) -> None:
    early = columns() | {"time": -1.0 + 0.02 * torch.arange(7, dtype=torch.float64)}
    with pytest.raises(RobotLogError, match=r"time begins at -1.000 s, MCAP knows none before 0"):
        write_columns(tmp_path / "log.mcap", early)
    assert not list(tmp_path.iterdir())
    assert torch.equal(read_columns(write_columns(tmp_path / "log.npz", early))["time"], early["time"])


def test_an_mcap_row_without_its_action(tmp_path: Path) -> None:
    path, torn = write_columns(tmp_path / "log.mcap", columns()), tmp_path / "torn.mcap"
    with open(torn, "wb") as file:
        writer = Writer(file)
        for topic, _, time, value in read_messages(path):
            if topic != "/action" or round(time * 1e-7) != 10006:  # row 3, at 100.06 s
                writer.write_message(topic, value, log_time=time, publish_time=time)
        writer.finish()
    with pytest.raises(RobotLogError, match=r"row 3 \(at 100.060 s\) has no action"):
        read_columns(torn)
    nothing = {name: value[:0] for name, value in columns().items()}
    with pytest.raises(RobotLogError, match="has no joint positions"):
        read_columns(write_columns(tmp_path / "none.mcap", nothing))


def test_paths(tmp_path: Path) -> None:
    with pytest.raises(RobotLogError, match=r"ending in .mcap, .csv, .npz"):
        read_columns(tmp_path / "log.bag")
    with pytest.raises(RobotLogError, match="must end in"):
        write_columns(tmp_path / "log.txt", columns())
    with pytest.raises(FileNotFoundError, match="no robot log"):
        read_columns(tmp_path / "log.csv")


def test_a_written_log_is_read_as_a_log(tmp_path: Path, log: RobotLog) -> None:
    for suffix in SUFFIXES:
        again = RobotLog.load(log.save(tmp_path / f"log{suffix}"))
        assert torch.equal(again.action, log.action)
        assert torch.equal(again.start, log.start)
