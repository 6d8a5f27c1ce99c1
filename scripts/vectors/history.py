"""Vectors of the encoder's samples: each is reported twice, and what was overwritten is counted."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from line import line

RING = 32
ENDS = (0, 7, (1 << 32) - 40, (1 << 32) - RING, (1 << 32) - 1)  # of samples ever taken


def histories(rng: Random) -> Iterator[str]:
    """Any number of samples between reports, up to more than the ring holds."""
    time_us, count = -5000, -3
    for taken in ENDS:
        yield line("history", taken=taken)
        yield line("history-report")
        for times in (1, 0, 2, RING - 2, RING, RING + 1, 0, 0, RING // 2, RING // 2, 3, 70, 1, 31):
            time_us += rng.randrange(1 << 30)
            count += rng.randrange(1000)
            yield line("history-push", time_us=time_us, count=count, times=times)
            yield line("history-report")
    yield line("history", taken=0)
    for before, after in ((0, 3), (1, 0), (5, 2), (RING + 3, 1), (3, RING + 1)):  # the clock steps
        yield line("history-push", time_us=7, count=1, times=before)
        yield line("history-flush")
        yield line("history-push", time_us=1 << 50, count=9, times=after)
        yield line("history-report")
        yield line("history-report")
    yield line("history", taken=0)
    for times in (5, RING - 5, 1, 1, 2, RING):  # without a report in between
        yield line("history-push", time_us=1 << 40, count=(1 << 31) - 99, times=times)
    yield line("history-report")
