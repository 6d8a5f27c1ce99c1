"""Other ways to make a clock of the same stamps, for comparison; nothing of it runs on a board.

Each knows the least delays, as ours does: a difference between both ways is taken off.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clocks.exchanges import EPOCH_US, Clock, Scene, Stamps, Times

SKEW_MAX = 300e-6
AGEING = 15e-6  # by which a delay is taken to grow in NTP's filter: RFC 5905, PHI

Array = NDArray[np.float64]


class Curve(NamedTuple):
    """A clock minus the own ticks and `base_us`: from each tick on a straight line."""

    base_us: int
    ticks: Array
    offset_us: Array
    rate: Array

    def at(self, ticks: Times) -> Array:
        """Its offset, without the base, at ticks of shape (m,); NaN before it began."""
        k = np.searchsorted(self.ticks, ticks, side="right") - 1
        value = self.offset_us[k] + self.rate[k] * (ticks - self.ticks[k])
        return np.where(k >= 0, value, np.nan)

    def shown(self, scene: Scene) -> Clock:
        """What it shows at true times within those of a scene."""

        def clock(true_us: Times) -> Array:
            ticks = np.rint(np.interp(true_us, scene.servo_us, scene.servo_ticks)).astype(np.int64)
            return self.at(ticks) + (ticks + self.base_us)

        return clock

    def error(self, scene: Scene) -> Array:
        """What it shows minus the host's time at each servo period [us]."""
        drift = scene.servo_ticks + self.base_us - scene.servo_us - EPOCH_US
        return self.at(scene.servo_ticks) + drift


class Samples(NamedTuple):
    """Of frames that echo another one, (n,) each, relative to the first."""

    base_us: int  # upstream minus ticks
    first_ticks: int
    arrived: Array  # ticks
    at: Array  # ticks for which the offset holds
    offset_us: Array  # upstream minus ticks, minus the base, with half the round trip taken off
    half_us: Array  # the round trip's half
    sent_us: Array  # upstream, as ticks by the base


def samples(stamps: Stamps) -> Samples:
    """What all rivals start from."""
    kept = stamps.received_upstream != 0
    arrived, echo = stamps.arrived_ticks[kept], stamps.echo_ticks[kept]
    sent, received = stamps.sent_upstream[kept], stamps.received_upstream[kept]
    base, first = int(sent[0] - arrived[0]), int(arrived[0])
    ahead = sent - arrived - base + stamps.least.to_here
    behind = received - echo - base - stamps.least.to_there
    return Samples(
        base,
        first,
        (arrived - first).astype(float),
        (arrived + echo) / 2 - first,
        (ahead + behind) / 2,
        ((arrived - echo) - (sent - received)) / 2,
        (sent - base - first).astype(float),
    )


def _curve(s: Samples, rows: list[tuple[float, float, float]]) -> Curve:
    ticks, offset, rate = np.array(rows).T
    return Curve(s.base_us, ticks + s.first_ticks, offset, rate)


def _clamp(skew: float) -> float:
    return max(-SKEW_MAX, min(SKEW_MAX, skew))


def alpha_beta(stamps: Stamps, alpha: float, beta: float) -> Curve:
    """Half the round trip, and a filter of second order (Sklansky, RCA Review 18, 1957).

    `beta` is in units of alpha^2 / 2, at which the filter is critically damped, or nearly.
    """
    s = samples(stamps)
    interval = float(np.median(np.diff(s.arrived))) or 1.0
    gain = beta * alpha**2 / 2 / interval
    offset, skew, then = float(s.offset_us[0]), 0.0, float(s.at[0])
    rows = []
    for arrived, at, measured in zip(
        s.arrived.tolist(), s.at.tolist(), s.offset_us.tolist(), strict=True
    ):
        offset += skew * (at - then)
        then = at
        off = measured - offset
        offset += alpha * off
        skew = _clamp(skew + gain * off)
        rows.append((arrived, offset + skew * (arrived - at), skew))
    return _curve(s, rows)


