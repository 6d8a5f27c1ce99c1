"""What a reference wants at the nodes of a horizon, worked out for many ticks at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from headway.controller.reference import Reference

Array = NDArray[np.float64]

TICKS = 32  # at once: numpy's calls cost more than its numbers


class Ahead:
    """A reference at knots, of which a horizon's nodes are every so many."""

    def __init__(self, knot_us: int, knots: int, intervals: int) -> None:
        """`knots`: of the horizon, which has so many intervals."""
        self._knot_us, self._knots, self._stride = knot_us, knots, knots // intervals
        self._first = self._end = 0  # commit knots that are known; none
        self._states: Array = np.empty((0, 0))
        self._time_s: Array = np.empty(0)

    def follow(self, reference: Reference, start_us: int) -> None:
        """From now on this one, whose time zero is at a system time."""
        self._reference, self._start_us = reference, start_us
        self._first = self._end = 0

    def at(self, commit_knot: int) -> tuple[Array, Array]:
        """At the nodes of the horizon that begins there: times of the task (N+1,), and the
        positions and velocities wanted (N+1, 2n)."""
        if not self._first <= commit_knot < self._end:
            self._first, self._end = commit_knot, commit_knot + TICKS
            knots = np.arange(self._first, self._end + self._knots)
            since_us = knots * self._knot_us - self._start_us
            self._time_s = since_us.astype(np.float64) * 1e-6
            position, velocity, _ = self._reference.at(self._time_s)
            self._states = np.concatenate((position, velocity), axis=1)
        first = commit_knot - self._first
        nodes = slice(first, first + self._knots + 1, self._stride)
        return self._time_s[nodes], self._states[nodes]
