"""Boards that ask each other for the time: real nodes, with wires between their ports.

Reference is what the simulation knows: the host's time, or that of the board whose lineage the
others keep. What a board tells of its error is held against it; nothing of the firmware's
arithmetic is repeated.
"""

import heapq
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from rig import KEY, State, device_settings

from headway.firmware import _core
from headway.sim import _board

PEER_KEY = bytes(range(50, 66))
EPOCH_US = 1_700_000_000_000_000
MS, SECOND = 1000, 1_000_000
DAY_US = 86_400 * SECOND
ASK_US = 16_000
LIMIT_US = 5000
DRIFT_PPB = 100_000
PORTS = range(1, 5)
CHAIN = [(0, 1), (1, 2), (2, 3), (3, 4)]
MESH = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)]
REQUEST, RESPONSE = 10, 11  # types of frames
FIELDS = struct.Struct("<BBQqqiiIBQ")  # of a response

End = tuple[int, int]  # a board and its port


def unstuffed(packet: bytes) -> bytes:
    frame = _core.cobs_decode(packet)
    assert frame is not None
    return frame


def sealed(frame: bytes) -> bytes:
    """With the right tag, as a packet."""
    tag = _core.siphash24(PEER_KEY, 4, frame)
    return _core.cobs_encode(frame + tag.to_bytes(8, "little"))


@dataclass
class Village:
    """Boards with wires whose delays are drawn anew for each packet; polled each millisecond."""

    rng: np.random.Generator
    delay_us: tuple[int, int] = (0, 1000)
    now: int = 0
    nodes: list[_board.Node] = field(default_factory=list)
    memory: list[np.ndarray] = field(default_factory=list)
    wires: dict[End, End] = field(default_factory=dict)
    drifts: list[int] = field(default_factory=list)
    flying: list[tuple[int, int, int, int, bytes]] = field(default_factory=list)
    count: int = 0
    # What somebody on the way makes of a packet: sender, packet -> what arrives instead.
    meddle: Callable[[End, bytes], list[bytes]] = lambda end, packet: [packet]
    host: int | None = None
    session: _core.Session | None = None
    echo: tuple[int, int, int] = (0, 0, 0)

    def add(self, count: int, ports: int = 0b11110, **changes: int) -> list[int]:
        """Boards that boot now; their numbers."""
        numbers = []
        for _ in range(count):
            memory = np.zeros(_board.NODE_NUMBERS)
            node = _board.Node(memory)
            node.supply_V, node.random = 24.0, int(self.rng.integers(2**63))
            settings = device_settings()
            settings.neighbours, settings.ask_us, settings.peer_key = ports, ASK_US, PEER_KEY
            sync = settings.sync
            sync.limit_us, sync.among_boards = LIMIT_US, self.host is None
            for name, value in changes.items():
                setattr(sync, name, value)
            settings.sync = sync
            drift = int(self.rng.integers(-DRIFT_PPB, DRIFT_PPB + 1))
            node.flash(settings, int(self.rng.integers(2**32)), drift, 500, 2 * DRIFT_PPB)
            if self.now > 0:
                node.poll(self.now, 0)
                node.restart()
            numbers.append(len(self.nodes))
            self.nodes.append(node)
            self.memory.append(memory)
        return numbers

    def wire(self, a: int, b: int) -> None:
        """Between the lowest ports that are free."""
        ends = []
        for board in (a, b):
            port = next(p for p in PORTS if (board, p) not in self.wires)
            ends.append((board, port))
            self.wires[board, port] = (-1, -1)
        self.wires[ends[0]], self.wires[ends[1]] = ends[1], ends[0]

    def cut(self, a: int, b: int) -> None:
        for end, other in list(self.wires.items()):
            if {end[0], other[0]} == {a, b}:
                del self.wires[end]

    def delay(self) -> int:
        return int(self.rng.integers(self.delay_us[0], self.delay_us[1] + 1))

    def put(self, time_us: int, end: End, packet: bytes) -> None:
        self.count += 1
        heapq.heappush(self.flying, (time_us, self.count, *end, packet))

    def _collect(self, board: int) -> None:
        for port in range(5):
            for time_us, packet in self.nodes[board].collect(port):
                if port == 0:
                    self._to_host(board, time_us, packet)
                elif (board, port) in self.wires:
                    for other in self.meddle((board, port), packet):
                        self.put(time_us + self.delay(), self.wires[board, port], other)

    def poll(self, board: int) -> None:
        self.nodes[board].poll(self.now, 0)
        self._collect(board)

    def run(self, time_us: int) -> Iterator[None]:
        """On by so much; after each millisecond."""
        end_us = self.now + time_us
        while self.now < end_us:
            next_us = self.now + MS
            while self.flying and self.flying[0][0] <= next_us:
                self.now, _, board, port, packet = heapq.heappop(self.flying)
                self.nodes[board].deliver(self.now, packet, port)
                self.poll(board)
            self.now = next_us
            for board in range(len(self.nodes)):
                self.poll(board)
            if self.host is not None and self.now % (4 * MS) == 0:
                self._say()
            yield

    def go(self, time_us: int) -> None:
        for _ in self.run(time_us):
            pass

    def _to_host(self, board: int, left_us: int, packet: bytes) -> None:
        if board != self.host:
            return
        arrived_us = left_us + self.delay()
        if self.session is None:
            self.session = _core.welcome_open(KEY, bytes(16), packet)[2]
            return
        opened = self.session.open(packet)
        if isinstance(opened, tuple) and opened[0] == _core.FRAME_STATUS:
            status = _core.status_decode(opened[1])
            assert status is not None
            self.echo = status.sent_count_us, arrived_us + EPOCH_US, arrived_us

    def _say(self) -> None:
        """The host's SYNC, to the one board that it knows."""
        assert self.host is not None
        if self.session is None:
            self.put(self.now, (self.host, 0), _core.hello(bytes(16)))
            return
        echo = self.echo if self.echo[2] <= self.now else (0, 0, 0)
        sync = _core.sync_encode((echo[0], echo[1], self.now + EPOCH_US))
        self.put(self.now + self.delay(), (self.host, 0), self.session.seal(_core.FRAME_SYNC, sync))

    def times(self) -> list[int]:
        """What each clock shows now."""
        return [node.system_us(self.now) for node in self.nodes]

    def reference_us(self, board: int) -> int:
        """The truth for a board: the host's time, or the clock of whose lineage it keeps."""
        if self.host is not None:
            return self.now + EPOCH_US
        whose = self.nodes[board].lineage
        owner = [n for n in self.nodes if n.lineage == whose and n.error_ns == (0, 0)]
        assert len(owner) == 1
        return owner[0].system_us(self.now)

    def assert_told_truly(self) -> None:
        """What each board knows of its error is right.

        A clock is read at a count that is rounded down, and the reading is, too: what is read of
        the error is up to two microseconds less than it is, or, by the reference's count, one more.
        """
        for board, node in enumerate(self.nodes):
            least, most = node.error_ns
            if max(-least, most) < (1 << 31) - 1:
                error_us = node.system_us(self.now) - self.reference_us(board)
                assert least / 1000 < error_us + 2
                assert error_us - 1 < most / 1000


