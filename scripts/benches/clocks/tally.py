"""Quantiles of more numbers than fit into memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

LOW_US, HIGH_US, BINS = 1e-2, 1e7, 2700  # each is 0.8 % wide
EDGES = np.geomspace(LOW_US, HIGH_US, BINS + 1)


class Tally:
    """Sizes, in bins of their logarithm."""

    def __init__(self) -> None:
        self.counts = np.zeros(BINS + 2, dtype=np.int64)
        self.largest = 0.0

    def add(self, values: NDArray[np.float64]) -> None:
        """Takes the sizes of values of any shape [us]; not finite ones are beyond all bins."""
        sizes = np.nan_to_num(np.abs(values), nan=np.inf).ravel()
        self.counts += np.bincount(np.searchsorted(EDGES, sizes), minlength=BINS + 2)
        self.largest = max(self.largest, float(sizes.max(initial=0.0)))

    def merge(self, other: Tally) -> None:
        self.counts += other.counts
        self.largest = max(self.largest, other.largest)

    def quantile(self, share: float) -> float:
        """The upper edge of the bin that it is in; NaN without values."""
        total = int(self.counts.sum())
        if total == 0:
            return float("nan")
        at = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return min(float(EDGES[at]) if at <= BINS else float("inf"), self.largest)

    def told(self) -> dict[str, Any]:
        """As what JSON has."""
        bins = np.flatnonzero(self.counts)
        return {"bins": bins.tolist(), "counts": self.counts[bins].tolist(), "most": self.largest}

    @classmethod
    def of(cls, told: dict[str, Any]) -> Tally:
        """What `told` told."""
        tally = cls()
        tally.counts[told["bins"]] = told["counts"]
        tally.largest = told["most"]
        return tally
