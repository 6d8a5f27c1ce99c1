"""The firmware's own clock, by the bounds or by the document's routine."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clocks.exchanges import EPOCH_US, WANDER_PPM_PER_S, Least, Scene
from headway.firmware import _core

DRIFT_PPM = 200  # as told to the boards
BOUNDS, AVERAGE = 0, 1  # enum sync_method
LIMIT_US = 40_000  # wide: no network here is to keep a clock from settling
AVERAGE_RANGES = {
    "interval_us": (4096.0, 262_144.0),
    "phase_gain": (40.0, 40_000.0),
    "skew_gain_q8": (1.0, 60_000.0),
}
# Without a search: nothing but bounds looks at them.
AVERAGE_DEFAULTS = {"interval_us": 16_384.0, "phase_gain": 4000.0, "skew_gain_q8": 10_000.0}


class Told(NamedTuple):
    """At each servo period, (m,) each [us]."""

    error: NDArray[np.float64]  # what is shown minus the host's time, as it is
    least: NDArray[np.float64]  # and what the clock says it is at least ...
    most: NDArray[np.float64]  # ... and at most; NaN: not known
    shown: NDArray[np.float64]  # relative to the host's epoch
    settled: NDArray[np.bool_]
    excluded: int  # stamps

    @property
    def violations(self) -> NDArray[np.bool_]:
        """Where the truth is outside what was told, whatever the rest of the count's microsecond:
        between two counts time goes on, and the clock with it."""
        return (self.error + 1 < self.least) | (self.error > self.most)


def settings_of(
    method: int, least: Least, tuned: dict[str, float] | None = None
) -> _core.SyncSettings:
    """A board's, for a wire with these least delays."""
    numbers = tuned or AVERAGE_DEFAULTS
    settings = _core.SyncSettings()
    settings.method, settings.limit_us = method, LIMIT_US
    settings.drift_ppm, settings.wander_ppb_s = DRIFT_PPM, round(WANDER_PPM_PER_S * 1000)
    settings.to_device_least_us, settings.to_host_least_us = least
    settings.interval_us = round(numbers["interval_us"])
    settings.phase_gain = round(numbers["phase_gain"])
    settings.skew_gain_q8 = round(numbers["skew_gain_q8"])
    return settings


def follow(scene: Scene, settings: _core.SyncSettings) -> Told:
    """A row each servo period and each frame, in the order of time."""
    stamps = scene.stamps
    servo, frames = len(scene.servo_us), len(stamps.arrived_us)
    order = np.argsort(np.concatenate((scene.servo_us, stamps.arrived_us)), kind="stable")

    def column(frame: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.concatenate((np.zeros(servo, dtype=np.int64), frame))[order]

    def count(ticks: NDArray[np.int64]) -> NDArray[np.uint32]:
        return (ticks & 0xFFFFFFFF).astype(np.uint32)

    ticks = np.concatenate((scene.servo_ticks, stamps.arrived_ticks))[order]
    sync = _core.Sync(settings, int(ticks[0] & 0xFFFFFFFF))
    system_us, fraction, least_ns, most_ns, settled = sync.follow(
        count(ticks),
        count(column(stamps.arrived_ticks)),
        count(column(stamps.echo_ticks)),
        column(stamps.received_upstream),
        column(stamps.sent_upstream),
    )
    judged = np.empty(servo + frames, dtype=np.int64)
    judged[order] = np.arange(servo + frames)
    at = judged[:servo]
    shown = (system_us[at] - EPOCH_US) + fraction[at] / 2**32
    unknown = np.iinfo(np.int32).max
    least, most = (
        np.where(np.abs(told.astype(np.int64)) == unknown, np.nan, told * 1e-3)
        for told in (least_ns[at], most_ns[at])
    )
    return Told(shown - scene.servo_us, least, most, shown, settled[at].astype(bool), sync.excluded)
