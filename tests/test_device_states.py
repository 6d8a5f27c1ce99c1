"""The whole device, run against a host session: what it does with time, plans, losses and lies."""

import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig import (
    BRAKE_PERIODS,
    COUNT_PQ,
    KD,
    KNOT_US,
    KP,
    PERIOD_US,
    POLL_US,
    POSITION,
    SHIFT,
    TORQUE,
    Plan,
    Points,
    Rig,
    State,
    device_settings,
    ramp,
    synced_rig,
)

from headway.firmware import _core
from headway.sim import _board

UNSYNCED, IDLE, ARMED = State.UNSYNCED, State.IDLE, State.ARMED
RUNNING, COAST, HOLD = State.RUNNING, State.COAST, State.HOLD


# ---- sync


@pytest.mark.parametrize("epoch_us", [0, 300_000, 10**9, 1_700_000_000_000_123])
@pytest.mark.parametrize("delay_us", [0, 1000, 9000])
def test_syncs_to_the_hosts_time(epoch_us: int, delay_us: int) -> None:
    """However far the first step is. It takes a second, and half a round trip of uncertainty."""
    rig = Rig(epoch_us, count_offset=(1 << 32) - 60_000, delay_us=delay_us)
    rig.poll()
    while not rig.node.synced:
        assert rig.now < 1_200_000
        assert rig.node.state == UNSYNCED
        assert rig.node.brake and rig.node.duty_q15 == 0
        rig.poll()
    assert rig.now >= 1_000_000
    assert rig.node.state == IDLE
    # A frame may wait for the next poll on the host's side: half of 250 us.
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200
    rig.run(1_000_000)
    assert abs(rig.node.system_us(rig.now) - rig.host_us) <= 200
    assert rig.statuses[-1].synced and rig.statuses[-1].state == IDLE
    assert not rig.statuses[0].synced
    assert rig.node.dropped == 0


def test_stays_unsynced_without_stamps() -> None:
    rig = Rig()
    rig.syncing = False
    rig.run(300_000)
    assert rig.node.state == UNSYNCED
    for _ in range(200):  # authentic frames without a status' stamps
        rig.node.deliver(
            rig.now, rig.host.seal(_core.FRAME_SYNC, _core.sync_encode((0, 0, rig.host_us)))
        )
        rig.run(500)
    assert rig.node.state == UNSYNCED
    assert not rig.statuses[-1].synced
    assert rig.statuses[-1].frames_bad == 0


def test_takes_no_plan_unsynced() -> None:
    rig = Rig(epoch_us=0, count_offset=0)  # even if the clocks happen to agree
    rig.syncing = False
    rig.run(20_000)
    assert rig.give(rig.knot + 5, {POSITION: [0] * 5}) == "state"
    assert rig.node.state == UNSYNCED
    assert rig.node.status.plan_seen == 1
    assert rig.node.status.plan_accepted == 0
    rig.run(100_000)
    assert rig.node.brake and rig.node.duty_q15 == 0


# ---- the first plan


@pytest.mark.parametrize("count", [0, 1000, -70_000])
def test_first_plan_starts_at_the_measured_position(count: int) -> None:
    for excess, verdict in ((-1, "accepted"), (0, "accepted"), (1, "start")):
        for sign in (-1, 1):
            rig = Rig(settings=device_settings(sample_every=3))
            rig.encoder = lambda true_us: count
            rig.sync().arm()
            point = count * COUNT_PQ + sign * (64 * COUNT_PQ + excess)
            assert rig.give(rig.knot + 4, {POSITION: [point] * 4}) == verdict
            assert rig.node.state == (RUNNING if verdict == "accepted" else ARMED)


@pytest.mark.parametrize("sink", [POSITION, TORQUE])
@pytest.mark.parametrize("length", [1, 2, 3])
def test_first_plan_starts_at_rest(sink: int, length: int) -> None:
    rig = synced_rig().arm()
    tracks = {POSITION: [0] * 8, TORQUE: [100] * 8}
    tracks[sink] = [p + 1 for p in tracks[sink][:length]] + tracks[sink][length:]
    verdict = "accepted" if length == 3 else "start"
    assert rig.give(rig.knot + 4, tracks) == verdict


