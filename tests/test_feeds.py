"""Devices that give each other tracks: real boards, with wires between them that lose packets.

What a track has to be is the encoder's own formula, at the time that the feed says, within what
both clocks may be off and what a straight line of a few milliseconds leaves out. Frames of those
who mean no good are made here, byte by byte.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray
from rig import KEY, PERIOD_US, device_settings

from headway.configs.schema import Channel
from headway.devices.signals import Logic, event
from headway.firmware import _core
from headway.sim.boards import Boards, Cable, Crystal, End, Host
from headway.sim.network import Wire

EPOCH_US = 1_700_000_000_000_000
PEER_KEY = bytes(range(50, 66))
TRACK, OTHER = _core.SOURCE_OF_PIECES, _core.SOURCE_OF_PIECES + 1
NODE = _core.SOURCE_OF_NODES
POSITION = _core.SOURCE_OF_INPUTS
LAG = _core.SOURCE_OF_INPUTS + _core.INPUTS.index("lag")
DIGITAL = _core.SOURCE_OF_INPUTS + _core.INPUTS.index("digital0")
INTERVAL = _core.TRIGGER_KINDS.index("interval")
RAMP, STEP = range(len(_core.FEED_KINDS))
NUMBER, EVERY, AFTER_US = 77, 4, 12_000
SWING, TURN_US = 20_000, 700_000  # counts, and a period of the leader's encoder
BEGIN_US = 2_500_000


def swing(true_us: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the leader's encoder shows."""
    shown: NDArray[np.float64] = SWING * np.sin(2 * np.pi * true_us / TURN_US)
    return shown


@dataclass
class Street:
    """Boards in a row or a ring, each with a host of its own or, but for the first, with none."""

    boards: Boards
    ways: list[Wire]
    # What somebody on the way makes of a board's frame: board, packet -> what arrives instead.
    meddle: Callable[[int, bytes], list[bytes]] = lambda board, packet: [packet]
    seen: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        carry = self.boards.carry

        def meddled(start: End, sent_us: int, frame: bytes) -> None:
            self.seen.append(frame)
            for other in self.meddle(start.board, frame):
                carry(start, sent_us, other)

        self.boards.carry = meddled  # type: ignore[method-assign]

    def signals(self, board: int):  # type: ignore[no-untyped-def]
        return self.boards.hosts[board].remote.signals

    def run(self, us: int) -> None:
        self.boards.advance(self.boards.now_us + us)

    def readings(self, board: int, trigger: int = 0, from_us: int = 0) -> NDArray[np.int64]:
        """True times and values of what a board's host was told."""
        told = [(t - EPOCH_US, v) for t, v, of in self.signals(board).readings if of == trigger]
        return np.array([r for r in told if r[0] >= from_us], dtype=np.int64).reshape(-1, 2)

    def follow(self, **changes: int) -> None:
        """The first gives its encoder, all others have it as their track."""
        feed = {"kind": RAMP, "source": POSITION, "every": EVERY, "after_us": AFTER_US} | changes
        given = (feed["kind"], feed["source"], NUMBER, feed["every"], feed["after_us"])
        self.signals(0).rule(Logic(feeds=[given]))
        for board in self.boards.hosts:
            if board > 0:
                triggers = [(INTERVAL, TRACK, 0, 3), (INTERVAL, LAG, 0, 3)]
                self.signals(board).rule(Logic(triggers=triggers, fed=[(TRACK, NUMBER)]))


