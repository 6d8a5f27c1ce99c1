"""Signals: pieces, logic and readings alone, and on boards behind wires that lose packets."""

from bisect import bisect_right
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rig import KEY, PERIOD_US, device_settings

from headway.configs.schema import Channel
from headway.devices.signals import Logic, Piece, Signals, event
from headway.firmware import _core
from headway.sim.boards import Boards, Crystal, Host
from headway.sim.network import Wire

EPOCH_US = 1_700_000_000_000_000
TRACK = _core.SOURCE_OF_PIECES
NODE = _core.SOURCE_OF_NODES
POSITION = _core.SOURCE_OF_INPUTS
STATE = _core.SOURCE_OF_INPUTS + _core.INPUTS.index("state")
DIGITAL = _core.SOURCE_OF_INPUTS + _core.INPUTS.index("digital0")
ADD, MULTIPLY, COMPARE, WINDOW, GATE, EDGE, PAST = range(len(_core.NODE_KINDS))
INTERVAL, ON_EDGE, IN_WINDOW = range(len(_core.TRIGGER_KINDS))
INT32_MAX = 2**31 - 1
words = st.integers(-INT32_MAX - 1, INT32_MAX)


# ---- pieces

Line = tuple[int, int, int, int]  # start, end, from, to


def exactly(lines: list[Line], time_us: int) -> Fraction:
    """What a track has, as fractions have it; 0 before the first piece."""
    i = bisect_right([line[0] for line in lines], time_us) - 1
    if i < 0:
        return Fraction(0)
    start, end, first, last = lines[i]
    if time_us >= end:
        return Fraction(last)
    return first + Fraction(last - first) * (time_us - start) / (end - start)


@st.composite
def tracks(draw: st.DrawFn) -> list[Line]:
    lines: list[Line] = []
    at = draw(st.integers(-(2**59), 2**59))
    for _ in range(draw(st.integers(1, _core.PIECES))):
        at += draw(st.sampled_from([0, 1, 1000, 2**20]))
        took = draw(st.sampled_from([0, 1, 7, 1000, 2**20, 2**30]))
        lines.append((at, at + took, draw(words), draw(words)))
    return lines


@given(tracks(), st.data())
def test_pieces_are_straight_lines(lines: list[Line], data: st.DataObject) -> None:
    pieces, now = _core.Pieces(), _core.Pieces()
    for number, (start, end, first, last) in enumerate(lines):
        for each in (pieces, now):
            assert each.take(number, (start, end, first, last), lines[0][0]) == "taken"
    times = sorted(
        data.draw(st.lists(st.integers(lines[0][0] - 5, lines[-1][1] + 5), max_size=20))
        + [t + d for line in lines for t in line[:2] for d in (-1, 0, 1)]
    )
    for time_us in times:
        got = pieces.at(time_us)
        assert abs(got - exactly(lines, time_us)) < 2
        assert now.now(time_us) == got


def test_what_is_left_out_goes_on() -> None:
    pieces = _core.Pieces()
    assert pieces.take(0, (None, 5, 0, 1), 0) == "gap"
    assert pieces.take(0, (0, 5, None, 1), 0) == "gap"
    assert pieces.take(0, (1000, 2000, 0, 100), 0) == "taken"
    assert pieces.take(1, (None, 3000, None, 0), 0) == "taken"  # from 2000, from 100
    assert [pieces.at(t) for t in (1500, 2000, 2500, 3000)] == [50, 100, 50, 0]
    assert pieces.take(2, (2500, 2600, None, 7), 0) == "taken"  # cuts the last one short, at 50
    assert [pieces.at(t) for t in (2499, 2500, 2600, 9000)] == [50, 50, 7, 7]


def test_pieces_come_once_in_order_and_in_time() -> None:
    pieces = _core.Pieces()
    assert pieces.take(1, (10, 10, 1, 1), 0) == "gap"
    assert pieces.take(0, (10, 10, 1, 1), 10) == "taken"
    assert pieces.take(0, (99, 99, 9, 9), 10) == "taken"  # again: the first one holds
    assert pieces.at(99) == 1
    assert pieces.take(1, (9, 9, 1, 1), 99) == "order"
    assert pieces.take(1, (20, 19, 1, 1), 0) == "order"
    assert pieces.take(1, (20, 21 + 2**30, 1, 1), 0) == "order"
    for number in range(1, _core.PIECES):
        assert pieces.take(number, (20 + number, 20 + number, number, number), 0) == "taken"
    assert pieces.take(_core.PIECES, (100, 100, 0, 0), 20) == "full"  # the second has not begun
    assert pieces.take(_core.PIECES, (100, 100, 0, 0), 21) == "taken"
    assert pieces.next == _core.PIECES + 1


