"""One episode as one MCAP file that Foxglove and rerun open as it is: frames, joints, contacts, signals, shapes."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import torch
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.records import Metadata
from mcap_protobuf.writer import Writer
from torch import Tensor

from agility_rl.go2 import constants
from agility_rl.record.messages import message_type, read_messages, read_raw
from agility_rl.record.scene import WORLD, Shape, body_transforms, entity, foot_entity, robot_entities

Contacts = message_type("Contacts", dict.fromkeys(constants.LEGS, "bool"))
TRANSFORMS, JOINTS, CONTACTS, SCENE, FEET = "/tf", "/joint_states", "/contacts", "/scene", "/feet"
RESERVED = {topic[1:] for topic in (TRANSFORMS, JOINTS, CONTACTS, SCENE, FEET)}


def is_free(path: Path) -> bool:
    """Whether no episode has this name, neither a finished one nor one in writing, which a killed run may have left."""
    return not path.exists() and not _staged(path).exists()


def free_file(folder: Path, stem: str) -> Path:
    """``STEM_N.mcap`` with the first N that is free.

    Example:
        >>> free_file(Path("nowhere"), "trot").name
        'trot_0.mcap'
    """
    return next(path for number in itertools.count() if is_free(path := folder / f"{stem}_{number}.mcap"))


def _staged(path: Path) -> Path:
    return path.with_name(f".{path.name}.incoming")


class EpisodeRecorder:
    """Write one robot's episode to an MCAP file with Foxglove schemas.

    Topics: ``/tf`` (FrameTransforms of 13 bodies), ``/joint_states`` (JointStates: position, velocity, torque),
    ``/contacts`` (a boolean a foot), ``/scene`` (SceneUpdate: robot and obstacles as primitives, once), ``/feet``
    (SceneUpdate: all four, coloured by contact, at every change), and ``/NAME`` for every group of signals, such as
    ``/command`` and ``/reward``. The file takes its name when it is complete; until then an earlier one of that name
    stays.

    Source: Foxglove message schemas (protobuf); no formula.

    Args:
        path: file ending in ``.mcap``; its folder is made.
        dt: time between two calls of :meth:`record` [s].
        obstacles: shapes in the world frame, by name.
        metadata: JSON values stored in the file (seed, behaviour, policy).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with EpisodeRecorder(f"{folder}/trot.mcap", dt=0.02) as recorder:
        ...         for _ in range(3):
        ...             recorder.record(
        ...                 torch.tensor([0.0, 0.0, 0.3]), torch.tensor([1.0, 0, 0, 0]), torch.zeros(12),
        ...                 signals={"command": {"velocity_x": 1.0}},
        ...             )
        ...     episode = read_episode(f"{folder}/trot.mcap")
        >>> episode["root_position"].shape, episode["command/velocity_x"]
        (torch.Size([3, 3]), tensor([1., 1., 1.]))
    """

    def __init__(
        self,
        path: str | Path,
        *,
        dt: float = constants.CONTROL_DT,
        obstacles: Mapping[str, Shape] | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        if dt <= 0.0:
            raise ValueError(f"expected a positive time between two records [s], got {dt}")
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.num_steps = 0
        self._period = round(dt * 1e9)
        self._staged = _staged(self.path)
        self._file = open(self._staged, "wb")  # noqa: SIM115  (closed by close)
        self._writer = Writer(self._file)
        self._contact: list[bool] | None = None
        self._groups: dict[str, Any] = {}
        described = {key: json.dumps(value) for key, value in (metadata or {}).items()}
        self._writer.add_metadata("episode", {"dt": json.dumps(dt), **described})
        shapes = [entity(name, WORLD, [shape]) for name, shape in (obstacles or {}).items()]
        self._writer.write_message(SCENE, SceneUpdate(entities=[*robot_entities(), *shapes]), 0, 0)

    def record(
        self,
        root_position: Tensor,
        root_quaternion: Tensor,
        joint_position: Tensor,
        *,
        joint_velocity: Tensor | None = None,
        joint_torque: Tensor | None = None,
        foot_contact: Tensor | None = None,
        signals: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Append one control step.

        Args:
            root_position: ``[3]`` [m], world frame.
            root_quaternion: ``[4]``, ``(w, x, y, z)``.
            joint_position: ``[12]`` [rad].
            joint_velocity: ``[12]`` [rad/s].
            joint_torque: ``[12]`` [N·m].
            foot_contact: bool ``[4]``.
            signals: group to name to number; a group keeps the names of its first record.

        Raises:
            ValueError: if a shape differs, or a group changes its names or takes a reserved one.
            RuntimeError: after :meth:`close`.
        """
        if self._file.closed:
            raise RuntimeError(f"{self.path} is closed; make a new recorder for the next episode")
        position = _row("root_position", root_position, 3)
        quaternion = _row("root_quaternion", root_quaternion, 4)
        angles = _row("joint_position", joint_position, constants.NUM_JOINTS)
        velocities = None if joint_velocity is None else _row("joint_velocity", joint_velocity, constants.NUM_JOINTS)
        torques = None if joint_torque is None else _row("joint_torque", joint_torque, constants.NUM_JOINTS)
        time = self.num_steps * self._period
        transforms = FrameTransforms(transforms=body_transforms(position, quaternion, angles))
        for transform in transforms.transforms:
            transform.timestamp.FromNanoseconds(time)
        self._write(TRANSFORMS, transforms, time)
        self._write(JOINTS, _joint_states(time, angles, velocities, torques), time)
        if foot_contact is not None:
            self._record_contact([bool(x) for x in _row("foot_contact", foot_contact, len(constants.LEGS))], time)
        for group, values in (signals or {}).items():
            self._record_signals(group, values, time)
        self.num_steps += 1

    def close(self) -> None:
        """Finish the file and give it its name; calling it again does nothing."""
        if self._file.closed:
            return
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        os.replace(self._staged, self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()  # also after an error: what was recorded shows how it came about

    def _record_contact(self, contact: list[bool], time: int) -> None:
        self._write(CONTACTS, Contacts(**dict(zip(constants.LEGS, contact, strict=True))), time)
        if contact != self._contact:
            # All feet each time, and apart from the scene: who jumps in time sees the last message of each topic alone.
            feet = [foot_entity(leg, touching) for leg, touching in zip(constants.LEGS, contact, strict=True)]
            self._write(FEET, SceneUpdate(entities=feet), time)
        self._contact = contact

    def _record_signals(self, group: str, values: Mapping[str, Any], time: int) -> None:
        if group not in self._groups:
            if group in RESERVED:
                raise ValueError(
                    f"the group {group!r} is reserved; choose another name than {', '.join(sorted(RESERVED))}"
                )
            kinds = {name: "string" if isinstance(value, str) else "double" for name, value in values.items()}
            self._groups[group] = message_type(group.title().replace("_", "").replace("/", ""), kinds)
        kind = self._groups[group]
        names = [field.name for field in kind.DESCRIPTOR.fields]
        if sorted(names) != sorted(values):
            raise ValueError(f"the group {group!r} began with {sorted(names)}, got {sorted(values)}; keep its names")
        plain = {name: value if isinstance(value, str) else float(value) for name, value in values.items()}
        self._write(f"/{group}", kind(**plain), time)

    def _write(self, topic: str, message: Any, time: int) -> None:
        self._writer.write_message(topic, message, log_time=time, publish_time=time)


def write_episode(
    path: str | Path,
    episode: Mapping[str, Tensor],
    *,
    dt: float = constants.CONTROL_DT,
    obstacles: Mapping[str, Shape] | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write an episode that is already in memory, the inverse of :func:`read_episode`.

    Args:
        path: file ending in ``.mcap``.
        episode: ``root_position`` ``[T, 3]``, ``root_quaternion`` ``[T, 4]``, ``joint_position`` ``[T, 12]``; if there
            are, ``joint_velocity``, ``joint_torque``, ``foot_contact`` ``[T, 4]``, and signals ``GROUP/NAME`` ``[T]``.
        dt: time between two rows [s].
        obstacles: shapes in the world frame, by name.
        metadata: JSON values stored in the file.

    Raises:
        KeyError: if one of the three necessary entries is missing.
    """
    needed = ("root_position", "root_quaternion", "joint_position")
    if missing := [name for name in needed if name not in episode]:
        raise KeyError(f"an episode needs {', '.join(needed)}; missing {missing}, got {sorted(episode)}")
    optional = {name: episode[name] for name in ("joint_velocity", "joint_torque", "foot_contact") if name in episode}
    groups: dict[str, dict[str, list[float]]] = {}
    for name, values in episode.items():
        group, slash, signal = name.rpartition("/")
        if slash:
            groups.setdefault(group, {})[signal] = values.tolist()
    with EpisodeRecorder(path, dt=dt, obstacles=obstacles, metadata=metadata) as recorder:
        for index in range(len(episode["root_position"])):
            recorder.record(
                *(episode[name][index] for name in needed),
                **{name: values[index] for name, values in optional.items()},
                signals={g: {name: column[index] for name, column in rows.items()} for g, rows in groups.items()},
            )
    return Path(path)


def read_episode(path: str | Path) -> dict[str, Tensor]:
    """Read an episode back.

    Returns:
        ``time`` float64 ``[T]`` [s]; ``root_position`` ``[T, 3]``, ``root_quaternion`` ``[T, 4]``, ``joint_position``
        ``[T, 12]`` and whatever else was recorded: ``joint_velocity``, ``joint_torque``, ``foot_contact`` bool
        ``[T, 4]``, and numeric signals as ``GROUP/NAME`` ``[T]``. Tensors are float32 unless stated.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no episode.
        agility_rl.record.messages.DamageError: if the file cannot be read.
    """
    rows: dict[str, list[Any]] = {}
    for topic, _, time, value in read_messages(path):
        if topic == TRANSFORMS:
            trunk = value.transforms[0]
            rows.setdefault("time", []).append(time)
            rows.setdefault("root_position", []).append([trunk.translation.x, trunk.translation.y, trunk.translation.z])
            turn = trunk.rotation
            rows.setdefault("root_quaternion", []).append([turn.w, turn.x, turn.y, turn.z])
        elif topic == JOINTS:
            for name, field in (("position", "position"), ("velocity", "velocity"), ("torque", "effort")):
                if value.joints[0].HasField(field):
                    rows.setdefault(f"joint_{name}", []).append([getattr(joint, field) for joint in value.joints])
        elif topic == CONTACTS:
            rows.setdefault("foot_contact", []).append([getattr(value, leg) for leg in constants.LEGS])
        elif topic not in (SCENE, FEET):
            for field in value.DESCRIPTOR.fields:
                if not isinstance(number := getattr(value, field.name), str):
                    rows.setdefault(f"{topic[1:]}/{field.name}", []).append(number)
    if "time" not in rows:
        raise ValueError(f"{path} holds no episode: expected the topic {TRANSFORMS}")
    episode = {name: torch.tensor(values) for name, values in rows.items() if name != "time"}
    return {"time": torch.tensor(rows["time"], dtype=torch.float64) * 1e-9, **episode}


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Metadata of an episode, with ``dt`` [s]."""
    for record in read_raw(path):
        if isinstance(record, Metadata) and record.name == "episode":
            return {key: json.loads(value) for key, value in record.metadata.items()}
    return {}


def _row(name: str, value: Tensor, size: int) -> list[float]:
    if value.shape != (size,):
        raise ValueError(f"{name} of one robot must be [{size}], got {list(value.shape)}; record one robot at a time")
    return value.tolist()


def _joint_states(
    time: int, angles: Sequence[float], velocities: Sequence[float] | None, torques: Sequence[float] | None
) -> JointStates:
    message = JointStates()
    message.timestamp.FromNanoseconds(time)
    for index, name in enumerate(constants.JOINT_NAMES):
        joint = message.joints.add(name=name, position=angles[index])
        if velocities is not None:
            joint.velocity = velocities[index]
        if torques is not None:
            joint.effort = torques[index]
    return message
