"""A simulated board's counter: how fast it runs, how that changes, that it is the same for all."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rig import device_settings

from headway.sim import _board

SECOND_US = 1_000_000
YEAR_US = 31_557_600 * SECOND_US
MOST_PPB = _board.OSCILLATOR_PPB_MAX

bounds = st.integers(0, 150_000)
wanders = st.integers(0, 2000)
seeds = st.integers(0, 2**64 - 1)


@st.composite
def oscillators(draw: st.DrawFn) -> tuple[int, int, int, int, int]:
    """Arguments of an Oscillator."""
    bound = draw(bounds)
    drift = draw(st.integers(-bound, bound))
    return draw(st.integers(-(2**40), 2**40)), drift, draw(wanders), bound, draw(seeds)


def gained_us(oscillator: _board.Oscillator, true_us: NDArray[np.int64]) -> NDArray[np.int64]:
    """Counts minus true time, unwrapped, from the first one on."""
    steps = np.diff(oscillator.counts(true_us)).astype(np.int64)  # modulo 2^32, as unsigned
    return np.concatenate(([0], np.cumsum(steps))) - (true_us - true_us[0])


def unwrapped(late_by: np.uint32) -> int:
    return (int(late_by) + 2**31) % 2**32 - 2**31


@given(oscillators(), st.integers(0, 10**9))
def test_skew_and_its_rate_keep_their_bounds(
    numbers: tuple[int, int, int, int, int], since_us: int
) -> None:
    """As measured over stretches of 16 s: each count is less than one off."""
    _, _, wander, bound, _ = numbers
    span_us = 16 * SECOND_US
    skew_ppb = np.diff(
        gained_us(_board.Oscillator(*numbers), since_us + np.arange(40) * span_us)
    ) * (10**9 / span_us)
    error_ppb = 10**9 / span_us
    assert np.abs(skew_ppb).max() <= bound + error_ppb
    assert np.abs(np.diff(skew_ppb)).max() <= 16 * wander + 2 * error_ppb


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_skew_wanders_as_far_as_it_may(seed: int) -> None:
    """In a day it has been nearly everywhere within its bound, by steps as large as configured."""
    wander, bound = 100, 3000
    ends_us = np.arange(0, 24 * 3600, 10) * SECOND_US
    skew = np.diff(gained_us(_board.Oscillator(0, 0, wander, bound, seed), ends_us)) * 100.0
    assert skew.min() < -0.95 * bound and skew.max() > 0.95 * bound  # within 100 ppb
    assert abs(skew.mean()) < bound / 3  # a walk from wall to wall takes it a third of an hour
    # Mean skews of two neighbouring stretches of n rates differ by sigma sqrt(2 n / 3).
    sigma = wander / np.sqrt(3) * np.sqrt(20 / 3)
    assert np.diff(skew).std() == pytest.approx(np.hypot(sigma, 100 / np.sqrt(2)), rel=0.1)


def test_without_wander_the_skew_stays() -> None:
    true_us = np.arange(0, 3600 * SECOND_US, 7 * SECOND_US)
    gained = gained_us(_board.Oscillator(0, -12_345, 0, 20_000, 5), true_us)
    assert np.array_equal(gained, true_us * -12_345 // 10**9)


def test_where_the_bound_is_zero_nothing_wanders() -> None:
    true_us = np.arange(100) * SECOND_US
    assert (gained_us(_board.Oscillator(0, 0, 1000, 0, 5), true_us) == 0).all()


@given(oscillators(), st.integers(-(10**6), 10**9))
def test_monotonic(numbers: tuple[int, int, int, int, int], since_us: int) -> None:
    """Microsecond by microsecond, across a second's end, too."""
    edge_us = since_us // SECOND_US * SECOND_US
    true_us = np.concatenate((np.arange(-300, 300) + edge_us, np.arange(-300, 300) + since_us))
    steps = np.diff(_board.Oscillator(*numbers).counts(np.sort(true_us)))
    assert steps.max() <= max(np.diff(np.sort(true_us)).max() * 2, 2)  # never backwards: 2^32 - 1


