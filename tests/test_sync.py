"""The steered clock: no faster than it may, within what it tells, settled as long as it is good."""

from fractions import Fraction

import numpy as np
import pytest
from clockwork import (
    EPOCH_US,
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
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from headway.configs.schema import Sync
from headway.devices.settings import sync_settings
from headway.firmware import _core

RATE_MAX = 500e-6
SETTLE_US = 1_000_000
OUTCAST = 64
UNKNOWN_US = (2**31 - 1) / 1e3


def constant(skew: float, seconds: float = 400.0) -> Offset:
    return Offset(np.array([0.0, seconds * 1e6]), np.array([skew, skew]))


def begun(theta: Offset, seconds: float, seed: int = 0, **changes: int) -> tuple[Clockwork, Told]:
    """In contact for so long, by a wire of up to 1 ms each way."""
    work = Clockwork(theta, settings(**changes), WRAP - 7_000_000)
    told = work.follow(stream(np.random.default_rng(seed), seconds))
    told.assert_inside()
    return work, told


def ticks(work: Clockwork) -> int:
    """Now."""
    return work.sync.clock.ticks_us


# ---- steering


@given(
    st.integers(0, 2**32),
    st.sampled_from([0, 1]),
    st.integers(1, 300),
    st.sampled_from([10, 1000, 60_000]),
    st.booleans(),
)
@hypothesis_settings(max_examples=30, deadline=None)
def test_never_faster_than_500_ppm_and_never_back(
    seed: int, method: int, drift: int, wander: int, may_step: bool
) -> None:
    """Whatever the delays are, and while the host lies as well."""
    rng = np.random.default_rng(seed)
    theta = wandering(rng, 8, drift * 1e-6, wander * 1e-9)
    changes = {"drift_ppm": drift, "wander_ppb_s": wander, "method": method}
    changes |= {"phase_gain": int(rng.integers(65536)), "skew_gain_q8": int(rng.integers(65536))}
    work = Clockwork(theta, settings(**changes))

    def delay(rng: np.random.Generator, count: int) -> Reals:
        found: Reals = rng.exponential(rng.choice([1, 300, 5000]), count)
        return found

    frames = stream(rng, 7, period_us=float(rng.choice([1000, 4096, 50_000])), delay=delay)
    first = frames.part(frames.arrived < 2e6)
    work.follow(first, may_step=True)
    for i, lie_us in enumerate((0, 200, -90_000, 0)):
        work.lie_us, low = lie_us, (2 + i) * 1e6
        part = frames.part((frames.arrived >= low) & (frames.arrived < low + 1e6))
        if not len(part):
            continue
        before = work.sync.clock.system_us + Fraction(work.sync.clock.fraction_q32, WRAP)
        begin = ticks(work)
        was_settled = work.sync.settled
        told = work.follow(part, may_step=may_step)
        steps = may_step and not (was_settled and told.settled.all())  # or it came to doubt
        after = work.sync.clock.system_us + Fraction(work.sync.clock.fraction_q32, WRAP)
        if not steps:
            # The clock's way over the whole part, and from row to row.
            way = after - before - (ticks(work) - begin)
            assert abs(way) <= Fraction(501, 10**6) * (ticks(work) - begin)
            assert (np.abs(told.rate[1:]) <= RATE_MAX + 1e-9).all()
        assert abs(work.sync.clock.rate_q32) <= round(RATE_MAX * WRAP)


@pytest.mark.parametrize("skew", [-100e-6, 0.0, 100e-6])
@pytest.mark.parametrize("seed", range(3))
def test_it_follows_the_host_closely(skew: float, seed: int) -> None:
    """By half of what it tells, and much better than the delays are."""
    work, told = begun(constant(skew), 12, seed)
    late = told.known & (np.arange(len(told.error)) > 1500)
    assert np.abs(told.error[late]).max() < 15
    assert np.median(np.abs(told.error[late])) < 5
    assert work.sync.clock.rate_q32 / WRAP == pytest.approx(skew, abs=60e-6)


@pytest.mark.parametrize("asymmetry_us", [-800, 600])
def test_unequal_delays_are_told(asymmetry_us: int) -> None:
    """Nobody can see them: off by half of the difference, it tells half of the round trip."""
    rng = np.random.default_rng(1)
    times = np.arange(3000) * 4096.0 + 3500
    one = np.ones(3000)
    there, back = 2000 + asymmetry_us, 2000
    frames = exchanges(times, one * there, times - 1000 + rng.uniform(0, 9, 3000), one * back)
    work = Clockwork(constant(0), settings(drift_ppm=1, wander_ppb_s=0))
    told = work.follow(frames)
    told.assert_inside()
    assert told.error[-1] == pytest.approx(-asymmetry_us / 2, abs=3)
    assert told.width[-1] == pytest.approx(there + back + 2, abs=4)
    known = settings(drift_ppm=1, wander_ppb_s=0, to_device_least_us=there, to_host_least_us=back)
    work = Clockwork(constant(0), known)
    told = work.follow(frames)
    told.assert_inside()
    assert abs(told.error[-1]) < 2 and told.width[-1] < 6


def test_only_a_clock_that_may_step_steps() -> None:
    """300 us at once, or slewed in at less than 500 ppm."""
    sync = _core.Sync(settings(drift_ppm=20, wander_ppb_s=0))
    assert sync.take((0, 0, EPOCH_US), 0, 0, True)
    assert sync.clock.system_us == EPOCH_US
    assert sync.steer(0, False)  # the first sample set it
    # A status left at 0 and was there 600 us later: the middle lies 300 us off.
    assert sync.take((0, EPOCH_US + 600, EPOCH_US + 600), 600, 600, True)
    assert not sync.steer(1000, False)
    begin = sync.clock.system_us - 1000
    for count in range(2000, 200_000, 1000):
        before = sync.clock.system_us
        assert not sync.steer(count, False)
        assert 999 <= sync.clock.system_us - before <= 1001
    assert sync.clock.system_us - 199_000 - begin > 30
    assert sync.steer(200_000, True)
    middle = -(sync.least_error_ns + sync.most_error_ns) / 2e3
    assert abs(middle) < 1
    assert not sync.steer(201_000, True)  # it is there: within 8 us it is slewed


# ---- holdover


@pytest.mark.parametrize("skew", [-100e-6, 100e-6])
@pytest.mark.parametrize("seed", range(4))
def test_half_a_second_alone(skew: float, seed: int) -> None:
    """After ten seconds of contact it knows its oscillator."""
    work, _ = begun(constant(skew), 10, seed)
    told = work.alone(ticks(work) + np.arange(1, 501) * 1000)
    told.assert_inside()
    assert np.abs(told.error).max() < 50
    assert (np.diff(told.width) >= -1e-9).all()


@pytest.mark.parametrize("wander", [1000, 60_000])
@pytest.mark.parametrize("pause_s", [40, 400, 4000, 400_000])
def test_a_long_time_alone(pause_s: int, wander: int) -> None:
    """The interval grows by no more than the oscillators' bounds, and then is narrow again."""
    theta = constant(90e-6, pause_s + 100.0)
    work, before = begun(theta, 10, wander_ppb_s=wander, limit_us=1_000_000)
    step = min(1_000_000, pause_s * 1000)
    told = work.alone(ticks(work) + np.arange(1, pause_s * 1_000_000 // step + 1) * step)
    told.assert_inside()
    most = before.width[-1] + 2 * 150.1e-6 * (np.arange(len(told.error)) + 1) * step + 1
    assert (told.width[told.known] <= most[told.known]).all()
    assert (np.diff(told.width[told.known]) >= -1e-9).all()
    assert told.known[-1] == (pause_s <= 4000)
    later = stream(np.random.default_rng(9), 8)
    at = float(ticks(work))
    later = Frames(
        *(column + at for column in (later.sent, later.arrived, later.echo, later.received)),
        later.echoes,
    )
    again = work.follow(later, may_step=False)
    assert work.sync.excluded == 0
    again.assert_inside()
    if pause_s <= 4000:
        assert again.width[-1] < 60
    else:  # it may not step, and is off by more than can be told
        assert not again.known.any() and again.error.min() < -1_500_000


# ---- settling


def still(limit_us: int, there_us: int, **changes: int) -> _core.Sync:
    """One exchange of `there_us` each way, of oscillators that do not drift."""
    sync = _core.Sync(settings(drift_ppm=0, wander_ppb_s=0, limit_us=limit_us, **changes))
    assert sync.take((0, 0, EPOCH_US - there_us), 0, 0, True)
    assert sync.take(
        (0, EPOCH_US + there_us, EPOCH_US + there_us), 2 * there_us, 2 * there_us, True
    )
    sync.steer(2 * there_us, True)
    return sync


@pytest.mark.parametrize("there_us", [100, 999])
def test_settles_a_second_after_it_is_within_the_limit(there_us: int) -> None:
    begin = 2 * there_us
    sync = still(10_000, there_us)
    assert sync.error_us <= there_us + 3
    for passed, settled in ((SETTLE_US - 1, False), (SETTLE_US, True)):
        sync.steer(begin + passed - begin, True)
        assert sync.settled == settled


@pytest.mark.parametrize("over", [0, 1])
def test_the_limit_is_the_last_that_is_good(over: int) -> None:
    error_us = still(10_000, 500).error_us
    sync = still(error_us - over, 500)
    sync.steer(3 * SETTLE_US, True)
    assert sync.settled == (not over)


def test_unsettles_with_the_first_error_beyond_the_limit_and_settles_again() -> None:
    work, told = begun(constant(50e-6), 10, limit_us=100)
    assert work.sync.settled
    told = work.alone(ticks(work) + np.arange(1, 20_001) * 1000)
    error_us = np.maximum(-told.least, told.most) // 1 + 1
    assert (told.settled == (error_us <= 100)).all()
    assert told.settled[0] and not told.settled[-1]
    assert (np.diff(told.settled.astype(int)) <= 0).all()
    again = stream(np.random.default_rng(4), 3)
    at = float(ticks(work))
    again = Frames(
        *(column + at for column in (again.sent, again.arrived, again.echo, again.received)),
        again.echoes,
    )
    seen = work.follow(again)
    error_us = np.maximum(-seen.least, seen.most) // 1 + 1
    good = np.floor(again.arrived)[np.argmax(error_us <= 100)]
    settled = np.floor(again.arrived)[np.argmax(seen.settled)]
    assert seen.settled[-1]
    assert SETTLE_US - 4096 <= settled - good <= SETTLE_US + 2 * 4096


def test_a_host_that_never_echoes_settles_nothing() -> None:
    """There is but one side; and the second begins when there are two."""
    sync = _core.Sync(settings(drift_ppm=0, wander_ppb_s=0))
    for count in range(0, 5 * SETTLE_US, 10_000):
        assert sync.take((0, 0, EPOCH_US + count), count, count, True)
        assert sync.steer(count, True) == (count == 0)
        assert not sync.settled and sync.error_us == 2**31 - 1
    begin = 5 * SETTLE_US
    assert sync.take((begin - 100, EPOCH_US + begin, EPOCH_US + begin), begin, begin, True)
    for passed, settled in ((0, False), (SETTLE_US - 20_000, False), (SETTLE_US, True)):
        sync.steer(begin + passed, True)
        assert sync.settled == settled


# ---- hosts that are wrong


@pytest.mark.parametrize("lie_us", [86_400_000_000, -86_400_000_000, 300, -300, 30, -30])
@pytest.mark.parametrize("method", [0, 1])
def test_a_wrong_host(lie_us: int, method: int) -> None:
    """His time steps. What contradicts is excluded; the clock follows no further than it may.

    The truth stays what it was. Where a frame's delay hides the step, its stamps are taken: then
    the clock goes after the host, as slowly as oscillators may wander. A step that no delay hides
    leaves it where it is.
    """
    work, _ = begun(constant(40e-6), 10, limit_us=200, method=method)
    known_us = work.sync.most_error_ns / 1e3 - work.sync.least_error_ns / 1e3
    later = stream(np.random.default_rng(11), 4)
    at = float(ticks(work))
    later = Frames(
        *(column + at for column in (later.sent, later.arrived, later.echo, later.received)),
        later.echoes,
    )
    work.lie_us = lie_us
    told = work.follow(later, may_step=False)
    assert np.abs(told.error).max() <= 200 + 10 * known_us
    if abs(lie_us) > 1000:
        assert work.sync.excluded == work.sync.outcast == len(later)
        told.assert_inside()
    else:
        assert work.sync.excluded > 5


@pytest.mark.parametrize("lie_us", [86_400_000_000, -5000])
def test_excluded_in_a_row(lie_us: int) -> None:
    """One that is good ends the row; the count of all goes on."""
    work, _ = begun(constant(0), 5)
    later = stream(np.random.default_rng(11), 4)
    at = float(ticks(work))
    later = Frames(
        *(column + at for column in (later.sent, later.arrived, later.echo, later.received)),
        later.echoes,
    )
    for i in range(3 * OUTCAST):
        work.lie_us = 0 if i == OUTCAST else lie_us
        work.follow(later.part(np.array([i])), may_step=False)
        assert work.sync.outcast == (i + 1 if i < OUTCAST else i - OUTCAST)
    assert work.sync.excluded == 3 * OUTCAST - 1
    work.sync.restart()
    told = work.sync.excluded, work.sync.outcast, work.sync.settled
    assert told == (3 * OUTCAST - 1, 0, False)  # what it has counted stays
    assert work.sync.error_us == 2**31 - 1


def row_of(frames: Frames, at: float) -> Frames:
    """The same frames, so much later."""
    columns = frames.sent, frames.arrived, frames.echo, frames.received
    return Frames(*(column + at for column in columns), frames.echoes)


@pytest.mark.parametrize("lie_us", [250, -250])
def test_a_host_that_is_set_by_less_than_delays_vary_is_doubted(lie_us: int) -> None:
    """Some of his stamps are taken, others not, for ever: then what is known is known no more.

    Once it begins anew, all is well, by the host's new time.
    """
    work, _ = begun(constant(0), 10)
    later = row_of(stream(np.random.default_rng(11), 4), float(ticks(work)))
    work.lie_us = lie_us
    told = work.follow(later, may_step=False)
    assert not told.known[-1] and not told.settled[-1]
    gone = np.argmax(~told.known)
    assert not told.known[gone:].any() and not told.settled[gone:].any()
    assert work.sync.outcast < OUTCAST  # in a row they never were
    work.sync.restart()
    again = row_of(stream(np.random.default_rng(12), 4), float(ticks(work)))
    seen = work.follow(again)
    assert seen.settled[-1] and seen.known[-1]
    assert seen.least[-1] <= seen.error[-1] - lie_us <= seen.most[-1]


@pytest.mark.parametrize("slew_ppm", [-500, -200, 200, 500, 1000])
@pytest.mark.parametrize("seed", range(2))
def test_a_host_that_is_slewed_beyond_what_is_told_is_doubted(slew_ppm: int, seed: int) -> None:
    """As NTP does it. Within 1.5 s nothing counts as known any more; the drift that is told is 150
    ppm, and the oscillators' own is 40."""
    skews = np.array([40, 40, 40 + slew_ppm, 40 + slew_ppm]) * 1e-6
    work = Clockwork(Offset(np.array([0, 10e6, 10e6 + 1, 60e6]), skews), settings())
    frames = stream(np.random.default_rng(seed), 13)
    early = work.follow(frames.part(frames.arrived < 10e6))
    early.assert_inside()
    assert early.settled[-1] and work.sync.excluded == 0
    told = work.follow(frames.part(frames.arrived >= 10e6), may_step=False)
    late = frames.arrived[frames.arrived >= 10e6] > 11.5e6
    assert not told.known[late].any() and not told.settled[late].any()
    assert np.abs(told.error[told.known]).max() < 500


def test_a_few_that_are_wrong_are_no_doubt() -> None:
    """Sixteen in a row are, fifteen are not; one that is good takes a sixty-fourth of one back."""
    work, _ = begun(constant(0), 5)
    later = row_of(stream(np.random.default_rng(11), 30), float(ticks(work)))
    for i in range(15):
        work.lie_us = 86_400_000_000
        told = work.follow(later.part(np.array([i])), may_step=False)
        assert told.known[0]
    work.lie_us = 0
    work.follow(later.part(np.arange(15, 15 + 15 * 64)), may_step=False)
    for i in range(1000, 1016):
        assert told.known[0]
        work.lie_us = 86_400_000_000
        told = work.follow(later.part(np.array([i])), may_step=False)
    assert not told.known[0]


# ---- the plain routine


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("skew", [-100e-6, 0.0, 100e-6])
def test_the_average_stays_inside_what_it_tells(skew: float, seed: int) -> None:
    """It keeps another clock than the bounds do, and tells the error of that one."""
    work, told = begun(constant(skew), 30, seed, method=1)
    _, middle = begun(constant(skew), 30, seed)
    assert not np.array_equal(told.raw[0], middle.raw[0])
    assert work.sync.excluded == 0
    late = np.arange(len(told.error)) > 5000
    assert np.abs(told.error[late]).max() < 150  # the mean of delays that differ
    assert told.settled[late].all()
    assert np.mean(told.rate[late]) == pytest.approx(skew, abs=10e-6)  # each mean of few is rough


def test_the_average_is_off_by_half_of_what_delays_differ() -> None:
    rng = np.random.default_rng(3)
    times = np.arange(8000) * 4096.0 + 3500
    one = np.ones(8000)
    frames = exchanges(times, one * 2600, times - 1000 + rng.uniform(0, 9, 8000), one * 2000)
    work = Clockwork(constant(0), settings(method=1))
    told = work.follow(frames)
    told.assert_inside()
    assert told.error[-1] == pytest.approx(-300, abs=10)


@pytest.mark.parametrize(
    ("phase_per_s", "skew_per_s"), [(0.1, 0.0), (0.4, 0.0), (0.01, 0.002), (0.01, 0.01)]
)
def test_the_gains_are_the_configs(phase_per_s: float, skew_per_s: float) -> None:
    """A clock that is 500 us behind, by a wire whose delays are equal and stay the same: it runs
    faster by so much of that in a second, and with each interval by so much more."""
    every_us, behind_us = 65_536, 500
    made = sync_settings(
        Sync(
            method="average", limit_us=5000, average_us=every_us,
            average_phase_per_s=phase_per_s, average_skew_per_s=skew_per_s,
        )
    )  # fmt: skip
    times, one = np.arange(1000) * 4096.0 + 3500, np.full(1000, 2000.0)
    frames = exchanges(times, one, times - 1000, one)
    work = Clockwork(constant(0), made)
    assert work.follow(frames.part(frames.arrived < 2e6)).settled[-1]
    work.lie_us = behind_us
    told = work.follow(frames.part(frames.arrived >= 2e6), may_step=False)
    passed_us = frames.arrived[frames.arrived >= 2e6] - 2e6
    for intervals in (1, 4, 8):  # the first one begins before the host's clock is another one
        rate = told.rate[np.searchsorted(passed_us, (intervals + 1.5) * every_us)]
        due = 1e-6 * behind_us * (phase_per_s + (intervals + 0.5) * skew_per_s)
        assert rate == pytest.approx(due, rel=0.25, abs=1e-6)