@pytest.mark.parametrize("ahead", range(0, 6))
def test_first_plan_is_ahead(ahead: int) -> None:
    rig = synced_rig().arm()
    verdict = rig.give(rig.knot + ahead, {POSITION: [0] * 4})
    assert verdict == ("accepted" if ahead >= _core.LIVE_KNOTS else "late")


@pytest.mark.parametrize("tracks", [{TORQUE: [0] * 4}, {POSITION: [0] * 4, KD: [0] * 4}])
def test_plan_has_a_position_and_only_tracks_with_limits(tracks: Plan) -> None:
    rig = synced_rig().arm()
    assert rig.give(rig.knot + 4, tracks) == "sink"
    assert rig.node.state == ARMED


@pytest.mark.parametrize("ahead", [3, 4, 11])
def test_brake_lets_go_in_time_for_the_plans_first_knot(ahead: int) -> None:
    rig = synced_rig()
    torque = 50_000
    rig.arm(torque)
    rig.period()
    first = rig.knot + ahead
    assert rig.give(first, {POSITION: [0] * 60, TORQUE: [torque] * 60}) == "accepted"
    due = (first << SHIFT) - BRAKE_PERIODS * PERIOD_US
    while rig.node.brake:
        assert rig.node.duty_q15 == torque >> 10  # the load is carried before the brake lets go
        assert not rig.node.status.released
        assert rig.node.system_us(rig.now) < due + PERIOD_US
        rig.poll()
    assert due <= rig.node.system_us(rig.now) < due + PERIOD_US
    let_go = rig.now
    while not rig.node.status.released:
        rig.poll()
    assert rig.now - let_go == BRAKE_PERIODS * PERIOD_US
    for _ in range(400):
        rig.poll()
        assert not rig.node.brake and rig.node.power
        assert rig.node.duty_q15 == torque >> 10


# ---- running


