"""The process that writes run.mcap: rows out of the ring, messages into the file.

    python -m headway.controller.record.writer RING CAPACITY FILE

RING and FILE are inherited descriptors. Standard input brings a line of JSON about the run first,
and a second one, {"complete": true, "dropped": 0}, when all is in the ring. If it ends without that
line the run has died: the file is finished all the same, and says that it is not complete.
"""

from __future__ import annotations

import json
import os
import select
import sys
import time

from headway.controller.record.ring import Ring
from headway.controller.record.target import About, Target

LOOK_MS = 10  # from look to look into the ring
FLUSH_S = 0.4  # what a dead computer may lose


def write(ring: Ring, target: Target, control: int) -> None:
    """Writes what comes through the ring until `control` (a descriptor) says that it is over."""
    poll = select.poll()
    poll.register(control, select.POLLIN)
    over = b""
    target.flush()
    flushed_s = time.monotonic()
    while True:
        told = bool(poll.poll(LOOK_MS))  # before the last look into the ring
        if told:
            over = _line(control)
        target.write(ring.pop())
        if told:
            break
        if time.monotonic() - flushed_s > FLUSH_S:
            target.flush()
            flushed_s = time.monotonic()
    end = json.loads(over or b'{"complete": false, "dropped": 0}')
    target.finish(end["complete"], end["dropped"])


def _line(file: int) -> bytes:
    """The next line of a pipe; b"" at its end."""
    line = b""
    while not line.endswith(b"\n") and (byte := os.read(file, 1)):
        line += byte
    return line if line.endswith(b"\n") else b""


def main() -> None:
    memory, capacity, file = map(int, sys.argv[1:])
    control = sys.stdin.fileno()
    ring = Ring(memory, capacity)
    try:
        with os.fdopen(file, "wb") as output:
            about = _line(control)
            if about:  # else nothing was ever recorded
                write(ring, Target(output, About(**json.loads(about))), control)
    except OSError as error:
        sys.exit(f"{error.strerror}")


if __name__ == "__main__":
    main()
