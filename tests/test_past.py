"""Tracks at a past time: kernels, nodes of a device that moves, and nodes over pieces.

What is right is scipy's spline of the points that were sent, and fractions over the pieces.
"""

from bisect import bisect_right
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import PERIOD_US, SHIFT, Plan, Rig, State, device_settings
from scipy.interpolate import BSpline
from stages import assert_mistake, changed

from headway.configs.stage import load_stage
from headway.firmware import _core
from headway.sim.stage import Play

POSITION, TORQUE, KP, KI, KD = range(5)
NODE = _core.SOURCE_OF_NODES
PAST = _core.NODE_KINDS.index("past")
INTERVAL = _core.TRIGGER_KINDS.index("interval")
NEVER = -(2**31)  # what none of these tracks ever has
RING = _core.TRACK_POINTS


def spline(points: dict[int, int], knot: int, u: float) -> float:
    """The uniform cubic B-spline of points by knot, at u of the knot's interval."""
    live = [points[min(k, max(points))] for k in range(knot - 1, knot + 3)]
    return float(BSpline(np.arange(8) - 3.0, np.array(live, dtype=float), 3)(u))


@given(
    st.lists(st.tuples(st.integers(3, 128), st.integers(0, 90)), min_size=1, max_size=8),
    st.integers(9, 15),
    st.integers(-(2**40), 2**40),
    st.data(),
)
def test_a_track_has_what_it_was_given_or_says_that_it_is_gone(
    plans: list[tuple[int, int]], shift: int, start: int, data: st.DataObject
) -> None:
    """Plans of any length that begin anywhere before the end, so also ones that end sooner."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    track, kept, end = _core.Track(), dict[int, int](), start - 1
    assert track.past(start << shift, shift) is None
    for count, back in plans:
        first = max(end + 1 - back, start, end - RING + 130)
        points = rng.integers(-(2**15), 2**15, count)
        track.write(first, points.astype(np.int32))
        end = first + count - 1
        for i, point in enumerate(points.tolist()):
            kept.pop(first + i - RING, None)  # it had the same place
            kept[first + i] = point
        ahead = {k: kept[k] for k in kept if k <= end}
        for _ in range(8):
            knot = data.draw(st.integers(start - 3, end + 3))
            u = data.draw(st.integers(0, (1 << shift) - 1))
            found = track.past((knot << shift) + u, shift)
            there = knot <= end and all(min(knot + i, end) in ahead for i in range(-1, 3))
            assert (found is not None) == there
            if found is not None:
                assert -8 < found - spline(ahead, knot, u / (1 << shift)) < 2


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=80), st.data())
def test_pieces_reach_back_to_the_oldest_that_is_remembered(
    steps: list[int], data: st.DataObject
) -> None:
    pieces, starts = _core.Pieces(), list(accumulate(steps))
    for number, start in enumerate(starts):
        assert pieces.take(number, (start, start, number, number), start) == "taken"
    oldest = starts[-_core.PIECES] if len(starts) >= _core.PIECES else starts[0]
    for _ in range(20):
        time_us = data.draw(st.integers(-5, starts[-1] + 5))
        wanted = bisect_right(starts, time_us) - 1 if time_us >= oldest else None
        assert pieces.past(time_us) == wanted


# ---- a device that moves


def rule(rig: Rig, nodes: list[tuple[int, int, int, int, int]], every: int = 1) -> _core.Report:
    triggers = [(INTERVAL, NODE + i, 0, every) for i in range(len(nodes))]
    payload = _core.logic_encode(len(rig.reports) + 1, nodes, [], [], triggers)
    rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_LOGIC, payload))
    rig.run(10_000)
    return rig.reports[-1]


def readings(rig: Rig) -> dict[int, tuple[int, int, int]]:
    """All that came, by number: time, value, trigger."""
    return {n: r for report in rig.reports for n, r in enumerate(report.readings, report.first)}


def run(rig: Rig, us: int) -> None:
    """On, and tells that readings have arrived."""
    for _ in range(us // 10_000):
        rig.run(10_000)
        seen = max(readings(rig), default=-1) + 1
        payload = _core.batch_encode(0, seen, [])
        rig.node.deliver(rig.now, rig.host.seal(_core.FRAME_SIGNALS, payload))
        rig.run(500)  # a poll takes one packet; another one may have come


def waves(count: int, rest: int = 4) -> Plan:
    """Rest, waves of their own, rest; on all five tracks."""
    inside = np.arange(count - 2 * rest)
    made = {}
    for sink, size, base in ((POSITION, 2**17, 0), (TORQUE, 2**15, 0), (KP, 2**6, 2**7),
                             (KI, 2**6, 2**7), (KD, 2**6, 2**7)):  # fmt: skip
        wave = (
            base + size * np.sin((inside + sink) / 11) * np.sin(np.pi * inside / len(inside)) ** 2
        )
        whole = [base] * rest + [round(w) for w in wave] + [base] * rest
        made[sink] = whole
    return made


@pytest.mark.parametrize("sinks", [(POSITION, TORQUE, KP, KI), (KD, POSITION)])
@pytest.mark.parametrize("by_us", [0, 1, 100_003, 254 << SHIFT])
def test_nodes_read_the_past_of_all_tracks_of_motion(by_us: int, sinks: tuple[int, ...]) -> None:
    """Against the spline of what was sent, from before the begin until after the end."""
    settings = device_settings()
    for sink in (KP, KI, KD):
        settings.set_limits(sink, _core.GateLimits(0, 1 << 24, 1 << 24, 1 << 25))
    rig = Rig(settings=settings).sync()
    assert rule(rig, [(PAST, s, 0, by_us, NEVER) for s in sinks], every=4).result == "good"
    rig.arm()
    first, sent = rig.knot + _core.LIVE_KNOTS, waves(100)
    assert rig.give(first, sent) == "accepted"
    run(rig, 300_000)
    rig.run_until(State.HOLD)
    held_us = rig.node.system_us(rig.now)
    run(rig, 30_000)
    there = gone = 0
    for time_us, value, trigger in readings(rig).values():
        knot, phase = divmod(time_us - by_us, 1 << SHIFT)
        points = dict(enumerate(sent[sinks[trigger]], first))
        known = first < knot <= max(points)
        if value == NEVER:
            gone += 1
            assert not known or time_us > held_us - 2 * PERIOD_US
        else:
            there += 1
            assert known and time_us <= held_us
            assert -8 < value - spline(points, knot, phase / (1 << SHIFT)) < 2
    assert gone > 20 and (there > 100) == (by_us < 200_000)


def test_the_past_is_as_long_as_the_ring() -> None:
    """Plans one after the other, for 2 s: 1 s ago is there once it has been, and stays so."""
    rig = Rig().sync()
    ago_us = 700_000
    assert rule(rig, [(PAST, POSITION, 0, ago_us, NEVER)], every=5).result == "good"
    rig.arm()
    first = rig.knot + _core.LIVE_KNOTS
    whole = dict(enumerate(waves(620)[POSITION], first))
    for begin in range(first, first + 500, 10):
        points = [whole[k] for k in range(begin, begin + 37)]
        points += [points[-1]] * 3
        assert rig.give(begin, {POSITION: points}) == "accepted"  # it has other points at its end
        run(rig, 40_000)
    began = [(t, v) for t, v, _ in readings(rig).values() if v != NEVER]
    assert len(began) > 200
    for time_us, value in began:
        knot, phase = divmod(time_us - ago_us, 1 << SHIFT)
        assert knot > first
        assert -8 < value - spline(whole, knot, phase / (1 << SHIFT)) < 2
    missing = [t for t, v, _ in readings(rig).values() if v == NEVER]
    assert max(missing) - ago_us <= (first + 1) << SHIFT


@pytest.mark.parametrize(
    ("by_us", "result"), [(254 << SHIFT, "good"), ((254 << SHIFT) + 1, "limits")]
)
def test_a_device_knows_how_long_its_knots_are(by_us: int, result: str) -> None:
    rig = Rig().sync()
    assert rule(rig, [(PAST, POSITION, 0, by_us, 0)]).result == result
    assert _core.logic_check([(PAST, POSITION, 0, by_us, 0)], [], [], [])[0] == "good"


# ---- pieces, on a stage


STAGE = """\
name: echo
duration_s: 0.8
wire: {delay_us: 1000, jitter_us: 300, loss: 0.05}
sync: {to_device_least_us: 700, to_host_least_us: 700, limit_us: 500}
tracks:
  fire: {stream: {start_us: 100000, every_us: 40000, on_us: 20000, times: 15}}
  sweep: {ramps: [{start_us: 100000, end_us: 500000, first: 0, last: 40000}]}
