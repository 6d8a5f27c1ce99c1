"""The clock map: a free-running 32-bit count to system time, a line between two calls."""

from fractions import Fraction

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from headway.firmware import _core

WRAP, HALF = 1 << 32, 1 << 31
EPOCH_US = 1_700_000_000_000_000
RATE_MAX_Q32 = 2_147_484  # 500 ppm

counts = st.integers(0, WRAP - 1)
rates = st.integers(-RATE_MAX_Q32, RATE_MAX_Q32) | st.sampled_from([-RATE_MAX_Q32, RATE_MAX_Q32])
steps_us = st.integers(0, 1000) | st.integers(0, 1_000_000) | st.integers(HALF - 5, HALF - 1)
bases_us = st.integers(-(1 << 59), 1 << 59) | st.sampled_from([0, EPOCH_US, -EPOCH_US])


def exact(clock: _core.Clock) -> Fraction:
    """The time at the anchor."""
    return clock.system_us + Fraction(clock.fraction_q32, WRAP)


@given(counts, bases_us, st.lists(st.tuples(steps_us, rates), min_size=1, max_size=40))
@example(WRAP - 1, 0, [(1, RATE_MAX_Q32), (1, -RATE_MAX_Q32), (0, 1)])
def test_it_is_a_line_of_the_rate_and_loses_nothing(
    start: int, base_us: int, moves: list[tuple[int, int]]
) -> None:
    """However the rate changes on the way: the sum of all pieces, exact to the last bit."""
    clock = _core.Clock(start)
    clock.set(base_us, 0)
    time, count = Fraction(base_us), start
    for elapsed, rate in moves:
        clock.rate_q32 = rate
        count += elapsed
        time += elapsed * (1 + Fraction(rate, WRAP))
        clock.advance(count % WRAP)
        assert exact(clock) == time
        assert (clock.count_us, clock.ticks_us) == (count % WRAP, count - start)


@given(counts, rates, st.lists(steps_us, min_size=2, max_size=40))
def test_time_never_goes_back(start: int, rate: int, steps: list[int]) -> None:
    """Whichever count is looked at, and whenever the anchor moves on."""
    clock = _core.Clock(start)
    clock.set(EPOCH_US, 12345)
    clock.rate_q32 = rate
    count, last_us = start, clock.at(start)
    for elapsed in steps:
        count += elapsed
        seen_us = [clock.at((count - back) % WRAP) for back in (elapsed, elapsed // 2, 1, 0)]
        if elapsed >= 2:
            assert last_us <= seen_us[0] and sorted(seen_us) == seen_us
        clock.advance(count % WRAP)
        assert clock.at(count % WRAP) == clock.system_us == seen_us[-1]
        last_us = seen_us[-1]


@given(counts, rates, st.integers(0, WRAP - 1), st.integers(-HALF, HALF - 1))
@example(5, RATE_MAX_Q32, 0, -HALF)
@example(5, RATE_MAX_Q32, WRAP - 1, HALF - 1)
def test_counts_before_and_after_the_anchor(
    start: int, rate: int, fraction_q16: int, elapsed: int
) -> None:
    clock = _core.Clock(start)
    fraction_q16 %= 1 << 16
    clock.set(EPOCH_US, fraction_q16)
    clock.rate_q32 = rate
    time = EPOCH_US + Fraction(fraction_q16, 1 << 16) + elapsed * (1 + Fraction(rate, WRAP))
    assert clock.at((start + elapsed) % WRAP) == time // 1
    assert clock.ticks((start + elapsed) % WRAP) == elapsed
    assert clock.ticks_us == 0  # looking moves nothing


@given(
    counts, rates, st.lists(steps_us, min_size=1, max_size=30), st.integers(-HALF // 2, HALF // 2)
)
def test_a_wrap_of_the_count_changes_nothing(
    start: int, rate: int, steps: list[int], look: int
) -> None:
    """Two clocks, one of which begins at a count of 0; also with the wrap right at an anchor."""
    for begin in (start, WRAP - steps[0] % WRAP):
        plain, wrapping = _core.Clock(0), _core.Clock(begin % WRAP)
        passed = 0
        for clock in (plain, wrapping):
            clock.set(EPOCH_US, 777)
            clock.rate_q32 = rate
        for elapsed in steps:
            passed += elapsed
            plain.advance(passed % WRAP)
            wrapping.advance((begin + passed) % WRAP)
            assert plain.system_us == wrapping.system_us
            assert plain.fraction_q32 == wrapping.fraction_q32
            assert plain.ticks_us == wrapping.ticks_us == passed
            ahead = (passed + look) % WRAP
            assert plain.at(ahead) == wrapping.at((begin + ahead) % WRAP)
            assert plain.ticks(ahead) == wrapping.ticks((begin + ahead) % WRAP)


@given(counts, bases_us, st.integers(-(1 << 61), 1 << 61), st.lists(steps_us, max_size=5))
@example(0, 1 << 59, -1, [])
@example(0, -(1 << 59), 65535, [HALF - 1])
def test_the_offset_is_what_was_set(
    start: int, base_us: int, offset_q16: int, steps: list[int]
) -> None:
    clock = _core.Clock(start)
    count = start
    for elapsed in steps:
        count += elapsed
        clock.advance(count % WRAP)
    ticks_us = clock.ticks_us
    clock.set(base_us, offset_q16)
    assert clock.offset_q16(base_us) == offset_q16
    assert exact(clock) == ticks_us + base_us + Fraction(offset_q16, 1 << 16)
    assert (clock.ticks_us, clock.count_us) == (ticks_us, count % WRAP)  # these are not set
    if abs(offset_q16) < 1 << 60:
        assert clock.offset_q16(base_us - 5) == offset_q16 + 5 * 65536


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_offset_runs_with_the_rate(sign: int) -> None:
    """100 ppm are 100 us a second, whatever the ticks are."""
    clock = _core.Clock()
    clock.set(EPOCH_US, 0)
    clock.rate_q32 = sign * 429_497
    for second in range(1, 100):
        clock.advance(second * 1_000_000)
        expected = sign * 100 * second
        assert abs(clock.offset_q16(EPOCH_US) / 65536 - expected) < 1e-3 * second