def village(
    seed: int, links: list[tuple[int, int]], host: int | None = None, **changes: int
) -> Village:
    made = Village(np.random.default_rng(seed), host=host)
    made.add(1 + max(max(link) for link in links), **changes)
    for a, b in links:
        made.wire(a, b)
    return made


def settled(of: Village, boards: list[int] | None = None) -> bool:
    return all(of.nodes[i].synced for i in boards or range(len(of.nodes)))


# ---- they agree


@pytest.mark.parametrize("method", [0, 1], ids=["bounds", "average"])
@pytest.mark.parametrize(
    ("links", "host"),
    [(CHAIN, 0), (MESH, 0), (CHAIN, None), (MESH, None)],
    ids=["chain behind a host", "mesh behind a host", "chain", "mesh"],
)
def test_all_settle_and_keep_within_a_bound(
    links: list[tuple[int, int]], host: int | None, method: int
) -> None:
    """Delays vary by a millisecond each way, oscillators differ by up to 200 ppm.

    The bound is twice what eight seeds had at most.
    """
    apart_us = {0: 120, 1: 800}[method]
    boards = village(1 + method, links, host, method=method)
    for k, _ in enumerate(boards.run(14 * SECOND)):
        if host is not None or k > 300:  # before, lineages change
            boards.assert_told_truly()
        if k >= 3000:
            assert settled(boards)
        if k >= 8000:
            times = boards.times()
            assert max(times) - min(times) <= apart_us
    assert all(node.state == State.IDLE for node in boards.nodes)
    assert len({node.lineage for node in boards.nodes}) == 1
    assert [node.status.frames_bad for node in boards.nodes] == [0] * len(boards.nodes)


