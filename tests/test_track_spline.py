"""Track.evaluate against scipy's B-splines, within the error that track.h states."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from headway.firmware import _core

EPOCH_US = 1_700_000_000_000_000
SHIFTS = range(9, 16)
SIXTH_ERROR = 1 / (3 << 18)  # of the curve: 43691 / 2^18 stands for 1/6
FLOAT = 1e-3  # what float64 loses at 2^30

Ints = NDArray[np.int64]


def spline(points: Ints) -> BSpline:
    """The uniform cubic B-spline whose i-th point belongs to i: t_i .. t_{i+4} is centred there."""
    knots = np.arange(len(points) + 4) - 2.0
    return BSpline(knots, points.astype(float), 3, extrapolate=False)


def check(points: Ints, first_knot: int, times_us: Ints, shift: int) -> None:
    """Compares at times in the intervals where all four points are in `points`."""
    track = _core.Track()
    track.write(first_knot, points.astype(np.int32))
    value, rate, curve = track.evaluate(times_us, shift)
    x = (times_us - (first_knot << shift)) / (1 << shift)  # exact: small integers over 2^shift
    exact = spline(points)
    bend = exact(x, 2)
    # The term 1/6 weighs the curve at both ends of the interval with 1 - u^3 and u^3.
    u, k = np.modf(x)
    ends = exact(np.stack([k, k + 1]).clip(1, len(points) - 2), 2)
    bias = ((1 - u**3) * ends[0] + u**3 * ends[1]) * SIXTH_ERROR
    value_error = value - exact(x) - bias
    assert np.all(value_error <= FLOAT)
    assert np.all(value_error > np.where(u == 0, -1, -6) - FLOAT)
    rate_error = rate - exact(x, 1)
    assert np.all((rate_error <= FLOAT) & (rate_error > -2.5 - FLOAT))
    curve_error = curve - bend
    assert np.all((curve_error <= FLOAT) & (curve_error > -1 - FLOAT))


@st.composite
def walks(draw: st.DrawFn) -> Ints:
    """Points within the gate's range, from differences of every size up to the gate's largest."""
    largest = draw(st.sampled_from([0, 1, 5, 1 << 10, 1 << 18, (1 << 25) - 1, 1 << 25]))
    step = st.integers(-largest, largest) | st.sampled_from([-largest, largest])
    steps = draw(st.lists(step, min_size=5, max_size=20))
    start = draw(st.integers(-_core.POINT_MAX, _core.POINT_MAX))
    points = start + np.cumsum(np.array([0, *steps], dtype=np.int64))
    return np.clip(points, -_core.POINT_MAX, _core.POINT_MAX)


def times(first_knot: int, count: int, shift: int, seed: int) -> Ints:
    """Knots, the microseconds around them and random times, where count points are known."""
    low, high = (first_knot + 1) << shift, (first_knot + count - 2) << shift
    knots = np.arange(first_knot + 1, first_knot + count - 2, dtype=np.int64) << shift
    near = (knots[:, None] + np.array([0, 1, (1 << shift) // 2, (1 << shift) - 1])).ravel()
    random = np.random.default_rng(seed).integers(low, high, 50)
    return np.concatenate([near, random])


@given(
    walks(),
    st.sampled_from(SHIFTS),
    st.sampled_from([0, -7 << 15, 12345, EPOCH_US, -EPOCH_US, 1 << 60]),
    st.integers(0, 2**32),
)
def test_value_rate_and_curve_are_the_splines(
    points: Ints, shift: int, epoch_us: int, seed: int
) -> None:
    first_knot = epoch_us >> shift
    check(points, first_knot, times(first_knot, len(points), shift, seed), shift)


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("largest", [1, 40, 1 << 12, 1 << 18, 1 << 25])
def test_dense_random_splines(shift: int, largest: int) -> None:
    rng = np.random.default_rng([shift, largest])
    first_knot = EPOCH_US >> shift
    for _ in range(10):
        steps = rng.choice([-largest, largest, 0], 100)
        if largest < 1 << 25:
            steps = rng.integers(-largest, largest + 1, 100)
        points = np.clip(np.cumsum(steps), -_core.POINT_MAX, _core.POINT_MAX)
        inside = rng.integers((first_knot + 1) << shift, (first_knot + 98) << shift, 3000)
        check(points, first_knot, inside, shift)


def test_largest_errors_are_as_stated() -> None:
    """The bounds in track.h are not only safe but near: the worst found is close to them."""
    rng = np.random.default_rng(5)
    shift, worst = 15, np.zeros(3)
    for _ in range(300):
        points = np.cumsum(rng.integers(-5000, 5001, 128)).astype(np.int32)
        track = _core.Track()
        track.write(0, points)
        k = np.arange(1, 126, dtype=np.int64).repeat(20)
        times_us = (k << shift) + (1 << shift) - 1 - rng.integers(0, 400, len(k))
        x = times_us / (1 << shift)
        exact = spline(points)
        for i, got in enumerate(track.evaluate(times_us, shift)):
            worst[i] = min(worst[i], np.min(got - exact(x, i)))
    assert np.all(worst > [-6, -2.5, -1])
    assert np.all(worst < [-5, -2.3, -0.99])
    # 85 quanta where neighbouring differences are opposite and the largest
    track = _core.Track()
    track.write(0, (np.arange(8) % 2 * _core.DIFFERENCE_MAX).astype(np.int32))
    value, _, _ = track.evaluate(np.array([2 << shift, 3 << shift]), shift)
    assert list(value) == [11184896, 22369536]  # 2^25 / 3 = 11184810.7 and 2^26 / 3 = 22369621.3


@given(walks(), st.sampled_from(SHIFTS))
def test_a_knot_owns_its_point(points: Ints, shift: int) -> None:
    track = _core.Track()
    first_knot = EPOCH_US >> shift
    track.write(first_knot, points.astype(np.int32))
    knots = np.arange(1, len(points) - 2)
    value, rate, curve = track.evaluate((first_knot + knots) << shift, shift)
    for i, k in enumerate(knots):
        before, at, after = (int(p) for p in points[k - 1 : k + 2])
        second = before - 2 * at + after
        error = int(value[i]) - Fraction(before + 4 * at + after, 6) - Fraction(second, 3 << 18)
        assert -1 < error <= 0
        assert rate[i] == (after - before) // 2
        assert curve[i] == second


@given(walks(), st.integers(1, 300), st.sampled_from(SHIFTS))
def test_the_last_point_is_repeated_for_ever(points: Ints, beyond: int, shift: int) -> None:
    first_knot = EPOCH_US >> shift
    short, long = _core.Track(), _core.Track()
    short.write(first_knot, points.astype(np.int32))
    long.write(first_knot, np.append(points, [points[-1]] * 20).astype(np.int32))
    assert short.end == first_knot + len(points) - 1
    inside = times(first_knot, len(points) + 20, shift, beyond)
    for got, expected in zip(
        short.evaluate(inside, shift), long.evaluate(inside, shift), strict=True
    ):
        assert np.array_equal(got, expected)
    after = np.array([(short.end + 1 + beyond) << shift, ((short.end + 1) << shift) + 1])
    value, rate, curve = short.evaluate(after, shift)
    assert np.all(value == points[-1])
    assert not rate.any() and not curve.any()
    assert list(short.points(short.end - 1, 4)) == [points[-2], *[points[-1]] * 3]


@given(
    st.integers(-_core.POINT_MAX, _core.POINT_MAX),
    st.integers(-_core.DIFFERENCE_MAX, _core.DIFFERENCE_MAX),
    st.integers(-_core.DIFFERENCE_MAX, _core.DIFFERENCE_MAX),
    st.sampled_from(SHIFTS),
)
@example(_core.POINT_MAX, -_core.DIFFERENCE_MAX, -_core.DIFFERENCE_MAX, 15)
@example(-_core.POINT_MAX, _core.DIFFERENCE_MAX, _core.DIFFERENCE_MAX, 9)
def test_at_rest_exactly(rest: int, before: int, after: int, shift: int) -> None:
    def evaluate(points: list[int], times_us: Ints) -> set[tuple[int, int, int]]:
        track = _core.Track()
        track.write(0, np.array(points, dtype=np.int32))
        return {tuple(map(int, v)) for v in zip(*track.evaluate(times_us, shift), strict=True)}

    # three equal points: at the middle one's knot
    points = [rest + before, rest, rest, rest, rest + after]
    assert evaluate(points, np.array([2 << shift])) == {(rest, 0, 0)}
    # four: over the whole interval
    points = [rest + before, rest, rest, rest, rest, rest + after]
    interval = np.arange(2 << shift, (3 << shift) + 1, max(1, (1 << shift) // 256))
    assert evaluate(points, interval) == {(rest, 0, 0)}


def test_before_its_first_point_a_track_is_at_that_point() -> None:
    track = _core.Track()
    assert not track.written
    assert [list(a) for a in track.evaluate(np.array([EPOCH_US]), 12)] == [[0], [0], [0]]
    track.write(1000, np.array([70, 80, 90, 90, 90], dtype=np.int32))
    assert track.written
    assert list(track.points(1000 - 200, 200)) == [70] * 200
    value, rate, curve = track.evaluate(np.array([900 << 12]), 12)
    assert (value[0], rate[0], curve[0]) == (70, 0, 0)


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(3, 20)), min_size=1, max_size=40))
def test_writes_replace_and_the_ring_remembers(writes: list[tuple[int, int]]) -> None:
    """Overlapping writes, as many knots as go round the ring, against a dictionary."""
    track, model = _core.Track(), {}
    end, serial = (EPOCH_US >> 12), 0
    for back, count in writes:
        first = end + 1 - min(back, count - 1) if model else end
        points = np.arange(serial, serial + count, dtype=np.int32)
        serial += count
        track.write(first, points)
        if not model:
            model = {k: 0 for k in range(first - 300, first)}
        model = {k: v for k, v in model.items() if k < first}
        model |= {first + i: int(p) for i, p in enumerate(points)}
        end = first + count - 1
        assert track.end == end
        low = end - _core.TRACK_POINTS + 1
        expected = [model[k] for k in range(low, end + 1)]
        assert list(track.points(low, _core.TRACK_POINTS)) == expected


def test_copies_are_independent() -> None:
    track = _core.Track()
    track.write(0, np.array([1, 2, 3], dtype=np.int32))
    copy = track.copy()
    track.write(3, np.array([4, 5, 6], dtype=np.int32))
    assert (copy.end, track.end) == (2, 5)
    assert list(copy.points(0, 6)) == [1, 2, 3, 3, 3, 3]


@pytest.mark.parametrize("count", [0, 2, 129])
def test_a_write_has_3_to_128_points(count: int) -> None:
    with pytest.raises(ValueError, match=r"3 \.\. 128"):
        _core.Track().write(0, np.zeros(count, dtype=np.int32))
