"""Protobuf message types of our own, made at run time, and reading of MCAP files that may be unfinished.

Foxglove and rerun read a message's fields from the descriptor stored in the file, so that no generated code is needed.
Protobuf is chosen over JSON because it keeps NaN, infinity and every bit of a float.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.data_stream import EndOfFile
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

_KINDS = {
    "double": descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
    "int64": descriptor_pb2.FieldDescriptorProto.TYPE_INT64,
    "bool": descriptor_pb2.FieldDescriptorProto.TYPE_BOOL,
    "string": descriptor_pb2.FieldDescriptorProto.TYPE_STRING,
}


def message_type(name: str, fields: Mapping[str, str]) -> Any:
    """Class of a protobuf message ``agility_rl.NAME`` with the given fields, numbered in order.

    Source: protobuf language guide (descriptors); no formula.

    Args:
        name: message name.
        fields: field name to ``double``, ``int64``, ``bool`` or ``string``; a trailing ``[]`` makes it a list.

    Raises:
        ValueError: if a field has another kind.

    Example:
        >>> Scalar = message_type("DocumentedScalar", {"step": "int64", "value": "double"})
        >>> Scalar.FromString(Scalar(step=3, value=0.5).SerializeToString()).value
        0.5
    """
    return _message_type(name, tuple(fields.items()))


@cache
def _message_type(name: str, fields: tuple[tuple[str, str], ...]) -> Any:
    # A pool of its own lets two episodes have a message of the same name with different fields.
    pool = descriptor_pool.DescriptorPool()
    file = descriptor_pb2.FileDescriptorProto(name=f"agility_rl/{name}.proto", package="agility_rl", syntax="proto3")
    message = file.message_type.add(name=name)
    for number, (field, kind) in enumerate(fields, start=1):
        base = kind.removesuffix("[]")
        if base not in _KINDS:
            raise ValueError(f"field {field!r} has kind {kind!r}; expected one of {', '.join(_KINDS)}, or a list: []")
        repeated = kind.endswith("[]")
        proto = descriptor_pb2.FieldDescriptorProto
        label = proto.LABEL_REPEATED if repeated else proto.LABEL_OPTIONAL
        message.field.add(name=field, number=number, type=_KINDS[base], label=label, json_name=field)
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"agility_rl.{name}"))


class Record(NamedTuple):
    """One decoded message of a file."""

    topic: str
    schema: str
    time: int
    """Log time [ns]."""
    value: Any
    """The protobuf message."""


class DamageError(ValueError):
    """A file whose middle cannot be read, in contrast to one that merely ends early."""


def read_raw(path: str | Path) -> Iterator[tuple[Schema, Channel, Message] | Metadata]:
    """Every message and metadata record, in file order, up to the end or to where a killed writer stopped.

    Raises:
        FileNotFoundError: if there is no such file.
        DamageError: if a chunk's checksum does not agree, or the file is no MCAP; records before it were yielded.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with open(path, "rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    yield schemas[channel.schema_id], channel, record
                elif isinstance(record, Metadata):
                    yield record
        except Exception as error:  # a parser of damaged bytes can raise anything
            # A file that ends early, without the closing magic, is still being written, or its writer was killed:
            # only the last, incomplete chunk is lost, and that is no error.
            if _size(file) < len(MCAP0_MAGIC) or (isinstance(error, EndOfFile | struct.error) and not _finished(file)):
                return
            reason = (str(error) or type(error).__name__).splitlines()[0]
            raise DamageError(f"{path} is damaged or no MCAP file: {reason}") from error


def _size(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size


def _finished(file: BinaryIO) -> bool:
    if _size(file) < 2 * len(MCAP0_MAGIC):
        return False  # the magic there is opens the file
    file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
    return file.read() == MCAP0_MAGIC


def read_messages(path: str | Path) -> Iterator[Record]:
    """Every message of a file, decoded, in file order; reads unfinished files too.

    Raises:
        FileNotFoundError: if there is no such file.
        DamageError: as :func:`read_raw`.
    """
    factory = DecoderFactory()
    decoders: dict[int, Any] = {}
    for record in read_raw(path):
        if isinstance(record, Metadata):
            continue
        schema, channel, message = record
        if schema.id not in decoders:
            decoders[schema.id] = factory.decoder_for(channel.message_encoding, schema)
        if decoders[schema.id] is not None:
            yield Record(channel.topic, schema.name, message.log_time, decoders[schema.id](message.data))