@pytest.mark.parametrize("host", [0, None])
@pytest.mark.parametrize("links", [CHAIN, MESH])
@pytest.mark.parametrize("slowest_us", [0, 3])
def test_nothing_is_told_too_well_where_the_wire_is_exact(
    slowest_us: int, links: list[tuple[int, int]], host: int | None
) -> None:
    """No delay at all: each microsecond that is rounded the wrong way contradicts another one."""
    boards = village(7, links, host)
    boards.delay_us = 0, slowest_us
    boards.go(1500 * MS)
    excluded = [node.excluded for node in boards.nodes]
    for _ in boards.run(6 * SECOND):
        boards.assert_told_truly()
    assert [node.excluded for node in boards.nodes] == excluded


def test_the_interval_widens_hop_by_hop() -> None:
    """A neighbour's error is added to what is not known of the wire."""
    boards = village(5, CHAIN, 0)
    boards.delay_us = 300, 1000
    boards.go(8 * SECOND)
    widths = [most - least for least, most in (node.error_ns for node in boards.nodes)]
    assert widths[0] > 590_000
    assert all(b > a + 590_000 for a, b in pairwise(widths))


# ---- whose time it is


def test_the_oldest_wins_among_those_that_are_not_settled() -> None:
    boards = Village(np.random.default_rng(2))
    boards.add(1)
    boards.go(300 * MS)
    boards.add(1)
    boards.go(100 * MS)
    boards.add(1)
    oldest = boards.nodes[0].lineage
    assert len({node.lineage for node in boards.nodes}) > 1
    boards.wire(0, 1)
    boards.wire(1, 2)
    boards.go(3 * SECOND)
    assert settled(boards)
    assert {node.lineage for node in boards.nodes} == {oldest}
    boards.assert_told_truly()


@pytest.mark.parametrize("older", [False, True])
def test_a_newcomer_joins_a_settled_group_whatever_its_counter_says(older: bool) -> None:
    """A board that has just booted; or one that was of an older group, and has lost it."""
    boards = Village(np.random.default_rng(3))
    if older:
        boards.add(1)
        while boards.now < DAY_US:
            boards.now += 1000 * SECOND
            boards.poll(0)
        boards.add(1)
        boards.wire(0, 1)
    group = boards.add(2)
    boards.wire(*group)
    boards.go(3 * SECOND)
    assert settled(boards)
    if older:
        assert boards.nodes[1].system_us(boards.now) > DAY_US
        boards.cut(0, 1)
        boards.go(700 * MS)
    newcomer = 1 if older else boards.add(1)[0]
    assert not boards.nodes[newcomer].synced
    lineage, before = boards.nodes[group[0]].lineage, boards.now
    assert boards.nodes[newcomer].lineage != lineage
    clocks = [boards.nodes[i].system_us(before) for i in group]
    boards.wire(group[1], newcomer)
    for _ in boards.run(6 * SECOND):
        passed = boards.now - before
        for i, clock in zip(group, clocks, strict=True):  # 500 ppm, and its oscillator's
            moved = boards.nodes[i].system_us(boards.now) - clock - passed
            assert abs(moved) <= 1 + passed * 700e-6
            assert boards.nodes[i].lineage == lineage
    assert settled(boards, [*group, newcomer])
    assert boards.nodes[newcomer].lineage == lineage
    times = [boards.nodes[i].system_us(boards.now) for i in (*group, newcomer)]
    assert max(times) - min(times) < 500


def test_groups_that_settled_apart_exclude_each_other() -> None:
    """None steps, none leaves its time: each goes on as it was, and counts."""
    boards = village(4, [(0, 1), (2, 3)])
    boards.go(3 * SECOND)
    assert settled(boards)
    lineages = [node.lineage for node in boards.nodes]
    assert lineages[0] == lineages[1] != lineages[2] == lineages[3]
    boards.wire(1, 2)
    before = boards.times()
    for _ in boards.run(4 * SECOND):
        after = boards.times()
        assert all(abs(b - a - MS) <= 2 for a, b in zip(before, after, strict=True))
        before = after
    assert [node.lineage for node in boards.nodes] == lineages
    assert [node.state for node in boards.nodes] == [State.IDLE] * 4
    followers = [node for node in boards.nodes if node.error_ns != (0, 0)]
    assert len(followers) == 2
    excluded = [node.excluded for node in boards.nodes[1:3] if node in followers]
    assert all(count > 100 for count in excluded)


