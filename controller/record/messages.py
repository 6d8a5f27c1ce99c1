"""The channels as protobuf: schemas made from the table, rows to messages and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from google.protobuf.descriptor_pb2 import (
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from headway.controller.record.channels import CHANNELS, Channel

TYPES = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "int": FieldDescriptorProto.TYPE_SINT64,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
}


def message_name(channel: Channel) -> str:
    """Full name of the type of a channel's messages."""
    return f"headway.{channel.name.capitalize()}"


def _file(channel: Channel) -> FileDescriptorProto:
    """A .proto file with the one message type of a channel."""
    file = FileDescriptorProto(
        name=f"headway/{channel.name}.proto", package="headway", syntax="proto3"
    )
    message = file.message_type.add(name=channel.name.capitalize())
    for number, field in enumerate(channel.fields, 1):
        kind, _, many = field.kind.partition(" ")
        label = FieldDescriptorProto.LABEL_REPEATED if many else FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(name=field.name, number=number, type=TYPES[kind], label=label)
    return file


def schema(channel: Channel) -> bytes:
    """The schema of a channel, as MCAP wants it: a serialized FileDescriptorSet."""
    return FileDescriptorSet(file=[_file(channel)]).SerializeToString(deterministic=True)


def _classes() -> dict[str, type[Message]]:
    pool = DescriptorPool()
    for channel in CHANNELS.values():
        pool.Add(_file(channel))
    return {
        name: GetMessageClass(pool.FindMessageTypeByName(message_name(channel)))
        for name, channel in CHANNELS.items()
    }


CLASSES = _classes()


def encode(channel: Channel, values: Sequence[Any]) -> bytes:
    """The message of a row."""
    names = (field.name for field in channel.fields)
    message = CLASSES[channel.name](**dict(zip(names, values, strict=True)))
    return message.SerializeToString(deterministic=True)


def decode(channel: Channel, data: bytes) -> list[Any]:
    """The row of a message. Raises google.protobuf.message.DecodeError for what is none."""
    message = CLASSES[channel.name].FromString(data)
    return [getattr(message, field.name) for field in channel.fields]
