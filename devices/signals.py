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
Sent = tuple[int, int, tuple[int | None, int, int | None, int]]  # track, number, piece
WRONG = {
    "kind": "is of a kind that there is not",
    "missing": "reads something that is not there",
    "cycle": "reads itself, or a node after it",
    "limits": "has its low above its high, or no period",
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
    """Nodes, what outputs follow, what is read and when. Sources are numbers, see graph.h; a node
    reads nodes before it."""

    nodes: Sequence[Node] = ()
    digital: Sequence[int] = ()
    pwm: Sequence[int] = ()
    triggers: Sequence[Trigger] = ()
    names: Sequence[str] = ()  # of the nodes, for messages

    def check(self) -> None:
        """Raises ValueError, with the node's name, for what a device would refuse."""
        result, wrong = _core.logic_check(
            list(self.nodes), list(self.digital), list(self.pwm), list(self.triggers)
        )
        if result == "good":
            return
        if wrong < len(self.nodes):
            what = f"node {self.names[wrong] if wrong < len(self.names) else wrong}"
        elif wrong < len(self.nodes) + _OUTPUTS:
            what = f"output {wrong - len(self.nodes)}"
        else:
            what = f"reading {wrong - len(self.nodes) - _OUTPUTS}"
        raise ValueError(f"{what} {WRONG[result]}")


_OUTPUTS = 6  # digital and PWM, see board.h


@dataclass
class Signals:
    """Of one device. `readings` are all that came: (system time [us], value, trigger)."""

    readings: list[tuple[int, int, int]] = field(default_factory=list)
    lost: int = 0  # readings that the device could not keep
    refused: int = 0  # pieces
    _pieces: dict[int, list[Piece]] = field(default_factory=dict)
    _next: dict[int, int] = field(default_factory=dict)
    _logic: Logic | None = None
    _number: int = 0
    _answered: int = 0
    _seen: int = 0
    _heard: bool = False  # since something was sent

    def write(self, track: int, pieces: Sequence[Piece]) -> None:
        """Appends to a track (a source, from _core.SOURCE_OF_PIECES on)."""
        self._pieces.setdefault(track, []).extend(pieces)

    def rule(self, logic: Logic) -> None:
        """The logic from now on. Raises ValueError as Logic.check does."""
        logic.check()
        self._logic = logic
        self._number += 1

    @property
    def settled(self) -> bool:
        """Whether the device has all."""
        return self._answered == self._number and all(
            self._next.get(track, 0) == len(pieces) for track, pieces in self._pieces.items()
        )

    def packets(self, seal: Callable[[int, bytes], bytes], now_us: int) -> list[bytes]:
        """What is to be sent now, sealed."""
        packets = []
        if self._logic is not None and self._answered != self._number:
            logic = self._logic
            payload = _core.logic_encode(
                self._number,
                list(logic.nodes),
                list(logic.digital),
                list(logic.pwm),
                list(logic.triggers),
            )
            packets.append(seal(_core.FRAME_LOGIC, payload))
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
        self._answered = max(self._answered, report.logic)
        self.lost, self.refused = report.lost, report.refused
        for i, number in enumerate(report.next):
            self._next[_core.SOURCE_OF_PIECES + i] = number
        fresh = report.readings[max(0, self._seen - report.first) :]
        self.readings += fresh
        self._seen = max(self._seen, report.first + len(report.readings))


_MOST = 40  # pieces in a frame
