"""What the loop and the simulator hand over.

A note is (name, system time [us], values). Of `received` and `sent` (all packets of a tick) and of
`tick`, rows.py makes rows of the channels; any other is a row of the channel of that name, with its
values in the order of the fields. Values are what marshal knows, and numpy's arrays of float64, of
which it takes the bytes. What it makes of them is read by the same Python, so the format does not
matter.
"""

from __future__ import annotations

import marshal
from collections.abc import Iterator
from io import BytesIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from headway.controller.record.recorder import Recorder
    from headway.controller.tick import Tick

Note = tuple[str, int, tuple[Any, ...]]

OUTCOME = "outcome"  # of a tick: told later, by reference until then
VERSION = 2  # of marshal: the later ones look for repeated objects, which takes time


def note_tick(recorder: Recorder, tick: Tick, sent_us: int, in_time: bool) -> None:
    """Notes and publishes a tick: what was decided, and what became of it. It must not change any
    more."""
    recorder.add((OUTCOME, tick.now_us, (tick, sent_us, in_time)))
    recorder.publish()


def freeze(notes: list[Note]) -> bytes:
    """A batch of notes. Raises ValueError for a value that cannot be noted."""
    return marshal.dumps([_told(*note) if note[0] == OUTCOME else note for note in notes], VERSION)


def thaw(frozen: bytes) -> Iterator[Note]:
    """The notes of batches, one after the other; arrays are bytes."""
    stream = BytesIO(frozen)
    while stream.tell() < len(frozen):
        yield from marshal.load(stream)


def _told(_: str, now_us: int, values: tuple[Tick, int, bool]) -> Note:
    """A tick in values that marshal knows."""
    tick, sent_us, in_time = values
    now, commit, solution = tick.now, tick.commit, tick.solution
    if now is None or commit is None:
        return "startup", now_us, (int(tick.phase), tick.states)
    solver = None
    if solution is not None:
        solver = (
            (
                solution.status,
                solution.plan is not None,
                solution.iterations,
                solution.residual,
                solution.stationarity,
                solution.complementarity,
                solution.assumed,
                solution.committed,
            ),
            (solution.prepare_us, solution.solve_us),
        )
    told = (
        (sent_us, in_time, tick.accepted, tick.samples, tick.states),
        (tick.encoding_error, tick.planned_torque),
        (now.z, now.covariance),
        (commit.z, commit.covariance),
        commit.time_us,
        solver,
        (tick.total_us, tick.estimate_us, tick.encode_us),
    )
    return "tick", now_us, told
