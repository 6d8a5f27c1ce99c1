"""How far ahead to plan."""

from __future__ import annotations

from headway.cli.rules.subject import Subject

# Knots to an interval and intervals: from 213 to 451 ms, all within a frame.
HORIZONS = ((2, 26), (3, 22), (4, 22), (5, 22))
TIMES = 2.0  # what the task needs to stop


def horizon(subject: Subject) -> tuple[int, int]:
    """The shortest that is long enough, or the longest."""
    needed_us = TIMES * 1e6 * subject.stop_s()
    for stride, intervals in HORIZONS:
        if stride * intervals * subject.config.loop.knot_us >= needed_us:
            return stride, intervals
    return HORIZONS[-1]
