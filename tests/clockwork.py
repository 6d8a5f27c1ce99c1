"""A device's oscillator against a host's, a wire between them, and what `_core.Sync` makes of it.

Everything runs by the device's own ticks, as a real number. The host's time is ticks + theta, the
offset, whose slope is the skew. A frame never takes less host time than is promised of the wire.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from headway.firmware import _core

WRAP = 1 << 32
EPOCH_US = 1_700_000_000_000_000
Reals = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Offset:
    """Theta: its slope is linear between `times_us`; `skews` are the slopes there."""

    times_us: Reals
    skews: Reals

    def __call__(self, ticks_us: Reals | Integers) -> Reals:
        t, k = self.times_us, self.skews
        pieces = (k[1:] + k[:-1]) / 2 * np.diff(t)
        at = np.clip(np.searchsorted(t, ticks_us, side="right") - 1, 0, len(t) - 2)
        age = np.asarray(ticks_us - t[at], dtype=np.float64)
        bend = (k[at + 1] - k[at]) / (t[at + 1] - t[at])
        found: Reals = (
            np.concatenate(([0.0], np.cumsum(pieces)))[at] + (k[at] + bend * age / 2) * age
        )
        return found


def wandering(
    rng: np.random.Generator,
    seconds: float,
    drift: float,
    wander_per_s: float,
    piece_s: float = 0.1,
) -> Offset:
    """A skew within +-drift that now and then changes how fast it changes, up to the wander."""
    count = int(seconds / piece_s) + 2
    skews, bend = [rng.uniform(-drift, drift)], 0.0
    for _ in range(count - 1):
        if rng.random() < 0.1:
            bend = rng.uniform(-wander_per_s, wander_per_s)
        if abs(skews[-1] + bend * piece_s) > drift:
            bend = -bend
        skews.append(float(np.clip(skews[-1] + bend * piece_s, -drift, drift)))
    return Offset(np.arange(count) * piece_s * 1e6, np.array(skews))


@dataclass(frozen=True)
class Frames:
    """By arrival: ticks when the host's frames left and arrived; the device's that they echo."""

    sent: Reals
    arrived: Reals
    echo: Reals
    received: Reals
    echoes: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.sent)

    def part(self, chosen: NDArray[np.bool_] | Integers) -> Frames:
        columns = (self.sent, self.arrived, self.echo, self.received, self.echoes)
        return Frames(*(column[chosen] for column in columns))


def exchanges(
    sent: Reals, to_device: Reals, left: Reals, to_host: Reals, start_us: float = 0.0
) -> Frames:
    """Frames of both ways with their delays; each of the device's is echoed once, in order."""
    order = np.argsort(left + to_host)
    left, there = left[order], (left + to_host)[order]
    echo, received = np.zeros(len(sent)), np.zeros(len(sent))
    echoes = np.zeros(len(sent), dtype=bool)
    told = 0
    for i in range(len(sent)):
        if told < len(there) and there[told] <= sent[i]:
            echo[i], received[i], echoes[i] = left[told], there[told], True
            told += 1
    frames = Frames(sent, sent + to_device, echo, received, echoes)
    return frames.part(np.argsort(frames.arrived, kind="stable"))


def stream(
    rng: np.random.Generator,
    seconds: float,
    period_us: float = 4096.0,
    delay: Callable[[np.random.Generator, int], Reals] = lambda rng, n: rng.uniform(0, 1000, n),
) -> Frames:
    """One frame each way in a period."""
    count = int(seconds * 1e6 / period_us)
    times = np.arange(count) * period_us
    sent, left = times + 3500, times + rng.uniform(0, period_us)
    return exchanges(sent, delay(rng, count), left, delay(rng, count))


def settings(**changes: int) -> _core.SyncSettings:
    """Those of the sketch that the thresholds were found with, but for the changes."""
    made = _core.SyncSettings()
    made.drift_ppm, made.wander_ppb_s, made.limit_us = 150, 1000, 5000
    made.interval_us, made.phase_gain, made.skew_gain_q8 = 16_384, 4295, 10_995
    for name, value in changes.items():
        assert hasattr(made, name)
        setattr(made, name, value)
    return made


@dataclass(frozen=True)
class Told:
    """After each row: the clock's error and what is told of it [us], and what else there is."""

    error: Reals
    least: Reals
    most: Reals
    settled: NDArray[np.bool_]
    rate: Reals  # between this row and the one before
    raw: tuple[NDArray[np.generic], ...]  # as `follow` returns it

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether there is an interval."""
        found: NDArray[np.bool_] = np.maximum(-self.least, self.most) < 2.147e6
        return found

    @property
    def width(self) -> Reals:
        return self.most - self.least

    def assert_inside(self) -> None:
        """With a nanosecond for the ticks that a count rounds off."""
        assert (self.least[self.known] <= self.error[self.known] + 1e-3).all()
        assert (self.error[self.known] <= self.most[self.known] + 1e-3).all()


class Clockwork:
    """A device's clock that begins at a count; ticks are whole numbers here, without wraps."""

    def __init__(
        self, theta: Offset, made: _core.SyncSettings, start: int = 0, lie_us: int = 0
    ) -> None:
        self.theta, self.start, self.lie_us = theta, start, lie_us
        self.sync = _core.Sync(made, start % WRAP)

    def count(self, ticks_us: Reals | Integers) -> NDArray[np.uint32]:
        return ((np.floor(ticks_us).astype(np.int64) + self.start) % WRAP).astype(np.uint32)

    def host(self, ticks_us: Reals) -> Integers:
        """What the host says that his time is."""
        true = np.floor(ticks_us + self.theta(ticks_us)).astype(np.int64)
        return true + EPOCH_US + self.lie_us

    def follow(self, frames: Frames, lag_us: Reals | float = 0.0, may_step: bool = True) -> Told:
        """Each frame is looked at `lag_us` after its arrival, in order."""
        now = np.maximum.accumulate(np.floor(frames.arrived + lag_us)).astype(np.int64)
        received = np.where(frames.echoes, self.host(frames.received), 0)
        columns = (self.count(frames.arrived), self.count(frames.echo), received)
        return self._told(now, *columns, self.host(frames.sent), may_step)

    def alone(self, ticks_us: Integers, may_step: bool = False) -> Told:
        """Nothing arrives."""
        none = np.zeros(len(ticks_us), dtype=np.int64)
        counts = none.astype(np.uint32)
        return self._told(ticks_us, counts, counts, none, none, may_step)

    def _told(
        self,
        now: Integers,
        arrived: NDArray[np.uint32],
        echo: NDArray[np.uint32],
        received: Integers,
        sent: Integers,
        may_step: bool,
    ) -> Told:
        raw = self.sync.follow(self.count(now), arrived, echo, received, sent, may_step)
        system, fraction, least, most, settled = raw
        past = (system - EPOCH_US - now) + fraction / WRAP
        rate = np.diff(past, prepend=np.nan) / np.maximum(np.diff(now, prepend=now[0] - 1), 1)
        error = past - self.theta(now)
        return Told(error, least / 1e3, most / 1e3, settled.astype(bool), rate, raw)
