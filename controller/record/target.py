"""run.mcap as it is written: batches of rows in, chunks of messages out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import IO

from mcap.writer import MCAP0_MAGIC, Writer

from headway.controller.record.channels import CHANNELS
from headway.controller.record.hash import Hash
from headway.controller.record.messages import encode, message_name, schema
from headway.controller.record.rows import rows

FORMAT = "1"
MAGIC: bytes = MCAP0_MAGIC
CHUNK_BYTES = 256 * 1024  # before compression; what a cut file may lose


@dataclass(frozen=True)
class About:
    """What a record says of its run from the first byte on."""

    config: str  # YAML
    seed: int
    versions: dict[str, str]


class Target:
    """The file, from its first byte to its index."""

    def __init__(self, file: IO[bytes], about: About) -> None:
        """Writes what is known beforehand: schemas, channels, config, versions, seed."""
        self._hash = Hash()
        self._writer = Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(library="headway")
        self._writer.add_metadata("run", {"format": FORMAT, "seed": str(about.seed)})
        self._writer.add_metadata("versions", about.versions)
        config = about.config.encode()
        self._writer.add_attachment(0, 0, "config.yaml", "application/yaml", config)
        self._ids = {}
        for name, channel in CHANNELS.items():
            type_id = self._writer.register_schema(
                message_name(channel), "protobuf", schema(channel)
            )
            meaning = {f.name: f"[{f.unit}] {f.about}".removeprefix("[] ") for f in channel.fields}
            self._ids[name] = self._writer.register_channel(
                name, "protobuf", type_id, {"about": channel.about, **meaning}
            )

    def write(self, frozen: bytes) -> None:
        """Appends the rows of notes."""
        for channel, time_us, values in rows(frozen):
            message = encode(channel, values)
            self._hash.add(channel, time_us, message)
            time_ns = time_us * 1000
            self._writer.add_message(self._ids[channel.name], time_ns, message, time_ns)

    def flush(self) -> None:
        """Ends the chunk, so that all so far can be read whatever happens."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self, complete: bool, dropped: int) -> None:
        """Writes the end: what became of the record, and the index.

        complete: the run has said that this was all; dropped: batches that found no room.
        """
        end = {
            "complete": str(complete and not dropped).lower(),
            "batches_dropped": str(dropped),
            "log_sha256": self._hash.hex(),
        }
        self._writer.add_metadata("end", end)
        self._writer.finish()  # type: ignore[no-untyped-call]
