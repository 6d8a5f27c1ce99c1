"""A device's clock as the host sees it: what the device tells of it, and what the host measures.

The device says between which bounds its clock errs (firmware/sync.h). The host does not take its
word for it: a status was sent before it arrived, and after the frame that it had heard arrived at
the device. So with T the device's clock as it sent a status, R the host's as that arrived, and S
the host's in a frame that the device had heard `age` before,

    T - age - S >= T's error >= T - R.

with the rounding of all readings. Over a window the tightest of both sides count. As the device's
clock is steered meanwhile by no more than some hundred ppm, a window of a second blurs them by no
more than that.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from headway.firmware import _core

WINDOW_US = 1_000_000
SLEW_PPM = 500  # a clock is slewed by this much at most, against the count ...
RATE_PPM = 800  # ... which drifts by 300 at most against the host's
UNKNOWN_NS = 2**31 - 1


@dataclass(frozen=True)
class ClockState:
    """One device's clock at a time. Errors are the device's clock minus the host's."""

    settled: bool  # the device says so, and what the host measures does not contradict it
    offset_us: float | None  # as the host measures it: the middle
    least_us: float | None  # between these the error lies, as the device tells it
    most_us: float | None
    measured_us: tuple[float, float] | None  # and as the host measures it
    skew_ppm: float  # of the device's oscillator against the host's
    round_trip_us: int | None  # the shortest in the window
    excluded: int  # stamps that contradicted what the device knew, ever

    @property
    def interval_us(self) -> float | None:
        """The width of what the device tells."""
        if self.least_us is None or self.most_us is None:
            return None
        return self.most_us - self.least_us


class RemoteClock:
    """What statuses say of a device's clock."""

    def __init__(self) -> None:
        # When it was received; least and most, as they would be at `_base_us`; round trip.
        self._window: deque[tuple[int, float, float, int]] = deque()
        self._base_us = 0
        self._status: _core.Status | None = None
        self._unread: deque[tuple[_core.Status, int]] = deque()

    def note(self, status: _core.Status, received_us: int) -> None:
        """A status that arrived at a time of the host's. What it says waits until it is asked for:
        while a machine runs nobody does."""
        self._unread.append((status, received_us))
        while received_us - self._unread[0][1] > WINDOW_US:
            self._unread.popleft()

    def _read(self) -> None:
        for status, received_us in self._unread:
            self._take(status, received_us)
        self._unread.clear()

    def _take(self, status: _core.Status, received_us: int) -> None:
        if self._status is not None and not self._status.synced and status.synced:
            self._window.clear()  # it may have stepped until now
        self._status = status
        if status.heard_us:
            # All readings are rounded down: the host's, the device's count, and its clock at it.
            age_us, heard_us = status.heard_age_us, status.heard_us
            least = status.sent_us - received_us - 1
            most = status.sent_us - age_us - heard_us + 2 + SLEW_PPM * 1e-6 * age_us
            # They blur from then on, all at one rate: which is the tightest does not change.
            if not self._window:
                self._base_us = heard_us
            blur = RATE_PPM * 1e-6 * (heard_us - self._base_us)
            trip = received_us - heard_us - age_us
            self._window.append((received_us, least + blur, most - blur, trip))
        self._forget(received_us)

    def _forget(self, now_us: int) -> None:
        while self._window and now_us - self._window[0][0] > WINDOW_US:
            self._window.popleft()

    def state(self, now_us: int) -> ClockState:
        """As far as it is known at a time of the host's."""
        self._read()
        self._forget(now_us)
        status = self._status
        measured = offset = trip = None
        if self._window:
            blur = RATE_PPM * 1e-6 * (now_us + 1 - self._base_us)
            _, leasts, mosts, trips = zip(*self._window, strict=True)
            least, most = max(leasts) - blur, min(mosts) + blur
            measured, offset = (least, most), (least + most) / 2
            trip = min(trips)
        if status is None:
            return ClockState(False, None, None, None, None, 0.0, None, 0)
        known = status.least_error_ns > -UNKNOWN_NS and status.most_error_ns < UNKNOWN_NS
        told = (status.least_error_ns * 1e-3, status.most_error_ns * 1e-3) if known else None
        agrees = (
            told is not None
            and measured is not None
            and told[0] <= measured[1]
            and measured[0] <= told[1]
        )
        return ClockState(
            settled=status.synced and agrees,
            offset_us=offset,
            least_us=told[0] if told else None,
            most_us=told[1] if told else None,
            measured_us=measured,
            skew_ppm=-status.rate_q32 / 2**32 * 1e6,
            round_trip_us=trip,
            excluded=status.stamps_excluded,
        )
