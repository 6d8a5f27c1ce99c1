"""The gate, against its definition in unbounded integers and against the curve it lets through."""

import random
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from headway.firmware import _core

WIDEST = _core.GateLimits(-_core.POINT_MAX, _core.POINT_MAX, _core.DIFFERENCE_MAX, 1 << 26)
LIVE = _core.LIVE_KNOTS
REACH = _core.TRACK_POINTS // 2  # a plan ends before knot + REACH
INT64_MAX = (1 << 63) - 1


def make_track(first_knot: int, points: list[int]) -> _core.Track:
    track = _core.Track()
    track.write(first_knot, np.array(points, dtype=np.int32))
    return track


def check(
    limits: _core.GateLimits, track: _core.Track, first_knot: int, points: list[int], knot: int
) -> str:
    return _core.gate_check_track(limits, track, first_knot, np.array(points, dtype=np.int32), knot)


@dataclass
class Case:
    """A stored track (or none), and a plan that arrives in the interval of `knot`."""

    limits: _core.GateLimits
    stored_first: int
    stored: list[int]
    first_knot: int
    points: list[int]
    knot: int

    def before(self, k: int) -> int:
        """The stored track's point: its first and last are repeated on both sides."""
        i = k - self.stored_first
        return self.stored[max(0, min(i, len(self.stored) - 1))]

    def after(self, k: int) -> int:
        """The point if the plan is taken."""
        if not self.stored:
            return self.points[max(0, min(k - self.first_knot, len(self.points) - 1))]
        if k < self.first_knot:
            return self.before(k)
        return self.points[min(k - self.first_knot, len(self.points) - 1)]

    def faults(self) -> set[str]:
        """All that is wrong with the plan."""
        low, d_max, d2_max = self.first_knot, *self.speeds()
        end = low + len(self.points) - 1
        found = set()
        if self.stored:
            stored_end = self.stored_first + len(self.stored) - 1
            if low > stored_end + 1 or low <= self.knot - REACH + 2:
                found.add("gap")
            live = range(low, max(self.knot + LIVE, low))
            if any(self.before(k) != self.after(k) for k in live):
                found.add("late")
        elif low < self.knot + LIVE:
            found.add("late")
        if end >= self.knot + REACH:
            found.add("far")
        if len(set(self.points[-3:])) != 1:
            found.add("rest")
        if not all(self.limits.point_min <= p <= self.limits.point_max for p in self.points):
            found.add("range")
        p = [self.after(k) for k in range(low - 2, end + 3)]
        if any(abs(b - a) > d_max for a, b in pairwise(p)):
            found.add("speed")
        if any(abs(p[i] - 2 * p[i + 1] + p[i + 2]) > d2_max for i in range(len(p) - 2)):
            found.add("acceleration")
        return found

    def speeds(self) -> tuple[int, int]:
        return self.limits.difference_max, self.limits.second_difference_max

    def verdict(self) -> str:
        track = make_track(self.stored_first, self.stored) if self.stored else _core.Track()
        return check(self.limits, track, self.first_knot, self.points, self.knot)


def legal_walk(
    rng: random.Random, limits: _core.GateLimits, last: int, difference: int, count: int
) -> list[int]:
    """At least `count` points that keep the limits (often just) and end at rest."""
    points: list[int] = []
    d_max, d2_max = limits.difference_max, limits.second_difference_max
    while len(points) < count or difference:
        if len(points) < count - 3:
            step = rng.choice([-d2_max, d2_max, rng.randint(-d2_max, d2_max), 0])
        else:  # brake
            step = max(-d2_max, min(d2_max, -difference))
        wanted = max(-d_max, min(d_max, difference + step))
        if not limits.point_min <= last + wanted <= limits.point_max:
            wanted = max(difference - d2_max, min(difference + d2_max, 0))
        difference = wanted
        last += difference
        points.append(last)
    return [*points, last, last]


