"""The last samples in the order of their stamps, and the filter after each of them."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from headway.controller._tick import Rows
from headway.controller.sample import Sample

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ROWS = 1024  # at first


class Checkpoints:
    """Rows `begin` .. `end` - 1 of arrays: a sample's, and the filter's after it.

    The first of them stands for all before it. The arrays stay where they are and the rows move on
    through them, so that nothing is moved but once in many ticks.
    """

    z: Array  # (rows, 3n)
    covariance: Array  # (rows, 3n, 3n)
    nis: Array  # (rows,) normalized innovation squared
    rejected: Integers  # (rows, n) outliers in a row, by axis
    rows: Rows  # all arrays, for the filter

    def __init__(self, n: int) -> None:
        self._n, self.begin = n, 0
        self._samples: list[Sample] = []
        self._allocate(ROWS)

    @property
    def end(self) -> int:
        """The row after the last."""
        return self.begin + len(self._samples)

    def restart(self, time_us: int, z: Array, covariance: Array) -> None:
        """Forgets all; the filter at a time takes its place."""
        self._samples, self.begin = [Sample(time_us, -1, 0.0)], 0
        self.z[0], self.covariance[0], self.rejected[0] = z, covariance, 0

    def insert(self, samples: list[Sample]) -> int:
        """Puts samples in their places, but for known ones and those older than all that is
        remembered. Returns the first row that the filter has to fill in, `end` if there is none."""
        kept, first = self._samples, len(self._samples)
        for sample in samples:
            key = sample[:2]
            at = bisect_left(kept, key)  # a shorter tuple comes before the longer one
            known = at < len(kept) and kept[at][:2] == key
            if known or at == 0:
                continue
            kept.insert(at, sample)
            first = min(first, at)
        if self.end > len(self.nis):
            self._make_room(first)
        first += self.begin
        time_us, axis, position = self._heard
        for row in range(first, self.end):
            time_us[row], axis[row], position[row] = kept[row - self.begin]
        return first

    def times_us(self, first: int) -> list[int]:
        """Stamps from a row on."""
        return [sample.time_us for sample in self._samples[first - self.begin :]]

    def forget(self, before_us: int) -> list[tuple[bool, float]]:
        """Forgets the rows before the last one that is older than a time. Returns of each of their
        samples whether it was an outlier, and its NIS."""
        cut = max(0, bisect_left(self._samples, (before_us, 0)) - 1)
        heard = [
            (bool(self.rejected[row, sample.axis]), float(self.nis[row]))
            for row, sample in enumerate(self._samples[:cut], self.begin)
            if sample.axis >= 0
        ]
        del self._samples[:cut]
        self.begin += cut
        return heard

    def _allocate(self, rows: int) -> None:
        n = self._n
        self._heard = np.zeros(rows, np.int64), np.zeros(rows, np.int64), np.zeros(rows)
        self.z, self.covariance = np.zeros((rows, 3 * n)), np.zeros((rows, 3 * n, 3 * n))
        self.nis, self.rejected = np.zeros(rows), np.zeros((rows, n), np.int64)
        self.rows = Rows(*self._heard, self.z, self.covariance, self.nis, self.rejected)

    def _make_room(self, filled: int) -> None:
        """Moves the first `filled` rows, which the filter will not fill in anew, to the front of
        the arrays, or of larger ones."""
        old = *self._heard, self.z, self.covariance, self.nis, self.rejected
        if 2 * len(self._samples) > len(self.nis):
            self._allocate(4 * len(self._samples))
        new = *self._heard, self.z, self.covariance, self.nis, self.rejected
        for before, after in zip(old, new, strict=True):
            after[:filled] = before[self.begin : self.begin + filled]
        self.begin = 0
