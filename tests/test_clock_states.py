"""What a device does about its clock: when it moves, stops, starts anew, and whom it believes."""

import pytest
from rig import MAKE, PERIOD_US, POLL_US, POSITION, TORQUE, Rig, State, device_settings

S = State
DAY_US = 86_400_000_000
ENOUGH = 16  # stamps in a row that contradict what is known: then that is doubted
SYNC_US = 4000  # between the rig's frames


def wandering_rig(
    margin_us: int, sync_lost_us: int = 10_000_000, period_us: int = PERIOD_US
) -> Rig:
    """Its interval grows by 30 us in the first second alone; the limit is so much above it."""
    settings, poll_us = device_settings(), min(POLL_US, period_us // 2)
    settings.servo_period_us = period_us
    sync = settings.sync
    sync.wander_ppb_s = 60_000
    settings.sync, settings.sync_lost_us = sync, sync_lost_us
    known = Rig(settings=settings, poll_us=poll_us).sync().statuses[-1]
    error_us = max(-known.least_error_ns, known.most_error_ns) // 1000 + 1
    assert 1000 < error_us < 2000  # half of the round trip, and what a poll adds
    sync.limit_us = error_us + margin_us
    settings.sync = sync
    return Rig(settings=settings, poll_us=poll_us).sync()


def keep_running(rig: Rig, within_us: int) -> None:
    """Plans at rest, which echo nothing, until it stops by itself."""
    end, first = rig.now + within_us, rig.knot - 10
    while rig.state == S.RUNNING:
        assert rig.now < end
        count = rig.knot + 20 - first
        if count > 120:
            first, count = first + 60, count - 60
        tracks = {POSITION: [0] * count, TORQUE: [0] * count}
        rig.epoch_us -= rig.delay_us  # it left then
        assert rig.give(first, tracks) == "accepted"
        rig.epoch_us += rig.delay_us
        for _ in range(20):
            if rig.state == S.RUNNING:
                rig.poll()


def run_into_running(rig: Rig) -> None:
    first = rig.start(60)
    rig.run_to_knot(first)
    assert rig.give(first, {POSITION: [0] * 60, TORQUE: [0] * 60}) == "accepted"
    assert rig.state == S.RUNNING


def host_is_off(rig: Rig, by_us: int) -> None:
    """Its time is another one from now on."""
    rig.epoch_us += by_us
    rig.stamps = (0, 0)


# ---- the limit


def test_an_interval_beyond_the_limit_stops_it() -> None:
    rig = wandering_rig(margin_us=40)
    run_into_running(rig)
    rig.syncing = False
    keep_running(rig, 10_000_000)
    assert rig.state == S.TAIL and rig.reason == "CLOCK"
    fault = rig.node.status.fault
    limit_us = rig.settings.sync.limit_us
    assert fault.state == S.RUNNING and fault.limit == limit_us
    assert limit_us < fault.value <= limit_us + 2
    assert not rig.node.synced
    # It rests and holds, and is resumed only once its clock is good again.
    rig.run_until(S.HOLD)
    rig.epoch += 1
    assert rig.ask("RESUME", 0, rig.epoch) == "UNSYNCED"
    assert rig.state == S.HOLD
    rig.syncing = True
    rig.run(900_000)
    assert rig.ask("RESUME", 0, rig.epoch) == "UNSYNCED"
    rig.run(200_000)
    assert rig.ask("RESUME", 0, rig.epoch) == "DONE"


def test_a_wide_interval_ends_idle() -> None:
    rig = wandering_rig(margin_us=40)
    rig.syncing = False
    rig.run_until(S.UNSYNCED, 5_000_000)
    assert rig.reason == "NONE"  # nothing stopped
    rig.syncing = True
    rig.run_until(S.IDLE)


def test_it_is_not_armed_with_a_clock_that_is_not_good() -> None:
    """The instant after it left HOLD, before anything has followed from that."""
    rig = wandering_rig(margin_us=40)
    run_into_running(rig)
    rig.syncing = False
    keep_running(rig, 10_000_000)
    rig.run_until(S.HOLD)
    while rig.now % 1000 != 500:  # between servo periods
        rig.poll()
    assert rig.ask("DISARM") == "DONE" and rig.state == S.IDLE
    assert rig.ask("ARM", 0, 9) == "UNSYNCED"
    rig.period()
    assert rig.state == S.UNSYNCED


@pytest.mark.parametrize("period_us", [PERIOD_US, 100])
@pytest.mark.parametrize("sync_lost_us", [100_000, 10_000_000])
def test_silence_is_told_from_an_unsure_clock(sync_lost_us: int, period_us: int) -> None:
    """Whichever comes first; also where the clock is steered in parts."""
    rig = wandering_rig(margin_us=40, sync_lost_us=sync_lost_us, period_us=period_us).arm()
    rig.syncing = False
    rig.run_until(S.TAIL, 5_000_000)
    assert rig.reason == ("SYNC_LOST" if sync_lost_us == 100_000 else "CLOCK")


def test_in_short_periods_silence_is_found_two_milliseconds_later_at_most() -> None:
    settings = device_settings()
    settings.servo_period_us, settings.sync_lost_us = 100, 100_000
    for after_us in range(0, 1600, 150):
        rig = Rig(settings=settings, poll_us=50).sync().arm()
        while rig.now % SYNC_US != 0:
            rig.poll()
        rig.run(after_us)
        rig.syncing = False
        heard_us = rig.now - after_us + rig.delay_us
        rig.run_until(S.TAIL, 200_000)
        assert rig.reason == "SYNC_LOST"
        assert 0 < rig.now - heard_us - 100_000 <= 1600 + 2 * 100


def test_in_short_periods_the_clock_is_steered() -> None:
    """To a host whose time is another one by less than the interval is wide, at 300 ppm at most."""
    settings = device_settings()
    settings.servo_period_us = 100
    rig = Rig(settings=settings, poll_us=50).sync().arm()
    before_us = rig.node.system_us(rig.now) - rig.host_us
    host_is_off(rig, 300)
    rig.run(200_000)
    after_us = rig.node.system_us(rig.now) - rig.host_us
    assert before_us - 300 < after_us  # it began so far behind
    assert after_us - (before_us - 300) <= 200_000 * 301e-6
    least_ns, most_ns = rig.node.error_ns
    assert least_ns <= 1000 * after_us <= most_ns


# ---- a host whose time is another one


@pytest.mark.parametrize("by_us", [DAY_US, -DAY_US, 3000, -3000])
def test_a_host_that_contradicts_itself_moves_nothing(by_us: int) -> None:
    """What he says is excluded and counted; as he says nothing else, the axis comes to rest.

    Up to then the clock is, to the last bit, that of a board which hears nothing.
    """
    rig = wandering_rig(margin_us=40)
    twin = wandering_rig(margin_us=40)
    run_into_running(rig)
    run_into_running(twin)
    assert rig.now == twin.now
    truth = rig.epoch_us
    host_is_off(rig, by_us)
    twin.syncing = False
    for _ in range(400_000 // POLL_US):
        rig.poll()
        twin.poll()
        assert rig.node.system_us(rig.now) == pytest.approx(truth + rig.now, abs=300)
        if rig.node.status.stamps_excluded < ENOUGH - 1:  # as last told
            assert rig.node.system_us(rig.now) == twin.node.system_us(twin.now)
            assert rig.state in (S.RUNNING, S.COAST)
    status = rig.node.status
    assert status.stamps_excluded >= 400_000 // SYNC_US - 2
    assert status.frames_bad == 0 and twin.node.status.stamps_excluded == 0
    assert status.heard_us > 0
    rig.run(3_000_000)
    assert rig.state == S.HOLD


def test_and_its_plans_stop_it_by_the_clock() -> None:
    """One whose plans are still in time: until what is known is doubted."""
    rig = wandering_rig(margin_us=40)
    run_into_running(rig)
    host_is_off(rig, 5000)
    keep_running(rig, 10_000_000)
    assert rig.state == S.TAIL and rig.reason == "CLOCK"
    assert ENOUGH - 1 <= rig.node.status.stamps_excluded <= ENOUGH + 3


@pytest.mark.parametrize("by_us", [DAY_US, -DAY_US, 10**9])
def test_at_rest_it_starts_anew_after_16(by_us: int) -> None:
    """From IDLE: what it knows is wrong, so it forgets it and takes the host's time."""
    rig = Rig().sync()
    assert rig.state == S.IDLE
    before = rig.node.status.stamps_excluded
    host_is_off(rig, by_us)
    begin = rig.now
    while rig.state == S.IDLE:
        assert abs(rig.node.system_us(rig.now) - rig.host_us) > 10**8  # it does not step
        rig.poll()
    assert rig.state == S.UNSYNCED
    assert rig.node.status.stamps_excluded - before in (ENOUGH - 1, ENOUGH)  # as last told
    assert rig.now - begin == pytest.approx(ENOUGH * SYNC_US, abs=2 * SYNC_US)
    rig.run_until(S.IDLE)
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200
    assert rig.node.status.stamps_excluded - before <= ENOUGH + 1


def test_unsynced_too() -> None:
    """Half a second into settling the host's time is another one."""
    rig = Rig()
    rig.run(500_000)
    assert rig.state == S.UNSYNCED and rig.node.status.stamps_excluded == 0
    host_is_off(rig, DAY_US)
    rig.run(ENOUGH * SYNC_US + 20_000)
    assert rig.node.status.stamps_excluded == ENOUGH
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 2000
    rig.run_until(S.IDLE)
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200


@pytest.mark.parametrize("state", ["ARMED", "HOLD"])
def test_under_power_it_never_does(state: str) -> None:
    """It comes to rest, and stays there: no clock steps with power on."""
    rig = Rig().sync().arm()
    if state == "HOLD":
        assert rig.ask("STOP") == "DONE"
        rig.run_until(S.HOLD)
    host_is_off(rig, DAY_US)
    for _ in range(350_000 // POLL_US):
        before = rig.node.system_us(rig.now)
        rig.poll()
        assert abs(rig.node.system_us(rig.now) - before - POLL_US) <= 2
    assert rig.node.status.stamps_excluded > ENOUGH
    assert rig.state == S.HOLD
    if state == "ARMED":
        assert rig.reason == "CLOCK"


@pytest.mark.parametrize("by_us", [600, -600])
@pytest.mark.parametrize("state", [state for state in S if state > S.UNSYNCED])
def test_above_unsynced_it_is_slewed(state: State, by_us: int) -> None:
    """After a host that has been set by less than the wire's delays hide: by 500 ppm at most."""
    rig = MAKE[state]()
    assert rig.state == state
    host_is_off(rig, by_us)
    begin = rig.node.system_us(rig.now) - rig.now
    for _ in range(100_000 // POLL_US):
        before = rig.node.system_us(rig.now)
        rig.poll()
        if rig.state == S.UNSYNCED:  # after an emergency stop
            break
        assert abs(rig.node.system_us(rig.now) - before - POLL_US) <= 1
    moved = rig.node.system_us(rig.now) - rig.now - begin
    assert abs(moved) > 10 or state == S.ESTOP
    assert rig.node.status.stamps_excluded == 0


def test_15_are_not_enough() -> None:
    """And each that is right takes a 64th of one back."""
    rig = Rig().sync()
    epoch_us = rig.epoch_us
    for _ in range(3):
        host_is_off(rig, DAY_US)
        excluded = rig.node.status.stamps_excluded
        while rig.node.status.stamps_excluded < excluded + ENOUGH - 1:
            rig.poll()
        rig.epoch_us = epoch_us
        rig.run((ENOUGH - 1) * 64 * SYNC_US + 20_000)
        assert rig.state == S.IDLE
        rig.flying.clear()
        rig.stamps = (0, 0)
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200


# ---- what it tells


def test_a_status_tells_the_interval_and_what_was_heard() -> None:
    rig = Rig(delay_us=3000).sync()
    for _ in range(50):
        rig.run(4000)
        status = rig.statuses[-1]
        true_us = rig.stamps[1] - rig.epoch_us - 3000  # it left then
        error_ns = (status.sent_us - rig.epoch_us - true_us) * 1000
        assert status.least_error_ns - 1000 <= error_ns <= status.most_error_ns + 1000
        assert status.synced == (status.state >= S.IDLE)
        assert (status.sent_count_us - 12_345) % (1 << 32) <= rig.now
        # heard_us left the host 3 ms before it was heard
        heard_true_us = status.heard_us - rig.epoch_us + 3000
        assert abs(heard_true_us + status.heard_age_us - true_us) <= POLL_US
        assert abs(status.rate_q32) < 1 << 20


def test_before_the_first_stamps_nothing_is_known() -> None:
    rig = Rig()
    rig.syncing = False
    rig.run(50_000)
    assert rig.ask("FAULTS") == "DONE"
    rig.run(50_000)
    status = rig.statuses[-1]
    assert (status.least_error_ns, status.most_error_ns) == (-(2**31 - 1), 2**31 - 1)
    assert status.heard_us == 0 and status.stamps_excluded == 0


def test_a_step_forgets_the_samples_of_before() -> None:
    """A sample's stamp and a status' are of the same time, or the sample is not told."""
    rig = Rig()
    for _ in range(400):
        rig.run(1000)
        if rig.statuses:
            status = rig.statuses[-1]
            late = [status.sent_us - time_us for time_us, _ in status.samples]
            assert all(0 <= age < 100_000 for age in late)


# ---- the counter's ends

Moment = tuple[State, int, bool, bool, int, tuple[int, int], int, int]


def life(offset: int) -> list[Moment]:
    """Of a board whose count begins at `offset`: from power-up through a run, its end, another one
    and silence, with an encoder that moves a little; all that it does at each poll."""
    rig, moments = Rig(count_offset=offset % (1 << 32)), list[Moment]()

    def live(us: int) -> None:
        for _ in range(us // POLL_US):
            rig.poll()
            node, status = rig.node, rig.node.status
            moments.append(
                (rig.state, node.duty_q15, node.power, node.brake, node.system_us(rig.now),
                 node.error_ns, status.frames_bad, status.stamps_excluded)
            )  # fmt: skip

    live(1_200_000)
    rig.encoder = lambda now: now // 30_000 % 3
    for _ in range(2):
        rig.start(60)
        live(400_000)
    rig.syncing = False
    live(1_100_000)
    return moments


def test_a_wrap_of_the_count_changes_nothing() -> None:
    """At each of its ends, as unsigned and as signed numbers have them, in each part of a life."""
    plain = life(0)
    states = [moment[0] for moment in plain]
    assert {S.UNSYNCED, S.IDLE, S.RUNNING, S.COAST, S.HOLD} <= set(states)
    assert any(moment[1] for moment in plain)
    for edge in (1 << 31, 1 << 32):
        for state in (S.UNSYNCED, S.IDLE, S.RUNNING, S.COAST, S.HOLD):
            middle_us = POLL_US * (states.index(state) + states.count(state) // 3)
            for aside in (0, 1, 137):
                assert life(edge - middle_us - aside) == plain, (edge, state, aside)
