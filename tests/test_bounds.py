"""What stamps prove of the other clock's offset: always true, and as much as there is to know.

The oracle knows no lines and no Newton: it asks a linear program for the lowest and the highest
offset now over all paths of the offset that the stamps and the oscillators' bounds allow.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from clockwork import (
    WRAP,
    Clockwork,
    Frames,
    Offset,
    Reals,
    Told,
    exchanges,
    settings,
    stream,
    wandering,
)
from hypothesis import HealthCheck, example, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.sparse import coo_array

from headway.firmware import _core

AGE_MAX_US = 1 << 25
ORACLE_US = 0.2  # so much may its tangents give away
STAMP_US = 1  # a difference of two stamps that are rounded down is off by less


# ---- the truth is inside


@dataclass(frozen=True)
class World:
    """A wire and an oscillator within what the device is told of them."""

    drift_ppm: int
    wander_ppb_s: int
    least_us: tuple[int, int]
    theta: Offset
    frames: Frames
    lag_us: Reals
    start: int

    def told(self, start: int | None = None, method: int = 0) -> Told:
        made = settings(
            drift_ppm=self.drift_ppm,
            wander_ppb_s=self.wander_ppb_s,
            to_device_least_us=self.least_us[0],
            to_host_least_us=self.least_us[1],
            method=method,
        )
        work = Clockwork(self.theta, made, self.start if start is None else start)
        told = work.follow(self.frames, self.lag_us)
        assert work.sync.excluded == 0
        return told


shares = st.floats(-1, 1) | st.sampled_from([-1.0, 0.0, 1.0])
delays_us = st.floats(0, 10) | st.floats(0, 3000) | st.floats(0, 2e6)
gaps_us = st.floats(0, 20) | st.floats(100, 10_000) | st.floats(0, 3e6)


@st.composite
def worlds(draw: st.DrawFn) -> World:
    """Frames may overtake each other, come in crowds and after long pauses."""
    drift, wander = draw(st.integers(1, 300)), draw(st.integers(0, 60_000))
    least = draw(st.tuples(*[st.sampled_from([0, 5, 2000, 1_000_000])] * 2))
    rows = draw(st.lists(st.tuples(gaps_us, *[delays_us] * 3), min_size=1, max_size=40))
    gap, down, up, wait = np.array(rows).T
    left = np.cumsum(gap)
    # The host's microseconds are no longer than this many of the device's.
    longest = 1 + 2 * 300e-6
    there = up + least[1] * longest
    frames = exchanges(left + 5e5 + wait, down + least[0] * longest, left, there)
    # Bang-bang, or anything between: the skew moves at up to the wander, within the drift.
    bends = draw(st.lists(st.tuples(shares, st.floats(1e3, 5e6)), min_size=1, max_size=12))
    times, skews = [0.0], [draw(shares) * drift * 1e-6]
    while times[-1] < frames.arrived.max() + 1e4:
        share, lasts = bends[len(times) % len(bends)]
        skew = skews[-1] + share * wander * 1e-15 * lasts
        times.append(times[-1] + lasts)
        skews.append(float(np.clip(skew, -drift * 1e-6, drift * 1e-6)))
    lag = draw(st.sampled_from([0.0, 1.0, 900.0, 50_000.0]))
    theta = Offset(np.array(times), np.array(skews))
    start = draw(st.integers(0, WRAP - 1) | st.just(0))
    return World(drift, wander, least, theta, frames, np.full(len(frames), lag), start)


@given(worlds())
@hypothesis_settings(suppress_health_check=[HealthCheck.too_slow], deadline=None)
def test_the_truth_is_inside(world: World) -> None:
    """For any oscillator within its bounds and any delays that are not too short."""
    world.told().assert_inside()


@given(worlds())
@hypothesis_settings(suppress_health_check=[HealthCheck.too_slow], max_examples=40, deadline=None)
def test_a_wrap_of_the_count_changes_nothing(world: World) -> None:
    """Anywhere on the way: the same bits as from a count of 0."""
    plain = world.told(start=0)
    middle = int(world.frames.arrived[len(world.frames) // 2])
    for start in (WRAP - middle - 1, WRAP - 1, world.start):
        told = world.told(start=start)
        for a, b in zip(plain.raw, told.raw, strict=True):
            assert (a == b).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("drift", "wander"), [(150, 1000), (300, 60_000), (10, 10)])
def test_the_truth_is_inside_a_long_stream(drift: int, wander: int, seed: int) -> None:
    """Many more proofs than lines are kept; now and then a delay is a hundred times as long."""
    rng = np.random.default_rng(seed)

    def delay(rng: np.random.Generator, count: int) -> Reals:
        heavy = rng.random(count) < 0.05
        found: Reals = rng.uniform(0, 1000, count) * np.where(heavy, 100, 1)
        return found

    theta = wandering(rng, 32, drift * 1e-6, wander * 1e-9)
    made = settings(drift_ppm=drift, wander_ppb_s=wander)
    work = Clockwork(theta, made, WRAP - 15_000_000)
    told = work.follow(stream(rng, 30, delay=delay))
    told.assert_inside()
    assert work.sync.excluded == 0 and told.settled[-1]


# ---- and it is as narrow as it can be


@dataclass(frozen=True)
class Proofs:
    """theta >= value at lower ones' ticks, theta <= value at the others'."""

    ticks_us: Reals
    values: Reals
    is_lower: np.ndarray

    def needed(self, drift: float) -> "Proofs":
        """Without those that another one implies, since the slope is within the drift."""
        kept = np.ones(len(self.values), dtype=bool)
        for lower in (True, False):
            (side,) = np.nonzero(self.is_lower == lower)
            sign = 1 if lower else -1
            t, v = self.ticks_us[side], sign * self.values[side]
            for i in range(len(side)):
                implied = v - drift * np.abs(t - t[i])
                implied[i] = -np.inf
                equal = implied == v[i]
                kept[side[i]] = not (implied > v[i]).any() and not equal[:i].any()
        return Proofs(self.ticks_us[kept], self.values[kept], self.is_lower[kept])


def proofs_of(work: Clockwork, frames: Frames) -> Proofs:
    """What the whole numbers in the frames prove."""
    epoch = int(work.host(np.zeros(1))[0])
    echoes = frames.part(frames.echoes)
    at_arrival, at_leaving = np.floor(frames.arrived), np.floor(echoes.echo)
    lower = work.host(frames.sent) - epoch - at_arrival - STAMP_US
    upper = work.host(echoes.received) - epoch - at_leaving + STAMP_US
    return Proofs(
        np.concatenate((at_arrival, at_leaving)),
        np.concatenate((lower, upper)),
        np.repeat([True, False], [len(lower), len(upper)]),
    )


def allowed(proofs: Proofs, now_us: float, drift: float, wander: float) -> tuple[float, float]:
    """The lowest and the highest theta now.

    Theta and its slope at each proof, now, and each 100 ms are the variables. Over a time dt the
    slope moves by x, no more than wander dt, and theta by dt times the mean of both slopes, give or
    take (wander^2 dt^2 - x^2) / 4 wander, which is what a slope makes that turns once on the way:
    tangents of that parabola bound it. Nor does theta move by more than drift dt.
    """
    proofs = proofs.needed(drift)
    ticks = np.unique(
        np.concatenate((np.arange(now_us, proofs.ticks_us.min(), -1e5), proofs.ticks_us))
    )
    n, ppm = len(ticks), 1e-6
    rows: list[tuple[list[tuple[int, float]], float]] = []
    for i, dt in enumerate(np.diff(ticks)):
        for sign in (1.0, -1.0):
            rows.append(([(n + i + 1, sign), (n + i, -sign)], wander * dt / ppm))
            rows.append(([(i + 1, sign), (i, -sign)], drift * dt))
            for c in np.linspace(-1, 1, 9):  # tangents at x = c wander dt
                step = [(i + 1, sign), (i, -sign)]
                bend = [
                    (n + i, -dt * ppm / 2 * (sign + c)),
                    (n + i + 1, -dt * ppm / 2 * (sign - c)),
                ]
                rows.append((step + bend, wander * dt * dt * (1 + c * c) / 4))
    for t, v, lower in zip(proofs.ticks_us, proofs.values, proofs.is_lower, strict=True):
        at = int(np.searchsorted(ticks, t))
        rows.append(([(at, -1.0)], -v) if lower else ([(at, 1.0)], v))
    entries = np.array([(r, at, x) for r, (terms, _) in enumerate(rows) for at, x in terms])
    places = entries[:, :2].astype(int).T
    matrix = coo_array((entries[:, 2], (places[0], places[1])), shape=(len(rows), 2 * n)).tocsr()
    skews = [(-drift / ppm, drift / ppm)] * n
    ends = []
    for sign in (1, -1):
        cost = np.zeros(2 * n)
        cost[n - 1] = sign
        solved = linprog(
            cost, matrix, [most for _, most in rows], bounds=[(None, None)] * n + skews
        )
        assert solved.status == 0, solved.message
        ends.append(sign * solved.fun)
    return ends[0], ends[1]


def against_the_oracle(
    work: Clockwork, frames: Frames, drift: float, wander: float, chosen: list[int]
) -> list[tuple[float, float]]:
    """The widths, told and allowed, after some frames; asserts that the first has the other."""
    told = work.follow(frames)
    widths = []
    for i in chosen:
        now = np.floor(frames.arrived[i])
        seen = frames.part(np.arange(i + 1))
        low, high = allowed(proofs_of(work, seen), now, drift, wander)
        # theta itself: of the clock's error plus theta, minus what it is told to be at the ends
        clock = told.error[i] + work.theta(np.array([now]))[0]
        least, most = clock - told.most[i], clock - told.least[i]
        assert least <= low + ORACLE_US
        assert most >= high - ORACLE_US
        widths.append((most - least, high - low))
    assert work.sync.excluded == 0
    return widths


@pytest.mark.parametrize("seed", [1, 2])
def test_no_narrower_than_allowed_and_hardly_wider(seed: int) -> None:
    """244 frames a second each way with delays up to 1 ms. All of them are the oracle's."""
    rng = np.random.default_rng(seed)
    theta = wandering(rng, 20, 100e-6, 1e-6)
    frames = stream(rng, 15)
    work = Clockwork(theta, settings())
    chosen = np.linspace(1000, len(frames) - 1, 20).astype(int).tolist()
    widths = np.array(against_the_oracle(work, frames, 150e-6, 1e-12, chosen))
    assert np.median(widths[:, 0] / widths[:, 1]) <= 1.1
    assert np.median(widths[:, 1]) < 30  # it does know something