def regression(stamps: Stamps, decay: float, age: float, gate: float, floor_us: float) -> Curve:
    """Clock against send time by an exponentially weighted regression, and the least half round
    trip, which ages; a sample far off by the predicted variance is left out if it is late.

    The idea is that of Klipper's klippy/clocksync.py (K. O'Connor), with the weight `decay` of a
    sample, the minimum's `age` [us/us], the outliers' `gate` [standard deviations], from `floor_us`
    on, as the numbers to tune.
    """
    s = samples(stamps)
    asymmetry_us = (stamps.least.to_here - stamps.least.to_there) / 2
    mean_t = float(s.sent_us[0])
    mean_c = float(s.arrived[0] - s.sent_us[0])  # the clock minus send time
    slope = covariance = variance = 0.0
    least_us, least_at = float(s.half_us[0]), mean_t
    spread, kept_at = floor_us**2, mean_t
    rows = []
    for arrived, sent, half in zip(
        s.arrived.tolist(), s.sent_us.tolist(), s.half_us.tolist(), strict=True
    ):
        if half < least_us + age * (sent - least_at):
            least_us, least_at = half, sent
        off = arrived - sent - mean_c - slope * (sent - mean_t)
        if off**2 > max(gate**2 * spread, floor_us**2):
            if off > 0 and sent < kept_at + 10e6:
                continue
            spread = (2 * floor_us) ** 2
        else:
            kept_at = sent
            spread = (1 - decay) * (spread + decay * off**2)
        by_t, by_c = sent - mean_t, arrived - sent - mean_c
        mean_t += decay * by_t
        mean_c += decay * by_c
        variance = (1 - decay) * (variance + decay * by_t**2)
        covariance = (1 - decay) * (covariance + decay * by_t * by_c)
        slope = _clamp(covariance / variance) if variance > 0 else 0.0
        rate = 1 / (1 + slope) - 1
        # A frame that took its least time left at: mean_t + (its ticks - the mean's) / (1 + slope)
        left = mean_t + (arrived - mean_t - mean_c) * (1 + rate)
        rows.append((arrived, left + least_us + asymmetry_us - arrived, rate))
    return _curve(s, rows)


def minimum(stamps: Stamps, count: float, time_s: float, ratio: float) -> Curve:
    """Of the last `count` samples the one with the least delay, which grows as it ages, into a
    loop with a proportional and an integral part (Mills, IEEE Trans. Commun. 39, 1991; RFC 5905).

    The phase fades with `time_s`, the frequency follows `ratio` times more slowly.
    """
    s = samples(stamps)
    kept, time_us = max(1, round(count)), time_s * 1e6
    window: deque[tuple[float, int]] = deque()  # ascending delays: its first is the least
    offset, skew, left = float(s.offset_us[0]), 0.0, 0.0
    then, used, used_at = float(s.arrived[0]), -1, float(s.at[0])
    at_list, measured = s.at.tolist(), s.offset_us.tolist()
    rows = []
    for i, (arrived, at, half) in enumerate(
        zip(s.arrived.tolist(), at_list, s.half_us.tolist(), strict=True)
    ):
        elapsed = arrived - then
        then = arrived
        faded = left * -math.expm1(-elapsed / time_us)
        offset, left = offset + skew * elapsed + faded, left - faded
        delay = half - AGEING * at
        while window and window[-1][0] >= delay:
            window.pop()
        window.append((delay, i))
        while window[0][1] <= i - kept:
            window.popleft()
        best = window[0][1]
        if best > used:  # older ones have had their say
            left = measured[best] - (offset - skew * (arrived - at_list[best]))
            pause = min(max(at_list[best] - used_at, 0.0), time_us)
            skew = _clamp(skew + left * pause / (time_us * time_us * ratio))
            used, used_at = best, at_list[best]
        rows.append((arrived, offset, skew + left / time_us))
    return _curve(s, rows)


Ranges = dict[str, tuple[float, float]]

RIVALS: dict[str, tuple[Callable[..., Curve], Ranges]] = {
    "half trip": (alpha_beta, {"alpha": (1e-4, 0.3), "beta": (0.01, 2.0)}),
    "regression": (
        regression,
        {"decay": (3e-4, 0.1), "age": (1e-9, 1e-4), "gate": (2.0, 10.0), "floor_us": (10.0, 3e3)},
    ),
    "minimum": (minimum, {"count": (1, 1000), "time_s": (0.03, 30.0), "ratio": (0.3, 30.0)}),
}