devices:
  one:
    nodes:
      echo: {kind: past, a: fire, by_us: 90000, otherwise: -1}
      before: {kind: past, a: sweep, by_us: 200000, otherwise: -1}
    readings:
      - {kind: interval, read: echo, every: 3}
      - {kind: interval, read: before, every: 3}
"""


def test_pieces_are_played_again_later(tmp_path: Path) -> None:
    file = tmp_path / "echo.yaml"
    file.write_text(STAGE)
    play = Play(load_stage(file))
    play.run()
    assert play.signals(0).settled and play.signals(0).lost == 0
    near = round(play.widest_us) + 2
    for trigger, by_us in ((0, 90_000), (1, 200_000)):
        told = [(t - by_us, v) for t, v in play.readings(0, trigger).tolist()]
        assert len(told) > 200
        for at, value in told:
            if at < 100_000:
                assert value == -1
            elif trigger == 0:
                i, since = divmod(at - 100_000, 40_000)
                assert value == (since < 20_000 if i < 15 else 0)
            else:
                assert abs(value - min((at - 100_000) / 10, 40_000)) < 2
    assert near < 500


@pytest.mark.parametrize(
    ("old", "new", "key", "text"),
    [
        ("a: fire, by", "a: state, by", "nodes.echo.a", "of nothing else the past is kept"),
        ("a: fire, by", "a: before, by", "nodes.echo.a", "there are: fire, sweep"),
        ("by_us: 90000, ", "", "nodes.echo.by_us", "say how long ago"),
        ("by_us: 90000", "by_us: -1", "nodes.echo.by_us", "greater than or equal to 0"),
        ("kind: past, a: fire", "kind: edge, a: fire", "nodes.echo.by_us", "only of kind past"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, key: str, text: str) -> None:
    assert_mistake(changed(tmp_path, STAGE, old, new), key, text)