def random_limits(rng: random.Random) -> _core.GateLimits:
    if rng.random() < 0.3:
        return WIDEST
    d_max = rng.choice([1, 2, 100, 1 << 20])
    size = d_max * rng.choice([1, 5, 50])
    middle = rng.randint(-size, size)
    return _core.GateLimits(middle - size, middle + size, d_max, rng.choice([1, d_max, 2 * d_max]))


def random_case(seed: int) -> Case:
    """Plans of all kinds: continuing or first, mostly legal and often spoilt by one point."""
    rng = random.Random(seed)
    limits = random_limits(rng)
    start = rng.choice([limits.point_min, limits.point_max, 0])
    start = max(limits.point_min, min(limits.point_max, start))
    stored_first = rng.choice([0, -40, 415_000_000_000])
    stored = []
    if rng.random() < 0.8:
        stored = legal_walk(rng, limits, start, 0, rng.randint(1, 60))[:128]
    end = stored_first + len(stored) - 1
    knot = rng.randint(stored_first - 5, end + 20)
    if rng.random() < 0.05:
        knot = end - REACH + rng.randint(0, 3)
    case = Case(limits, stored_first, stored, 0, [], knot)
    back = rng.choice([0, 1, 2, 3, 5, 10, REACH - 3, REACH - 2, REACH - 1, REACH])
    case.first_knot = knot + LIVE - back if stored else knot + LIVE + rng.randint(-1, 3)
    if stored:
        case.first_knot = min(case.first_knot, end + rng.choice([1, 1, 1, 1, 2]))
        kept = range(case.first_knot, max(knot + LIVE, case.first_knot))
        points = [case.before(k) for k in kept]
        a, b = (case.before(max(knot + LIVE, case.first_knot) - i) for i in (2, 1))
        points += legal_walk(rng, limits, b, b - a, rng.randint(1, 30))
        if rng.random() < 0.1:  # cut short, perhaps before the live points' end
            points = points[: rng.randint(3, max(3, len(kept)))]
    else:
        points = legal_walk(rng, limits, start, 0, rng.randint(1, 30))
    points = points[:128] if rng.random() < 0.5 else points[-128:]
    while rng.random() < 0.05 and len(points) < 128:
        points += [points[-1]] * (128 - len(points))
    if rng.random() < 0.3:
        i = rng.randrange(len(points))
        points[i] += rng.choice([-1, 1, 5, -limits.difference_max, 1 << 25])
    points = points if len(points) >= 3 else [*points, *points, *points]
    case.points = [max(-(1 << 31), min((1 << 31) - 1, p)) for p in points]
    return case


def decided_right(case: Case) -> str:
    verdict, faults = case.verdict(), case.faults()
    if faults:
        assert verdict in faults, (verdict, faults, case)
    else:
        assert verdict == "accepted", (verdict, case)
    return verdict


@settings(max_examples=400)
@given(st.integers(0, 1 << 62))
def test_accepts_what_is_legal_and_names_a_fault_of_the_rest(seed: int) -> None:
    decided_right(random_case(seed))


def test_the_cases_are_of_all_kinds() -> None:
    verdicts = Counter(decided_right(random_case(seed)) for seed in range(4000))
    assert verdicts["accepted"] > 1000
    for reason in ("late", "gap", "far", "range", "speed", "acceleration", "rest"):
        assert verdicts[reason] > 15, verdicts


@settings(max_examples=200)
@given(st.integers(0, 1 << 62))
def test_an_accepted_curve_keeps_its_limits_everywhere(seed: int) -> None:
    """Position, speed and acceleration, densely, from before the splice to the rest."""
    case = random_case(seed)
    if case.verdict() != "accepted":
        return
    low = min(case.first_knot, case.knot) - 3
    high = max(case.first_knot + len(case.points), case.knot) + 3
    points = np.array([case.after(k) for k in range(low, high + 1)], dtype=float)
    curve = BSpline(np.arange(len(points) + 4) - 2.0, points, 3)
    x = np.linspace(1, len(points) - 2, 32 * (len(points) - 3) + 1)
    slack = 1e-9 * (1 << 30)
    value, limits = curve(x), case.limits
    assert limits.point_min - slack <= value.min() <= value.max() <= limits.point_max + slack
    assert np.abs(curve(x, 1)).max() <= limits.difference_max + slack
    assert np.abs(curve(x, 2)).max() <= limits.second_difference_max + slack
    # what runs now and up to the margin is what ran before, and the end is at rest
    if case.stored:
        for k in range(case.knot - 1, case.knot + LIVE):
            assert case.before(k) == case.after(k)
    assert len(set(points[-5:])) == 1