def street(
    cables: list[tuple[int, int]] | None = None,
    loss: float = 0.0,
    seed: int = 3,
    keys: dict[int, bytes] | None = None,
) -> Street:
    """Clocks have settled; oscillators differ by 140 ppm."""
    rng = np.random.default_rng(seed)
    cables = [(0, 1)] if cables is None else cables
    count = 1 + max(max(c) for c in cables)
    ports, made = [0] * count, []
    mesh, wire = (
        Channel(delay_us=700, jitter_us=300, loss=loss),
        Channel(delay_us=1000, jitter_us=300),
    )
    for pair in cables:
        for board in pair:
            ports[board] += 1
        ends = [End(board, ports[board]) for board in pair]
        made.append(
            Cable((ends[0], ends[1]), (Wire(mesh, rng.spawn(1)[0]), Wire(mesh, rng.spawn(1)[0])))
        )
    given, hosts, crystals = [], [], []
    for board in range(count):
        settings = device_settings()
        settings.sync.limit_us = 1000
        settings.sync.to_device_least_us = settings.sync.to_host_least_us = 700
        settings.peer_key, settings.ask_us = (keys or {}).get(board, PEER_KEY), 16_000
        settings.neighbours = sum(2 << i for i in range(ports[board]))
        given.append(settings)
        wires = Wire(wire, rng.spawn(1)[0]), Wire(wire, rng.spawn(1)[0])
        hosts.append(Host(board, KEY, wires, EPOCH_US, 100 + board, 4096, rng.spawn(1)[0]))
        crystals.append(Crystal(int(rng.integers(2**32)), (-1) ** board * 70_000, 500, 100_000, 3))
    boards = Boards(given, crystals, made, rng, hosts, poll_us=250)
    boards.encoders[0] = lambda true_us: round(float(swing(np.array([true_us]))[0]))
    boards.advance(BEGIN_US)
    assert all(node.synced for node in boards.nodes)
    return Street(boards, [])


def apart(told: NDArray[np.int64], after_us: int) -> float:
    """From the leader's encoder, so much before."""
    return float(np.abs(told[:, 1] - swing(told[:, 0] - after_us)).max())


SPEED = 2 * np.pi * SWING / TURN_US  # counts per us
BEND = SPEED * 2 * np.pi / TURN_US
LINE = BEND * (EVERY * PERIOD_US) ** 2 / 8  # what a line of this length leaves out


def allowed(boards: Boards) -> float:
    """Two clocks, two roundings of a count and of a microsecond, polls that are late, a line."""
    clocks_us = sum(max(-low, high) / 1000 for low, high in boards.told_ns())
    return LINE + SPEED * (clocks_us + 4) + 2


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_a_track_is_what_another_boards_encoder_was(loss: float) -> None:
    """With loss a piece may be late, and for as long the track stands; what is not, is right."""
    of = street(loss=loss)
    of.follow()
    of.run(100_000)
    begin_us, worst = of.boards.now_us, 0.0
    for _ in range(40):
        of.run(50_000)
        worst = max(worst, allowed(of.boards))
    told, lag = of.readings(1, from_us=begin_us), of.readings(1, 1, from_us=begin_us)
    assert len(told) > 600 and np.ptp(told[:, 1]) > 1.9 * SWING
    signals = of.signals(1)
    assert signals.gaps == 0 and signals.refused == 0
    if not loss:
        assert apart(told, AFTER_US) <= worst and signals.late == 0 and not lag[:, 1].any()
    else:
        off = np.abs(told[:, 1] - swing(told[:, 0] - AFTER_US))
        assert (off <= worst).mean() > 0.95
        # Where it stands it is right of the time up to which all is known: whole milliseconds
        # before, as they were a servo period before.
        assert (off <= worst + SPEED * (1000 * lag[:, 1] + 1000 + PERIOD_US)).all()
        assert 0 < signals.late < 30
    assert all(node.status.frames_bad == 0 for node in of.boards.nodes)


def test_a_step_comes_at_its_moment_and_once() -> None:
    """An edge of the leader's input, on the follower's output: within both clocks and a poll."""
    of = street(loss=0.1)
    of.follow(kind=STEP, source=DIGITAL, every=2, after_us=9000)
    of.signals(1).rule(Logic(digital=[TRACK], fed=[(TRACK, NUMBER)]))
    of.signals(0).rule(Logic(digital=[DIGITAL], feeds=[(STEP, DIGITAL, NUMBER, 2, 9000)]))
    of.run(200_000)
    for number in range(40):
        of.boards.nodes[0].digital_in = number % 2 == 0
        of.run(17_000 + 331 * number)
    of.run(30_000)
    first, second = ([(t, on) for t, _, on in of.boards.nodes[i].flips] for i in (0, 1))
    assert len(first) == 40 and [on for _, on in first] == [on for _, on in second]
    off = np.array([b[0] - a[0] - 9000 for a, b in zip(first, second, strict=True)])
    clocks_us = sum(max(-low, high) / 1000 for low, high in of.boards.told_ns())
    assert np.abs(off).max() <= clocks_us + 3
    assert of.signals(1).gaps == 0


