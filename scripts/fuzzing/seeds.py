"""What a fuzzer begins with: the published vectors' bytes, in the form that a target reads."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

# Of a vector's word: the first byte for tests/fuzz/bytes.c, and the name of the bytes.
READERS = {
    "plan-decode": (0, "payload"),
    "status-decode": (1, "payload"),
    "settings-decode": (2, "bytes"),
    "cobs-decode": (4, "bytes"),
    "open": (7, "frame"),
    "sync-decode": (8, "payload"),
    "command-decode": (9, "payload"),
    "faults-decode": (10, "payload"),
    "hello-decode": (11, "frame"),
    "welcome-decode": (11, "frame"),
    "peer-request-decode": (12, "frame"),
    "peer-response-decode": (12, "frame"),
    "peer-feed-decode": (12, "frame"),
    "group-decode": (13, "frame"),
}


def of_vectors(folder: Path) -> Iterator[bytes]:
    """For the target `bytes`."""
    for file in sorted(folder.glob("*.txt")):
        for line in file.read_text().splitlines():
            word, *parts = line.partition(" ->")[0].split(" ")
            given = dict(part.split("=", 1) for part in parts if "=" in part)
            if word not in READERS or READERS[word][1] not in given:
                continue
            first, name = READERS[word]
            first += word == "settings-decode" and given.get("with_key") == "1"
            yield bytes([first]) + bytes.fromhex(given[name])


def write(corpus: Path, inputs: Iterator[bytes]) -> None:
    """Each as a file, named as libFuzzer does: what is known stays one."""
    corpus.mkdir(parents=True, exist_ok=True)
    for content in inputs:
        (corpus / hashlib.sha1(content).hexdigest()).write_bytes(content)