def test_a_late_piece_is_taken_so_that_its_track_goes_on() -> None:
    pieces = _core.Pieces()
    assert pieces.take(0, (10, 20, 0, 100), 15) == "late"
    assert [pieces.at(t) for t in (9, 15, 20)] == [0, 50, 100]
    assert pieces.take(1, (30, 30, 7, 7), 40) == "late"
    assert pieces.take(2, (50, 50, 8, 8), 40) == "taken"
    assert [pieces.at(t) for t in (29, 30, 49, 50)] == [100, 7, 7, 8]


@given(tracks(), st.data())
def test_a_track_has_its_values_also_after_a_clock_that_stepped_back(
    lines: list[Line], data: st.DataObject
) -> None:
    pieces = _core.Pieces()
    for number, line in enumerate(lines):
        pieces.take(number, line, lines[0][0])
    for _ in range(10):
        time_us = data.draw(st.integers(lines[0][0] - 5, lines[-1][1] + 5))
        assert pieces.now(time_us) == pieces.at(time_us)
        assert abs(pieces.at(time_us) - exactly(lines, time_us)) < 2


# ---- logic


@given(words, words)
def test_nodes_of_two_values(a: int, b: int) -> None:
    graph = _core.Graph(
        [(ADD, 0, 1, 0, 0), (MULTIPLY, 0, 1, 0, 0), (GATE, 0, 1, 0, 0), (ADD, 32, 34, 0, 0)]
    )
    clip = lambda x: max(-INT32_MAX, min(INT32_MAX, x))  # noqa: E731
    gated = a if b else 0
    assert graph.step([a, b]) == [clip(a + b), clip(a * b >> 16), gated, clip(clip(a + b) + gated)]


@given(st.lists(st.integers(-5, 5), min_size=1, max_size=40))
def test_nodes_of_one_value(values: list[int]) -> None:
    graph = _core.Graph([(WINDOW, 0, 0, -2, 3), (COMPARE, 0, 0, -2, 3), (EDGE, 0, 0, 0, 0)])
    high = before = False
    for value in values:
        high = value > 3 or (high and value >= -2)
        assert graph.step([value]) == [-2 <= value <= 3, high, bool(value) and not before]
        before = bool(value)