def test_any_device_is_a_producer_for_any_other() -> None:
    """A ring: each gives and takes; and what is not wired comes by way of the one between."""
    of = street([(0, 1), (1, 2), (2, 3), (3, 0)])
    for board in range(4):
        of.boards.nodes[board].digital_in = 1 if board % 2 else 0
        from_board = (board + 1) % 4
        triggers = [(INTERVAL, TRACK, 0, 4), (INTERVAL, OTHER, 0, 4)]
        feeds = [(STEP, DIGITAL, board, 2, 9000), (RAMP, OTHER if board else POSITION, 10 + board,
                                                   EVERY, AFTER_US)]  # fmt: skip
        fed = [(TRACK, from_board)] + ([(OTHER, 9 + board)] if board else [])
        of.signals(board).rule(Logic(triggers=triggers, feeds=feeds, fed=fed))
    of.run(300_000)
    begin_us = of.boards.now_us
    of.run(1_000_000)
    for board in range(4):
        ones = of.readings(board, from_us=begin_us)
        assert len(ones) > 200 and (ones[:, 1] == (board + 1) % 2).all()
        if board:  # each on the way adds its own delay, and a line of lines
            told = of.readings(board, 1, from_us=begin_us)
            assert apart(told, board * AFTER_US) <= board * allowed(of.boards)


def test_a_producer_that_dies_leaves_its_last_value_and_the_lag_tells() -> None:
    of = street()
    of.follow()
    of.run(300_000)
    of.meddle = lambda board, packet: [] if board == 0 else [packet]
    died_us = of.boards.now_us
    of.run(500_000)
    told, lag = of.readings(1, from_us=died_us), of.readings(1, 1, from_us=died_us)
    after = told[told[:, 0] > died_us + AFTER_US + 2000]
    assert len(after) > 100 and len(set(after[:, 1].tolist())) == 1
    until_us = died_us - EVERY * PERIOD_US - 2000  # its last point, at least
    # It is told in whole milliseconds, of the servo period before.
    assert until_us <= lag[-1, 0] - 1000 * lag[-1, 1] - AFTER_US <= died_us + 2 * PERIOD_US + 100
    assert (np.diff(lag[:, 1]) >= 0).all()
    of.meddle = lambda board, packet: [packet]
    of.run(500_000)  # it lives again
    begin_us = of.boards.now_us - 400_000
    assert apart(of.readings(1, from_us=begin_us), AFTER_US) <= allowed(of.boards)
    assert of.signals(1).gaps == 1 and of.signals(1).refused == 0
    assert not of.readings(1, 1, from_us=begin_us)[:, 1].any()


def test_boards_of_another_key_give_nothing() -> None:
    of = street(keys={0: bytes(16)})
    of.follow()
    of.run(500_000)
    told, lag = of.readings(1), of.readings(1, 1)
    assert len(told) > 100 and not told[:, 1].any()
    assert (lag[:, 1] == _core.FEED_UNKNOWN_MS).all()
    assert of.boards.nodes[1].status.frames_bad > 50


def frame(
    points: list[tuple[int, int]], time_us: int, number: int = NUMBER, steps: bool = False,
    lineage: int = 0, key: bytes = PEER_KEY,
) -> bytes:  # fmt: skip
    """A packet, sealed with the boards' key: points are how long before the time, and the value."""
    body = bytes([1, _core.FRAME_FEED])
    body += struct.pack("<HBBIq", number, steps, len(points), lineage, time_us)
    body += b"".join(struct.pack("<Ii", *point) for point in points).ljust(48, b"\0")
    return _core.cobs_encode(body + _core.siphash24(key, 4, body).to_bytes(8, "little"))


@dataclass
class Alone:
    """A board with one wire, on which somebody says what he likes."""

    of: Street

    def say(self, points: list[tuple[int, int]], ahead_us: int = 0, **changes: int) -> bool:
        """Whether it was taken for good; values are read some servo periods later."""
        node, now_us = self.of.boards.nodes[1], self.of.boards.now_us
        bad = node.status.frames_bad
        packet = frame(points, now_us + EPOCH_US + ahead_us, **changes)  # type: ignore[arg-type]
        self.of.boards.arrive(End(1, 1), now_us, packet)
        self.of.run(20_000)
        return node.status.frames_bad == bad

    def value(self) -> int:
        return int(self.of.readings(1)[-1, 1])


