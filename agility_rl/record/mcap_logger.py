"""Metrics of a run in one MCAP file: readable while it is written, after a crash, and in Foxglove."""

from __future__ import annotations

import io
import json
import os
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.records import Metadata
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from PIL import Image
from torch import Tensor
from torchrl.record.loggers import Logger

from agility_rl.record.messages import DamageError, message_type, read_messages, read_raw

METRICS_FILE = "metrics.mcap"
Scalar = message_type("Scalar", {"step": "int64", "value": "double", "session": "int64"})
Histogram = message_type("Histogram", {"step": "int64", "edges": "double[]", "counts": "double[]", "session": "int64"})


class MCAPLogger(Logger):
    """TorchRL logger that writes ``LOG_DIR/EXP_NAME/metrics.mcap``.

    Every metric is a topic ``/NAME`` of messages ``(step, value, session)``; a resumed run counts one session more.
    The file is cut into chunks at most ``flush_interval`` seconds apart, so a killed process loses no more than that.
    When a run resumes, the readable part of its file is copied to a new one, which then takes the old one's place and
    grows on: nothing that was readable is lost, whenever the process is killed.

    Source: MCAP specification (chunks), Foxglove schema ``CompressedImage``; no formula.

    Args:
        exp_name: name of the run, the folder below ``log_dir``.
        log_dir: folder of all runs.
        resume: continue an existing file.
        flush_interval: longest time [s] that logged values wait in memory (checked at each call); 0 writes at once.

    Raises:
        FileExistsError: if the run already has metrics and ``resume`` is false.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as runs:
        ...     logger = MCAPLogger("demo", runs)
        ...     _ = logger.log_metrics({"loss": torch.tensor(0.5)}, step=10)
        ...     logger.close()
        ...     read_scalars(f"{runs}/demo")["loss"]
        (tensor([10]), tensor([0.5000], dtype=torch.float64))
    """

    def __init__(
        self, exp_name: str, log_dir: str | Path, *, resume: bool = False, flush_interval: float = 1.0
    ) -> None:
        self.path = Path(log_dir) / exp_name / METRICS_FILE
        self.flush_interval = flush_interval
        self.session = 0
        self._resume = resume
        self._next_step: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[str, int] = {}
        self._flushed = time.monotonic()
        super().__init__(exp_name=exp_name, log_dir=str(log_dir))

    def _create_experiment(self) -> _Stream:
        if self.path.exists() and not self._resume:
            raise FileExistsError(f"{self.path} already exists; choose another run name, or continue with resume=True")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if not self.path.exists():
            stream = _Stream(self.path)
        else:
            staged = self.path.with_name(f".{METRICS_FILE}.incoming")
            stream = _Stream(staged)
            self._copy_previous(stream)
            stream.flush()
            os.fsync(stream.file.fileno())
            os.replace(staged, self.path)  # the open stream follows the file to its new name
        # Ends the file properly when the interpreter exits or the logger is dropped, without keeping the logger alive.
        self._finalizer = weakref.finalize(self, stream.finish)
        return stream

    def _copy_previous(self, stream: _Stream) -> None:
        """Copy what an earlier session wrote, and keep a damaged file beside."""
        kinds = {kind.DESCRIPTOR.full_name: kind for kind in (Scalar, Histogram)}
        try:
            for record in read_raw(self.path):
                if isinstance(record, Metadata):
                    stream.writer.add_metadata(record.name, record.metadata)
                    continue
                schema, channel, message = record
                if channel.topic not in self._channels:
                    if schema.name not in self._schemas:
                        identity = stream.writer.register_schema(schema.name, schema.encoding, schema.data)
                        self._schemas[schema.name] = identity
                    self._register(stream, channel.topic, schema.name, self._schemas[schema.name])
                self._send(stream, channel.topic, message.data, message.log_time)
                if kind := kinds.get(schema.name):
                    logged = kind.FromString(message.data)
                    self.session = max(self.session, logged.session + 1)
                    self._next_step[channel.topic[1:]] = logged.step + 1
        except DamageError:
            count = len(list(self.path.parent.glob("metrics.damaged-*.mcap")))
            os.link(self.path, self.path.with_name(f"metrics.damaged-{count + 1}.mcap"))
        self.session = max(self.session, 1)

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        """Log one number; a tensor or list of several numbers is logged as ``NAME/0``, ``NAME/1``, ...

        Args:
            name: metric, with ``/`` between groups, such as ``reward/imitation``.
            value: the number; NaN and infinity are kept.
            step: iteration; one more than the last one of this name by default.
        """
        numbers = value.tolist() if isinstance(value, Tensor | np.ndarray) else value
        if isinstance(numbers, list | tuple):
            for index, number in enumerate(numbers):
                self.log_scalar(f"{name}/{index}", number, step)
            return
        self._write(name, Scalar(step=self._step(name, step), value=float(numbers), session=self.session))
        self._maybe_flush()

    def log_histogram(self, name: str, data: Tensor | Sequence[float], **kwargs: Any) -> None:
        """Log how many values fall between equally spaced edges; NaN and infinity are left out.

        Args:
            name: topic.
            data: any shape.
            **kwargs: ``step`` as in :meth:`log_scalar`, ``bins`` (30).
        """
        values = torch.as_tensor(data, dtype=torch.float64).flatten().cpu()
        values = values[values.isfinite()]
        counts, edges = np.histogram(values.numpy(), bins=kwargs.get("bins", 30))
        step = self._step(name, kwargs.get("step"))
        self._write(name, Histogram(step=step, edges=edges, counts=counts.astype(float), session=self.session))
        self._maybe_flush()

    def log_image(self, name: str, image: Tensor, step: int | None = None, *, time_ns: int | None = None) -> None:
        """Log a picture, uint8 ``[3 or 1, height, width]``, as a Foxglove ``CompressedImage`` (JPEG).

        Raises:
            ValueError: if the picture has another shape or type.
        """
        if image.dtype != torch.uint8 or image.ndim != 3 or image.shape[0] not in (1, 3):
            raise ValueError(
                f"expected uint8 [3 or 1, height, width] for {name!r}, got {image.dtype} {list(image.shape)}"
            )
        pixels = image.permute(1, 2, 0).squeeze(-1).cpu().numpy()
        encoded = io.BytesIO()
        Image.fromarray(pixels).save(encoded, format="JPEG", quality=90)
        message = CompressedImage(data=encoded.getvalue(), format="jpeg", frame_id=f"step {self._step(name, step)}")
        stamp = time.time_ns() if time_ns is None else time_ns
        message.timestamp.FromNanoseconds(stamp)
        self._write(name, message, stamp)
        self._maybe_flush()

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log pictures in sequence, uint8 ``[T, 3, height, width]`` or ``[N, T, 3, height, width]`` (N side by side).

        Args:
            name: topic.
            video: the pictures.
            step: iteration.
            **kwargs: ``fps`` (50), which spaces their times.
        """
        if video.ndim == 5:
            video = torch.cat(tuple(video.unbind(0)), dim=-1)
        if video.ndim != 4:
            raise ValueError(f"expected [T, 3, height, width] or [N, T, 3, height, width], got {list(video.shape)}")
        start, period = time.time_ns(), int(1e9 / kwargs.get("fps", 50))
        step = self._step(name, step)
        for index, image in enumerate(video):
            self.log_image(name, image, step, time_ns=start + index * period)

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Store settings as a metadata record ``hparams``, one JSON text an entry; see :func:`read_hparams`."""
        self.experiment.writer.add_metadata("hparams", {str(k): json.dumps(v, default=str) for k, v in cfg.items()})
        self.flush()

    def flush(self, timeout: float | None = None) -> None:
        """Hand everything logged so far to the operating system, where other processes can read it."""
        del timeout
        self.experiment.flush()
        self._flushed = time.monotonic()

    def shutdown(self, timeout: float | None = None) -> None:
        """Write the index and close the file; calling it again does nothing."""
        del timeout
        self._finalizer()
        self._service_shutdown = True

    def state_dict(self) -> dict[str, Any]:
        """Next step of every metric; the folder is left out, so that a run can be moved and resumed."""
        self.flush()
        return {"exp_name": self.exp_name, "local": self._checkpoint_state()}

    def _checkpoint_state(self) -> dict[str, Any]:
        return {"next_step": dict(self._next_step)}

    def _load_checkpoint_state(self, state_dict: Mapping[str, Any]) -> None:
        self._next_step = dict(state_dict["next_step"])

    def __repr__(self) -> str:
        return f"MCAPLogger({str(self.path)!r}, session={self.session})"

    def _step(self, name: str, step: int | None) -> int:
        step = self._next_step.get(name, 0) if step is None else int(step)
        self._next_step[name] = step + 1
        return step

    def _write(self, name: str, message: Any, stamp: int | None = None) -> None:
        topic, kind = f"/{name}", type(message).DESCRIPTOR.full_name
        stream = self.experiment
        if stream.finished:
            raise RuntimeError(f"{self.path} is closed; log before close(), or open it again with resume=True")
        if topic not in self._channels:
            if kind not in self._schemas:
                self._schemas[kind] = register_schema(stream.writer, type(message))
            self._register(stream, topic, kind, self._schemas[kind])
        if self._channels[topic][1] != kind:
            raise ValueError(f"{name!r} was logged as {self._channels[topic][1]}, got {kind}; use another name")
        self._send(stream, topic, message.SerializeToString(), time.time_ns() if stamp is None else stamp)

    def _register(self, stream: _Stream, topic: str, kind: str, schema: int) -> None:
        self._channels[topic] = (stream.writer.register_channel(topic, "protobuf", schema), kind)

    def _send(self, stream: _Stream, topic: str, data: bytes, stamp: int) -> None:
        stream.writer.add_message(self._channels[topic][0], log_time=stamp, data=data, publish_time=stamp)

    def _maybe_flush(self) -> None:
        if time.monotonic() - self._flushed >= self.flush_interval:
            self.flush()


