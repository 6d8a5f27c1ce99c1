"""A campaign of many jobs, whose results are kept as they come."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path
from typing import Any, NamedTuple

from headway.sim.profiles import PROFILES

ROOT = Path(__file__).resolve().parents[2]


class Task(NamedTuple):
    """A job under a name of its own, and what it is called with. What it returns JSON has."""

    name: str
    job: Callable[[Any], Any]
    argument: Any


def campaign_options(parser: argparse.ArgumentParser) -> None:
    """Those of such a benchmark."""
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="keep them, and go on from them"
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then begin no more")
    parser.add_argument("--processes", type=int, default=2, help="at once")


def fingerprint(effort: Any, *sources: str) -> str:
    """Of what results depend on: how much is simulated, the networks, the firmware and files by
    patterns from the root on."""
    digest = hashlib.sha256(repr((effort, PROFILES)).encode())
    for pattern in ("firmware/*.[ch]", *sources):
        for path in sorted(ROOT.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()


class Journal:
    """Results by their jobs' names, one JSON line each after one that says what they are of."""

    def __init__(self, path: Path | None, of: str) -> None:
        """None: they are not kept. Raises SystemExit for a file of something else."""
        self.found: dict[str, Any] = {}
        self._path = path
        if path is None:
            return
        if not path.exists():
            path.write_text(json.dumps({"of": of}) + "\n")
        first, *lines = path.read_text().splitlines(keepends=True)
        if json.loads(first) != {"of": of}:
            raise SystemExit(
                f"{path}: is of other sources, other networks or another effort: give --results "
                "another file"
            )
        if lines and not lines[-1].endswith("\n"):  # it was ended amid a line
            lines.pop()
            path.write_text(first + "".join(lines))
        for line in lines:
            self.found.update(json.loads(line))

    def keep(self, name: str, result: Any) -> None:
        """Takes a result."""
        line = json.dumps({name: result})
        self.found.update(json.loads(line))
        if self._path is not None:
            with self._path.open("a") as file:
                file.write(line + "\n")


class Campaign:
    """Runs jobs that have no result yet, until the time is over, and says how far it is."""

    def __init__(self, pool: Executor, journal: Journal, minutes: float) -> None:
        self._pool, self._journal = pool, journal
        self._end_s = time.monotonic() + 60 * minutes
        self.complete = True  # so far each job has had its turn

    def run(self, what: str, tasks: Sequence[Task]) -> None:
        """In their order; two are under way at a time for each that runs, no more."""
        left = [task for task in tasks if task.name not in self._journal.found]
        running: dict[Future[Any], str] = {}
        done = len(tasks) - len(left)
        while left or running:
            if time.monotonic() > self._end_s:
                self.complete &= not left
                left = []
            while left and len(running) < AHEAD:
                task = left.pop(0)
                running[self._pool.submit(task.job, task.argument)] = task.name
            for each in wait(running, return_when=FIRST_COMPLETED).done if running else ():
                self._journal.keep(running.pop(each), each.result())
                done += 1
            told = f"\r{what}: {done} of {len(tasks)} "
            print(told, end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)


AHEAD = 3  # jobs that are submitted: nobody waits, and little is left when the time is over
