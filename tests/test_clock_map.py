"""The clock map: local counts to system time, and the filter that keeps it there."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from headway.firmware import _core

WRAP = 1 << 32
EPOCH_US = 1_700_000_000_000_000
SAMPLE_US = 4096  # 244 Hz
SETTLE_SAMPLES = 65  # one whole step and the 64 of the second
SKEW_MAX_Q32 = 858_993  # 200 ppm
SLEW_MAX = 2.0**-11


@dataclass
class Exchange:
    """A host and a device whose oscillator drifts; every time is true time [us] unless named."""

    drift: float = 0.0
    count_at_zero: int = 0
    epoch_us: int = EPOCH_US  # the host's time at true time zero
    clock: _core.Clock = field(default_factory=_core.Clock)
    now: int = 0

    def __post_init__(self) -> None:
        self.clock.count_us = self.count(0)

    def count(self, true_us: float) -> int:
        return int(self.count_at_zero + true_us * (1 + self.drift)) % WRAP

    def advance(self, true_us: int) -> None:
        self.now = true_us
        self.clock.advance(self.count(true_us))

    def error(self) -> int:
        return self.clock.system_us - (self.epoch_us + self.now)

    def sample(self, uplink_us: int, downlink_us: int, wait_us: int = 0) -> None:
        """Status out, `wait_us` at the host, frame back: the four stamps, and their offset."""
        t0 = self.clock.at(self.count(self.now))
        t1 = self.epoch_us + self.now + uplink_us
        t2 = t1 + wait_us
        arrival = self.now + uplink_us + wait_us + downlink_us
        t3 = self.clock.at(self.count(arrival))
        ahead = (t1 - t0) + (t2 - t3)
        self.clock.sample(ahead // 2 if ahead >= 0 else -(-ahead // 2))

    def run(self, seconds: float, delays: NDArray[np.int64]) -> NDArray[np.int64]:
        """Samples each 4096 us, advances each 1024 us; the errors at the advances."""
        errors, end = [], self.now + int(seconds * 1e6)
        for i, t in enumerate(range(self.now, end, SAMPLE_US)):
            for quarter in range(4):
                self.advance(t + quarter * SAMPLE_US // 4)
                errors.append(self.error())
            uplink, downlink = delays[i % len(delays)]
            self.sample(int(uplink), int(downlink))
        self.now = end
        return np.array(errors)


def constant(us: int) -> NDArray[np.int64]:
    return np.full((1, 2), us)


# ---- the filter


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("drift", [-50e-6, 0.0, 50e-6])
def test_jitter_and_drift(drift: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    exchange = Exchange(drift, count_at_zero=WRAP - 4_000_000)  # the counter wraps on the way
    delays = rng.integers(2000, 4001, (4000, 2))
    exchange.run(5, delays)
    assert exchange.clock.synced
    settled = exchange.run(10, delays).astype(float)
    assert np.abs(settled).max() < 100
    assert np.sqrt(np.mean(settled**2)) < 40


@pytest.mark.parametrize("drift", [-50e-6, 0.0, 50e-6])
@pytest.mark.parametrize("delay_us", [0, 3000, 20_000])
def test_half_of_the_round_trip_is_taken_off(drift: float, delay_us: int) -> None:
    exchange = Exchange(drift)
    errors = exchange.run(10, constant(delay_us))
    assert np.abs(errors[-2000:]).max() < 5
    assert exchange.clock.skew_q32 == pytest.approx(-drift * WRAP, abs=1e-6 * WRAP)


@pytest.mark.parametrize("asymmetry_us", [-800, 600])
def test_unequal_delays_bias_by_half_their_difference(asymmetry_us: int) -> None:
    exchange = Exchange()
    delays = np.array([[3000 + asymmetry_us, 3000]])
    errors = exchange.run(10, delays)
    assert np.abs(errors[-2000:] - asymmetry_us / 2).max() < 5


def test_waiting_at_the_host_does_not_count() -> None:
    exchange = Exchange()
    for t in range(0, 10_000_000, SAMPLE_US):
        exchange.advance(t)
        exchange.sample(3000, 3000, wait_us=t % 7919)
    assert abs(exchange.error()) < 5


@pytest.mark.parametrize("epoch_us", [0, 5, -3_000_000, EPOCH_US, -EPOCH_US, 1 << 59])
def test_steps_to_any_time_and_then_is_synced(epoch_us: int) -> None:
    exchange = Exchange(epoch_us=epoch_us)
    exchange.advance(1000)
    exchange.sample(3000, 3000)
    assert abs(exchange.error()) <= 1  # the first step takes it all
    for n in range(2, SETTLE_SAMPLES + 1):
        assert not exchange.clock.synced
        exchange.advance(1000 + n)
        exchange.sample(3000 + 500, 3000 - 500)
    assert exchange.clock.synced
    assert abs(exchange.error() - 500) <= 2  # the second takes the mean of the next 64


@pytest.mark.parametrize("wild_us", [1 << 20, 1 << 31, 1 << 32, (1 << 32) + 64, 1 << 60])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_wild_offset_cannot_move_far(wild_us: int, sign: int) -> None:
    """While settling one of 64 counts as a second at the most; then as 4096 us."""
    clock = _core.Clock()
    clock.sample(0)
    clock.sample(sign * wild_us)
    for _ in range(63):
        clock.sample(0)
    assert clock.synced
    assert clock.system_us == sign * (1 << 20) // 64
    before = clock.system_us
    clock.sample(sign * wild_us)
    clock.advance(1_000_000)
    moved = clock.system_us - before - 1_000_000
    assert abs(moved) <= 4096 / 256 + 4096 * 2e-9 * 1e6 + 1
    assert moved * sign > 0


def test_skew_is_limited() -> None:
    clock = synced()
    for sign in (1, -1):
        for _ in range(2000):
            clock.sample(sign * 4096)
        assert clock.skew_q32 == sign * SKEW_MAX_Q32


# ---- the map


def synced() -> _core.Clock:
    clock = _core.Clock()
    for _ in range(SETTLE_SAMPLES):
        clock.sample(0)
    assert clock.synced
    return clock


intervals = st.integers(1, 1000) | st.integers(1, 1_000_000)
offsets = st.none() | st.integers(-5000, 5000) | st.sampled_from([-(1 << 62), 1 << 62])


@given(st.integers(0, WRAP - 1), st.lists(st.tuples(intervals, offsets), max_size=60))
def test_monotone_also_while_slewing(start: int, moves: list[tuple[int, int | None]]) -> None:
    clock = synced()
    clock.count_us = count = start
    for elapsed, offset in moves:
        before = clock.system_us
        count = (count + elapsed) % WRAP
        clock.advance(count)
        passed = clock.system_us - before
        assert passed >= 0
        assert abs(passed - elapsed) <= elapsed * (SLEW_MAX + 200e-6) + 1
        assert clock.at(count) == clock.system_us
        if offset is not None:
            clock.sample(offset)


@given(
    st.integers(0, WRAP - 1),
    st.integers(-SKEW_MAX_Q32, SKEW_MAX_Q32),
    st.lists(st.integers(-30_000_000, 30_000_000), min_size=2, max_size=30),
)
def test_map_is_the_exact_line_and_wraps(start: int, skew: int, elapsed: list[int]) -> None:
    """Counts before and after the anchor, across 2^32: rounded down, so monotone."""
    clock = synced()
    clock.count_us, clock.system_us, clock.skew_q32 = start, EPOCH_US, skew
    times = [clock.at((start + e) % WRAP) for e in sorted(elapsed)]
    assert times == [EPOCH_US + e + (e * skew >> 32) for e in sorted(elapsed)]
    assert times == sorted(times)


@given(st.integers(0, WRAP - 1), st.integers(-SKEW_MAX_Q32, SKEW_MAX_Q32), st.data())
def test_advancing_loses_no_fraction(start: int, skew: int, data: st.DataObject) -> None:
    """Many small advances end where one long line does: nothing is rounded away."""
    clock = synced()
    clock.count_us, clock.system_us, clock.skew_q32 = start, EPOCH_US, skew
    elapsed = 0
    for step in data.draw(st.lists(intervals, min_size=1, max_size=50)):
        elapsed += step
        clock.advance((start + elapsed) % WRAP)
        assert clock.system_us == EPOCH_US + elapsed + (elapsed * skew >> 32)


def test_runs_through_a_wrap() -> None:
    exchange = Exchange(count_at_zero=WRAP - 5_000_000)
    exchange.run(4, constant(3000))
    errors = exchange.run(3, constant(3000))  # the counter passes 2^32 in here
    assert exchange.clock.count_us < 3_000_000
    assert np.abs(errors).max() < 5


@pytest.mark.parametrize("sign", [-1, 1])
def test_slews_at_its_limit_and_no_faster(sign: int) -> None:
    clock = synced()
    clock.sample(sign * 4096)  # 16 us to be slewed in
    skew_us = sign * 4096 * 8 / WRAP * 1000  # per millisecond
    for n in range(1, 60):
        clock.advance(n * 1000)
        slewed = sign * (clock.system_us - n * 1000)
        expected = min(1000 * n * SLEW_MAX, 16) + sign * skew_us * n
        assert abs(slewed - expected) <= 1