class _Stream:
    """An MCAP writer and its file, which finish together."""

    def __init__(self, path: Path) -> None:
        self.file = open(path, "wb")  # noqa: SIM115  (closed by finish)
        self.writer = Writer(self.file)
        self.writer.start(profile="", library="agility_rl")
        self.finished = False
        self.process = os.getpid()

    def flush(self) -> None:
        if not self.finished:
            self.writer.flush()

    def finish(self) -> None:
        # A forked child inherits the object, and must not write its buffer into the parent's file.
        if not self.finished and self.process == os.getpid():
            self.finished = True
            self.writer.finish()
            self.file.close()


def read_scalars(path: str | Path) -> dict[str, tuple[Tensor, Tensor]]:
    """Every scalar of a run: name to (steps int64 ``[n]``, values float64 ``[n]``).

    Reads files that are still written or whose writer was killed. What a resumed run did again replaces what
    came after the checkpoint it resumed from.

    Args:
        path: ``metrics.mcap`` or the folder that holds it.

    Raises:
        FileNotFoundError: if there is no such file.
        agility_rl.record.messages.DamageError: if the file is no MCAP or damaged in the middle.
    """
    rows: dict[str, list[tuple[int, float, int]]] = {}
    first: dict[int, int] = {}  # step that a session did again first
    before: dict[tuple[str, int], int] = {}  # last step of a name before a session
    for record in read_messages(_file(path)):
        if record.schema == Scalar.DESCRIPTOR.full_name:
            name, step, session = record.topic[1:], record.value.step, record.value.session
            entries = rows.setdefault(name, [])
            if (name, session) not in before:
                before[name, session] = max((entry[0] for entry in entries), default=-1)
            if step <= before[name, session]:  # not of a name that a session begins or goes on with
                first[session] = min(first.get(session, step), step)
            entries.append((step, record.value.value, session))
    result = {}
    for name, entries in rows.items():
        kept = [e for e in entries if all(e[0] < start for session, start in first.items() if session > e[2])]
        steps = torch.tensor([step for step, _, _ in kept], dtype=torch.int64)
        result[name] = (steps, torch.tensor([value for _, value, _ in kept], dtype=torch.float64))
    return result


def read_hparams(path: str | Path) -> dict[str, Any]:
    """Settings that :meth:`MCAPLogger.log_hparams` stored."""
    found: dict[str, Any] = {}
    for record in read_raw(_file(path)):
        if isinstance(record, Metadata) and record.name == "hparams":
            found.update({key: json.loads(value) for key, value in record.metadata.items()})
    return found


def _file(path: str | Path) -> Path:
    path = Path(path)
    return path / METRICS_FILE if path.is_dir() else path