# ---- each limit, exactly and one more

AT_REST = make_track(0, [0, 0, 0])
KNOT = 10


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("limit", [1, 7, 1000, 1 << 20, 1 << 25])
def test_difference_limit(limit: int, sign: int) -> None:
    limits = _core.GateLimits(-_core.POINT_MAX, _core.POINT_MAX, limit, 1 << 27)
    for d, verdict in ((limit - 1, "accepted"), (limit, "accepted"), (limit + 1, "speed")):
        for at in range(3):  # at the splice and inside the plan
            points = [0] * (KNOT + LIVE + at) + [sign * d] * 3
            assert check(limits, AT_REST, 0, points, KNOT) == verdict
        assert check(limits, _core.Track(), 50, [0, 0, 0] + [sign * d] * 3, KNOT) == verdict


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("limit", [2, 8, 1000, 1 << 20, (1 << 26) - 2])
def test_second_difference_limit(limit: int, sign: int) -> None:
    limits = _core.GateLimits(-_core.POINT_MAX, _core.POINT_MAX, 1 << 25, limit)
    half = limit // 2
    for excess, verdict in ((-1, "accepted"), (0, "accepted"), (1, "acceleration")):
        # differences half, -half - excess, 0: their difference is limit + excess
        turn = [half, -excess, -excess, -excess]
        for at in range(3):
            points = [0] * (KNOT + LIVE + at) + [sign * p for p in turn]
            assert check(limits, AT_REST, 0, points, KNOT) == verdict
    for d, verdict in ((limit, "accepted"), (limit + 1, "acceleration")):
        if limit < 1 << 25:  # starting and stopping: from and to a difference of zero
            start = [0] * (KNOT + LIVE) + [sign * d] * 3
            assert check(limits, AT_REST, 0, start, KNOT) == verdict


@pytest.mark.parametrize("sign", [-1, 1])
def test_second_difference_across_the_splice(sign: int) -> None:
    """The last stored difference counts for the plan's first point."""
    limits = _core.GateLimits(-1000, 1000, 100, 7)
    moving = [sign * p for p in (0, 0, 0, 7, 14, 21, 28, 35, 42, 49, 49, 49, 49)]
    track = make_track(0, moving)
    knot = 2  # free from 5 on; points 3 and 4 differ by 7
    for d, verdict in (
        (0, "accepted"),
        (-1, "acceleration"),
        (14, "accepted"),
        (15, "acceleration"),
    ):
        settle = [14 + d] * 3 if d <= 7 else [14 + d, 14 + d + 7, *[14 + d + 7] * 2]
        for first in range(5):  # with and without points that are stored
            points = moving[first:5] + [sign * p for p in settle]
            assert check(limits, track, first, points, knot) == verdict
        assert check(limits, track, 5, [sign * p for p in settle], knot) == verdict


@pytest.mark.parametrize("limit", [0, 5, 1 << 29, _core.POINT_MAX - 1, _core.POINT_MAX])
def test_range_limits(limit: int) -> None:
    upper = _core.GateLimits(-_core.POINT_MAX, limit, 1 << 25, 1 << 26)
    lower = _core.GateLimits(-limit, _core.POINT_MAX, 1 << 25, 1 << 26)
    for sign, limits in ((1, upper), (-1, lower)):
        for excess, verdict in ((-1, "accepted"), (0, "accepted"), (1, "range")):
            start, p = sign * (limit - 10), sign * (limit + excess)
            track = make_track(0, [start] * 3)
            for at in range(3):
                points = [start] * (KNOT + LIVE + at) + [p] * 3
                assert check(limits, track, 0, points, KNOT) == verdict
            assert check(limits, _core.Track(), 50, [p] * 3, KNOT) == verdict


