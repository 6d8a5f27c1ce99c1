"""Fewer points for a plot, with every extreme kept."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def thin(time_s: Array, values: NDArray[Any], points: int) -> tuple[Array, Array]:
    """At most `points` rows of (m,) increasing times and (m, n) values; all rows if m is less.

    Rows are gathered into buckets, as many in each, or one more. A bucket gives two rows: at its
    first and its last time every column has its least and its greatest value, in the order in which
    they came. So noise keeps its range, what rises or falls through a bucket is exact at both, a
    peak is off by a bucket at most, and the columns share their times. NaN is passed over where
    there is anything else. `points` is at least 2.
    """
    rows = np.asarray(values, dtype=np.float64)
    m = len(time_s)
    if m <= points:
        return time_s, rows
    count = points // 2
    starts = np.arange(count) * m // count
    sizes = np.diff(starts, append=m)
    number, bucket = np.arange(m)[:, None], np.repeat(np.arange(count), sizes)
    low, high = np.fmin.reduceat(rows, starts), np.fmax.reduceat(rows, starts)
    first_low, first_high = (
        np.minimum.reduceat(np.where(rows == extreme[bucket], number, m), starts)
        for extreme in (low, high)
    )
    rising = first_low <= first_high
    pairs = np.stack((np.where(rising, low, high), np.where(rising, high, low)), axis=1)
    times = np.stack((time_s[starts], time_s[starts + sizes - 1]), axis=1)
    return times.ravel(), pairs.reshape(2 * count, -1)
