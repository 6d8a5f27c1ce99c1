"""The wall clock: the one place where the command reads the time that devices are told."""

from __future__ import annotations

import time

FACTORS = 0.01, 10.0


class WallClock:
    """The computer's raw monotonic clock, in microseconds times a factor.

    Nobody sets it, and nobody slews it: NTP bends the other monotonic one by up to 500 ppm, which
    is more than `sync.drift_ppm` may allow for.

    With a factor of 0.05 a second of this time takes twenty: all that happens is the same, and the
    computer has twenty times as long for it. Processes with the same factor have the same time.
    """

    def __init__(self, factor: float = 1.0) -> None:
        self._factor = factor
        self._us_per_ns = factor * 1e-3

    def now_us(self) -> int:
        """System time."""
        return int(time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW) * self._us_per_ns)

    def wait_until(self, time_us: int) -> None:
        """Sleeps until a system time."""
        while (left_us := time_us - self.now_us()) > 0:
            time.sleep(self.seconds(left_us))

    def seconds(self, span_us: int) -> float:
        """How many seconds a span of system time takes."""
        return span_us * 1e-6 / self._factor