@pytest.mark.parametrize("far", [(1 << 31) - 1, -(1 << 31), 1 << 30, -(1 << 30)])
def test_points_that_would_overflow_are_out_of_range(far: int) -> None:
    for near in (-_core.POINT_MAX, 0, _core.POINT_MAX):
        track = make_track(0, [near] * 3)
        points = [near] * (KNOT + LIVE) + [far] * 3
        assert check(WIDEST, track, 0, points, KNOT) == "range"
        assert check(WIDEST, _core.Track(), 50, [near, far, near, near, near], KNOT) == "range"


@pytest.mark.parametrize("sign", [-1, 1])
def test_jump_from_end_to_end_is_too_fast(sign: int) -> None:
    track = make_track(0, [sign * _core.POINT_MAX] * 3)
    points = [sign * _core.POINT_MAX] * (KNOT + LIVE) + [-sign * _core.POINT_MAX] * 3
    assert check(WIDEST, track, 0, points, KNOT) == "speed"


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_largest_of_everything_at_once(sign: int) -> None:
    """From one end of the range to the other at full speed, and there to and fro: legal."""
    run = [min((i << 25) - _core.POINT_MAX, _core.POINT_MAX) for i in range(1, 65)]
    to_and_fro = [run[-1] - (1 << 25), run[-1]] * 28
    points = [sign * p for p in [*run, *to_and_fro, run[-1], run[-1]]]
    track = make_track(KNOT, [-sign * _core.POINT_MAX] * 3)
    assert check(WIDEST, track, KNOT + LIVE, points, KNOT) == "accepted"
    tighter = _core.GateLimits(-_core.POINT_MAX, _core.POINT_MAX, 1 << 25, (1 << 26) - 1)
    assert check(tighter, track, KNOT + LIVE, points, KNOT) == "acceleration"
    tighter = _core.GateLimits(-_core.POINT_MAX, _core.POINT_MAX, (1 << 25) - 1, 1 << 26)
    assert check(tighter, track, KNOT + LIVE, points, KNOT) == "speed"


# ---- what is live


def moving_track() -> tuple[_core.Track, list[int]]:
    """Knots 0 .. 20: at rest, moving, and at rest again."""
    points = [0, 0, 0, *(i * i for i in range(1, 16)), 225, 225, 225]
    return make_track(0, points), points


@pytest.mark.parametrize("knot", range(0, 21))
@pytest.mark.parametrize("change", [-1, 1])
def test_a_live_point_may_be_repeated_but_not_changed(knot: int, change: int) -> None:
    track, stored = moving_track()
    stored = stored + [stored[-1]] * 12
    for first in range(max(0, knot - 4), min(21, knot + LIVE) + 1):
        assert check(WIDEST, track, first, stored[first:], knot) == "accepted"
        for at in range(first, len(stored) - 3):
            changed = stored.copy()
            changed[at] += change
            verdict = "late" if at < knot + LIVE else "accepted"
            assert check(WIDEST, track, first, changed[first:], knot) == verdict, (first, at)


@pytest.mark.parametrize("knot", range(0, 24))
def test_a_plan_that_ends_early_changes_what_it_leaves_out(knot: int) -> None:
    """Beyond its end a plan repeats its last point; a live point must not change that way."""
    resting = [0, 0, 0, 5, 9, 9, 9, 9, 20, 35, 50, 50, 50, 40, 30, 30, 30]
    track = make_track(0, resting)
    for first in range(0, len(resting)):
        for count in range(3, len(resting) - first + 1):
            case = Case(WIDEST, 0, resting, first, resting[first : first + count], knot)
            decided_right(case)
    if knot < 6:  # three equal points, and then live ones that move
        early = check(WIDEST, track, 4, [9, 9, 9], knot)
        assert early == ("accepted" if knot + LIVE <= 4 + 4 else "late")


@pytest.mark.parametrize("offset", range(-3, 6))
def test_a_first_plan_begins_past_what_is_live(offset: int) -> None:
    verdict = check(WIDEST, _core.Track(), KNOT + offset, [7] * 5, KNOT)
    assert verdict == ("accepted" if offset >= LIVE else "late")