@pytest.mark.parametrize(
    ("logic", "message"),
    [
        (Logic([(ADD, 32, 0, 0, 0)], names=["sum"]), "node sum reads itself, or a node after it"),
        (Logic([(ADD, 0, 33, 0, 0), (ADD, 0, 0, 0, 0)]), "node 0 reads itself, or a node after"),
        (Logic([(ADD, 0, 47, 0, 0)]), "node 0 reads something that is not there"),
        (Logic([(GATE, 0, 30, 0, 0)]), "node 0 reads something that is not there"),
        (Logic([(9, 0, 0, 0, 0)]), "node 0 is of a kind that there is not"),
        (Logic([(WINDOW, 0, 0, 3, 2)]), "node 0 has its low above its high"),
        (Logic([(EDGE, 0, 200, 0, 0)], [TRACK, 31]), "output 1 reads something that is not there"),
        (Logic(triggers=[(INTERVAL, 0, 99, 0)]), "reading 0 has its low above its high, no"),
        (
            Logic([(PAST, STATE, 0, 1, 0)]),
            "node 0 reads something that is not there, or whose past",
        ),
        (Logic([(EDGE, 0, 0, 0, 0), (PAST, NODE, 0, 1, 0)]), "node 1 reads something that is not"),
        (Logic([(PAST, 0, 0, (254 << 15) + 1, 0)]), "node 0 has .* a past that no track reaches"),
        (Logic([(PAST, TRACK, 0, -1, 0)]), "node 0 has .* a past that no track reaches back to"),
        (Logic(triggers=[(ON_EDGE, 0, 99, 0)]), "reading 0 reads something that is not there"),
        (Logic(triggers=[(5, 0, 0, 1)]), "reading 0 is of a kind that there is not"),
        (Logic([(ADD, 0, 0, 0, 2**40)], names=["sum"]), "node sum has 1099511627776, which is not"),
        (Logic([(ADD, 0, -1, 0, 0)]), "node 0 has -1, which is not from 0 to 255"),
        (Logic(pwm=[300]), "output 4 has 300, which is not from 0 to 255"),
        (Logic(triggers=[(INTERVAL, 0, 0, 70_000)]), "reading 0 has 70000, which is not from 0"),
        (Logic(digital=[TRACK] * 5), "5 digital outputs: a device has 4"),
        (Logic([(ADD, 0, 0, 0, 0)] * 17), "17 nodes: a device has 16"),
    ],
)
def test_what_is_wrong_is_named(logic: Logic, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        logic.check()


@pytest.mark.parametrize(
    ("track", "written", "message"),
    [
        (3, [event(0, 1)], "there is no track 3 of pieces: give one of 5 to 15"),
        (TRACK, [event(0, 2**31)], "track 5, piece 0 has 2147483648, which is not from"),
        (TRACK, [event(0, 1), event(2**60, 1)], "track 5, piece 1 has 1152921504606846976, which"),
        (TRACK, [event(9, 1), event(8, 1)], "piece 1 starts at 8, before the piece before it, 9"),
        (TRACK, [Piece(8, 1, 9, 1)], "piece 0 takes -1 us, which is not from 0 to 1073741824"),
        (TRACK, [Piece(2**30 + 1, 1, 0, 1)], "piece 0 takes 1073741825 us"),
        (TRACK, [Piece(8, 1, None, 1)], "piece 0 is the first one: give it a start and a first"),
    ],
)
def test_what_a_device_would_refuse_is_not_written(
    track: int, written: list[Piece], message: str
) -> None:
    signals = Signals()
    with pytest.raises(ValueError, match=message):
        signals.write(track, written)
    assert signals.settled  # nothing of it is to be sent
    signals.write(TRACK, [event(5, 1)])
    with pytest.raises(ValueError, match="piece 1 starts at 4"):
        signals.write(TRACK, [event(4, 1)])


@given(st.lists(st.tuples(st.integers(0, 2**58), words, words), min_size=1, max_size=64))
def test_whatever_is_written_fits_its_frames(ramps: list[tuple[int, int, int]]) -> None:
    signals = Signals()
    for track in range(TRACK, TRACK + 4):
        signals.write(track, [Piece(t + 9, last, t, first) for t, first, last in sorted(ramps)])
    assert signals.packets(lambda kind, payload: payload, -(2**59))
    assert signals.packets(lambda kind, payload: payload, 2**59)


class Told:
    """A report, as a device tells it."""

    def __init__(self, logic: int = 0, result: str = "good", wrong: int = 0, kept: int = 0,
                 first: int = 0, count: int = 0) -> None:  # fmt: skip
        self.logic, self.result, self.wrong = logic, result, wrong
        self.kept, self.first = kept, first
        self.readings = [(1000 * n, n, 0) for n in range(first, first + count)]
        self.refused = self.late = self.gaps = 0
        self.next = [0] * 11


def test_a_logic_that_the_device_refuses_is_not_settled() -> None:
    signals = Signals()
    signals.rule(Logic([(ADD, 0, 0, 0, 0)], names=["sum"]))
    assert not signals.settled
    signals.note(Told(1, "cycle", 0))
    assert not signals.settled and signals.refusal == "node sum reads itself, or a node after it"
    assert not [1 for kind, _ in sealed(signals) if kind == _core.FRAME_LOGIC]  # it has answered
    signals.rule(Logic())
    assert signals.refusal is None and not signals.settled
    signals.note(Told(1, "cycle", 0))  # of the one before
    assert signals.refusal is None and not signals.settled
    signals.note(Told(2))
    assert signals.settled
    signals.note(Told(1))  # whatever brought the old one back
    assert not signals.settled
    assert [1 for kind, _ in sealed(signals) if kind == _core.FRAME_LOGIC]


def sealed(signals: Signals) -> list[tuple[int, bytes]]:
    kinds: list[tuple[int, bytes]] = []
    signals.packets(lambda kind, payload: kinds.append((kind, payload)) or b"", 0)
    return kinds


@given(st.data())
def test_readings_are_those_that_were_told_and_the_rest_is_lost(data: st.DataObject) -> None:
    """Reports are lost, doubled, out of step, and the device overwrites what it likes."""
    signals, taken, kept, heard = Signals(), 0, 0, set[int]()
    for _ in range(data.draw(st.integers(1, 20))):
        taken += data.draw(st.integers(0, 60))
        kept = max(kept, taken - _core.READINGS, signals._seen)
        first = data.draw(st.integers(kept, taken))
        count = data.draw(st.integers(0, min(48, taken - first)))
        heard |= set(range(first, first + count))
        signals.note(Told(kept=kept, first=first, count=count))
        got = [value for _, value, _ in signals.readings]
        before = [n for n in sorted(heard) if n < signals._seen]
        assert got == before
        assert signals.lost == signals._seen - len(before)
        assert signals._seen >= kept and signals._seen not in heard


# ---- on boards


def stage(loss: float = 0.0, boards: int = 2, seed: int = 5) -> Boards:
    """Boards with oscillators of their own, each with a host by a wire that varies by 600 us."""
    rng = np.random.default_rng(seed)
    channel = Channel(delay_us=1000, jitter_us=300, loss=loss)
    given, hosts, crystals = [], [], []
    for board in range(boards):
        made = device_settings()
        made.sync.limit_us = 1000
        made.sync.to_device_least_us = made.sync.to_host_least_us = 700
        given.append(made)
        wires = Wire(channel, rng.spawn(1)[0]), Wire(channel, rng.spawn(1)[0])
        hosts.append(Host(board, KEY, wires, EPOCH_US, 100 + board, 4096, rng.spawn(1)[0]))
        crystals.append(Crystal(int(rng.integers(2**32)), (-1) ** board * 80_000, 500, 100_000, 3))
    made_boards = Boards(given, crystals, [], rng, hosts, poll_us=250)
    made_boards.advance(2_500_000)
    assert all(node.synced for node in made_boards.nodes)
    return made_boards


def rising(boards: Boards, board: int, output: int = 0) -> list[int]:
    """Host times at which an output went on."""
    return [t + EPOCH_US for t, o, on in boards.nodes[board].flips if o == output and on]


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_one_stream_fires_on_two_boards_at_once(loss: float) -> None:
    boards = stage(loss)
    start_us = EPOCH_US + 3_000_123
    times = [start_us + 20_011 * i for i in range(40)]
    stream = [e for t in times for e in (event(t, 1), event(t + 300, 0))]  # within a period
    for host in boards.hosts.values():
        host.remote.signals.rule(Logic(digital=[TRACK]))
        host.remote.signals.write(TRACK, stream)
    widest = 0.0  # what the boards themselves told of their clocks while it lasted
    for now_us in range(2_900_000, 4_000_000, 10_000):
        boards.advance(now_us)
        widest = max([widest, *(max(-low, high) / 1000 for low, high in boards.told_ns())])
    fired = [rising(boards, board)[-28:] for board in (0, 1)]
    assert widest < 400
    for board in (0, 1):
        assert boards.hosts[board].remote.signals.settled
        assert boards.hosts[board].remote.signals.refused == 0
        assert np.abs(np.array(fired[board]) - times[-28:]).max() <= widest + 1
        lengths = [t for t, _, _ in boards.nodes[board].flips]
        assert np.abs(np.diff(lengths)[0::2] - 300).max() <= 1 or loss
    assert np.abs(np.array(fired[0]) - fired[1]).max() <= 30  # far below the interval


def test_a_reading_on_each_edge_while_a_window_is_open() -> None:
    boards = stage(boards=1)
    signals = boards.hosts[0].remote.signals
    boards.encoders[0] = lambda true_us: true_us // 1000
    start_us = EPOCH_US + 3_000_000
    times = [start_us + 10_000 * i for i in range(40)]
    signals.write(TRACK, [e for t in times for e in (event(t, 1), event(t + 4000, 0))])
    signals.write(TRACK + 1, [Piece(start_us + 400_000, 400_000, start_us, 0)])
    signals.rule(
        Logic(
            [(WINDOW, TRACK + 1, 0, 95_000, 205_000), (GATE, TRACK, NODE, 0, 0)],
            triggers=[(ON_EDGE, POSITION, NODE + 1, 0)],
        )
    )
    boards.advance(4_000_000)
    inside = [t for t in times if 100_000 <= t - start_us <= 200_000]
    stamps = [time_us for time_us, _, _ in signals.readings]
    assert len(stamps) == len(inside) == 11
    late = np.array(stamps) - inside
    assert late.min() >= 0 and late.max() <= PERIOD_US
    for time_us, value, trigger in signals.readings:
        assert trigger == 0
        assert abs(value - (time_us - EPOCH_US) / 1000) <= 2  # the count is the stamp's


def test_intervals_windows_and_inputs() -> None:
    boards = stage(boards=1)
    signals = boards.hosts[0].remote.signals
    signals.rule(
        Logic(
            triggers=[
                (INTERVAL, STATE, 0, 10),
                (IN_WINDOW, POSITION, DIGITAL, 5),
                (ON_EDGE, POSITION, DIGITAL, 0),
            ]
        )
    )
    boards.advance(2_700_000)
    boards.nodes[0].digital_in = 1
    boards.advance(2_740_000)
    boards.nodes[0].digital_in = 0
    boards.advance(3_000_000)
    by = {t: [r for r in signals.readings if r[2] == t] for t in range(3)}
    assert np.ptp(np.diff([r[0] for r in by[0]])) <= 2 and len(by[0]) > 25
    assert all(abs(d - 10_000) <= 2 for d in np.diff([r[0] for r in by[0]]))
    assert len(by[1]) == 8 and len(by[2]) == 1 and by[1][0][0] == by[2][0][0]
    assert signals.lost == 0


def test_readings_outlast_an_outage_as_far_as_the_ring_goes() -> None:
    boards = stage(boards=1)
    signals = boards.hosts[0].remote.signals
    signals.rule(Logic(triggers=[(INTERVAL, STATE, 0, 10)]))
    boards.advance(3_000_000)
    boards.cut_hosts(True)
    boards.advance(3_900_000)  # 90 readings: all are kept
    boards.cut_hosts(False)
    boards.advance(4_200_000)
    assert signals.lost == 0
    assert np.abs(np.diff([r[0] for r in signals.readings]) - 10_000).max() <= 1500  # or a step
    count = len(signals.readings)
    boards.cut_hosts(True)
    boards.advance(4_300_000 + 10_000 * _core.READINGS + 200_000)
    boards.cut_hosts(False)
    boards.advance(boards.now_us + 300_000)
    assert 20 <= signals.lost <= 40
    gaps = np.diff([r[0] for r in signals.readings[count - 1 :]])
    assert np.count_nonzero(gaps > 15_000) == 1
    assert len(signals.readings) - count + signals.lost == pytest.approx(188, abs=6)


def test_outputs_follow_nodes_and_go_off_with_the_host() -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.write(TRACK, [event(EPOCH_US + 2_600_000, 20_000)])
    logic = Logic([(ADD, TRACK, DIGITAL, 0, 0)], digital=[_core.SOURCE_UNUSED, NODE], pwm=[TRACK])
    signals.rule(logic)
    boards.advance(2_700_000)
    assert node.pwm_q15 == [20_000, 0]
    assert node.flips[-1][1:] == (1, True)
    node.stop_line = True  # an emergency stop
    boards.advance(2_710_000)
    assert node.pwm_q15 == [0, 0] and node.flips[-1][1:] == (1, False)


def test_a_device_refuses_a_logic_as_a_whole() -> None:
    """A host that does not check: the old logic stays, and the answer names the node."""
    boards = stage(boards=1)
    remote = boards.hosts[0].remote
    remote.signals.rule(Logic(triggers=[(INTERVAL, STATE, 0, 10)]))
    boards.advance(2_700_000)
    payload = _core.logic_encode(99, [(ADD, 0, 0, 0, 0), (ADD, 33, 0, 0, 0)], [], [], [])
    boards.nodes[0].deliver(boards.now_us, remote._session.seal(_core.FRAME_LOGIC, payload))
    reports = []
    note = remote.signals.note
    remote.signals.note = lambda report: (reports.append(report), note(report))  # type: ignore
    count = len(remote.signals.readings)
    boards.advance(2_800_000)
    # The host, which knows of no such logic, sends its own again.
    assert (99, "cycle", 1) in [(r.logic, r.result, r.wrong) for r in reports]
    assert (reports[-1].logic, reports[-1].result) == (1, "good")
    assert len(remote.signals.readings) > count + 5


def test_reports_and_batches_do_not_break_on_bytes() -> None:
    assert _core.report_decode(b"") is None
    with pytest.raises(ValueError, match="out of range"):
        _core.batch_encode(0, 0, [(TRACK - 1, 0, (0, 0, 0, 0))])
    with pytest.raises(ValueError, match="more pieces"):
        _core.batch_encode(0, 0, [(TRACK, 0, (0, 0, 0, 0))] * 65)
    with pytest.raises(ValueError, match="more nodes"):
        _core.logic_encode(1, [(ADD, 0, 0, 0, 0)] * 17, [], [], [])


# ---- what comes too late, and what was


def test_a_piece_that_starts_before_the_next_period_changes_its_output() -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.rule(Logic(digital=[TRACK]))
    boards.advance(2_600_000)
    for number in range(40):
        on = number % 2 == 0
        boards.advance(boards.now_us + 10_137)
        host_us = boards.now_us + EPOCH_US
        signals.write(TRACK, [event(host_us + 300, int(on))])
        batch = signals.packets(boards.hosts[0].remote._session.seal, host_us)[-1]
        node.deliver(boards.now_us, batch)  # over no wire: at once
        boards.advance(boards.now_us + 20_000)
        assert shown(node, boards.now_us)[0] is on, number
        late_us = node.flips[-1][0] + 20_000 - boards.now_us - 300
        assert -100 <= late_us <= PERIOD_US + 250  # as the clock has it; polls are that far apart
    assert signals.settled and signals.refused == 0


def shown(node, now_us: int) -> list[bool]:  # type: ignore[no-untyped-def]
    """What its digital outputs are at a time."""
    outputs = [False] * 4
    for time_us, output, on in node.flips:
        if time_us <= now_us:
            outputs[output] = on
    return outputs


def test_an_outage_delays_a_track_and_does_not_end_it() -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.rule(Logic(digital=[TRACK]))
    times = [EPOCH_US + 2_600_000 + 20_000 * i for i in range(150)]
    signals.write(TRACK, [e for t in times for e in (event(t, 1), event(t + 5000, 0))])
    boards.advance(3_000_000)
    boards.cut_hosts(True)
    boards.advance(3_500_000)
    assert not shown(node, boards.now_us)[0]
    boards.cut_hosts(False)
    boards.advance(5_290_000)  # a second of which the clock takes to settle again
    fired = [t for t in rising(boards, 0) if t > EPOCH_US + 4_790_000]
    wanted = [t for t in times if EPOCH_US + 4_790_000 < t < EPOCH_US + 5_290_000]
    assert np.abs(np.array(fired) - wanted).max() <= 200
    boards.advance(5_700_000)
    assert signals.settled and signals.refused == 0
    assert 5 < signals.late < 60  # those of the outage that were not sent ahead, each once
    assert not shown(node, boards.now_us)[0]


def test_outputs_are_off_in_a_new_session() -> None:
    boards = stage(boards=1)
    node, remote = boards.nodes[0], boards.hosts[0].remote
    for digital in ([], [TRACK]):
        remote.signals = Signals()
        remote.signals.rule(Logic(digital=digital, pwm=[TRACK]))
        remote.signals.write(TRACK, [event(boards.now_us + EPOCH_US + 100_000, 20_000)])
        boards.advance(boards.now_us + 200_000)
        assert node.pwm_q15 == [20_000, 0] and shown(node, boards.now_us)[0] is bool(digital)
        remote.signals = Signals()
        remote._session.renew()
        boards.advance(boards.now_us + 2_000_000)
        assert remote.established and node.synced
        assert node.pwm_q15 == [0, 0] and not any(shown(node, boards.now_us))


def test_an_output_is_off_whose_track_has_not_begun() -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.rule(Logic(digital=[TRACK]))
    signals.write(TRACK, [event(EPOCH_US + 2_600_000, 1)])
    boards.advance(2_700_000)
    assert shown(node, boards.now_us)[0]
    signals.rule(Logic(digital=[TRACK + 1]))
    signals.write(TRACK + 1, [event(EPOCH_US + 3_000_000, 1)])
    boards.advance(2_900_000)
    assert signals.settled and not shown(node, boards.now_us)[0]
    boards.advance(3_100_000)
    assert shown(node, boards.now_us)[0]


def test_a_logic_that_was_overtaken_does_not_come_back() -> None:
    boards = stage(boards=1)
    node, remote = boards.nodes[0], boards.hosts[0].remote
    remote.signals.rule(Logic(digital=[TRACK]))
    boards.advance(2_600_000)
    old = remote._session.seal(_core.FRAME_LOGIC, _core.logic_encode(1, [], [TRACK], [], []))
    remote.signals.rule(Logic(digital=[TRACK + 1]))
    boards.advance(2_700_000)
    assert remote.signals.settled
    told = []
    note = remote.signals.note
    remote.signals.note = lambda report: (told.append(report.logic), note(report))  # type: ignore
    node.deliver(boards.now_us, old)
    boards.advance(2_900_000)
    assert set(told) == {2} and len(told) > 40


@pytest.mark.parametrize("back", [False, True])
def test_a_late_servo_is_no_late_output(back: bool) -> None:
    """The main loop hangs for four periods: the board has been told. What a fault or another logic
    ends is not told any longer."""
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.rule(Logic(digital=[TRACK]))
    at_us = EPOCH_US + 2_700_000
    signals.write(TRACK, [event(at_us, 1), event(at_us + 200, 0)])
    boards.advance(2_700_000 - 3 * PERIOD_US)
    if back:
        node.stop_line = True
        boards.advance(boards.now_us + PERIOD_US + 300)
    node.hung = True
    boards.advance(2_700_000 + PERIOD_US // 2)
    node.hung = False
    boards.advance(2_800_000)
    flips = [(t + EPOCH_US - at_us, on) for t, _, on in node.flips]
    if back:
        assert not any(on for _, on in flips)
    else:
        assert [on for _, on in flips] == [True, False]
        assert abs(flips[0][0]) < 100 and abs(flips[1][0] - flips[0][0] - 200) <= 1


@pytest.mark.parametrize("digital", [[], [TRACK + 1], [POSITION]])
def test_another_logic_takes_back_what_was_told_ahead(digital: list[int]) -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    signals.rule(Logic(digital=[TRACK]))
    signals.write(TRACK, [event(EPOCH_US + 2_700_000, 1), event(EPOCH_US + 2_700_100, 0)])
    boards.advance(2_600_000)
    while not node.flips:  # until it is told, five periods ahead
        boards.advance(boards.now_us + PERIOD_US // 4)
    assert boards.now_us < 2_700_000 - 3 * PERIOD_US
    signals.rule(Logic(digital=digital))
    seal = boards.hosts[0].remote._session.seal
    for packet in signals.packets(seal, boards.now_us + EPOCH_US):
        node.deliver(boards.now_us, packet)
    boards.advance(2_800_000)
    assert not any(on for _, _, on in node.flips)


def test_what_is_true_when_logic_comes_is_no_edge() -> None:
    boards = stage(boards=1)
    node, signals = boards.nodes[0], boards.hosts[0].remote.signals
    node.digital_in = 1
    boards.advance(2_600_000)
    edges = [(ON_EDGE, STATE, DIGITAL, 0), (ON_EDGE, STATE, NODE, 0)]
    signals.rule(Logic([(EDGE, DIGITAL, 0, 0, 0)], triggers=edges))
    boards.advance(2_700_000)
    assert signals.settled and not signals.readings
    node.digital_in = 0
    boards.advance(2_720_000)
    node.digital_in = 1
    boards.advance(2_800_000)
    assert sorted(trigger for _, _, trigger in signals.readings) == [0, 1]


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_on_a_good_wire_no_reading_is_lost(loss: float) -> None:
    """More of them than a report holds are on their way, and all are here, once, in order."""
    boards = stage(loss, boards=1)
    signals = boards.hosts[0].remote.signals
    every = [(INTERVAL, STATE, 0, 1)] * 4 if not loss else [(INTERVAL, STATE, 0, 2)]
    signals.rule(Logic(triggers=every))
    boards.advance(3_500_000)
    assert signals.lost == 0
    assert len(signals.readings) > (3800 if not loss else 450)
    steps = np.diff([t for t, _, trigger in signals.readings if trigger == 0])
    assert np.abs(steps - (PERIOD_US if not loss else 2 * PERIOD_US)).max() <= 2