@given(oscillators(), st.lists(st.integers(-(10**6), 10**8), min_size=1, max_size=30))
def test_the_same_in_any_order_and_one_by_one(
    numbers: tuple[int, int, int, int, int], times: list[int]
) -> None:
    together = _board.Oscillator(*numbers).counts(np.array(times, dtype=np.int64))
    alone = [_board.Oscillator(*numbers).count_at(t) for t in times]
    assert together.tolist() == alone
    assert together.dtype == np.uint32


def test_another_seed_has_other_counts() -> None:
    true_us = np.arange(1000) * SECOND_US
    one, other = (_board.Oscillator(0, 0, 100, 10_000, seed).counts(true_us) for seed in (1, 2))
    assert not np.array_equal(one, other)


@given(st.integers(0, 2**33))
def test_wraps_at_2_to_the_32(offset: int) -> None:
    wrap_us = -offset % 2**32
    counts = _board.Oscillator(offset).counts(np.array([wrap_us - 1, wrap_us, wrap_us + 1]))
    assert counts.tolist() == [2**32 - 1, 0, 1]


@pytest.mark.parametrize("drift", [-MOST_PPB, MOST_PPB])
def test_years(drift: int) -> None:
    """By exact arithmetic; with wander the bound still holds."""
    times = [YEAR_US, 54 * YEAR_US, 200 * YEAR_US + 1]
    steady = _board.Oscillator(3, drift, 0, MOST_PPB)
    assert steady.counts(np.array(times)).tolist() == [
        (t + 3 + t * drift // 10**9) % 2**32 for t in times
    ]
    wandering = _board.Oscillator(0, drift, MOST_PPB, MOST_PPB, 1)
    last_us = np.arange(YEAR_US // 10, YEAR_US // 10 + 10**8, 10**6)
    assert np.abs(np.diff(gained_us(wandering, last_us))).max() <= 1001


@given(oscillators(), st.integers(0, 10**8), st.integers(-(2**31), 2**31 - 1))
def test_a_step_is_there_from_its_time_on(
    numbers: tuple[int, int, int, int, int], at_us: int, step_us: int
) -> None:
    stepped, steady = _board.Oscillator(*numbers), _board.Oscillator(*numbers)
    stepped.step(at_us, step_us)
    times = np.array([at_us - SECOND_US, at_us - 1, at_us, at_us + 1, at_us + 10**7])
    late_by = stepped.counts(times) - steady.counts(times)
    assert [unwrapped(late) for late in late_by] == [0, 0, step_us, step_us, step_us]
    stepped.step(at_us + 5, 7)
    more = stepped.counts(times[-1:]) - steady.counts(times[-1:]) - np.uint32(7)
    assert unwrapped(more[0]) == step_us


@pytest.mark.parametrize(
    "numbers",
    [
        {"drift_ppb": 11, "drift_bound_ppb": 10},
        {"drift_ppb": -11, "drift_bound_ppb": 10},
        {"drift_bound_ppb": MOST_PPB + 1},
        {"drift_bound_ppb": -1},
        {"wander_ppb_per_s": -1},
        {"wander_ppb_per_s": MOST_PPB + 1},
    ],
)
def test_mistakes(numbers: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="within its bound"):
        _board.Oscillator(**numbers)


def test_a_board_has_the_same() -> None:
    """Its device's clock, which nobody has set, runs as the count does, before now as well."""
    numbers = (5, -7000, 900, 20_000, 3)
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    node.flash(device_settings(), *numbers)
    for true_us in range(0, 10 * SECOND_US, 250):
        node.poll(true_us, 0)
    times = node.true_us - np.arange(0, SECOND_US, 1013)
    counts = _board.Oscillator(*numbers).counts(times).astype(np.int64)
    assert [node.system_us(int(t)) for t in times] == (counts - 5).tolist()
    with pytest.raises(ValueError, match="within its bound"):
        node.flash(device_settings(), drift_ppb=11, drift_bound_ppb=10)