@pytest.fixture
def alone() -> Alone:
    of = street()
    of.meddle = lambda board, packet: [packet] if _core.cobs_decode(packet)[1] != 15 else []  # type: ignore[index]
    of.signals(1).rule(Logic(triggers=[(INTERVAL, TRACK, 0, 1)], fed=[(TRACK, NUMBER)]))
    of.run(100_000)
    return Alone(of)


def test_what_is_not_meant_for_a_track_changes_nothing(alone: Alone) -> None:
    assert alone.say([(0, 500)], steps=True) and alone.value() == 500
    assert alone.say([(0, 501)], number=NUMBER + 1, steps=True)  # some other's: no mistake
    assert alone.value() == 500
    assert not alone.say([(0, 502)], steps=True, lineage=9)  # of a time that is not ours
    assert not alone.say([(0, 503)], 100_500, steps=True)  # not about now
    assert not alone.say([(0, 504)], -100_500, steps=True)
    assert not alone.say([(0, 505)], steps=True, key=bytes(16))  # type: ignore[arg-type]
    assert not alone.say([(5, 1), (5, 2)], steps=True)  # not one after the other
    assert alone.value() == 500
    assert alone.say([(0, 506)], steps=True) and alone.value() == 506


def test_a_frame_that_is_played_again_changes_nothing(alone: Alone) -> None:
    now_us = alone.of.boards.now_us + EPOCH_US
    old = frame([(0, 100)], now_us, steps=True)
    alone.of.boards.arrive(End(1, 1), alone.of.boards.now_us, old)
    alone.of.run(20_000)
    assert alone.value() == 100
    assert alone.say([(0, 200)], steps=True) and alone.value() == 200
    for pause_us in (0, 30_000, 500_000):  # fresh still, and not
        alone.of.run(pause_us)
        alone.of.boards.arrive(End(1, 1), alone.of.boards.now_us, old)
        alone.of.run(20_000)
        assert alone.value() == 200
    assert alone.of.boards.nodes[1].status.frames_bad >= 1  # the last one


def test_a_gap_holds_the_value_and_the_track_goes_on_behind_it(alone: Alone) -> None:
    """Not along a line from before the gap to behind it."""
    assert alone.say([(4000, 0), (0, 0)])
    assert alone.say([(24_000, 0), (20_000, 0), (0, 0)])
    assert alone.of.signals(1).gaps in (0, 1)
    before = alone.of.signals(1).gaps
    now_us = alone.of.boards.now_us
    assert alone.say([(4000, 900), (0, 1000)])  # none of those that were known
    alone.of.run(5000)
    assert alone.of.signals(1).gaps == before + 1
    told = alone.of.readings(1, from_us=now_us - 30_000)
    assert set(told[:, 1].tolist()) <= {0, *range(900, 1001)} and alone.value() == 1000


def test_a_hosts_pieces_for_such_a_track_are_refused_on_both_ends(alone: Alone) -> None:
    signals = alone.of.signals(1)
    with pytest.raises(ValueError, match="track 5 comes from another board"):
        signals.write(TRACK, [event(0, 1)])
    signals.write(OTHER, [event(EPOCH_US, 1)])
    with pytest.raises(ValueError, match="track 6 has pieces of the host's"):
        signals.rule(Logic(fed=[(OTHER, NUMBER)]))
    assert alone.say([(0, 500)], steps=True)
    session = alone.of.boards.hosts[1].remote._session
    payload = _core.batch_encode(0, 0, [(TRACK, 1, (EPOCH_US, EPOCH_US, 7, 7))])
    alone.of.boards.nodes[1].deliver(
        alone.of.boards.now_us, session.seal(_core.FRAME_SIGNALS, payload)
    )
    alone.of.run(30_000)
    assert alone.value() == 500 and signals.refused == 1


def test_another_producer_begins_a_track_anew(alone: Alone) -> None:
    assert alone.say([(0, 500)], steps=True) and alone.value() == 500
    triggers = [(INTERVAL, TRACK, 0, 1)]
    alone.of.signals(1).rule(Logic(triggers=triggers, fed=[(TRACK, NUMBER)], digital=[TRACK]))
    alone.of.run(30_000)
    assert alone.value() == 500  # the same one goes on
    alone.of.signals(1).rule(Logic(triggers=triggers, fed=[(TRACK, NUMBER + 1)], digital=[TRACK]))
    alone.of.run(30_000)
    assert alone.value() == 0
    assert alone.say([(0, 600)], steps=True) and alone.value() == 0
    assert alone.say([(0, 700)], number=NUMBER + 1, steps=True) and alone.value() == 700
    assert alone.of.boards.nodes[1].flips[-1][2]  # its output has been told
    alone.of.signals(1).rule(Logic(triggers=triggers))
    alone.of.run(30_000)
    assert alone.value() == 0