def test_a_first_plan_starts_anywhere_but_at_rest() -> None:
    """Before its first point the track is at that point, so a first difference is too fast."""
    limits = _core.GateLimits(-1000, 1000, 10, 3)
    assert check(limits, _core.Track(), 50, [900, 903, 906, 906, 906], KNOT) == "accepted"
    assert check(limits, _core.Track(), 50, [900, 904, 907, 907, 907], KNOT) == "acceleration"


# ---- gap, far, rest


def test_gap() -> None:
    track = make_track(0, [5] * 20)  # ends at knot 19
    for first, verdict in ((19, "accepted"), (20, "accepted"), (21, "gap"), (INT64_MAX, "gap")):
        assert check(WIDEST, track, first, [5] * 4, KNOT) == verdict
    for back in range(-2, 3):
        knot = REACH - 1 + back  # how far back a plan may begin
        verdict = check(WIDEST, track, 2, [5] * 128, knot)
        assert verdict == ("accepted" if back <= 0 else "gap")
    assert check(WIDEST, track, -INT64_MAX - 1, [5] * 4, KNOT) == "gap"


def test_the_points_before_a_plan_are_still_remembered() -> None:
    """At the ring's full length: an old difference must not be taken from newer points."""
    limits = _core.GateLimits(-1000, 1000, 100, 50)
    first = [0] * 128
    later = [0] * 120 + [40, 80, 100, 100, 100, 100, 100, 100]
    track = make_track(-128, first)
    track.write(0, np.array(later, dtype=np.int32))
    knot = 0  # the ring holds -128 .. 127
    for begin in range(knot - REACH - 1, knot + 1):
        points = ([0] * 256)[: max(3, knot + LIVE - begin)][:128]
        if begin + len(points) < knot + LIVE:
            continue
        verdict = check(limits, track, begin, points, knot)
        assert verdict == ("accepted" if begin > knot - REACH + 2 else "gap"), begin


@pytest.mark.parametrize("count", [3, 10, 120])
def test_far(count: int) -> None:
    track = make_track(KNOT - 4, [5] * 128)
    for end, verdict in ((REACH - 1, "accepted"), (REACH, "far"), (REACH + 1, "far")):
        first = KNOT + end - count + 1
        assert check(WIDEST, _core.Track(), first, [5] * count, KNOT) == verdict
        stored = min(first, KNOT + 124)  # continuing, without a gap
        points = [5] * (KNOT + end - stored + 1)
        assert check(WIDEST, track, stored, points, KNOT) == verdict


def test_knot_numbers_do_not_wrap() -> None:
    for first in (INT64_MAX, INT64_MAX - 2, INT64_MAX // 2):
        assert check(WIDEST, _core.Track(), first, [5] * 3, KNOT) == "far"
    for first in (-INT64_MAX - 1, -INT64_MAX, -INT64_MAX // 2):
        assert check(WIDEST, _core.Track(), first, [5] * 3, KNOT) == "late"


@pytest.mark.parametrize("count", [3, 4, 8])
def test_rest(count: int) -> None:
    track = make_track(0, [5] * (KNOT + LIVE))
    for i in range(count):
        points = [5] * count
        points[i] = 6
        verdict = check(WIDEST, track, KNOT + LIVE, points, KNOT)
        assert verdict == ("rest" if i >= count - 3 else "accepted")


@pytest.mark.parametrize(
    "numbers",
    [
        (1, 0, 5, 5),
        (-(1 << 30), 0, 5, 5),
        (0, 1 << 30, 5, 5),
        (0, 1, 0, 5),
        (0, 1, -1, 5),
        (0, 1, (1 << 25) + 1, 5),
        (0, 1, 5, 0),
        (0, 1, 5, -1),
    ],
)
def test_limits_in_which_something_could_overflow_are_refused(
    numbers: tuple[int, int, int, int],
) -> None:
    with pytest.raises(ValueError, match="outside the range"):
        _core.GateLimits(*numbers)
