"""What a contender answers in a tick, and the clocks that time it."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter_ns, thread_time_ns

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class Reply:
    """What one tick took [us] of the thread's time and by the wall clock, and its plan."""

    x: Array  # (2n, N+1)
    u: Array  # (n, N+1)
    good: bool  # converged, by the solver's own word
    iterations: int
    cpu: dict[str, float] = field(default_factory=dict)  # linearize, prepare, feedback
    wall: dict[str, float] = field(default_factory=dict)


class Watch:
    """Both clocks of one call [us]."""

    def __enter__(self) -> Watch:
        self._begun = thread_time_ns(), perf_counter_ns()
        return self

    def __exit__(self, *_: object) -> None:
        now = thread_time_ns(), perf_counter_ns()
        self.cpu, self.wall = ((b - a) * 1e-3 for a, b in zip(self._begun, now, strict=True))
