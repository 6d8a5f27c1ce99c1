"""What a device does in time beside its axis, as the host has it: pieces, logic, readings.

Both ways it is repeated until there is an answer: pieces and logic until a report has them,
readings until a batch says that they were seen. So nothing is lost with a frame, and nothing
happens twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from headway.firmware import _core

Node = tuple[int, int, int, int, int]  # kind, a, b, low, high
Trigger = tuple[int, int, int, int]  # kind, source, condition, every
Feed = tuple[int, int, int, int, int]  # kind, source, number, every, after_us
Fed = tuple[int, int]  # track, number of the feed
Sent = tuple[int, int, tuple[int | None, int, int | None, int]]  # track, number, piece
WRONG = {
    "kind": "is of a kind that there is not",
    "missing": "reads something that is not there, or whose past nobody keeps",
    "cycle": "reads itself, or a node after it",
    "limits": "has its low above its high, no period, a past that no track reaches back to, or the "
    "number or the track of another one",
}


@dataclass(frozen=True)
class Piece:
    """Straight from one value to another, held from its end on [us, the track's quantum]. What is
    None goes on from the piece before: its end, the value at the start."""

    end_us: int
    to: int
    start_us: int | None = None
    start: int | None = None  # first value


def event(time_us: int, value: int) -> Piece:
    """Holds a value from a time on."""
    return Piece(time_us, value, time_us, value)


@dataclass(frozen=True)
class Logic:
    """Nodes, what outputs follow, what is read and when, what other boards are given and which
    tracks come from them. Sources are numbers, see graph.h; a node reads nodes before it."""

    nodes: Sequence[Node] = ()
    digital: Sequence[int] = ()
    pwm: Sequence[int] = ()
    triggers: Sequence[Trigger] = ()
    names: Sequence[str] = ()  # of the nodes, for messages
    feeds: Sequence[Feed] = ()
    fed: Sequence[Fed] = ()

    def check(self) -> None:
        """Raises ValueError, with the node's name, for what a device would refuse."""
        for what, found, most in (
            ("nodes", self.nodes, _core.GRAPH_NODES),
            ("digital outputs", self.digital, _DIGITAL),
            ("PWM outputs", self.pwm, _OUTPUTS - _DIGITAL),
            ("readings", self.triggers, _TRIGGERS),
            ("feeds", self.feeds, _core.LOGIC_FEEDS),
            ("tracks from other boards", self.fed, _core.LOGIC_FEEDS),
        ):
            if len(found) > most:
                raise ValueError(f"{len(found)} {what}: a device has {most}")
        for i, node in enumerate(self.nodes):
            _fits(self.name_of(i), node, (_BYTE, _BYTE, _BYTE, _WORD, _WORD))
        for i, source in enumerate(self.digital):
            _fits(f"output {i}", (source,), (_BYTE,))
        for i, source in enumerate(self.pwm):
            _fits(f"output {_DIGITAL + i}", (source,), (_BYTE,))
        for i, trigger in enumerate(self.triggers):
            _fits(f"reading {i}", trigger, (_BYTE, _BYTE, _BYTE, _HALF))
        for i, feed in enumerate(self.feeds):
            _fits(f"feed {i}", feed, (_BYTE, _BYTE, _HALF, _HALF, _HALF))
        for i, fed in enumerate(self.fed):
            _fits(f"track from another board {i}", fed, (_BYTE, _HALF))
        result, wrong = _core.logic_check(*self._lists())
        if result != "good":
            raise ValueError(f"{self.name_of(wrong)} {WRONG[result]}")

    def payload(self, number: int) -> bytes:
        """Of a LOGIC frame."""
        return _core.logic_encode(number, *self._lists())

    def _lists(self) -> tuple[
        list[Node], list[int], list[int], list[Trigger], list[Feed], list[Fed]
    ]:  # fmt: skip
        given = self.nodes, self.digital, self.pwm, self.triggers, self.feeds, self.fed
        nodes, digital, pwm, triggers, feeds, fed = given
        return list(nodes), list(digital), list(pwm), list(triggers), list(feeds), list(fed)

    def name_of(self, wrong: int) -> str:
        """What a device counts: nodes, then outputs, readings, feeds and tracks that it is fed."""
        if wrong < len(self.nodes):
            return f"node {self.names[wrong] if wrong < len(self.names) else wrong}"
        if wrong < len(self.nodes) + _OUTPUTS:
            return f"output {wrong - len(self.nodes)}"
        wrong -= len(self.nodes) + _OUTPUTS
        for what, found in (("reading", self.triggers), ("feed", self.feeds)):
            if wrong < len(found):
                return f"{what} {wrong}"
            wrong -= len(found)
        return f"track from another board {wrong}"


_DIGITAL, _OUTPUTS, _TRIGGERS = 4, 6, 4  # see board.h (outputs: also PWM) and logic.h
_BYTE, _HALF, _WORD = range(1 << 8), range(1 << 16), range(-(1 << 31), 1 << 31)
_TIME = range(-(1 << 59), (1 << 59) + 1)


def _fits(what: str, numbers: Sequence[int], ranges: Sequence[range]) -> None:
    for number, possible in zip(numbers, ranges, strict=True):
        if number not in possible:
            text = f"from {possible[0]} to {possible[-1]}"
            raise ValueError(f"{what} has {number}, which is not {text}")


@dataclass
class Signals:
    """Of one device. `readings` are all that came: (system time [us], value, trigger)."""

    readings: list[tuple[int, int, int]] = field(default_factory=list)
    lost: int = 0  # readings that the device could not keep
    refused: int = 0  # pieces: what was repeated, too
    late: int = 0  # pieces that came after their start: taken, but not in time
    gaps: int = 0  # in tracks that come from other boards
    refusal: str | None = None  # of the logic that was sent last, by the device
    _pieces: dict[int, list[Piece]] = field(default_factory=dict)
    _next: dict[int, int] = field(default_factory=dict)
    _logic: Logic | None = None
    _number: int = 0
    _answered: int = 0
    _seen: int = 0  # readings before this one are here, or lost
    _apart: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # told beyond a gap
    _heard: bool = False  # since something was sent

    def write(self, track: int, pieces: Sequence[Piece]) -> None:
        """Appends to a track (a source, from _core.SOURCE_OF_PIECES on). Raises ValueError, and
        appends nothing, for what a device would refuse."""
        if track not in range(_core.SOURCE_OF_PIECES, _core.SOURCE_OF_INPUTS):
            known = f"{_core.SOURCE_OF_PIECES} to {_core.SOURCE_OF_INPUTS - 1}"
            raise ValueError(f"there is no track {track} of pieces: give one of {known}")
        if self._logic is not None and track in dict(self._logic.fed):
            raise ValueError(f"track {track} comes from another board: give another one")
        written = self._pieces.get(track, [])
        last = (self._start(written, len(written) - 1), written[-1].end_us) if written else None
        for number, piece in enumerate(pieces, len(written)):
            last = _follow(f"track {track}, piece {number}", piece, last)
        self._pieces.setdefault(track, []).extend(pieces)

    def rule(self, logic: Logic) -> None:
        """The logic from now on. Raises ValueError as Logic.check does, and for a track that is to
        come from another board and has been written here."""
        logic.check()
        for track, _ in logic.fed:
            if track in self._pieces:
                text = "has pieces of the host's, so it cannot come from another board"
                raise ValueError(f"track {track} {text}")
        self._logic = logic
        self._number += 1
        self.refusal = None

    @property
    def settled(self) -> bool:
        """Whether the device has all."""
        return (
            self._answered == self._number
            and self.refusal is None
            and all(self._next.get(track, 0) == len(of) for track, of in self._pieces.items())
        )

    def packets(self, seal: Callable[[int, bytes], bytes], now_us: int) -> list[bytes]:
        """What is to be sent now, sealed."""
        packets = []
        if self._logic is not None and self._answered != self._number:
            packets.append(seal(_core.FRAME_LOGIC, self._logic.payload(self._number)))
        due = self._due(now_us)
        if due or self._heard:
            self._heard = False
            payload = _core.batch_encode(now_us, self._seen, due)
            packets.append(seal(_core.FRAME_SIGNALS, payload))
        return packets

    def _due(self, now_us: int) -> list[Sent]:
        """Pieces that have no answer and for which the device has room."""
        due: list[Sent] = []
        for track, pieces in self._pieces.items():
            for number in range(self._next.get(track, 0), len(pieces)):
                gone = number - _core.PIECES + 1  # has to have begun
                if len(due) == _MOST or (gone >= 0 and self._start(pieces, gone) > now_us):
                    break
                piece = pieces[number]
                due.append((track, number, (piece.start_us, piece.end_us, piece.start, piece.to)))
        return due

    @staticmethod
    def _start(pieces: Sequence[Piece], number: int) -> int:
        start_us = pieces[number].start_us
        return pieces[number - 1].end_us if start_us is None else start_us

    def note(self, report: _core.Report) -> None:
        """Takes what the device has told."""
        self._heard = True
        self._answered = report.logic
        if report.logic == self._number and self._logic is not None:
            good = report.result == "good"
            what = self._logic.name_of(report.wrong)
            self.refusal = None if good else f"{what} {WRONG[report.result]}"
        self.refused, self.late, self.gaps = report.refused, report.late, report.gaps
        for i, number in enumerate(report.next):
            self._next[_core.SOURCE_OF_PIECES + i] = number
        self._apart |= dict(enumerate(report.readings, report.first))
        left = sorted(number for number in self._apart if number >= self._seen)
        for number in left:
            if number > self._seen and number > report.kept:
                break
            self.lost += number - self._seen
            self.readings.append(self._apart[number])
            self._seen = number + 1
        self.lost += max(0, report.kept - self._seen)
        self._seen = max(self._seen, report.kept)
        self._apart = {n: self._apart[n] for n in left if n >= self._seen}


def _follow(what: str, piece: Piece, before: tuple[int, int] | None) -> tuple[int, int]:
    """A piece's start and end [us] after one with these. Raises ValueError."""
    if before is None and (piece.start_us is None or piece.start is None):
        raise ValueError(f"{what} is the first one: give it a start and a first value")
    before_us, end_us = before or (piece.start_us or 0, 0)
    start_us = end_us if piece.start_us is None else piece.start_us
    _fits(what, (start_us, piece.end_us), (_TIME, _TIME))
    _fits(what, (piece.start or 0, piece.to), (_WORD, _WORD))
    if start_us < before_us:
        raise ValueError(f"{what} starts at {start_us}, before the piece before it, {before_us}")
    took_us = piece.end_us - start_us
    if not 0 <= took_us <= _core.PIECE_LONGEST_US:
        longest = _core.PIECE_LONGEST_US
        raise ValueError(f"{what} takes {took_us} us, which is not from 0 to {longest}")
    return start_us, piece.end_us


_MOST = 29  # pieces in a frame of 1000 bytes: 13, and 34 each at most (batch.h)
