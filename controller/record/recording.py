"""A record that is written to a file while the run goes on."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from threading import Thread

from headway.controller.record.columns import Arrays
from headway.controller.record.note import Note, freeze
from headway.controller.record.reader import Run, read_run
from headway.controller.record.recorder import Recorder
from headway.controller.record.ring import Ring
from headway.controller.record.target import About
from headway.devices import interrupts

CAPACITY_BYTES = 4 << 20  # of the ring: some five seconds of a two-axis machine at 244 Hz
QUEUE_BATCHES = 1000  # on their way to the ring: some four seconds of ticks
PUMP_S = 0.003  # from look to look into the queue: about once a tick
WRITER = "headway.controller.record.writer"


class Recording(Recorder):
    """A batch goes by reference to a thread, as bytes through a ring to a process, and as messages
    into the file: noting costs the loop a few appended lists, and it never waits for the disk.

    What has no room on its way is dropped and counted. The process survives this one and completes
    the file.
    """

    def __init__(self, path: Path, about: About) -> None:
        """Starts the file `path`, which must not exist. Raises OSError."""
        super().__init__()
        self._path = path
        self._run: Run | None = None
        self.failure = ""  # why the file is not complete, after finish()
        self._control, control = socket.socketpair()
        with path.open("xb") as file, control:
            self._ring = Ring.create(CAPACITY_BYTES)
            files = self._ring.file, file.fileno()
            arguments = str(files[0]), str(CAPACITY_BYTES), str(files[1])
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", WRITER, *arguments],
                stdin=control.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                pass_fds=files,
                start_new_session=True,  # Ctrl-C is for the run
            )
        self._tell(asdict(about))
        self._queue: deque[list[Note]] = deque()
        self._dropped, self._over = 0, False
        self._thread = Thread(target=self._pump, name="recording", daemon=True)
        with interrupts.held_back():
            self._thread.start()

    def publish(self) -> None:
        if len(self._queue) < QUEUE_BATCHES:
            self._queue.append(self._notes)
        else:
            self._dropped += 1
        self._notes = []

    def _pump(self) -> None:
        """The thread. It needs some tens of us for a tick, and gets them when the loop sleeps."""
        over = False
        while not over:
            over = self._over  # before the last look
            while self._queue:
                batch = self._queue.popleft()
                try:
                    data = freeze(batch)
                except ValueError as error:
                    self.failure = f"it cannot take {[name for name, *_ in batch]}: {error}"
                    return
                while not self._ring.push(data):
                    if self._process.poll() is not None:
                        return
                    time.sleep(PUMP_S)
            time.sleep(PUMP_S)

    def await_room(self) -> None:
        while len(self._queue) > QUEUE_BATCHES // 2 and self._thread.is_alive():
            time.sleep(0.001)

    def finish(self, complete: bool = True) -> None:
        """Publishes the rest and waits until the file has its end.

        complete: False if the run broke off. Sets `failure` if the file misses anything else.
        """
        if self._notes:
            self.publish()
        self._over = True
        self._thread.join()
        self._tell({"complete": complete and not self.failure, "dropped": self._dropped})
        self._control.close()
        _, said = self._process.communicate()
        if code := self._process.returncode:
            killed = f"its writer was ended by {signal.Signals(-code).name}" if code < 0 else ""
            lines = said.decode(errors="replace").split("\n")
            self.failure = killed or next((line for line in reversed(lines) if line), "unknown")
        elif self._dropped and not self.failure:
            self.failure = f"its writer was too slow: {self._dropped} batches were dropped"
        self._ring.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.finish(complete=kind is None)

    def _tell(self, message: dict[str, object]) -> None:
        with suppress(BrokenPipeError, ConnectionResetError):  # it has died, as finish() will say
            line = json.dumps(message).encode() + b"\n"
            self._control.sendall(line, socket.MSG_NOSIGNAL)  # the signal would end the run

    def run(self) -> Run:
        """The finished file, read back."""
        if self._run is None:
            self._run = read_run(self._path)
        return self._run

    def arrays(self) -> Arrays:
        return dict(self.run().arrays)

    def sha256(self) -> str:
        return self.run().log_sha256