@given(st.integers(0, 2**32), st.sampled_from([0, 1000, 60_000]), st.integers(1, 300))
@hypothesis_settings(max_examples=25, deadline=None, report_multiple_bugs=False)
def test_never_narrower_than_allowed(seed: int, wander: int, drift: int) -> None:
    """Few frames at odd times: each of them shows."""
    rng = np.random.default_rng(seed)
    theta = wandering(rng, 9, drift * 1e-6, wander * 1e-9)
    count = int(rng.integers(2, 40))
    sent, left = (np.sort(rng.uniform(5e5, 8e6, count)) for _ in range(2))
    frames = exchanges(sent, rng.exponential(300, count), left, rng.exponential(300, count))
    work = Clockwork(theta, settings(drift_ppm=drift, wander_ppb_s=wander))
    chosen = [i for i in range(count) if frames.echoes[: i + 1].any()][-1::-7]
    against_the_oracle(work, frames, drift * 1e-6, wander * 1e-15, chosen)


# ---- contradictions


@pytest.mark.parametrize(
    "lie_us", [86_400_000_000, -86_400_000_000, 1200, -1200, 1 << 43, -(1 << 60)]
)
def test_a_contradiction_changes_nothing(lie_us: int) -> None:
    """Two devices, one of which is lied to, if not so often that it doubts what it knows: not one
    bit of what they say differs."""
    rng = np.random.default_rng(5)
    theta = wandering(rng, 9, 100e-6, 1e-6)
    frames = stream(rng, 8)
    before, after = frames.part(frames.arrived < 4e6), frames.part(frames.arrived >= 4e6)
    honest, lied_to = Clockwork(theta, settings()), Clockwork(theta, settings())
    for work in (honest, lied_to):
        work.follow(before)
    for i in range(15):
        frame = after.part(np.array([i]))
        lied_to.lie_us = lie_us
        lied_to.follow(frame)
        lied_to.lie_us = 0
        honest.alone(np.floor(frame.arrived).astype(np.int64))
    assert (honest.sync.excluded, lied_to.sync.excluded) == (0, 15)
    assert (honest.sync.outcast, lied_to.sync.outcast) == (0, 15)
    rest = after.part(np.arange(15, len(after)))
    told = [work.follow(rest) for work in (honest, lied_to)]
    for a, b in zip(told[0].raw, told[1].raw, strict=True):
        assert (a == b).all()
    assert lied_to.sync.outcast == 0
    told[1].assert_inside()


@given(st.integers(-40, 40))
@example(0)
def test_one_is_refused_exactly_where_nothing_is_left(lie_us: int) -> None:
    """A second frame at the same time that is `lie_us` beyond the other side of the first."""
    sync = _core.Sync(settings(drift_ppm=1, wander_ppb_s=0))
    # Ours left at 1000: theta is 10 s + 501 at most. His arrived at 1200: 10 s - 201 at least.
    assert sync.take((1000, 10_001_500, 10_001_000), 1200, 1200, True)
    width = 702
    assert sync.take((0, 0, 10_001_000 + width + lie_us), 1200, 1200, True) == (lie_us <= 0)
    assert sync.excluded == (lie_us > 0)
