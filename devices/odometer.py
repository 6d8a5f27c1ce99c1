"""An encoder's count without bounds, from what a device tells of it modulo 2^32."""

from __future__ import annotations


class Odometer:
    """Follows one encoder: of all counts that the told one may stand for it takes the one next to
    the last, so nothing but a jump by 2^31 is mistaken."""

    def __init__(self) -> None:
        self._last = 0
        self._homed: bool | None = None

    def read(self, samples: list[tuple[int, int]], homed: bool) -> list[tuple[int, int]]:
        """The same samples (time, count), with counts that go on beyond 32 bits.

        Where the device has just begun to tell, or has found out where it is, its last count is
        taken as it is.
        """
        if samples and homed is not self._homed:
            self._last, self._homed = samples[-1][1], homed
        read = []
        for time_us, count in samples:
            self._last += (count - self._last + 2**31) % 2**32 - 2**31
            read.append((time_us, self._last))
        return read