def test_what_is_wrong_with_feeds_is_named() -> None:
    good = (RAMP, POSITION, 1, 4, 0)
    for logic, message in (
        (Logic(feeds=[good, (2, POSITION, 2, 4, 0)]), "feed 1 is of a kind that there is not"),
        (Logic(feeds=[(RAMP, 30, 1, 4, 0)]), "feed 0 reads something that is not there"),
        (Logic(feeds=[good, good]), "feed 1 has .* the number or the track of another one"),
        (Logic(feeds=[(RAMP, POSITION, 1, 0, 0)]), "feed 0 has its low .* no period"),
        (Logic(feeds=[good] * 5), "5 feeds: a device has 4"),
        (Logic(feeds=[good], fed=[(TRACK, 1)]), "track from another board 0 reads itself"),
        (Logic(fed=[(TRACK, 1), (TRACK, 2)]), "track from another board 1 has .* the track of"),
        (Logic(fed=[(POSITION, 1)]), "track from another board 0 reads something that is not"),
        (Logic(fed=[(TRACK, 70_000)]), "track from another board 0 has 70000, which is not from 0"),
    ):
        with pytest.raises(ValueError, match=message):
            logic.check()


def queue_packets(of: Street) -> None:
    """Packets for the first board wait until its main loop polls: then one comes with a period."""
    happen = of.boards._happen

    def happens(now_us: int, number: int, board: int, what: int, packet: bytes) -> None:
        if what >= 0 and board == 0:
            of.boards.arrive(End(board, what), now_us, packet)
        else:
            happen(now_us, number, board, what, packet)

    of.boards._happen = happens  # type: ignore[method-assign]


def test_the_first_point_of_a_logic_is_of_its_own_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """The encoder was read by no logic before, and a logic comes between a period and its poll."""
    settings = device_settings

    def often(*given, **more):  # type: ignore[no-untyped-def]
        made = settings(*given, **more)
        made.servo_period_us = 100
        return made

    monkeypatch.setitem(globals(), "device_settings", often)
    of = street()
    queue_packets(of)
    of.boards.encoders[0] = lambda true_us: 1234
    of.run(50_000)
    of.signals(1).rule(Logic(triggers=[(INTERVAL, TRACK, 0, 5)], fed=[(TRACK, NUMBER)]))
    of.run(100_000)
    of.signals(0).rule(Logic(feeds=[(RAMP, POSITION, NUMBER, 40, 12_000)]))
    of.run(200_000)
    values = set(of.readings(1)[:, 1].tolist())
    assert 1234 in values and values <= {0, 1234}


def test_lag_is_unknown_when_the_clock_settles_again() -> None:
    """Meanwhile the producer has died: an output that needs a small lag stays off."""
    of = street()
    of.boards.nodes[0].digital_in = 1
    window, gate = _core.NODE_KINDS.index("window"), _core.NODE_KINDS.index("gate")
    of.signals(0).rule(Logic(feeds=[(STEP, DIGITAL, NUMBER, 2, 9000)]))
    nodes = [(window, LAG, 0, 0, 20), (gate, TRACK, NODE, 0, 0)]
    of.signals(1).rule(Logic(nodes=nodes, digital=[NODE + 1], fed=[(TRACK, NUMBER)]))
    of.run(300_000)
    node, host = of.boards.nodes[1], of.boards.hosts[1]
    assert [on for _, _, on in node.flips][-1]
    packets, host.packets = host.packets, lambda now_us: []  # type: ignore[method-assign]
    of.meddle = lambda board, packet: [packet] if _core.cobs_decode(packet)[1] == 15 else []
    for _ in range(400):
        of.run(10_000)
        if not node.synced:
            break
    assert not node.synced
    of.meddle = lambda board, packet: []
    of.run(1_000_000)
    before = len(node.flips)
    host.packets = packets  # type: ignore[method-assign]
    of.run(5_000_000)
    assert node.synced and not any(on for _, _, on in list(node.flips)[before:])