# ---- lies


def lied(boards: Village, liar: int, change: Callable[[list[int]], None]) -> None:
    """From now on all that a board answers is changed, and sealed anew: it has the key."""

    def meddle(end: End, packet: bytes) -> list[bytes]:
        frame = unstuffed(packet)
        if end[0] != liar or frame[1] != RESPONSE:
            return [packet]
        fields = list(FIELDS.unpack(frame))
        change(fields)
        return [sealed(FIELDS.pack(*fields)[:-8])]

    boards.meddle = meddle


@pytest.mark.parametrize("host", [0, None])
def test_a_neighbour_that_claims_a_day_more_is_excluded(host: int | None) -> None:
    boards = village(6, [(0, 1), (1, 2), (2, 0)], host)
    boards.go(5 * SECOND)
    assert settled(boards)
    counts = [node.excluded for node in boards.nodes]
    liar = 2 if host is not None or boards.nodes[2].error_ns != (0, 0) else 1

    def change(fields: list[int]) -> None:
        fields[3] += DAY_US
        fields[4] += DAY_US

    lied(boards, liar, change)
    before = boards.times()
    for _ in boards.run(2 * SECOND):
        after = boards.times()
        assert all(abs(b - a - MS) <= 2 for a, b in zip(before, after, strict=True))
        before = after
        boards.assert_told_truly()
    assert settled(boards)
    deceived = [node for i, node in enumerate(boards.nodes) if i != liar]
    for node, count in zip(deceived, [c for i, c in enumerate(counts) if i != liar], strict=True):
        assert node.error_ns == (0, 0) or node.excluded > count + 50


@pytest.mark.parametrize("far_us", [(1 << 60) + 1, -(1 << 60) - 1, (1 << 63) - 1, -(1 << 63)])
def test_times_beyond_all_bounds_are_no_response(far_us: int) -> None:
    boards = village(7, [(0, 1)])
    boards.go(3 * SECOND)
    liar = 0 if boards.nodes[0].error_ns == (0, 0) else 1

    def change(fields: list[int]) -> None:
        fields[3] = far_us

    lied(boards, liar, change)
    bad, excluded = (
        boards.nodes[1 - liar].status.frames_bad,
        boards.nodes[1 - liar].excluded,
    )
    boards.go(300 * MS)
    assert boards.nodes[1 - liar].status.frames_bad > bad + 10
    assert boards.nodes[1 - liar].excluded == excluded


@dataclass
class Tap:
    """Keeps what passes, and may hold it back."""

    seen: list[tuple[End, bytes]] = field(default_factory=list)
    holds: bool = False

    def __call__(self, end: End, packet: bytes) -> list[bytes]:
        self.seen.append((end, packet))
        return [] if self.holds else [packet]

    def responses(self, to: End, boards: Village) -> list[bytes]:
        return [
            packet
            for end, packet in self.seen
            if boards.wires[end] == to and unstuffed(packet)[1] == RESPONSE
        ]


def test_what_is_forged_replayed_or_late_is_not_taken() -> None:
    """Each is counted, and changes nothing of what is known."""
    boards = village(8, [(0, 1)], 0)
    tap = Tap()
    boards.meddle = tap
    boards.go(5 * SECOND)
    node, end = boards.nodes[1], (1, 1)
    answers = tap.responses(end, boards)
    assert len(answers) > 100 and node.status.frames_bad == 0
    forged = bytearray(unstuffed(answers[-1]))
    forged[20] ^= 1
    other_key = unstuffed(answers[-1])[:-8]
    tag = _core.siphash24(bytes(16), 4, other_key).to_bytes(8, "little")
    tap.holds = True  # the last question stays open
    boards.go(100 * MS)
    asked = [
        unstuffed(packet)[2:10]
        for sender, packet in tap.seen
        if sender == end and unstuffed(packet)[1] == REQUEST
    ]
    fields = list(FIELDS.unpack(unstuffed(answers[-1])))
    assert fields[2] != int.from_bytes(asked[-1], "little")
    old = []  # answers under the right key, to questions that are not the last one
    for nonce in (asked[-2], asked[0], bytes(8)):
        fields[2] = int.from_bytes(nonce, "little")
        old.append(sealed(FIELDS.pack(*fields)[:-8]))
    bad = [
        _core.cobs_encode(bytes(forged)), _core.cobs_encode(other_key + tag), answers[-1],
        answers[0], *old, _core.cobs_encode(b"\1"), _core.cobs_encode(b""),
    ]  # fmt: skip
    for k, packet in enumerate(bad):
        before = node.error_ns, node.excluded
        node.deliver(boards.now, packet, 1)
        node.poll(boards.now, 0)
        assert node.status.frames_bad == k + 1
        assert (node.error_ns, node.excluded) == before
    # the answer to the last question counts, once
    for delivery, counted in ((1, 0), (2, 1)):
        fields[2] = int.from_bytes(asked[-1], "little")
        node.deliver(boards.now, sealed(FIELDS.pack(*fields)[:-8]), 1)
        node.poll(boards.now, 0)
        assert node.status.frames_bad == len(bad) + counted, delivery


