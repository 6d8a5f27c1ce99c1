"""A record read back, whole or cut off anywhere."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from google.protobuf.message import DecodeError
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader
from ruamel.yaml import YAML
from zstandard import ZstdError

from headway.configs.schema import Config
from headway.controller.record.channels import CHANNELS
from headway.controller.record.columns import Arrays, Columns
from headway.controller.record.hash import Hash
from headway.controller.record.messages import decode
from headway.controller.record.target import FORMAT, MAGIC

NAME = "run.mcap"
DAMAGE = (
    McapError,
    ZstdError,
    DecodeError,
    struct.error,
    ValueError,
    LookupError,
    OverflowError,  # of a length
    MemoryError,
)
HEADER = struct.Struct("<BQ")  # of every record in an MCAP file: its kind and its length


class RecordError(Exception):
    """A file is not a record, told so that the user knows what to do."""


@dataclass
class Run:
    """A run as its record has it."""

    path: Path
    config_text: str  # YAML: every key
    seed: int
    versions: dict[str, str]
    arrays: Arrays = field(repr=False)  # see Columns
    messages: dict[str, int]  # how many, by channel
    complete: bool  # nothing is missing, from power-up to rest
    batches_dropped: int  # ticks, or stretches of the truth, that found no room in the ring
    log_sha256: str  # of the deterministic messages that are there

    def config(self) -> Config:
        """The config as used, its paths absolute."""
        return Config.model_validate(YAML(typ="safe", pure=True).load(self.config_text))


def read_run(path: Path) -> Run:
    """Reads run.mcap, or the one in a run's folder.

    Of a file that was cut off all but the last chunk is read; such a Run is not `complete`. Raises
    RecordError.
    """
    path = path / NAME if path.is_dir() else path
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from error
    if not data.startswith(MAGIC):
        raise RecordError(f"{path}: is no MCAP file; give a run's folder or its {NAME}")
    try:
        return _run(path, data)
    except DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordError(f"{path}: is damaged: {reason}") from error


def _run(path: Path, data: bytes) -> Run:
    config_text, metadata, topics = "", dict[str, dict[str, str]](), dict[int, str]()
    columns, digest, messages = Columns(), Hash(), dict.fromkeys(CHANNELS, 0)
    for record in _records(data):
        if isinstance(record, Message) and (name := topics[record.channel_id]) in CHANNELS:
            channel, time_us = CHANNELS[name], record.log_time // 1000
            columns.add(channel, time_us, decode(channel, record.data))
            digest.add(channel, time_us, record.data)
            messages[name] += 1
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Metadata):
            metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            config_text = record.data.decode()
    if not {"run", "versions"} <= metadata.keys() or not config_text:
        raise RecordError(f"{path}: was not written by headway, or is cut off at its beginning")
    if metadata["run"]["format"] != FORMAT:
        raise RecordError(
            f"{path}: has format {metadata['run']['format']}, this headway reads {FORMAT}: "
            f"use the version that wrote it, {metadata['versions'].get('headway')}"
        )
    end = metadata.get("end", {})
    return Run(
        path=path,
        config_text=config_text,
        seed=int(metadata["run"]["seed"]),
        versions=metadata["versions"],
        arrays=columns.arrays(),
        messages=messages,
        complete=end.get("complete") == "true"
        and end["log_sha256"] == digest.hex()
        and data.endswith(MAGIC),
        batches_dropped=int(end.get("batches_dropped", 0)),
        log_sha256=digest.hex(),
    )


def _records(data: bytes) -> Iterator[McapRecord]:
    """The records that are there as a whole, with those inside of chunks."""
    end = len(MAGIC)
    while end + HEADER.size <= len(data):
        after = end + HEADER.size + HEADER.unpack_from(data, end)[1]
        if after > len(data):
            break
        end = after
    try:
        yield from StreamReader(BytesIO(data[:end]), validate_crcs=True).records
    except EndOfFile:  # always: the file's last bytes, which are no record, are left out
        return
