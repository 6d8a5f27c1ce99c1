"""What the host measures of a device's clock: the truth is inside, whatever is rounded."""

from fractions import Fraction
from math import floor
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from headway.controller.settle import Settle
from headway.devices.clock import WINDOW_US, RemoteClock
from headway.devices.remote import Remote
from headway.firmware import _core

UNKNOWN_NS = 2**31 - 1
PPM = Fraction(1, 10**6)


def status(**given_: int | bool) -> _core.Status:
    fields: dict[str, int | bool] = {
        "sent_us": 0, "heard_us": 0, "heard_age_us": 0, "synced": True, "rate_q32": 0,
        "least_error_ns": -1000, "most_error_ns": 1000, "stamps_excluded": 0,
    }  # fmt: skip
    return cast(_core.Status, SimpleNamespace(**(fields | given_)))


ZERO, MOST = Fraction(0), Fraction(9, 10)
reals = st.fractions(0, 3000, max_denominator=997)


@given(
    offset_us=st.fractions(-(10**6), 10**6, max_denominator=991),
    slew_ppm=st.integers(-500, 500),
    drift_ppm=st.integers(-300, 300),
    phase=st.fractions(0, 1, max_denominator=97),
    trips=st.lists(st.tuples(reals, reals, reals, reals), min_size=1, max_size=8),
    later_us=reals,
)
@example(MOST, 0, 0, MOST, [(ZERO, ZERO, ZERO, ZERO)], ZERO)  # two readings rounded down
@example(ZERO, 500, 300, ZERO, [(ZERO, ZERO, Fraction(3000), ZERO)], ZERO)  # steered meanwhile
def test_the_truth_is_inside_what_is_measured(
    offset_us: Fraction,
    slew_ppm: int,
    drift_ppm: int,
    phase: Fraction,
    trips: list[tuple[Fraction, Fraction, Fraction, Fraction]],
    later_us: Fraction,
) -> None:
    """A counter that drifts, a clock that is slewed, and frames of any delay, exactly."""
    clock, now = RemoteClock(), Fraction(10**9)

    def ticks(at: Fraction) -> Fraction:
        return (at - 10**9) * (1 + drift_ppm * PPM) + 5 + phase

    def shown(count: Fraction | int) -> Fraction:
        return 10**9 + offset_us + count * (1 + slew_ppm * PPM)

    for pause, out, wait, home in trips:
        sent = now + pause
        heard = sent + out
        left = heard + wait
        now = left + home
        count = floor(ticks(left))
        told = status(
            heard_us=floor(sent),
            heard_age_us=count - floor(ticks(heard)),
            sent_us=floor(shown(count)),
        )
        clock.note(told, floor(now))
    now += later_us
    measured = clock.state(floor(now)).measured_us
    assert measured is not None
    error = shown(ticks(now)) - now
    assert measured[0] <= float(error) <= measured[1]
    # And it is as narrow as the fastest of each way, roundings and rates allow.
    age = now - 10**9
    fastest = min(out for _, out, _, _ in trips) + min(home for *_, home in trips)
    assert measured[1] - measured[0] <= fastest + 6 + float(age) * 2.2e-3


def test_what_is_older_than_the_window_is_forgotten() -> None:
    clock = RemoteClock()
    clock.note(status(sent_us=1500, heard_us=900, heard_age_us=100), 2000)
    assert clock.state(2000 + WINDOW_US).measured_us is not None
    late = clock.state(2001 + WINDOW_US)
    assert (late.measured_us, late.offset_us, late.round_trip_us) == (None, None, None)
    assert not late.settled


def test_nothing_is_known_of_a_device_that_is_silent() -> None:
    state = RemoteClock().state(5)
    assert not state.settled and state.measured_us is None and state.interval_us is None


@pytest.mark.parametrize(
    ("told_ns", "settled"),
    [((-1000, 1000), True), ((-90_000, -80_000), False), ((80_000, 90_000), False)],
)
def test_the_device_is_not_taken_at_its_word(told_ns: tuple[int, int], settled: bool) -> None:
    """It says that it errs by less than the stamps allow, or by more, or elsewhere."""
    clock = RemoteClock()
    least, most = told_ns
    told = status(
        sent_us=10_000, heard_us=9990, heard_age_us=5, least_error_ns=least, most_error_ns=most
    )
    clock.note(told, 10_005)
    assert clock.state(10_005).settled == settled


def test_an_open_interval_is_none() -> None:
    clock = RemoteClock()
    clock.note(status(least_error_ns=-UNKNOWN_NS, most_error_ns=UNKNOWN_NS, heard_us=5), 9)
    state = clock.state(9)
    assert (state.least_us, state.most_us, state.interval_us, state.settled) == (
        None, None, None, False,
    )  # fmt: skip


def test_what_was_measured_before_it_settled_is_forgotten() -> None:
    """Until then its clock may step."""
    clock = RemoteClock()
    clock.note(status(sent_us=99_000, heard_us=900, heard_age_us=100, synced=False), 2000)
    clock.note(status(sent_us=2500, heard_us=2400, heard_age_us=50), 2600)
    measured = clock.state(2600).measured_us
    assert measured is not None and measured[1] < 100


def test_only_the_last_second_is_kept() -> None:
    """A run lasts for hours, and nobody asks meanwhile."""
    clock = RemoteClock()
    for i in range(1000):
        now_us = 10**9 + i * 4000
        clock.note(status(heard_us=now_us - 500, sent_us=now_us - 100), now_us)
    assert len(clock._unread) == WINDOW_US // 4000 + 1
    assert clock.state(now_us).measured_us is not None
    assert (len(clock._unread), len(clock._window)) == (0, WINDOW_US // 4000 + 1)


def test_settling_says_what_is_wrong() -> None:
    """No session, no bound, silence; in this order."""
    remote = SimpleNamespace(clock=RemoteClock(), established=False, greeting="wrong key")
    settle = Settle(["q1"], [cast(Remote, remote)])
    assert settle.unsettled(0) == ["q1: wrong key: the board was set up with another one"]
    remote.established = True
    assert "no bound yet" in settle.unsettled(0)[0]
    remote.clock.note(status(sent_us=1500, heard_us=900, heard_age_us=100), 2000)
    assert settle.tick(2000)[0].settled and settle.settled_us(2000) == 0
    silent = settle.unsettled(2001 + WINDOW_US)
    assert silent == ["q1: nothing has come from it for a second: has its port gone?"]