def test_runs_its_tracks() -> None:
    """The servo's torque is kp times the error plus feed-forward, at each period's time."""
    rig = Rig().sync()
    first = rig.start()
    position = ramp(8, 0, 40)
    torque = [0, 0, 0, *(100 * p for p in range(3, 37)), *[3600] * 3]
    assert rig.give(first, {POSITION: position, TORQUE: torque}) == "accepted"
    reference = _core.Track(), _core.Track()
    for track, points in zip(reference, (position, torque), strict=True):
        track.write(first, np.array(points, dtype=np.int32))
    rig.run_to_knot(first + 1)
    moved = 0
    for _ in range(400):
        rig.poll()
        if rig.now % PERIOD_US:
            continue
        time = np.array([rig.node.system_us(rig.now)])
        at = int(reference[0].evaluate(time, SHIFT)[0][0])
        middle = int(reference[1].evaluate(time + PERIOD_US // 2, SHIFT)[0][0])
        assert rig.node.torque_tq == (at >> 2) + middle
        moved = max(moved, at)
    assert moved > 1 << 16


def test_coasts_and_holds_without_plans() -> None:
    """More than 5 knots without a plan: COAST; the plan runs on to its rest: HOLD."""
    rig = Rig().sync()
    first = rig.start(3)
    taken = rig.knot
    points = ramp(3, 0, 30)
    tracks = {POSITION: points, TORQUE: [0] * 3 + [700] * (len(points) - 3)}
    assert rig.give(first, tracks) == "accepted"
    end = first + len(points) - 1
    expected = rig.setpoints(first, end + 5)
    states = {}
    for _ in range(60 * KNOT_US // POLL_US):
        rig.poll()
        states.setdefault(rig.node.state, rig.node.system_us(rig.now))
    # each on the first servo period of its knot
    coast, hold = taken + _core.COAST_KNOTS + 1, end - 1
    assert 0 <= states[COAST] - (coast << SHIFT) < PERIOD_US
    assert 0 <= states[HOLD] - (hold << SHIFT) < PERIOD_US
    assert list(states) == [RUNNING, COAST, HOLD]
    assert rig.node.status.fault.reason == 0  # nothing is wrong
    assert rig.node.status.coasts == 1
    assert rig.statuses[-1].coasts == 1 and rig.statuses[-1].state == HOLD
    # the curve went on as planned, and holds with the last torque
    assert expected[-1] == rig.node.setpoint(0) == (points[-1], 0, 700)
    assert not rig.node.brake


def test_no_coast_while_plans_arrive() -> None:
    rig = Rig().sync()
    first = rig.start(12)
    for _ in range(8):
        rig.run_to_knot(rig.knot + _core.COAST_KNOTS)  # the longest wait that is allowed
        assert rig.node.state == RUNNING
        end = rig.knot + 12
        tracks = {POSITION: [0] * (end - first + 1), TORQUE: [0] * (end - first + 1)}
        assert rig.give(first, tracks) == "accepted"
    assert rig.node.status.coasts == 0
    rig.run_to_knot(rig.knot + _core.COAST_KNOTS + 1)
    rig.run(PERIOD_US)
    assert rig.node.state == COAST


def test_a_fresh_plan_in_coast_resumes() -> None:
    rig = Rig().sync()
    first = rig.start(30)
    rig.run_to_knot(rig.knot + 10)
    assert rig.node.state == COAST
    # refused ones do not
    assert rig.give(first, {POSITION: [0] * 30, TORQUE: [0] * 30}, number=1) == "stale"
    changed = [0] * (rig.knot + 2 - first) + [1] * 20
    assert rig.give(first, {POSITION: changed, TORQUE: [0] * len(changed)}) == "late"
    assert rig.node.state == COAST
    assert rig.give(first, {POSITION: [0] * 40, TORQUE: [0] * 40}) == "accepted"
    assert rig.node.state == RUNNING
    rig.run_to_knot(rig.knot + _core.COAST_KNOTS)
    assert rig.node.state == RUNNING
    rig.run_to_knot(rig.knot + 1)
    rig.run(PERIOD_US)
    assert rig.node.state == COAST
    assert rig.node.status.coasts == 2


def test_hold_takes_no_plan() -> None:
    rig = Rig().sync()
    first = rig.start(10)
    rig.run_to_knot(first + 20)
    assert rig.node.state == HOLD
    before = rig.setpoints(first, first + 60)
    for position in ([0] * 60, [0] * 40 + [9] * 20):
        assert rig.give(first, {POSITION: position, TORQUE: [0] * 60}) == "state"
    assert rig.node.state == HOLD
    assert rig.setpoints(first, first + 60) == before
    assert rig.node.status.plans_accepted == 1


def test_integrator_works_in_hold_alone() -> None:
    rig = Rig().sync()
    rig.encoder = lambda true_us: 1  # one count of following error
    first = rig.start(10)
    rig.run_to_knot(first + 1)
    proportional = -COUNT_PQ >> 2
    while rig.node.state != HOLD:
        assert rig.node.torque_tq == proportional
        rig.poll()
    began = rig.node.torque_tq
    assert proportional - COUNT_PQ // 64 <= began <= proportional  # no bump
    rig.run(100 * PERIOD_US)
    assert rig.node.torque_tq == began - 100 * COUNT_PQ // 64


def test_gains_beyond_a_scale_are_its_ends() -> None:
    settings = device_settings()
    settings.set_limits(KP, _core.GateLimits(-(1 << 27), 1 << 27, 1 << 25, 1 << 25))
    rig = Rig(settings=settings)
    rig.encoder = lambda true_us: -1
    rig.sync().arm()
    first = rig.knot + 4
    gains = [-5 << 8] * 6 + [min(i * (1 << 23), 1 << 26) for i in range(16)] + [1 << 26] * 3
    assert rig.give(first, {POSITION: [0] * len(gains), KP: gains}) == "accepted"
    rig.run_to_knot(first)
    assert rig.node.torque_tq == 0
    rig.run_to_knot(first + len(gains) - 3)
    assert rig.node.unclipped_tq == 65535 * COUNT_PQ >> 2


def test_gain_track_replaces_the_settings() -> None:
    rig = synced_rig().arm()
    rig.encoder = lambda true_us: -16
    first = rig.knot + 4
    gains = [3 << 8] * 6 + [5 << 8] * 12
    assert rig.give(first, {POSITION: [0] * 18, KP: gains}) == "accepted"
    rig.run_to_knot(first)
    assert rig.node.torque_tq == 3 * 16 * COUNT_PQ >> 2
    rig.run_to_knot(first + 12)
    rig.run(PERIOD_US)
    assert rig.node.torque_tq == 5 * 16 * COUNT_PQ >> 2


# ---- all or nothing


def rings(rig: Rig, values: Points) -> list[np.ndarray]:
    """What is stored of tracks: rings, which a resting value fills, with `written` and `end`."""
    numbers = rig.memory.view(np.int32)
    whole = np.ones(_core.TRACK_POINTS)
    starts = [
        int(np.flatnonzero(np.convolve(numbers == v, whole) == len(whole))[0]) - len(whole) + 1
        for v in values
    ]
    return [numbers[start - 4 : start + len(whole)] for start in starts]


def test_a_plan_is_taken_whole_or_not_at_all() -> None:
    rig = Rig()
    rig.encoder = lambda true_us: 3
    rig.sync().arm()
    first, rest = rig.knot + 4, 3 * COUNT_PQ
    assert rig.give(first, {POSITION: [rest] * 30, TORQUE: [77] * 30}) == "accepted"
    tracks = rings(rig, [rest, 77])
    before = [track.copy() for track in tracks]
    rig.run_to_knot(first)
    position, torque = ramp(10, rest, 30), [77] * 20 + [(1 << 20) + 1] * 10
    assert rig.give(first, {POSITION: position, TORQUE: torque}) == "range"
    assert all(map(np.array_equal, tracks, before))
    late = [rest + 1, *position[1:]]
    assert rig.give(first, {POSITION: late, TORQUE: [77] * 15 + [90] * 15}) == "late"
    assert all(map(np.array_equal, tracks, before))
    torque[20:] = [1 << 20] * 10
    assert rig.give(first, {POSITION: position, TORQUE: torque}) == "accepted"
    assert not any(map(np.array_equal, tracks, before))
    assert rig.node.setpoint((first + 40) << SHIFT) == (position[-1], 0, 1 << 20)


@pytest.mark.parametrize("ahead", range(0, 7))
def test_only_points_three_knots_ahead_change(ahead: int) -> None:
    rig = Rig().sync()
    first = rig.start(40)
    rig.run_to_knot(first + 10)
    at = rig.knot + ahead - first
    position = [0] * at + [5] * (40 - at)
    before = rig.setpoints(first, rig.knot + 1)
    verdict = rig.give(first, {POSITION: position, TORQUE: [0] * 40})
    assert verdict == ("accepted" if ahead >= 3 else "late")
    assert rig.setpoints(first, rig.knot + 1) == before


def test_a_packet_is_judged_when_it_is_taken() -> None:
    """It arrives in one knot's interval and is polled in the next: the later one counts."""
    rig = Rig().sync()
    first = rig.start(40)
    rig.run_to_knot(first + 10)
    target = rig.knot + 1
    while rig.node.system_us(rig.now + POLL_US) >> SHIFT < target:
        rig.poll()
    assert rig.knot == target - 1
    at = rig.knot + 3 - first
    packet = rig.plan(first, {POSITION: [0] * at + [5] * 20, TORQUE: [0] * (at + 20)})
    rig.node.deliver(rig.now + 1, packet)  # still in the older knot
    assert rig.node.system_us(rig.now + 1) >> SHIFT == target - 1
    rig.poll()
    assert rig.knot == target
    assert rig.node.status.plans_late == 1


def test_a_track_cannot_appear_while_others_run() -> None:
    """It would jump from nothing to its first point at once, before the margin."""
    rig = synced_rig().arm()
    first = rig.knot + 4
    assert rig.give(first, {POSITION: [0] * 40}) == "accepted"
    rig.run_to_knot(first + 10)
    before = rig.node.setpoint(rig.knot << SHIFT)
    later = rig.knot + 5
    tracks = {POSITION: [0] * 20, TORQUE: [9000] * 20}
    assert rig.give(later, tracks) == "start"
    assert rig.node.setpoint(rig.knot << SHIFT) == before


# ---- numbers, freshness and what the host is told


def test_stale_numbers() -> None:
    rig = Rig().sync()
    first = rig.start(40)
    tracks = {POSITION: [0] * 40, TORQUE: [0] * 40}
    for number, verdict in ((1, "stale"), (0, "stale"), (5, "accepted"), (5, "stale")):
        assert rig.give(first, tracks, number) == verdict
    for number, verdict in ((4, "stale"), (6, "accepted"), (2**32 - 1, "accepted"), (7, "stale")):
        assert rig.give(first, tracks, number) == verdict
    assert rig.node.status.plan_seen == rig.node.status.plan_accepted == 2**32 - 1


def test_a_plan_long_behind_the_newest_is_told_by_its_number_alone() -> None:
    rig = Rig().sync()
    first = rig.start(40)
    rig.run_to_knot(first)
    still = {POSITION: [0] * 40, TORQUE: [0] * 40}
    assert rig.give(first, still | {POSITION: [1] * 40}, 100) == "late"
    for number, mask in ((68, 0), (69, 1 << 31), (99, 1 << 31 | 2)):
        assert rig.give(first, still, number) == "accepted"
        status = rig.node.status
        assert (status.plan_seen, status.plan_accepted) == (100, number)
        assert status.accepted_mask == mask


@pytest.mark.parametrize("sign", [-1, 1])
def test_stale_stamps(sign: int) -> None:
    rig = Rig().sync()
    first = rig.start(60)
    tracks = {POSITION: [0] * 60, TORQUE: [0] * 60}
    arrays = {s: np.array(p, dtype=np.int32) for s, p in tracks.items()}
    now = rig.node.system_us(rig.now)
    for age, verdict in ((100_000, "accepted"), (100_001, "stale"), (1 << 59, "stale")):
        rig.number += 1
        payload = _core.plan_encode((0, 0, now - sign * age), rig.number, rig.epoch, first, arrays)
        assert rig.hand_over(rig.host.seal(_core.FRAME_PLAN, payload)) == verdict


@settings(max_examples=80)
@given(st.integers(0, 2**32))
def test_mask_tells_which_plans_were_taken(seed: int) -> None:
    """Plans are lost, refused and skipped at random; the mask is right about the last 32."""
    rng = random.Random(seed)
    rig = synced_rig()
    first = rig.start(100)
    rig.run_to_knot(first)  # so that its first point is live
    taken = {rig.number}
    seen = accepted = rig.number
    for _ in range(60):
        number = rig.number + rng.choice([1, 1, 1, 1, 2, 7, 31, 32, 33, 40])
        good = rng.random() < 0.7
        points = [0 if good else 1] + [0] * 99
        packet = rig.plan(first, {POSITION: points, TORQUE: [0] * 100}, number)
        if rng.random() < 0.4:
            continue  # lost
        assert rig.hand_over(packet) == ("accepted" if good else "late")
        seen = number
        if good:
            taken.add(number)
            accepted = number
        status = rig.node.status
        assert status.plan_seen == seen
        assert status.plan_accepted == accepted
        expected = sum(1 << i for i in range(32) if seen - i in taken)
        assert status.accepted_mask == expected


def test_state_is_the_array() -> None:
    """A node restored from a copy goes on to the last bit as the original does."""
    a = Rig().sync()
    a.start(60)
    b = Rig()
    b.memory[:] = a.memory
    for t in range(a.now + POLL_US, a.now + 200_000, POLL_US):
        for rig in (a, b):
            rig.node.poll(t, t // 1000 % 3)
        assert a.node.collect() == b.node.collect()
    assert np.array_equal(a.memory.view(np.int64), b.memory.view(np.int64))


def drop(statuses: list[_core.Status], lost: set[int]) -> list[tuple[int, int]]:
    """The samples of all statuses but the lost ones, each once, as the estimator has them."""
    kept = [status for i, status in enumerate(statuses) if i not in lost]
    return list(dict.fromkeys(sample for status in kept for sample in status.samples))


@pytest.mark.parametrize("sample_every", [1, 3])
@pytest.mark.parametrize("delay_us", [0, 6000])
@pytest.mark.parametrize("lost_every", [0, 2, 7])  # reports, none of them next to another lost one
def test_samples_arrive_in_order_and_complete(
    sample_every: int, delay_us: int, lost_every: int
) -> None:
    rig = Rig(delay_us=delay_us, settings=device_settings(sample_every))
    rig.encoder = lambda true_us: true_us // 250 - 4000  # tells when it was read
    rig.sync()
    known = len(rig.statuses)
    rig.run(1_000_000)
    reports = rig.statuses[known:]
    lost = set(range(1, len(reports) - 1, lost_every)) if lost_every else set()
    samples = drop(reports, lost)
    assert len(samples) > 900_000 // (PERIOD_US * sample_every)
    counts = [count for _, count in samples]
    stride = 4 * sample_every
    assert counts == list(range(counts[0], counts[0] + stride * len(counts), stride))
    for time_us, count in samples:
        true_us = (count + 4000) * 250
        assert abs(time_us - (rig.epoch_us + true_us)) <= 200
    sent = [status.sent_us for status in rig.statuses]
    assert sent[known:] == sorted(sent[known:])
    knots = [t >> SHIFT for t in sent[known:]]
    assert knots == list(range(knots[0], knots[0] + len(knots)))  # one a knot


def test_each_sample_is_reported_twice_in_a_row() -> None:
    rig = Rig().sync()
    known = len(rig.statuses)
    rig.run(200_000)
    reports = [status.samples for status in rig.statuses[known:]]
    for before, report, after in zip(reports, reports[1:], reports[2:], strict=False):
        fresh = [sample for sample in report if sample not in before]
        assert report == [*before[-(len(report) - len(fresh)) :], *fresh]
        assert 4 <= len(fresh) <= 5  # of the 1 kHz, in a knot
        assert after[: len(fresh)] == fresh
        assert not set(before) & set(after)


def test_more_samples_than_can_be_sent() -> None:
    """The ring holds the last 32, which a status can carry: older ones are lost."""
    settings = device_settings()
    settings.knot_shift, settings.servo_period_us = 15, POLL_US  # 131 samples a knot
    rig = Rig(epoch_us=0, delay_us=0, settings=settings)
    rig.encoder = lambda true_us: true_us // POLL_US
    rig.syncing = False
    rig.run(2000)
    rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_SYNC, _core.sync_encode((0, 0, 0))))
    rig.run(500_000)  # the session has begun
    for _ in range(10):
        known = len(rig.statuses)
        while len(rig.statuses) == known:
            rig.poll()
        samples = rig.statuses[-1].samples
        newest = rig.now // POLL_US
        assert [count for _, count in samples] == list(range(newest - 31, newest + 1))
        stamps = np.array([us for us, _ in samples])
        assert (np.diff(stamps) == POLL_US).all()


def test_torque_peak_and_clipping_are_told() -> None:
    rig = Rig().sync()
    first = rig.start(60)
    rig.run_to_knot(first + 2)
    rig.run(3 * KNOT_US)
    assert rig.statuses[-1].torque_peak_tq == 0
    rig.encoder = lambda true_us: -70_000  # kp: 17,920,000 tq, above the ceiling of 2^24
    rig.run(4 * PERIOD_US)
    rig.encoder = lambda true_us: 0
    rig.run(5 * KNOT_US)
    peaks = [s.torque_peak_tq for s in rig.statuses[-8:]]
    assert max(peaks) == 70_000 * COUNT_PQ >> 2
    assert peaks[-1] == 0  # since the last status only
    assert rig.statuses[-1].torque_clipped == 4


# ---- what is not authentic


def board_at() -> int:
    """Index of the first byte of the node that is the board's, not the device's."""
    memory = np.zeros(_board.NODE_NUMBERS)
    _board.Node(memory).poll(0x7EDCBA9876543210, 0)  # an empty device only brakes
    return int(np.flatnonzero(memory.view(np.int64) == 0x7EDCBA9876543210)[0])


def device_bytes(rig: Rig) -> np.ndarray:
    return rig.memory.view(np.int32)[: 2 * board_at()]


def bad_packets(rig: Rig, first: int) -> dict[str, bytes]:
    good = rig.plan(first, {POSITION: ramp(10, 0, 40), TORQUE: [0] * 40})
    to_device, to_host, number = rig.host.send_key, rig.host.receive_key, rig.host.number
    wrong_key = _core.Session(bytes(16), bytes(16), number)
    wrong_session = _core.Session(to_device, to_host, number + 1)
    reflected = _core.Session(to_host, to_device, number, at_device=True)
    replayed = _core.Session(to_device, to_host, number)
    for session in (wrong_key, wrong_session, reflected):
        session.sent = rig.host.sent + 5
    flipped = bytearray(good)
    flipped[40] ^= 0x80
    payload = _core.sync_encode((0, 0, 0))
    return {
        "noise": bytes(range(1, 90)),
        "zeros": bytes(50),
        "short": b"\x01",
        "flipped": bytes(flipped),
        "cut": good[:-1],
        "wrong key": wrong_key.seal(_core.FRAME_SYNC, payload),
        "wrong session": wrong_session.seal(_core.FRAME_SYNC, payload),
        "reflected": reflected.seal(_core.FRAME_SYNC, payload),
        "replayed": replayed.seal(_core.FRAME_SYNC, payload),
    }


BAD = ("noise", "zeros", "short", "flipped", "cut", "wrong key", "wrong session")


@pytest.mark.parametrize("kind", [*BAD, "reflected", "replayed"])
def test_unauthentic_frames_are_counted_and_change_nothing(kind: str) -> None:
    rig, twin = synced_rig(), synced_rig()
    first = rig.start(40)
    assert twin.start(40) == first
    packet = bad_packets(rig, first)[kind]
    for _ in range(3):
        assert rig.node.deliver(rig.now, packet)
    for r in (rig, twin):
        for _ in range(3):  # a poll opens one packet at most
            r.node.poll(r.now, 0)
    differing = np.flatnonzero(device_bytes(rig) != device_bytes(twin))
    assert len(differing) == 1  # the counter
    assert device_bytes(rig)[differing[0]] - device_bytes(twin)[differing[0]] == 3
    assert rig.node.status.frames_bad == twin.node.status.frames_bad + 3
    # and it still takes what is authentic
    assert rig.give(first, {POSITION: ramp(10, 0, 40), TORQUE: [0] * 40}) == "accepted"


def test_a_poll_opens_one_packet_at_most_and_the_rest_waits() -> None:
    """However much has arrived, the servo waits for one packet to be opened."""
    rig = synced_rig()
    payload = _core.sync_encode((0, 0, 0))
    wrong = _core.Session(bytes(16), bytes(16), rig.host.number)
    wrong.sent = rig.host.sent + 5
    bad = wrong.seal(_core.FRAME_SYNC, payload)
    before = rig.node.status.frames_bad
    for _ in range(16):
        assert rig.node.deliver(rig.now, bad)
    for opened in range(1, 18):
        rig.node.poll(rig.now, 0)
        assert rig.node.status.frames_bad == before + min(opened, 16)


@pytest.mark.parametrize("junk", [b"\x01", bytes(30), b"\x28\x01" + bytes(range(1, 200))])
def test_what_is_not_worth_opening_delays_nothing(junk: bytes) -> None:
    """A dozen before it, and a plan is taken in the same poll."""
    rig = synced_rig()
    first = rig.start(40)
    before = rig.node.status.frames_bad
    for _ in range(_core.INBOX_PACKETS - 1):
        assert rig.node.deliver(rig.now, junk)
    packet = rig.plan(first, {POSITION: ramp(10, 0, 40), TORQUE: [0] * 40})
    accepted = rig.node.status.plans_accepted
    rig.node.deliver(rig.now, packet)
    rig.node.poll(rig.now, 0)
    assert rig.node.status.plans_accepted == accepted + 1
    assert rig.node.status.frames_bad == before + _core.INBOX_PACKETS - 1


def test_the_servo_comes_before_what_has_arrived() -> None:
    """Obeyed in the poll, done by the next servo period: this one's was not kept waiting."""
    rig = synced_rig().arm()
    rig.run((BRAKE_PERIODS + 2) * PERIOD_US)
    assert rig.node.power
    rig.run(PERIOD_US - POLL_US - rig.now % PERIOD_US)
    payload = _core.command_encode(99, _core.COMMANDS.index("DISARM"), 0, 0)
    rig.node.deliver(rig.now + 1, rig.host.seal(_core.FRAME_COMMAND, payload))
    rig.poll()
    assert rig.now % PERIOD_US == 0 and rig.state == State.IDLE and rig.node.power
    rig.period()
    rig.run(BRAKE_PERIODS * PERIOD_US)
    assert not rig.node.power


@pytest.mark.parametrize(
    ("kind", "payload"),
    [
        (_core.FRAME_SYNC, b""),
        (_core.FRAME_SYNC, bytes(19)),
        (_core.FRAME_SYNC, bytes(21)),
        (_core.FRAME_SYNC, bytes(4) + b"\xff" * 7 + b"\x7f" + bytes(8)),  # a stamp of 2^63 - 1
        (_core.FRAME_PLAN, bytes(20)),
        (_core.FRAME_PLAN, bytes(36)),
        (_core.FRAME_STATUS, bytes(24)),
        (0, bytes(24)),
        (255, bytes(24)),
    ],
)
def test_malformed_payloads_are_bad_frames(kind: int, payload: bytes) -> None:
    rig = synced_rig()
    first = rig.start(20)
    before = rig.setpoints(first, first + 30)
    bad = rig.node.status.frames_bad
    rig.node.deliver(rig.now, rig.host.seal(kind, payload))
    rig.node.poll(rig.now, 0)
    assert rig.node.status.frames_bad == bad + 1
    assert rig.setpoints(first, first + 30) == before
    assert rig.node.state == RUNNING


# ---- the board


def test_an_empty_board_is_off_and_braked() -> None:
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    node.poll(1000, 5)
    assert node.brake and node.duty_q15 == 0 and node.collect() == []


@pytest.mark.parametrize(
    ("name", "value"),
    [("knot_shift", 8), ("knot_shift", 16), ("servo_period_us", 0), ("sample_every", 0)],
)
def test_settings_that_cannot_run_lead_to_a_fault(name: str, value: int) -> None:
    """Off and braked, deaf and dumb, until they are replaced by the programmer."""
    settings = device_settings()
    setattr(settings, name, value)
    rig = Rig(settings=settings)
    rig.run(100_000)
    assert rig.state == State.FAULT and rig.reason == "SETTINGS"
    assert rig.node.brake and not rig.node.power
    assert not rig.welcomed and not rig.statuses
    rig.node.flash(device_settings())
    rig.sync()


def test_array_of_the_wrong_size_is_refused() -> None:
    with pytest.raises(ValueError, match="too small"):
        _board.Node(np.zeros(_board.NODE_NUMBERS - 1))


def test_a_full_inbox_drops() -> None:
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    taken = [node.deliver(0, b"\x01") for _ in range(17)]
    assert taken == [True] * 16 + [False]
    assert node.dropped == 1
    assert not node.deliver(0, bytes(2000))


@pytest.mark.parametrize("drift_ppb", [-50_000, 50_000])
def test_drift_of_the_counter_over_years(drift_ppb: int) -> None:
    node = _board.Node(np.zeros(_board.NODE_NUMBERS))
    node.flash(device_settings(), count_offset=3, drift_ppb=drift_ppb)
    for true_us in (10**9, 10**12, 1_700_000_000_000_000):
        count = true_us + 3 + true_us * drift_ppb // 10**9
        assert (node.system_us(true_us) - (count - 3)) % (1 << 32) == 0
