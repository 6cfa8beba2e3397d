"""Episodes: exact round trip, Foxglove's own schemas, and errors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from mcap.reader import make_reader

from agility_rl.go2 import constants
from agility_rl.record.episode import EpisodeRecorder, free_file, is_free, read_episode, read_metadata, write_episode
from agility_rl.record.messages import read_messages
from agility_rl.record.scene import Shape


@pytest.fixture
def episode(generator: torch.Generator) -> dict[str, torch.Tensor]:
    steps = 40
    return {
        "root_position": torch.randn(steps, 3, generator=generator),
        "root_quaternion": torch.nn.functional.normalize(torch.randn(steps, 4, generator=generator), dim=-1),
        "joint_position": torch.randn(steps, 12, generator=generator),
        "joint_velocity": torch.randn(steps, 12, generator=generator),
        "joint_torque": torch.randn(steps, 12, generator=generator),
        "foot_contact": torch.rand(steps, 4, generator=generator) > 0.5,
        "command/velocity_x": torch.rand(steps, generator=generator),
        "reward/imitation": torch.rand(steps, generator=generator),
    }


def test_round_trip_is_exact(tmp_path: Path, episode: dict[str, torch.Tensor]) -> None:
    path = write_episode(
        tmp_path / "episodes" / "trot.mcap", episode, dt=0.02, metadata={"behaviour": "trot", "seed": 3}
    )
    again = read_episode(path)
    time = again.pop("time")
    assert torch.allclose(time, torch.arange(40, dtype=torch.float64) * 0.02)
    assert set(again) == set(episode)
    for name, value in episode.items():
        assert again[name].dtype == value.dtype and torch.equal(again[name], value), name
    assert read_metadata(path) == {"dt": 0.02, "behaviour": "trot", "seed": 3}


def test_schemas_are_those_foxglove_and_rerun_know(tmp_path: Path, episode: dict[str, torch.Tensor]) -> None:
    obstacles = {"bar": Shape("box", (0.1, 1.0, 0.1), (2.0, 0.0, 0.2))}
    path = write_episode(tmp_path / "e.mcap", episode, obstacles=obstacles)
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == {
        "/tf": "foxglove.FrameTransforms",
        "/joint_states": "foxglove.JointStates",
        "/scene": "foxglove.SceneUpdate",
        "/feet": "foxglove.SceneUpdate",
        "/contacts": "agility_rl.Contacts",
        "/command": "agility_rl.Command",
        "/reward": "agility_rl.Reward",
    }
    assert {schema.encoding for schema in summary.schemas.values()} == {"protobuf"}
    records = list(read_messages(path))
    first = next(record for record in records if record.topic == "/tf")
    assert len(first.value.transforms) == 13
    joints = next(record.value for record in records if record.topic == "/joint_states").joints
    assert tuple(joint.name for joint in joints) == constants.JOINT_NAMES
    scene = [record.value for record in records if record.topic == "/scene"]
    assert len(scene) == 1 and {e.id for e in scene[0].entities} >= {"trunk", "FL_calf", "bar"}
    feet = {record.time: record.value.entities for record in records if record.topic == "/feet"}
    for time, entities in feet.items():  # each message has all four, for viewers that jump to it
        coloured = {entity.id: entity.spheres[0].color.r > 0.5 for entity in entities}
        touching = episode["foot_contact"][round(time / 20_000_000)].tolist()
        assert coloured == {f"{leg}_foot": there for leg, there in zip(constants.LEGS, touching, strict=True)}
    changes = (episode["foot_contact"][1:] != episode["foot_contact"][:-1]).any(-1).sum()
    assert len(feet) == 1 + changes


def test_the_optional_parts_are_optional(tmp_path: Path, episode: dict[str, torch.Tensor]) -> None:
    bare = {name: episode[name] for name in ("root_position", "root_quaternion", "joint_position")}
    assert set(read_episode(write_episode(tmp_path / "e.mcap", bare))) == {"time", *bare}


def test_the_name_is_taken_when_the_file_is_complete(tmp_path: Path, episode: dict[str, torch.Tensor]) -> None:
    path = write_episode(tmp_path / "e.mcap", episode)
    before = path.read_bytes()
    recorder = EpisodeRecorder(path)
    assert path.read_bytes() == before
    with pytest.raises(RuntimeError, match="the robot fell"), recorder:
        recorder.record(
            torch.zeros(3), torch.tensor([1.0, 0, 0, 0]), torch.zeros(12), signals={"info": {"skill": "trot"}}
        )
        raise RuntimeError("the robot fell")
    assert len(read_episode(path)["time"]) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["e.mcap"]
    recorder.close()
    with pytest.raises(RuntimeError, match="is closed; make a new recorder"):
        recorder.record(torch.zeros(3), torch.tensor([1.0, 0, 0, 0]), torch.zeros(12))


def test_a_name_is_free_that_no_recording_has_finished_or_begun(tmp_path: Path) -> None:
    (tmp_path / "trot_0.mcap").touch()
    with EpisodeRecorder(free_file(tmp_path, "trot")) as recorder:
        assert recorder.path.name == "trot_1.mcap" and not is_free(recorder.path)
        assert free_file(tmp_path, "trot").name == "trot_2.mcap", "beside it, another one may record"


def test_two_recorders_may_have_the_same_group_with_other_names(tmp_path: Path) -> None:
    state = torch.zeros(3), torch.tensor([1.0, 0, 0, 0]), torch.zeros(12)
    for name in ("a", "b"):
        with EpisodeRecorder(tmp_path / f"{name}.mcap") as recorder:
            recorder.record(*state, signals={"command": {name: torch.tensor(2.0)}})
    assert read_episode(tmp_path / "b.mcap")["command/b"].tolist() == [2.0]


def test_errors(tmp_path: Path, episode: dict[str, torch.Tensor]) -> None:
    with EpisodeRecorder(tmp_path / "e.mcap") as recorder:
        state = torch.zeros(3), torch.tensor([1.0, 0, 0, 0]), torch.zeros(12)
        with pytest.raises(ValueError, match=r"root_position of one robot must be \[3\], got \[2, 3\]"):
            recorder.record(torch.zeros(2, 3), *state[1:])
        with pytest.raises(ValueError, match="'tf' is reserved"):
            recorder.record(*state, signals={"tf": {"x": 1.0}})
        recorder.record(*state, signals={"command": {"a": 1.0}})
        with pytest.raises(ValueError, match=r"began with \['a'\], got \['b'\]"):
            recorder.record(*state, signals={"command": {"b": 1.0}})
    with pytest.raises(ValueError, match="positive time"):
        EpisodeRecorder(tmp_path / "f.mcap", dt=0.0)
    with pytest.raises(KeyError, match="missing"):
        write_episode(tmp_path / "g.mcap", {"root_position": episode["root_position"]})
    with pytest.raises(FileNotFoundError):
        read_episode(tmp_path / "none.mcap")
