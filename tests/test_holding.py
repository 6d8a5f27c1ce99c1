"""What the host takes a device to hold, whatever was lost, late or refused: against the same logic
written out in Python; and the gate and the course of several tracks against those of each."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_plan_codec import status_layout

from headway.devices._tracks import Course, Gate, Holding
from headway.firmware import _core

Array = NDArray[np.float64]
PATIENCE_US, KNOT_US = 20_000, 4096
PLAN_SEEN, ACCEPTED_MASK, FIELDS = 25, 27, 36  # places in a status' head
POSITION, TORQUE = _core.TRACK_POSITION, _core.TRACK_TORQUE
NO_MARK = 0, _core.MARK_OPEN, 0


def status(sent_us: int, plan_seen: int, mask: int) -> _core.Status:
    head = [0] * FIELDS
    head[0], head[PLAN_SEEN], head[ACCEPTED_MASK] = sent_us, plan_seen, mask
    told = _core.status_decode(status_layout(tuple(head), []))
    assert told is not None
    assert (told.sent_us, told.plan_seen, told.accepted_mask) == (sent_us, plan_seen, mask)
    return told


class Told:
    """The oracle: plans that were acknowledged are held, those under way are presumed."""

    def __init__(self) -> None:
        self.held: list[tuple[int, list[int]]] = []  # what was written, in order
        self.pending: list[tuple[int, int, int, list[int]]] = []
        self.number = self.doomed = 0

    def settle(self, sent_us: int, seen: int, mask: int) -> None:
        answered = [plan for plan in self.pending if plan[0] <= seen]
        for number, _, first, points in answered:
            if seen - number < 32 and mask >> (seen - number) & 1:
                self.held.append((first, points))
        waiting = [plan for plan in self.pending if plan[0] > seen]
        while waiting and waiting[0][1] + PATIENCE_US < sent_us:
            waiting.pop(0)
        self.pending = waiting
        if not mask & 1 and seen > self.doomed:
            self.doomed = self.number

    def track(self) -> _core.Track:
        track = _core.Track()
        for first, points in self.held:
            track.write(first, np.array(points, dtype=np.int32))
        for number, _, first, points in self.pending:
            if number > self.doomed:
                track.write(first, np.array(points, dtype=np.int32))
        return track


acts = st.lists(
    st.one_of(
        st.tuples(st.just("send"), st.integers(0, 3), st.integers(3, 12)),
        st.tuples(st.just("settle"), st.integers(0, 6), st.integers(0, 2**32 - 1)),
        st.tuples(st.just("forget"), st.just(0), st.just(0)),
    ),
    min_size=1,
    max_size=40,
)


@given(acts, st.integers(0, 2**32))
def test_a_device_is_taken_to_hold_what_it_told(
    acts: list[tuple[str, int, int]], seed: int
) -> None:
    rng, holding, told = np.random.default_rng(seed), Holding(), Told()
    tracks = holding.track(POSITION), holding.track(TORQUE)
    now_us = 0
    for act, a, b in acts:
        now_us += int(rng.integers(0, 8000))
        if act == "send":
            told.number += 1
            points, first = rng.integers(-1000, 1000, b).tolist(), told.number + a
            rows = np.array([points, [3 * point for point in points]], np.int32)
            holding.send((0, 0, now_us), NO_MARK, told.number, 1, first, rows)
            told.pending.append((told.number, now_us, first, points))
        elif act == "settle":
            seen = max(0, told.number - a)
            holding.settle(status(now_us, seen, b), PATIENCE_US)
            told.settle(now_us, seen, b)
        else:
            holding.forget()
            told.held, told.pending = [], []
        expected = told.track()
        first = told.number - 2
        assert holding.track(POSITION) is tracks[0]
        assert (tracks[0].written, tracks[0].end) == (expected.written, expected.end)
        assert np.array_equal(tracks[0].points(first, 20), expected.points(first, 20))
        assert np.array_equal(tracks[1].points(first, 20), 3 * expected.points(first, 20))
        if told.pending:
            assert holding.waiting_since_us == told.pending[0][1]
        else:
            assert holding.waiting_since_us > 2**62


def test_a_plan_is_sealed_as_the_codec_has_it() -> None:
    rows = np.array([np.arange(5), np.arange(5) ** 2], np.int32)
    stamps = 5, 6, 7
    payload = Holding().send(stamps, (1, 2, 3), 9, 4, 100, rows)
    by_sink = {POSITION: rows[0].copy(), TORQUE: rows[1].copy()}
    assert payload == _core.plan_encode(stamps, 9, 4, 100, by_sink, (1, 2, 3))
    later = Holding().send(stamps, (1, 2, 3), 9, 4, 102, np.zeros((2, 9), np.int32)[:, 4:])
    assert later == Holding().send(stamps, (1, 2, 3), 9, 4, 102, np.zeros((2, 5), np.int32))


@pytest.mark.parametrize("shape", [(6, 3), (1, 2), (2, 129)])
def test_what_is_no_plan_is_not_taken_to_be_under_way(shape: tuple[int, int]) -> None:
    holding = Holding()
    with pytest.raises(ValueError, match="known sinks"):
        holding.send((0, 0, 0), NO_MARK, 1, 1, 10, np.zeros(shape, np.int32))
    with pytest.raises(ValueError, match="in one piece"):
        holding.send((0, 0, 0), NO_MARK, 1, 1, 10, np.zeros((2, 8), np.int32)[:, ::2])
    assert not holding.track(0).written and holding.waiting_since_us > 2**62


def tracks_of(seed: int, count: int, most: int = 500) -> list[_core.Track]:
    rng, tracks = np.random.default_rng(seed), [_core.Track() for _ in range(count)]
    for track in tracks:
        track.write(-2, np.cumsum(rng.integers(-most, most, 60)).astype(np.int32))
    return tracks


@given(st.integers(0, 2**32), st.integers(0, 3), st.integers(300, 700))
def test_the_gate_of_several_takes_what_each_takes(seed: int, odd: int, step: int) -> None:
    stored = tracks_of(seed, 3)
    limits = [_core.GateLimits(-(10**6), 10**6, step, 2 * step) for _ in stored]
    points = [track.points(4, 40).copy() for track in stored]
    for row in points:
        row[-3:] = row[-3]
    if odd < 3:
        points[odd][20] += 2 * step
    results = [
        _core.GATE_RESULTS.index(_core.gate_check_track(*given_, 4, row, 4))
        for *given_, row in zip(limits, stored, points, strict=True)
    ]
    first = next(((i, result) for i, result in enumerate(results) if result), None)
    assert Gate(limits, stored).refusal(4, np.array(points)[:, None], 4) == first
    assert Gate(limits, stored).refusal(4, np.array(points)[None], 4) == first
    twice = Gate(limits * 2, stored * 2)  # two devices of three sinks each, the second one's odd
    good = np.array(points)
    if odd < 3:
        good[odd, 20] -= 2 * step
    result = twice.refusal(4, np.stack((good, np.array(points))), 4)
    in_second = None if first is None else (3 + first[0], first[1])
    assert result == (twice.refusal(4, np.stack((good, good)), 4) or in_second)


@given(st.integers(0, 2**32), st.booleans(), st.floats(-1e3, 1e3))
def test_a_course_is_its_tracks_in_si(seed: int, continuous: bool, near: float) -> None:
    """Two motors on three axes; a continuous axis is followed from turn to turn."""
    position, torque = tracks_of(seed, 2), tracks_of(seed + 1, 2)
    pq, tq, still = [1000.0, 300.0], [10.0, 7.0], np.arange(15.0)
    wrapped = np.array([2**31 - 300, -(2**31) + 100, *[-(2**31) + 500] * 3], dtype=np.int32)
    position[1].write(20, wrapped)
    none, no = list[_core.Track](), np.empty(0)
    quanta = position, torque, pq, tq, [False, continuous], 12, still
    course = Course([0, 2], *quanta, none, none, no, no, no)
    times_us = np.arange(0, 50 * KNOT_US, 777)
    if continuous:
        times_us = times_us[(times_us > 23 * KNOT_US)]
    rows = course.at(times_us, np.array([0.0, 0.0, near]))
    for i, axis in enumerate((0, 2)):
        value, rate, _ = position[i].evaluate(times_us, 12)
        effort = torque[i].evaluate(times_us, 12)[0]
        if axis == 2 and continuous:  # the same place, next to the one that was given
            turns = (rows[:, axis] * pq[i] - value) / 2**32
            np.testing.assert_allclose(turns, np.rint(turns), atol=1e-6)
            assert abs(rows[0, axis] - near) <= 2**31 / pq[i] * (1 + 1e-9)
            assert np.abs(np.diff(rows[:, axis])).max() < 2**31 / pq[i]
        else:
            np.testing.assert_allclose(rows[:, axis], value / pq[i], rtol=1e-12)
        np.testing.assert_allclose(rows[:, 3 + axis], rate / pq[i] / (KNOT_US * 1e-6), rtol=1e-12)
        np.testing.assert_allclose(rows[:, 6 + axis], effort / tq[i], rtol=1e-12)
    kept = [1, 4, 7, *range(9, 15)]
    assert np.array_equal(rows[:, kept], np.tile(still[kept], (len(times_us), 1)))
    r0, f0 = (np.zeros((2, 3), order="F") for _ in range(2))
    course.points(5, np.array([0.0, 0.0, near]), r0, f0)
    np.testing.assert_allclose(r0[0], position[0].points(5, 3) / pq[0])
    for i in range(2):
        np.testing.assert_allclose(f0[i], torque[i].points(5, 3) / tq[i])
    gains = tracks_of(seed + 2, 4, most=1 << 23)  # below zero and beyond what a servo takes, too
    per, emf = np.array([[0.5, 3.0], [0.25, 2.0]]), np.array([0.1, 0.7])
    scheduled = Course([0, 2], *quanta, gains[:2], gains[2:], *per, emf)
    more = scheduled.at(times_us, np.array([0.0, 0.0, near]))
    assert np.array_equal(more[:, :9], rows[:, :9])
    for i, axis in enumerate((0, 2)):
        values = (gains[i + 2 * k].evaluate(times_us, 12)[0] for k in (0, 1))
        kp, kd = (np.clip(value // 256, 0, 65535) for value in values)
        np.testing.assert_allclose(more[:, 9 + axis], kp * per[0, i])
        np.testing.assert_allclose(more[:, 12 + axis], kd * per[1, i] + emf[i])
    assert np.array_equal(more[:, [10, 13]], rows[:, [10, 13]])