def test_who_is_no_neighbour_gets_no_answer() -> None:
    """A port that the settings do not name, the host's above all, and a wrong key."""
    boards = Village(np.random.default_rng(9))
    boards.add(1, ports=0b10)
    boards.go(100 * MS)
    node = boards.nodes[0]
    request = sealed(bytes([1, REQUEST]) + bytes(8))
    wrong = _core.cobs_encode(unstuffed(request)[:-1] + b"\0")
    for k, (port, packet, answers) in enumerate(
        [(1, request, 1), (1, wrong, 0), (2, request, 0), (0, request, 0), (1, request, 1)]
    ):
        boards.now += 100
        node.deliver(boards.now, packet, port)
        node.poll(boards.now, 0)
        sent = [node.collect(p) for p in range(5)]
        frames = [[unstuffed(p)[1] for _, p in of] for of in sent]
        assert [of.count(RESPONSE) for of in frames] == [answers * (p == port) for p in range(5)], k
    assert node.status.frames_bad == 3


@pytest.mark.parametrize("steps", [False, True])
def test_what_was_asked_before_a_step_gets_no_answer(steps: bool) -> None:
    """It arrived by another time than the answer would tell: that it came from is not known any
    more. The step here: the board joins a settled group."""
    boards = Village(np.random.default_rng(11))
    boards.add(1)
    node = boards.nodes[0]
    settings = node.settings
    settings.key, settings.peer_key, settings.dither_us = KEY, PEER_KEY, 60_000
    node.flash(settings)
    seen = []
    for k in range(200):
        boards.now += MS
        if k == 60:  # asked, and not answered at once
            request = sealed(bytes([1, REQUEST]) + bytes(8))
            node.deliver(boards.now, request, 1)
        node.poll(boards.now, 0)
        for _, packet in node.collect(1):
            frame = unstuffed(packet)
            seen.append((k, frame[1]))
            if frame[1] == REQUEST:
                nonce = int.from_bytes(frame[2:10], "little")
                asked = boards.now
        if k == 60 and steps:
            fields = [1, RESPONSE, nonce, DAY_US + asked, DAY_US + asked, 0, 0, 77, 1, 0]
            node.deliver(boards.now, sealed(FIELDS.pack(*fields)[:-8]), 1)
            node.poll(boards.now, 0)
            assert node.lineage == 77
    answers = [k for k, kind in seen if kind == RESPONSE]
    assert len(answers) == (0 if steps else 1) and all(k > 61 for k in answers)


def test_questions_do_not_keep_step() -> None:
    """Pauses vary by a quarter around what is asked for, and fill it evenly."""
    boards = village(10, [(0, 1)])
    tap = Tap()
    asked: list[int] = []

    def meddle(end: End, packet: bytes) -> list[bytes]:
        if end[0] == 0 and unstuffed(packet)[1] == REQUEST:
            asked.append(boards.now)
        return tap(end, packet)

    boards.meddle = meddle
    boards.go(8 * SECOND)
    pauses = np.diff(asked)
    assert pauses.min() >= ASK_US * 3 // 4 - MS and pauses.max() <= ASK_US * 5 // 4 + 2 * MS
    assert abs(pauses.mean() - ASK_US - MS / 2) < MS
    counts = np.histogram(pauses, bins=4, range=(ASK_US * 3 / 4, ASK_US * 5 / 4))[0]
    assert counts.min() > len(pauses) / 8
